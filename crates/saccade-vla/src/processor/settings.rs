//! How a processor prepares frames and words: by version, by path, and by the options that checkpoints carry.

use super::options::{MAX_AREA, MAX_SIDE, Options};
use crate::error::Result;
use crate::release::{self, Preprocessing, ProcessorRules, Version, ViewRules, Wording};

/// What a [`Processor`](super::Processor) is made with, besides a version and a tokenizer. None and false
/// leave it to the released processor.
#[derive(Clone, Copy, Debug, Default)]
pub struct ProcessorOptions<'a> {
    /// Whose frames and words. By default lerobot's for N1.5, and Isaac-GR00T's for the versions after it.
    pub preprocessing: Option<Preprocessing>,
    /// Height and width of a view, where all have one size.
    pub image_size: Option<usize>,
    /// Image tokens of a view, where all have one size.
    pub tokens_per_view: Option<usize>,
    /// Whether the instruction stands in the prompt as it is, and not as a list of one string.
    pub plain_text: bool,
    /// Keys of the released `processor_config.json` and `preprocessor_config.json`, as a JSON object.
    pub options: Option<&'a str>,
}

/// Everything that is decided before the first frame.
pub(super) struct Settings {
    pub version: Version,
    pub rules: &'static ProcessorRules,
    pub preprocessing: Preprocessing,
    pub plain_text: bool,
    pub formalize_language: bool,
    pub sizes: Sizes,
}

/// How large a view becomes.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Sizes {
    /// `size x size`, whatever the frame was.
    Square {
        size: usize,
        tokens: usize,
        /// Isaac-GR00T's centre crop.
        crop: f64,
    },
    /// As large as the frame makes it.
    Flexible(Flexible),
}

/// Views as large as the frame makes them.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Flexible {
    pub rules: &'static release::Flexible,
    /// Black bars make a square of a frame, before anything else.
    pub letter_box: bool,
    pub geometry: Geometry,
    /// The least and the greatest area of a view.
    pub min_pixels: usize,
    pub max_pixels: usize,
}

/// What becomes of a frame before it is fitted to patches.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Geometry {
    /// Nothing.
    Untouched,
    /// With `use_albumentations`: the shorter side to `edge` by area, the centre of `fraction`, the shorter
    /// side to `edge` again.
    Area { edge: usize, fraction: f64 },
    /// Isaac-GR00T's without `use_albumentations`: linear to `target`, the centre of the size `crop`, linear
    /// to `target` again.
    Linear { target: [usize; 2], crop: [usize; 2] },
    /// lerobot's without `use_albumentations`: cubic to a square of `edge`, the centre of `fraction`, cubic
    /// to `target`.
    Cubic {
        edge: usize,
        fraction: f64,
        target: [usize; 2],
    },
}

/// The centre that the published checkpoints keep.
const CROP_FRACTION: f64 = 0.95;

/// The shorter side of a frame of the published checkpoints.
const EDGE: usize = 256;

/// What lerobot writes for a checkpoint that says nothing.
pub(super) const LEROBOT_TARGET: [usize; 2] = [256, 256];
pub(super) const LEROBOT_CROP: [usize; 2] = [230, 230];

impl Settings {
    /// The settings of a version.
    ///
    /// # Errors
    /// [`Error::Input`] for an option that is unknown, of the wrong type, or of another version; all are
    /// listed.
    pub(super) fn new(
        version: Version,
        rules: &'static ProcessorRules,
        given: &ProcessorOptions<'_>,
    ) -> Result<Self> {
        let preprocessing = given.preprocessing.unwrap_or(rules.default_preprocessing);
        let mut options = Options::parse(given.options)?;
        if version.release().lerobot.is_none() && preprocessing == Preprocessing::Lerobot {
            options.problem(format!(
                "preprocessing: expected \"isaac\": lerobot has no {version}"
            ));
        }
        let is_formalized = rules.prompt.wording == Wording::Formalized;
        let formalize_language = options.flag("formalize_language", is_formalized);
        let sizes = match &rules.views {
            ViewRules::Square { size, patch_size } => {
                options.refuse_flexible_geometry(version);
                square([*size, *patch_size], preprocessing, given, &mut options)
            }
            ViewRules::Flexible(views) => {
                refuse_sizes(version, given, &mut options);
                flexible(views, preprocessing, &mut options)
            }
        };
        options.check_released_values(&rules.views);
        options.finish()?;
        Ok(Self {
            version,
            rules,
            preprocessing,
            plain_text: given.plain_text,
            formalize_language,
            sizes,
        })
    }
}

fn square(
    [image_size, patch_size]: [usize; 2],
    preprocessing: Preprocessing,
    given: &ProcessorOptions<'_>,
    options: &mut Options,
) -> Sizes {
    let of_file = options.square_size();
    let size = given.image_size.or(of_file).unwrap_or(image_size);
    let of_file = options.count("tokens_per_tile", MAX_AREA);
    let published = (size / patch_size).pow(2);
    // The file of a published processor does not know of a smaller image.
    let of_file = of_file.filter(|_| given.image_size.is_none());
    let tokens = given.tokens_per_view.or(of_file).unwrap_or(published);
    for (name, value) in [("image_size", size), ("tokens_per_view", tokens)] {
        if value == 0 || (name == "image_size" && value > MAX_SIDE) {
            options.problem(format!("{name}: expected 1 to {MAX_SIDE}, got {value}"));
        }
    }
    let crop = options
        .fraction("crop_fraction", Some(CROP_FRACTION))
        .unwrap_or(1.0);
    if preprocessing == Preprocessing::Lerobot && options.names("crop_fraction") && crop < 1.0 {
        options.differs("crop_fraction", "none: lerobot's N1.5 crops nothing");
    }
    Sizes::Square { size, tokens, crop }
}

/// Lists the sizes of views that are given where the frame makes them.
fn refuse_sizes(version: Version, given: &ProcessorOptions<'_>, options: &mut Options) {
    for (name, value) in [
        ("image_size", given.image_size),
        ("tokens_per_view", given.tokens_per_view),
    ] {
        if let Some(value) = value {
            options.problem(format!(
                "{name}: expected none for {version}, whose views are as large as the frame and the options make them, got {value}"
            ));
        }
    }
}

fn flexible(rules: &'static release::Flexible, preprocessing: Preprocessing, options: &mut Options) -> Sizes {
    let (letter_box, geometry) = match preprocessing {
        Preprocessing::Isaac => isaac_geometry(rules, options),
        Preprocessing::Lerobot => lerobot_geometry(options),
    };
    let (min_pixels, max_pixels) = options.pixel_limits(rules.areas);
    Sizes::Flexible(Flexible {
        rules,
        letter_box,
        geometry,
        min_pixels,
        max_pixels,
    })
}

/// Whether Isaac-GR00T adds black bars, and what it does then.
///
/// Every file of a released processor says `use_albumentations`. With it, a key that is missing has the
/// default of the released constructor. Options without it are no file, and complete those of the published
/// checkpoints.
fn isaac_geometry(rules: &release::Flexible, options: &mut Options) -> (bool, Geometry) {
    let is_file = options.names("use_albumentations");
    let letter_box = options.flag("letter_box_transform", is_file && rules.file_has_bars);
    let edge = if is_file { rules.file_edge } else { EDGE };
    let edge = options.side("shortest_image_edge", Some(edge));
    let fraction = options.number("crop_fraction", Some(CROP_FRACTION));
    let target = options.sides("image_target_size", None);
    let crop = options.sides("image_crop_size", None);
    if !options.flag("use_albumentations", true) {
        let (Some(target), Some(crop)) = (target, crop) else {
            for (key, size) in [("image_target_size", target), ("image_crop_size", crop)] {
                if size.is_none() {
                    options.missing(key, "a height and a width, since use_albumentations is false");
                }
            }
            return (letter_box, Geometry::Untouched);
        };
        return (letter_box, Geometry::Linear { target, crop });
    }
    // Only the heights count, and each option falls back for itself.
    let fraction = match (fraction, crop, target) {
        (Some(_), _, _) => options.fraction("crop_fraction", Some(CROP_FRACTION)),
        (None, Some([crop, _]), Some([target, _])) if crop > target => {
            options.differs(
                "image_crop_size",
                "a height up to that of image_target_size, since crop_fraction is null",
            );
            None
        }
        (None, Some([crop, _]), Some([target, _])) => Some(crop as f64 / target as f64),
        (None, _, _) => {
            options.missing(
                "crop_fraction",
                "a number, or image_crop_size and image_target_size in its place",
            );
            None
        }
    };
    let fraction = fraction.unwrap_or(1.0);
    match edge.or(target.map(|[height, _]| height)) {
        Some(edge) => (letter_box, Geometry::Area { edge, fraction }),
        // Frames that the caller has prepared.
        None if !is_file && fraction == 1.0 => (letter_box, Geometry::Untouched),
        None => {
            options.missing(
                "shortest_image_edge",
                "a whole number, or image_target_size in its place",
            );
            (letter_box, Geometry::Untouched)
        }
    }
}

/// The same of lerobot. What is missing is as lerobot writes it for a checkpoint that says nothing.
fn lerobot_geometry(options: &mut Options) -> (bool, Geometry) {
    let letter_box = options.flag("letter_box_transform", false);
    let use_albumentations = options.flag("use_albumentations", false);
    let edge = options.side("shortest_image_edge", None);
    let fraction = options.number("crop_fraction", None);
    let target = options.sides("image_target_size", Some(LEROBOT_TARGET));
    let crop = options.sides("image_crop_size", Some(LEROBOT_CROP));
    // Without a target lerobot does nothing at all.
    let Some(target) = target else {
        return (false, Geometry::Untouched);
    };
    let edge = edge.unwrap_or(target[0]);
    let of_sizes = crop.map(|[height, _]| height as f64 / target[0] as f64);
    let fraction = fraction
        .or(of_sizes)
        .filter(|fraction| *fraction > 0.0 && *fraction < 1.0)
        .unwrap_or(1.0);
    let geometry = match use_albumentations {
        true => Geometry::Area { edge, fraction },
        false => Geometry::Cubic {
            edge,
            fraction,
            target,
        },
    };
    (letter_box, geometry)
}
