//! What the sizes of a backbone must be to each other.

use super::config::{BackboneConfig, Tower};

/// Everything in which the sizes do not fit each other.
pub(super) fn contradictions(config: &BackboneConfig) -> Vec<String> {
    let BackboneConfig { vision, language, .. } = config;
    let mut problems = Vec::new();
    let mut add = |is_wrong: bool, problem: String| {
        if is_wrong {
            problems.push(problem);
        }
    };
    add(
        !vision.width.is_multiple_of(vision.num_heads),
        format!(
            "vision_config: expected a hidden_size that {} heads divide, got {}",
            vision.num_heads, vision.width
        ),
    );
    if let Some(size) = vision.image_size {
        add(
            !size.is_multiple_of(vision.token_size()),
            format!(
                "vision_config: expected an image_size of whole tokens of {} pixels, got {size}",
                vision.token_size()
            ),
        );
    }
    add(
        vision.table_side() * vision.table_side() != vision.num_positions,
        format!(
            "vision_config: expected positions in a square, got {}",
            vision.num_positions
        ),
    );
    let is_rotated = matches!(vision.tower, Tower::Qwen3Vl { .. });
    add(
        is_rotated && !vision.head_dim.is_multiple_of(4),
        format!(
            "vision_config: expected heads of a multiple of 4, got {}",
            vision.head_dim
        ),
    );
    let sorted = vision.deepstack.windows(2).all(|pair| pair[0] < pair[1]);
    let in_range = vision.deepstack.iter().all(|&block| block < vision.num_layers);
    add(
        !sorted || !in_range || vision.deepstack.len() > language.num_layers,
        format!(
            "vision_config.deepstack_visual_indexes: expected at most {} ascending blocks below {}, got {:?}",
            language.num_layers, vision.num_layers, vision.deepstack
        ),
    );
    add(
        !language.num_heads.is_multiple_of(language.num_kv_heads),
        format!(
            "text_config: expected a num_attention_heads that {} heads of keys divide, got {}",
            language.num_kv_heads, language.num_heads
        ),
    );
    add(
        !language.head_dim.is_multiple_of(2),
        format!(
            "text_config: expected an even head_dim, got {}",
            language.head_dim
        ),
    );
    if let Some(section) = language.mrope_section {
        add(
            section.iter().sum::<usize>() != language.head_dim / 2,
            format!(
                "text_config.rope_scaling.mrope_section: expected three numbers with the sum {}, got {section:?}",
                language.head_dim / 2
            ),
        );
    }
    add(
        config.image_token_id >= language.vocab_size,
        format!(
            "the image token is {}, expected an id below the vocab_size {}",
            config.image_token_id, language.vocab_size
        ),
    );
    problems
}
