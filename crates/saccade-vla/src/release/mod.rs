//! The releases of GR00T: a table with one row for each.
//!
//! A row ([`Release`]) names a release and says what its config, its backbone and its processor do, as data.
//! The rest of the crate never asks which release it has, but what its row says. A new release is a file with
//! its row and a line in the table of `version.rs`; `made_up.rs` is one, which `tests.rs` loads, runs and
//! prepares.

mod backbone;
mod head;
#[cfg(test)]
mod made_up;
mod n1;
mod n15;
mod n16;
mod n17;
mod processor;
mod row;
#[cfg(all(test, feature = "processor"))]
mod tests;
mod version;

pub(crate) use backbone::{BackboneRules, Names, PatchOrder, PixelOrder, TowerKind};
pub(crate) use head::{FEATURE_KEYS, Feature};
pub use processor::Preprocessing;
pub(crate) use processor::{
    Fitting, Flexible, IsaacFile, PIXEL_LIMITS, Pixels, ProcessorRules, PromptRules, ViewRules, Wording,
};
pub(crate) use row::LerobotRules;
pub use version::Version;
pub(crate) use version::choice;
