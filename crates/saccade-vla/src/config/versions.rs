//! The releases of the architecture: the one table of what each is called, what its class has, and what it takes for keys that its config
//! leaves out.

use Feature::{
    AlternatingBlocks, FutureTokens, MaskToken, SeveralDecoders, StateHistory, VlNorm, VlSelfAttention,
};

/// A release of the architecture.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Version {
    N1,
    N15,
    N16,
    N17,
}

/// Something that only some versions have.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Feature {
    /// Learned tokens between state and actions (`num_target_vision_tokens`, `future_tokens`).
    FutureTokens,
    /// Several action decoders (`use_multi_action_heads`, `action_arm_decoder`).
    SeveralDecoders,
    /// A norm of the vision-language tokens (`use_vlln`, `vlln`).
    VlNorm,
    /// Self-attention of the vision-language tokens (`vl_self_attention_cfg`, `vl_self_attention`).
    VlSelfAttention,
    /// Blocks that attend to text and to images in turn (`use_alternate_vl_dit`).
    AlternatingBlocks,
    /// Several state vectors in the state row (`state_history_length`).
    StateHistory,
    /// A learned vector in place of a state that training hides (`mask_token`).
    MaskToken,
}

/// A row of the table.
struct Release {
    version: Version,
    name: &'static str,
    /// `model_type` as its config has it. Other spellings are accepted: see [`Version::of_model`].
    model_type: &'static str,
    features: &'static [Feature],
    /// Whether its config names `max_action_dim` and chooses its transformer by `use_alternate_vl_dit`.
    is_flat: bool,
    /// Sizes that its class takes for keys that the config leaves out, in addition to [`COMMON_SIZES`].
    sizes: &'static [(&'static str, usize)],
}

/// Every release, in their order.
const RELEASES: [Release; 4] = [
    Release {
        version: Version::N1,
        name: "n1",
        model_type: "gr00t_n1",
        features: &[],
        is_flat: false,
        sizes: &[],
    },
    Release {
        version: Version::N15,
        name: "n1.5",
        model_type: "gr00t_n1_5",
        features: &[FutureTokens, SeveralDecoders, VlNorm, VlSelfAttention],
        is_flat: false,
        sizes: &[("backbone_embedding_dim", 1536), ("num_target_vision_tokens", 32)],
    },
    Release {
        version: Version::N16,
        name: "n1.6",
        model_type: "Gr00tN1d6",
        features: &[VlNorm, AlternatingBlocks, MaskToken],
        is_flat: true,
        sizes: &[
            ("max_state_dim", 29),
            ("max_action_dim", 29),
            ("action_horizon", 16),
            ("num_inference_timesteps", 4),
            ("backbone_embedding_dim", 2048),
        ],
    },
    Release {
        version: Version::N17,
        name: "n1.7",
        model_type: "Gr00tN1d7",
        features: &[VlNorm, VlSelfAttention, AlternatingBlocks, StateHistory],
        is_flat: true,
        sizes: &[
            ("max_state_dim", 132),
            ("max_action_dim", 132),
            ("action_horizon", 40),
            ("num_inference_timesteps", 4),
            ("backbone_embedding_dim", 2048),
        ],
    },
];

/// Sizes that the classes of all versions take for keys that the config leaves out.
const COMMON_SIZES: [(&str, usize); 10] = [
    ("hidden_size", 1024),
    ("max_seq_len", 1024),
    ("num_timestep_buckets", 1000),
    ("max_num_embodiments", 32),
    ("attend_text_every_n_blocks", 2),
    ("action_claw_dim", 2),
    ("action_arm_dim", 14),
    ("action_left_arm_dim", 7),
    ("action_right_arm_dim", 7),
    ("state_history_length", 1),
];

/// Keys that ask for a feature: a head without it would be silently wrong.
pub(crate) const FEATURE_KEYS: [(&str, Feature); 6] = [
    ("use_alternate_vl_dit", AlternatingBlocks),
    ("use_multi_action_heads", SeveralDecoders),
    ("num_target_vision_tokens", FutureTokens),
    ("use_vlln", VlNorm),
    ("vl_self_attention_cfg", VlSelfAttention),
    ("state_history_length", StateHistory),
];

impl Version {
    /// Every version, in the order of their release.
    pub(crate) fn all() -> impl Iterator<Item = Self> {
        RELEASES.iter().map(|release| release.version)
    }

    /// The version of this [`name`](Self::name).
    pub(crate) fn named(name: &str) -> Option<Self> {
        Self::all().find(|version| version.name() == name)
    }

    fn release(self) -> &'static Release {
        const TABLE: &[Release] = &RELEASES;
        let found = TABLE.iter().find(|release| release.version == self);
        found.expect("the table has every version")
    }

    /// Its name in [`HeadConfig::version`](crate::HeadConfig::version): `n1.5`.
    pub(crate) fn name(self) -> &'static str {
        self.release().name
    }

    /// Its name as models are called: `N1.5`.
    pub(crate) fn title(self) -> String {
        self.name().to_uppercase()
    }

    /// `model_type` in its config.
    pub(crate) fn model_type(self) -> &'static str {
        self.release().model_type
    }

    /// All model types, to be shown.
    pub(crate) fn model_types() -> String {
        let names: Vec<_> = RELEASES.iter().map(|release| release.model_type).collect();
        names.join(", ")
    }

    /// Whether its config names `max_action_dim` and chooses its transformer by `use_alternate_vl_dit`.
    pub(crate) fn is_flat(self) -> bool {
        self.release().is_flat
    }

    pub(crate) fn has(self, feature: Feature) -> bool {
        self.release().features.contains(&feature)
    }

    /// The versions that have a feature.
    pub(crate) fn with(feature: Feature) -> Vec<Self> {
        Self::all().filter(|version| version.has(feature)).collect()
    }

    /// The size that the version's class takes for a key that its config leaves out; none if the config must name it.
    pub(crate) fn default_size(self, key: &str) -> Option<usize> {
        let sizes = self.release().sizes.iter().chain(&COMMON_SIZES);
        sizes
            .into_iter()
            .find(|(name, _)| *name == key)
            .map(|(_, size)| *size)
    }

    /// The version of the model that is called this, in any spelling: `gr00t_n1_5`, `GR00T-N1.5`, `Gr00tN1d5`.
    ///
    /// The error says that it is a name of GR00T, and of none of the versions.
    pub(crate) fn of_model(name: &str) -> Result<Option<Self>, ()> {
        let plain: String = name
            .chars()
            .filter(char::is_ascii_alphanumeric)
            .map(|letter| letter.to_ascii_lowercase())
            .collect();
        let Some(number) = plain.strip_prefix("gr00t") else {
            return Ok(None);
        };
        let spelled = |version: &Self| {
            let name = version.name();
            number == name.replace('.', "") || number == name.replace('.', "d")
        };
        Self::all().find(spelled).map(Some).ok_or(())
    }

    /// The version whose name is in the path of a model, as lerobot finds it: `nvidia/GR00T-N1.5-3B`.
    pub(crate) fn in_path(path: &str) -> Option<Self> {
        let path = path.to_ascii_lowercase();
        let is_named = |version: &Self| {
            // `n1` is the beginning of all the others.
            version.name() != "n1"
                && ["gr00t-", "gr00t_"]
                    .iter()
                    .any(|start| path.contains(&format!("{start}{}", version.name())))
        };
        Self::all().find(is_named)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn models_are_known_by_every_spelling() {
        for release in &RELEASES {
            assert_eq!(Version::of_model(release.model_type), Ok(Some(release.version)));
            assert_eq!(release.version.name(), release.name);
        }
        for (name, version) in [
            ("GR00T-N1.5", Version::N15),
            ("gr00t_n1d5", Version::N15),
            ("Gr00tN1d6", Version::N16),
            ("GR00T_N1", Version::N1),
        ] {
            assert_eq!(Version::of_model(name), Ok(Some(version)));
        }
        assert_eq!(Version::of_model("bert"), Ok(None));
        assert_eq!(Version::of_model("gr00t_n2"), Err(()));
        assert_eq!(Version::in_path("nvidia/GR00T-N1.7-3B"), Some(Version::N17));
        assert_eq!(Version::in_path("nvidia/GR00T-N1-2B"), None);
    }
}
