//! The rules of a release's action head: what its class has, and what it takes for keys that a config leaves
//! out.

use Feature::{AlternatingBlocks, FutureTokens, SeveralDecoders, StateHistory, VlNorm, VlSelfAttention};

/// Something that only some releases have.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Feature {
    /// A width of the vision-language tokens in the config (`backbone_embedding_dim`), not only that of the
    /// cross-attention.
    ContextWidth,
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

/// The rules of an action head.
pub(crate) struct HeadRules {
    pub features: &'static [Feature],
    /// Whether its config names `max_action_dim` and chooses its transformer by `use_alternate_vl_dit`.
    pub is_flat: bool,
    /// Sizes that its class takes for keys that the config leaves out, in addition to [`COMMON_SIZES`].
    pub sizes: &'static [(&'static str, usize)],
}

/// Sizes that the classes of all releases take for keys that the config leaves out.
pub(super) const COMMON_SIZES: [(&str, usize); 10] = [
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
