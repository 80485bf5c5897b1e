//! Contradictions between the sizes and switches of a head's config.

use super::head_config::HeadConfig;
use super::values::MAX_SIZE;
use crate::error::require;

/// Sizes that a config may say although others determine them.
pub(super) struct SizesSaidTwice {
    pub cross_attention_dim: Option<usize>,
    pub output_dim: Option<usize>,
    pub action_dim: Option<usize>,
}

/// Everything in a head's config that contradicts itself, or what it says `twice`.
pub(super) fn contradictions(config: &HeadConfig, twice: &SizesSaidTwice) -> Vec<String> {
    let mut problems = Vec::new();
    let mut equal = |what: &str, given: usize, other: &str, expected: usize| {
        require!(problems, given == expected; "{what} is {given}, but {other} is {expected}");
    };
    equal(
        "input_embedding_dim",
        config.width,
        "diffusion_model_cfg.num_attention_heads x attention_head_dim",
        config.num_heads.saturating_mul(config.head_dim),
    );
    if config.vl_num_layers > 0 {
        equal(
            "backbone_embedding_dim",
            config.context_dim,
            "vl_self_attention_cfg.num_attention_heads x attention_head_dim",
            config.vl_num_heads.saturating_mul(config.vl_head_dim),
        );
    }
    let cross = "diffusion_model_cfg.cross_attention_dim";
    match twice.cross_attention_dim {
        Some(given) => equal(cross, given, "backbone_embedding_dim", config.context_dim),
        // Null means the width; flat configs give their class `backbone_embedding_dim` instead.
        None if !config.version.is_flat() => equal(
            &format!("{cross} (null, so input_embedding_dim)"),
            config.width,
            "backbone_embedding_dim",
            config.context_dim,
        ),
        None => {}
    }
    if let Some(output) = twice.output_dim {
        equal(
            "diffusion_model_cfg.output_dim",
            output,
            "hidden_size",
            config.hidden_dim,
        );
    }
    if config.version.is_flat()
        && let Some(action_dim) = twice.action_dim
    {
        equal("action_dim", action_dim, "max_action_dim", config.action_dim);
    }
    if let Some(bias) = &config.future_key_bias {
        equal(
            "the length of saccade.future_key_bias",
            bias.len(),
            "num_target_vision_tokens",
            config.num_future_tokens,
        );
    }
    problems.extend(impossible_sizes(config));
    problems
}

/// Sizes that no head can be computed with.
fn impossible_sizes(config: &HeadConfig) -> Vec<String> {
    let mut problems = Vec::new();
    require!(
        problems, config.encoder_action_dim >= config.action_dim;
        "pretrained_action_dim is {}, expected at least the {} of the actions that are decoded",
        config.encoder_action_dim, config.action_dim
    );
    require!(
        problems, config.attend_text_every_n_blocks == 0 || config.interleave_self_attention;
        "diffusion_model_cfg.interleave_self_attention is false, expected true with use_alternate_vl_dit"
    );
    for (what, size) in [
        (
            "diffusion_model_cfg.num_attention_heads x attention_head_dim",
            config.width,
        ),
        (
            "max_state_dim x state_history_length",
            config.state_dim.saturating_mul(config.state_history),
        ),
    ] {
        require!(problems, size as u64 <= MAX_SIZE; "{what} is {size}, expected at most {MAX_SIZE}");
    }
    require!(
        problems, config.width.is_multiple_of(2);
        "input_embedding_dim is {}, expected an even number (half sines, half cosines)", config.width
    );
    require!(
        problems, !config.add_pos_embed || config.action_horizon <= config.max_positions;
        "action_horizon is {}, more than the {} rows of the position table (max_seq_len)",
        config.action_horizon, config.max_positions
    );
    require!(
        problems, config.num_steps <= config.num_timestep_buckets;
        "num_inference_timesteps is {}, more than num_timestep_buckets {}",
        config.num_steps, config.num_timestep_buckets
    );
    problems
}
