//! GR00T N1, of which saccade has the action head.

use super::head::HeadRules;
use super::row::Release;

pub(super) static N1: Release = Release {
    name: "n1",
    model_type: "gr00t_n1",
    head: HeadRules {
        features: &[],
        is_flat: false,
        sizes: &[],
    },
    backbone: None,
    processor: None,
    lerobot: None,
};
