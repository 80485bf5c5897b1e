//! What the sizes of a backbone must be to each other.

use super::config::{BackboneConfig, CHANNELS, Tower};
use crate::config::MAX_SIZE;
use crate::error::require;

/// Everything in which the sizes do not fit each other.
pub(super) fn contradictions(config: &BackboneConfig) -> Vec<String> {
    let BackboneConfig { vision, language, .. } = config;
    let mut problems = Vec::new();
    require!(
        problems, vision.width.is_multiple_of(vision.num_heads);
        "vision_config: expected a hidden_size that {} heads divide, got {}", vision.num_heads, vision.width
    );
    if let Some(size) = vision.image_size {
        require!(
            problems, size.is_multiple_of(vision.token_size());
            "vision_config: expected an image_size of whole tokens of {} pixels, got {size}", vision.token_size()
        );
    }
    let patch = vision.patch_size.saturating_pow(2).saturating_mul(CHANNELS);
    let queries = language.num_heads.saturating_mul(language.head_dim);
    for (what, size) in [
        ("vision_config: 3 x patch_size x patch_size", patch),
        ("text_config: num_attention_heads x head_dim", queries),
    ] {
        require!(problems, size as u64 <= MAX_SIZE; "{what} is {size}, expected at most {MAX_SIZE}");
    }
    let positions = vision.num_positions;
    require!(
        problems, vision.table_side() * vision.table_side() == positions;
        "vision_config: expected positions in a square, got {positions}"
    );
    let is_rotated = matches!(vision.tower, Tower::Qwen3Vl { .. });
    require!(
        problems, !is_rotated || vision.head_dim.is_multiple_of(4);
        "vision_config: expected heads of a multiple of 4, got {}", vision.head_dim
    );
    let sorted = vision.deepstack.windows(2).all(|pair| pair[0] < pair[1]);
    let in_range = vision.deepstack.iter().all(|&block| block < vision.num_layers);
    require!(
        problems, sorted && in_range && vision.deepstack.len() <= language.num_layers;
        "vision_config.deepstack_visual_indexes: expected at most {} ascending blocks below {}, got {:?}",
        language.num_layers, vision.num_layers, vision.deepstack
    );
    require!(
        problems, language.num_heads.is_multiple_of(language.num_kv_heads);
        "text_config: expected a num_attention_heads that {} heads of keys divide, got {}",
        language.num_kv_heads, language.num_heads
    );
    require!(
        problems, language.head_dim.is_multiple_of(2);
        "text_config: expected an even head_dim, got {}", language.head_dim
    );
    if let Some(section) = language.mrope_section {
        let half = language.head_dim / 2;
        require!(
            problems, section.iter().sum::<usize>() == half;
            "text_config.rope_scaling.mrope_section: expected three numbers with the sum {half}, got {section:?}"
        );
    }
    let (token, vocab) = (config.image_token_id, language.vocab_size);
    require!(
        problems, token < vocab; "the image token is {token}, expected an id below the vocab_size {vocab}"
    );
    problems
}
