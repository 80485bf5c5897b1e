//! A row of the table.

use super::backbone::BackboneRules;
use super::head::HeadRules;
use super::processor::ProcessorRules;

/// A release of GR00T.
pub(crate) struct Release {
    /// Its number, as in [`Version::name`](super::Version::name): `n1.5`.
    pub name: &'static str,
    /// `model_type` as its config has it. Other spellings are accepted: see
    /// [`Version::of_model`](super::Version::of_model).
    pub model_type: &'static str,
    pub head: HeadRules,
    /// None if saccade does not compute its backbone.
    pub backbone: Option<BackboneRules>,
    /// None if saccade does not prepare its frames and words.
    pub processor: Option<ProcessorRules>,
    /// None if lerobot does not read it.
    pub lerobot: Option<LerobotRules>,
}

/// What lerobot adds to a release.
pub(crate) struct LerobotRules {
    /// Actions that a model denoises. lerobot keeps the number of the model that a policy was made from, and
    /// nothing that it saves holds it: `chunk_size`, and the `action_horizon` of its processors (which may be
    /// `chunk_size` again, or the most that Isaac-GR00T's processor takes), say what is trained and cut, not
    /// what is denoised. These are the published models'; a fine-tune by Isaac-GR00T keeps them too, since
    /// its trainer takes the model's config from where it starts.
    pub action_horizon: u64,
    /// The width that states and actions are padded to where a policy's config still has the defaults of
    /// N1.5.
    pub padded_to: Option<u64>,
    /// Whether its steps hold the sizes of views.
    pub has_view_sizes: bool,
    /// The steps of its preprocessors that decide about frames and words.
    pub steps: &'static [LerobotStep],
}

/// A step of lerobot's preprocessors.
pub(crate) struct LerobotStep {
    pub name: &'static str,
    /// The keys of its config.
    pub keys: &'static [&'static str],
    /// Whether it fits views. Sizes that it leaves out have then the defaults of its class.
    pub fits_views: bool,
}
