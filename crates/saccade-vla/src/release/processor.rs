//! The rules of a release's processor: prompt, views, and the files that its options are in.

use std::str::FromStr;

use saccade_vla_kernels::WeightRounding;

use crate::error::{Error, Result, problem};

/// The rules of a processor.
pub(crate) struct ProcessorRules {
    /// Published repositories that have its tokenizer, the released one first.
    pub tokenizers: &'static [&'static str],
    /// The files that are needed of such a repository.
    pub tokenizer_files: &'static [&'static str],
    /// Positions that its language model has.
    pub max_positions: usize,
    pub default_preprocessing: Preprocessing,
    /// The file of Isaac-GR00T's processor; none if it writes none.
    pub isaac_file: Option<IsaacFile>,
    pub prompt: PromptRules,
    pub views: ViewRules,
}

/// The code that a checkpoint was trained behind: it decides how frames are resized and in which order views
/// stand.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Preprocessing {
    /// lerobot's: views sorted by name.
    Lerobot,
    /// Isaac-GR00T's: views in the order given.
    Isaac,
}

/// `processor_config.json` of a release.
pub(crate) struct IsaacFile {
    /// The class that it names.
    pub class: &'static str,
    /// Arguments of that class: the keys that `processor_kwargs` may have.
    pub arguments: &'static [&'static [&'static str]],
}

/// A prompt with one turn of the user.
pub(crate) struct PromptRules {
    /// The prompt, in which `{views}` and `{text}` are replaced by the views and by the instruction.
    pub template: &'static str,
    pub view: ViewTokens,
    pub wording: Wording,
    /// The instruction of Isaac-GR00T's processor where none is given; none if it needs one.
    pub default_instruction: Option<&'static str>,
    /// Whether the released processor replaces `<image-1>` by a frame, wherever it stands in the prompt.
    pub has_placeholders: bool,
}

/// A view in a prompt.
pub(crate) struct ViewTokens {
    /// Whether `<image 1>` with the number of the view stands before it.
    pub is_numbered: bool,
    pub start: &'static str,
    /// Stands for a token of the view.
    pub image: &'static str,
    pub end: &'static str,
}

/// The form in which an instruction stands in a prompt.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(crate) enum Wording {
    /// As Python shows a list of it, unless plain text is asked for. With `formalize_language` lerobot writes
    /// it in lower case without punctuation and underscores; Isaac-GR00T does not read that option.
    List,
    /// In lower case without punctuation, unless `formalize_language` is off.
    Formalized,
}

/// The views that frames become.
pub(crate) enum ViewRules {
    /// Squares of one size, whatever the frame was.
    Square {
        /// Height and width of the published model's views.
        size: usize,
        patch_size: usize,
    },
    /// As large as the frame makes them.
    Flexible(Flexible),
}

/// Views as large as the frame makes them.
#[derive(Debug, PartialEq)]
pub(crate) struct Flexible {
    /// Pixels on each side of a patch.
    pub patch_size: usize,
    /// Patches on each side of a token.
    pub merge: usize,
    pub pixels: Pixels,
    /// Weights of the last, cubic resize.
    pub rounding: WeightRounding,
    pub fitting: Fitting,
    /// The least and the greatest area of a view, where no file says them.
    pub areas: (usize, usize),
    /// The shorter side of a frame, where a file of Isaac-GR00T's does not name it.
    pub file_edge: usize,
    /// Whether such a file adds black bars without naming the option.
    pub file_has_bars: bool,
}

/// The arrays of pixels that a backbone takes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Pixels {
    /// `(1, 3, height, width)` for each view.
    Planes,
    /// Patches of all views in one array, in the order of the tokens that they make.
    Patches {
        /// How often a frame stands in a patch, along time.
        frames: usize,
    },
}

/// The size of a view whose nearest multiples of a token's size are too large or too small.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Fitting {
    /// Shrinks the multiples, of at least a token and at most `max_side`.
    OfMultiples { max_side: f64 },
    /// Shrinks the frame.
    OfFrame,
}

/// The view of Eagle's processor.
pub(super) const EAGLE_VIEW: ViewTokens = ViewTokens {
    is_numbered: true,
    start: "<img>",
    image: "<IMG_CONTEXT>",
    end: "</img>",
};

/// The view of Qwen's processor.
pub(super) const QWEN_VIEW: ViewTokens = ViewTokens {
    is_numbered: false,
    start: "<|vision_start|>",
    image: "<|image_pad|>",
    end: "<|vision_end|>",
};

/// The files of a tokenizer that is stored in parts.
pub(super) const SLOW_TOKENIZER: [&str; 4] = [
    "vocab.json",
    "merges.txt",
    "added_tokens.json",
    "tokenizer_config.json",
];

/// The file with the least and the greatest area of a view, beside a checkpoint or its tokenizer.
pub(crate) const PIXEL_LIMITS: &str = "preprocessor_config.json";

/// Arguments of the processors of N1.6 and of all releases after it.
pub(super) const COMMON_ARGUMENTS: [&str; 22] = [
    "apply_sincos_state_encoding",
    "clip_outliers",
    "color_jitter_params",
    "crop_fraction",
    "embodiment_id_mapping",
    "extra_augmentation_config",
    "formalize_language",
    "image_crop_size",
    "image_target_size",
    "max_action_dim",
    "max_action_horizon",
    "max_state_dim",
    "modality_configs",
    "model_name",
    "model_type",
    "random_rotation_angle",
    "shortest_image_edge",
    "statistics",
    "transformers_loading_kwargs",
    "use_albumentations",
    "use_percentiles",
    "use_relative_action",
];

impl ProcessorRules {
    /// Whether a file says the least and the greatest area of a view.
    pub(crate) fn has_pixel_limits(&self) -> bool {
        self.tokenizer_files.contains(&PIXEL_LIMITS)
    }
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
}

impl FromStr for Preprocessing {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self> {
        let known = [Self::Lerobot, Self::Isaac]
            .into_iter()
            .find(|one| one.name() == name);
        known.ok_or_else(|| {
            Error::Input(problem!("preprocessing"; expected "\"lerobot\" or \"isaac\""; got "{name:?}"))
        })
    }
}
