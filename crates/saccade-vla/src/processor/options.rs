//! The keys of the released files: which there are, which are read here, and their values.

use serde_json::Value;

use crate::config::{Object, asks_for_nothing};
use crate::error::{Error, Problem, Result, bail};
use crate::release::{Pixels, Version, ViewRules};

/// Larger sides, and larger areas, are hostile: the greatest area that is published is this one.
pub(super) const MAX_SIDE: usize = 1 << 12;
pub(super) const MAX_AREA: usize = MAX_SIDE * MAX_SIDE;

/// Keys of the released files that are read here: they decide about frames and words.
const READ: [&str; 22] = [
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

/// Keys about states and actions, which a normalizer reads.
const OF_STATES_AND_ACTIONS: [&str; 14] = [
    "apply_sincos_state_encoding",
    "clip_outliers",
    "embodiment_id_mapping",
    "exclude_state",
    "max_action_dim",
    "max_action_horizon",
    "max_state_dim",
    "modality_configs",
    "statistics",
    "tactile_embed_dim",
    "tactile_input_shape",
    "tactile_state_keys",
    "use_percentiles",
    "use_relative_action",
];

/// Keys that change nothing about one observation at inference.
const WITHOUT_EFFECT: [&str; 34] = [
    "auto_map",
    "chat_template",
    "color_jitter_params",
    "crop_size",
    "data_format",
    "default_to_square",
    "device",
    "disable_grouping",
    "do_center_crop",
    "do_convert_rgb",
    "do_pad",
    "extra_augmentation_config",
    "image_end_token",
    "image_placeholder",
    "image_processor_type",
    "image_start_token",
    "image_token",
    "input_data_format",
    "max_dynamic_tiles",
    "min_dynamic_tiles",
    "model_name",
    "model_type",
    "pad_during_tiling",
    "pad_size",
    "processor_class",
    "random_rotation_angle",
    "return_tensors",
    "state_dropout_prob",
    "transformers_loading_kwargs",
    "use_mean_std",
    "use_thumbnail",
    "video_placeholder",
    "video_token",
    "vision_feature_select_strategy",
];

/// Whether a key of a released file says something about frames or words of a release with these views.
pub(super) fn is_read(views: &ViewRules, key: &str) -> bool {
    READ.contains(&key) && (matches!(views, ViewRules::Flexible(_)) || key == "formalize_language")
}

/// The keys that replace those of a checkpoint.
///
/// # Errors
/// [`Error::Input`] that lists the keys of which this is not possible; [`Error::Json`].
pub(super) fn overrides(text: &str) -> Result<Object> {
    let options = Options::parse(Some(text))?;
    let elsewhere = |key: &&String| OF_STATES_AND_ACTIONS.contains(&key.as_str());
    let problems: Vec<String> = options
        .keys
        .keys()
        .filter(elsewhere)
        .map(|key| {
            format!("{key}: expected a key about frames or words; states and actions are the normalizer's")
        })
        .collect();
    let Options {
        keys,
        problems: unknown,
    } = options;
    Options {
        keys: Object::new(),
        problems: [unknown, problems].concat(),
    }
    .finish()?;
    Ok(keys)
}

/// The keys of a file, and what is wrong with them.
pub(super) struct Options {
    keys: Object,
    problems: Vec<String>,
}

impl Options {
    /// The keys of a JSON object, those of its `processor_kwargs` beside the others.
    ///
    /// # Errors
    /// [`Error::Input`] and [`Error::Json`] for what is no object. Keys that are unknown are found by
    /// [`finish`](Self::finish).
    pub(super) fn parse(text: Option<&str>) -> Result<Self> {
        let mut keys = match text.map(serde_json::from_str).transpose() {
            Ok(None) => Object::new(),
            Ok(Some(Value::Object(keys))) => keys,
            Ok(Some(_)) => return Err(Error::Input(Problem::new("options", "expected a JSON object"))),
            Err(source) => return Err(Error::json("options", source)),
        };
        let mut problems = Vec::new();
        match keys.remove("processor_kwargs") {
            None => {}
            Some(Value::Object(nested)) => keys.extend(nested),
            Some(other) => problems.push(format!("processor_kwargs: expected an object, got {other}")),
        }
        let lists: [&[&str]; 3] = [&READ, &OF_STATES_AND_ACTIONS, &WITHOUT_EFFECT];
        for key in keys.keys() {
            if !lists.iter().any(|list| list.contains(&key.as_str())) {
                problems.push(format!(
                    "{key}: expected a key of the released files, such as {}",
                    READ.join(", ")
                ));
            }
        }
        Ok(Self { keys, problems })
    }

    /// # Errors
    /// [`Error::Input`] that lists everything that was found wrong.
    pub(super) fn finish(mut self) -> Result<()> {
        match self.problems.len() {
            0 => Ok(()),
            1 => Err(Error::Input(Problem::new("options", self.problems.remove(0)))),
            _ => bail!(Input, "options"; "\n  {}", self.problems.join("\n  ")),
        }
    }

    /// Adds something wrong.
    pub(super) fn problem(&mut self, problem: String) {
        self.problems.push(problem);
    }

    /// Adds that a key has another value than is expected.
    pub(super) fn differs(&mut self, key: &str, expected: &str) {
        let got = self.keys.get(key).unwrap_or(&Value::Null);
        self.problems
            .push(format!("{key}: expected {expected}, got {got}"));
    }

    /// Adds that a key is needed, which is null or missing.
    pub(super) fn missing(&mut self, key: &str, expected: &str) {
        // A value that is no such thing was found before.
        if !self.has(key) {
            self.differs(key, expected);
        }
    }

    /// Adds the keys that ask for what views of one size do not have.
    pub(super) fn refuse_flexible_geometry(&mut self, version: Version) {
        for key in [
            "image_crop_size",
            "image_target_size",
            "letter_box_transform",
            "shortest_image_edge",
            "use_albumentations",
        ] {
            if self.keys.get(key).is_some_and(|value| !asks_for_nothing(value)) {
                self.differs(key, &format!("none for {version}"));
            }
        }
    }

    /// Whether a key is there, be it null.
    pub(super) fn names(&self, key: &str) -> bool {
        self.keys.contains_key(key)
    }

    /// Whether a key has a value.
    fn has(&self, key: &str) -> bool {
        self.keys.get(key).is_some_and(|value| !value.is_null())
    }

    /// A switch; `default` where the key is missing. Null is off, as in Python.
    pub(super) fn flag(&mut self, key: &str, default: bool) -> bool {
        match self.keys.get(key) {
            None => default,
            Some(Value::Null) => false,
            Some(Value::Bool(value)) => *value,
            Some(_) => {
                self.differs(key, "true or false");
                default
            }
        }
    }

    /// A whole number of 1 to `most`; None where there is none.
    pub(super) fn count(&mut self, key: &str, most: usize) -> Option<usize> {
        let given = self.keys.get(key).filter(|value| !value.is_null())?;
        let count = given.as_u64().and_then(|count| usize::try_from(count).ok());
        let count = count.filter(|count| (1..=most).contains(count));
        if count.is_none() {
            self.differs(key, &format!("a whole number of 1 to {most}"));
        }
        count
    }

    /// A number of pixels; `default` where the key is missing, None where it is null.
    pub(super) fn side(&mut self, key: &str, default: Option<usize>) -> Option<usize> {
        match self.keys.contains_key(key) {
            false => default,
            true => self.count(key, MAX_SIDE),
        }
    }

    /// A height and a width, likewise.
    pub(super) fn sides(&mut self, key: &str, default: Option<[usize; 2]>) -> Option<[usize; 2]> {
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

    /// A number, likewise.
    pub(super) fn number(&mut self, key: &str, default: Option<f64>) -> Option<f64> {
        match self.keys.get(key) {
            None => default,
            Some(Value::Null) => None,
            Some(given) => {
                let number = given.as_f64();
                if number.is_none() {
                    self.differs(key, "a number or null");
                }
                number
            }
        }
    }

    /// A part of the whole, likewise.
    pub(super) fn fraction(&mut self, key: &str, default: Option<f64>) -> Option<f64> {
        let fraction = self.number(key, default)?;
        let is_part = fraction > 0.0 && fraction <= 1.0;
        if !is_part {
            self.differs(key, "a number above 0 and up to 1");
        }
        is_part.then_some(fraction)
    }

    /// The side of `size`, a square.
    pub(super) fn square_size(&mut self) -> Option<usize> {
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

    /// The least and the greatest area of a view; the released ones where no key says them.
    pub(super) fn pixel_limits(&mut self, (least, most): (usize, usize)) -> (usize, usize) {
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
    pub(super) fn check_released_values(&mut self, views: &ViewRules) {
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
            if self.keys.get(key) == Some(&Value::Bool(false)) {
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
        let ViewRules::Flexible(rules) = views else { return };
        let Pixels::Patches { frames } = rules.pixels else {
            return;
        };
        for (key, released) in [
            ("patch_size", rules.patch_size),
            ("merge_size", rules.merge),
            ("temporal_patch_size", frames),
        ] {
            if self.has(key) && self.keys[key] != released {
                self.differs(key, &released.to_string());
            }
        }
    }
}
