//! How a processor prepares frames and words: by version, by path, and by the options that checkpoints carry.

use serde_json::Value;

use crate::config::{Object, Version};
use crate::error::{Error, Result};

/// Whose code a checkpoint was trained behind: it decides how frames are resized and in which order views stand.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Preprocessing {
    /// lerobot's: views sorted by name.
    Lerobot,
    /// Isaac-GR00T's: views in the order given.
    Isaac,
}

impl Preprocessing {
    /// `lerobot` or `isaac`.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Lerobot => "lerobot",
            Self::Isaac => "isaac",
        }
    }

    /// The one that goes by this name.
    ///
    /// # Errors
    /// [`Error::Input`] if there is none.
    pub fn named(name: &str) -> Result<Self> {
        [Self::Lerobot, Self::Isaac]
            .into_iter()
            .find(|one| one.name() == name)
            .ok_or_else(|| {
                Error::Input(format!(
                    "preprocessing: expected \"lerobot\" or \"isaac\", got {name:?}"
                ))
            })
    }
}

/// What a [`Processor`](super::Processor) is made with, besides a version and a tokenizer. None and false leave it to the released processor.
#[derive(Clone, Copy, Debug, Default)]
pub struct ProcessorOptions<'a> {
    /// Whose frames and words. By default lerobot's for N1.5, and Isaac-GR00T's for the versions after it.
    pub preprocessing: Option<Preprocessing>,
    /// Height and width of N1.5's views.
    pub image_size: Option<usize>,
    /// Image tokens of one of N1.5's views.
    pub tokens_per_view: Option<usize>,
    /// Whether N1.5's instruction stands in the prompt as it is, and not as a list of one string.
    pub plain_text: bool,
    /// Keys of the released `processor_config.json` and `preprocessor_config.json`, as a JSON object.
    pub options: Option<&'a str>,
}

/// Everything that is decided before the first frame.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Settings {
    pub version: Version,
    pub preprocessing: Preprocessing,
    pub plain_text: bool,
    pub formalize_language: bool,
    pub sizes: Sizes,
}

/// How large a view becomes.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Sizes {
    /// N1.5: `size x size`, whatever it was.
    Square {
        size: usize,
        tokens: usize,
        /// Isaac-GR00T's centre crop.
        crop: f64,
    },
    /// N1.6 and N1.7: as large as the frame makes it.
    Flexible(Flexible),
}

/// The geometry of N1.6 and N1.7, in the words of `processor_config.json`.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Flexible {
    pub use_albumentations: bool,
    pub letter_box: bool,
    pub shortest_edge: Option<usize>,
    pub crop_fraction: Option<f64>,
    pub crop_size: Option<[usize; 2]>,
    pub target_size: Option<[usize; 2]>,
    pub min_pixels: usize,
    pub max_pixels: usize,
}

/// Sizes of the published N1.5.
pub(super) const IMAGE_SIZE: usize = 224;
pub(super) const PATCH_SIZE: usize = 14;

/// The centre that the published checkpoints keep.
const CROP_FRACTION: f64 = 0.95;

/// Larger sides, and larger areas, are hostile: the greatest area that is published is this one.
const MAX_SIDE: usize = 1 << 12;
pub(super) const MAX_AREA: usize = MAX_SIDE * MAX_SIDE;

/// Keys of the released files that say nothing about one observation at inference.
const WITHOUT_EFFECT: [&str; 48] = [
    "apply_sincos_state_encoding",
    "auto_map",
    "chat_template",
    "clip_outliers",
    "color_jitter_params",
    "crop_size",
    "data_format",
    "default_to_square",
    "device",
    "disable_grouping",
    "do_center_crop",
    "do_convert_rgb",
    "do_pad",
    "embodiment_id_mapping",
    "exclude_state",
    "extra_augmentation_config",
    "image_end_token",
    "image_placeholder",
    "image_processor_type",
    "image_start_token",
    "image_token",
    "input_data_format",
    "max_action_dim",
    "max_action_horizon",
    "max_dynamic_tiles",
    "max_state_dim",
    "min_dynamic_tiles",
    "modality_configs",
    "model_name",
    "model_type",
    "pad_during_tiling",
    "pad_size",
    "processor_class",
    "random_rotation_angle",
    "return_tensors",
    "state_dropout_prob",
    "statistics",
    "tactile_embed_dim",
    "tactile_input_shape",
    "tactile_state_keys",
    "transformers_loading_kwargs",
    "use_mean_std",
    "use_percentiles",
    "use_relative_action",
    "use_thumbnail",
    "video_placeholder",
    "video_token",
    "vision_feature_select_strategy",
];

/// Keys that are read.
const WITH_EFFECT: [&str; 22] = [
    "crop_fraction",
    "do_normalize",
    "do_rescale",
    "do_resize",
    "formalize_language",
    "image_crop_size",
    "image_mean",
    "image_std",
    "image_target_size",
    "letter_box_transform",
    "max_pixels",
    "merge_size",
    "min_pixels",
    "patch_size",
    "resample",
    "rescale_factor",
    "shortest_image_edge",
    "size",
    "temporal_patch_size",
    "tokens_per_tile",
    "use_albumentations",
    "use_tactile",
];

/// Whether a key of a released file has an effect on a version.
pub(super) fn is_read(version: Version, key: &str) -> bool {
    WITH_EFFECT.contains(&key) && (version != Version::N15 || key == "formalize_language")
}

impl Settings {
    /// The settings of a version.
    ///
    /// # Errors
    /// [`Error::Input`] for an option that is unknown, of the wrong type, or of another version; all are listed.
    pub(super) fn new(version: Version, given: &ProcessorOptions<'_>) -> Result<Self> {
        let preprocessing = given.preprocessing.unwrap_or(match version {
            Version::N15 => Preprocessing::Lerobot,
            _ => Preprocessing::Isaac,
        });
        let mut options = Options::parse(given.options)?;
        if version == Version::N16 && preprocessing == Preprocessing::Lerobot {
            options.problem("preprocessing: expected \"isaac\": lerobot has no N1.6".to_owned());
        }
        let formalize_language = options.flag("formalize_language", version != Version::N15);
        let sizes = match version {
            Version::N15 => square(given, &mut options),
            _ => flexible(version, given, &mut options),
        };
        options.check_released_values(version);
        options.finish()?;
        Ok(Self {
            version,
            preprocessing,
            plain_text: given.plain_text,
            formalize_language,
            sizes,
        })
    }
}

fn square(given: &ProcessorOptions<'_>, options: &mut Options) -> Sizes {
    let of_file = options.square_size();
    let size = given.image_size.or(of_file).unwrap_or(IMAGE_SIZE);
    let of_file = options.count("tokens_per_tile", MAX_AREA);
    let published = (size / PATCH_SIZE).pow(2);
    // The file of a published processor does not know of a smaller image.
    let of_file = of_file.filter(|_| given.image_size.is_none());
    let tokens = given.tokens_per_view.or(of_file).unwrap_or(published);
    for (name, value) in [("image_size", size), ("tokens_per_view", tokens)] {
        if value == 0 || (name == "image_size" && value > MAX_SIDE) {
            options.problem(format!("{name}: expected 1 to {MAX_SIDE}, got {value}"));
        }
    }
    Sizes::Square {
        size,
        tokens,
        crop: options
            .fraction("crop_fraction", Some(CROP_FRACTION))
            .unwrap_or(1.0),
    }
}

fn flexible(version: Version, given: &ProcessorOptions<'_>, options: &mut Options) -> Sizes {
    for (name, value) in [
        ("image_size", given.image_size),
        ("tokens_per_view", given.tokens_per_view),
    ] {
        if let Some(value) = value {
            options.problem(format!(
                "{name}: expected none for {}, whose views are as large as the frame and the options make them, got {value}",
                version.title()
            ));
        }
    }
    // Sizes in pixels alone mean that the edge and the fraction are not there, as in lerobot's reading of such a file.
    let has_target = options.has("image_target_size");
    let has_crop = options.has("image_crop_size");
    let (min_pixels, max_pixels) = options.pixel_limits(version);
    Sizes::Flexible(Flexible {
        use_albumentations: options.flag("use_albumentations", true),
        letter_box: options.flag("letter_box_transform", false),
        shortest_edge: options.side("shortest_image_edge", (!has_target).then_some(256)),
        crop_fraction: options.fraction("crop_fraction", (!has_crop).then_some(CROP_FRACTION)),
        crop_size: options.sides("image_crop_size", Some([230, 230])),
        target_size: options.sides("image_target_size", Some([256, 256])),
        min_pixels,
        max_pixels,
    })
}

/// The keys of a file, and what is wrong with them.
struct Options {
    keys: Object,
    problems: Vec<String>,
}

impl Options {
    fn parse(text: Option<&str>) -> Result<Self> {
        let mut keys = match text.map(serde_json::from_str).transpose() {
            Ok(None) => Object::new(),
            Ok(Some(Value::Object(keys))) => keys,
            Ok(Some(_)) => return Err(Error::Input("options: expected a JSON object".to_owned())),
            Err(source) => {
                return Err(Error::Json {
                    what: "options".to_owned(),
                    source,
                });
            }
        };
        let mut problems = Vec::new();
        match keys.remove("processor_kwargs") {
            None => {}
            Some(Value::Object(nested)) => keys.extend(nested),
            Some(other) => problems.push(format!("processor_kwargs: expected an object, got {other}")),
        }
        for key in keys.keys() {
            if !WITH_EFFECT.contains(&key.as_str()) && !WITHOUT_EFFECT.contains(&key.as_str()) {
                problems.push(format!(
                    "{key}: expected a key of the released files, such as {}",
                    WITH_EFFECT.join(", ")
                ));
            }
        }
        Ok(Self { keys, problems })
    }

    fn finish(mut self) -> Result<()> {
        match self.problems.len() {
            0 => Ok(()),
            1 => Err(Error::Input(format!("options: {}", self.problems.remove(0)))),
            _ => Err(Error::Input(format!(
                "options:\n  {}",
                self.problems.join("\n  ")
            ))),
        }
    }

    fn problem(&mut self, problem: String) {
        self.problems.push(problem);
    }

    fn differs(&mut self, key: &str, expected: &str) {
        let got = self.keys.get(key).unwrap_or(&Value::Null);
        self.problems
            .push(format!("{key}: expected {expected}, got {got}"));
    }

    /// Whether a key has a value.
    fn has(&self, key: &str) -> bool {
        self.keys.get(key).is_some_and(|value| !value.is_null())
    }

    fn flag(&mut self, key: &str, default: bool) -> bool {
        match self.keys.get(key) {
            None | Some(Value::Null) => default,
            Some(Value::Bool(value)) => *value,
            Some(_) => {
                self.differs(key, "true or false");
                default
            }
        }
    }

    /// A whole number of 1 to `most`; None where there is none.
    fn count(&mut self, key: &str, most: usize) -> Option<usize> {
        let given = self.keys.get(key).filter(|value| !value.is_null())?;
        let count = given.as_u64().and_then(|count| usize::try_from(count).ok());
        let count = count.filter(|count| (1..=most).contains(count));
        if count.is_none() {
            self.differs(key, &format!("a whole number of 1 to {most}"));
        }
        count
    }

    /// A number of pixels; `default` where the key is missing, None where it is null.
    fn side(&mut self, key: &str, default: Option<usize>) -> Option<usize> {
        match self.keys.contains_key(key) {
            false => default,
            true => self.count(key, MAX_SIDE),
        }
    }

    /// A height and a width, likewise.
    fn sides(&mut self, key: &str, default: Option<[usize; 2]>) -> Option<[usize; 2]> {
        let given = match self.keys.get(key) {
            None => return default,
            Some(Value::Null) => return None,
            Some(given) => given,
        };
        let side = |value: &Value| {
            let side = usize::try_from(value.as_u64()?).ok()?;
            (1..=MAX_SIDE).contains(&side).then_some(side)
        };
        let sides = match given.as_array().map(Vec::as_slice) {
            Some([height, width]) => side(height).zip(side(width)),
            _ => None,
        };
        if sides.is_none() {
            self.differs(key, &format!("a height and a width of 1 to {MAX_SIDE}"));
        }
        sides.map(|(height, width)| [height, width])
    }

    /// A part of the whole, likewise.
    fn fraction(&mut self, key: &str, default: Option<f64>) -> Option<f64> {
        match self.keys.get(key) {
            None => default,
            Some(Value::Null) => None,
            Some(given) => {
                let fraction = given
                    .as_f64()
                    .filter(|fraction| *fraction > 0.0 && *fraction <= 1.0);
                if fraction.is_none() {
                    self.differs(key, "a number above 0 and up to 1");
                }
                fraction
            }
        }
    }

    /// The side of `size`, a square.
    fn square_size(&mut self) -> Option<usize> {
        let size = self.keys.get("size").filter(|size| !size.is_null())?;
        let side = match size.get("height") == size.get("width") {
            true => size.get("height").and_then(Value::as_u64),
            false => None,
        };
        let side = side.and_then(|side| usize::try_from(side).ok());
        if side.is_none() {
            self.differs("size", "an equal height and width");
        }
        side
    }

    /// The least and the greatest area of a view.
    fn pixel_limits(&mut self, version: Version) -> (usize, usize) {
        let (least, most) = match version {
            Version::N17 => (1 << 16, 1 << 24),
            _ => (4 * 28 * 28, 4096 * 28 * 28),
        };
        let mut limit = |key: &str, of_size: &str, default: usize| {
            if self.has(key) {
                return self.count(key, MAX_AREA).unwrap_or(default);
            }
            let of_size = self.keys.get("size").and_then(|size| size.get(of_size));
            let limit = of_size.and_then(Value::as_u64).unwrap_or(default as u64);
            usize::try_from(limit).unwrap_or(usize::MAX).clamp(1, MAX_AREA)
        };
        let least = limit("min_pixels", "shortest_edge", least);
        let most = limit("max_pixels", "longest_edge", most);
        if least > most {
            self.problem(format!(
                "min_pixels: expected at most max_pixels, {most}, got {least}"
            ));
        }
        (least, most)
    }

    /// That what is computed in one way only is not asked for in another.
    fn check_released_values(&mut self, version: Version) {
        let is_half = |value: &Value| match value {
            Value::Array(values) => values.iter().all(|value| value.as_f64() == Some(0.5)),
            value => value.as_f64() == Some(0.5),
        };
        for key in ["image_mean", "image_std"] {
            if self
                .keys
                .get(key)
                .is_some_and(|value| !value.is_null() && !is_half(value))
            {
                self.differs(key, "0.5 for every channel");
            }
        }
        for key in ["do_normalize", "do_rescale", "do_resize"] {
            if !self.flag(key, true) {
                self.differs(key, "true");
            }
        }
        if self.flag("use_tactile", false) {
            self.differs("use_tactile", "false");
        }
        let rescale = self.keys.get("rescale_factor").and_then(Value::as_f64);
        if rescale.is_some_and(|factor| (factor - 1.0 / 255.0).abs() > 1e-9) {
            self.differs("rescale_factor", "1 / 255");
        }
        if self.has("resample") && self.keys["resample"] != 3 {
            self.differs("resample", "3 (cubic)");
        }
        if version != Version::N17 {
            return;
        }
        for (key, released) in [("patch_size", 16), ("merge_size", 2), ("temporal_patch_size", 2)] {
            if self.has(key) && self.keys[key] != released {
                self.differs(key, &released.to_string());
            }
        }
    }
}
