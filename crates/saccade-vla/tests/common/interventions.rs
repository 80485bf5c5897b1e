//! A head whose interventions are tested, and the making of interventions.

use std::sync::LazyLock;

use saccade_vla::{ActionHead, Group, Intervention, OwnedArray, Patch, Sampling, Tokens};
use serde_json::{Value, json};

use super::{Inputs, made_up};

/// Four blocks, two heads, three future and two action rows, width 4.
pub fn config() -> Value {
    json!({
        "action_dim": 3, "action_horizon": 2, "add_pos_embed": true, "backbone_embedding_dim": 6, "hidden_size": 5,
        "input_embedding_dim": 4, "max_action_dim": 3, "max_num_embodiments": 2, "max_seq_len": 4, "max_state_dim": 7,
        "num_inference_timesteps": 4, "num_target_vision_tokens": 3, "num_timestep_buckets": 1000, "use_vlln": true,
        "diffusion_model_cfg": {
            "attention_head_dim": 2, "cross_attention_dim": 6, "interleave_self_attention": true, "norm_type": "ada_norm",
            "num_attention_heads": 2, "num_layers": 4, "output_dim": 5, "positional_embeddings": null
        },
        "vl_self_attention_cfg": {
            "attention_head_dim": 3, "num_attention_heads": 2, "num_layers": 1, "positional_embeddings": null
        }
    })
}

pub static HEAD: LazyLock<ActionHead> = LazyLock::new(|| made_up(&config().to_string()));

pub const NUM_STEPS: usize = 3;
pub const ROWS: usize = 6;
/// Rows: state 0, future 1 to 3, action 4 and 5.
pub const FIRST_ACTION: usize = 4;

/// Two observations of five tokens.
pub fn inputs(head: &ActionHead) -> Inputs<'_> {
    Inputs::new(head, &[0, 1], 5)
}

pub fn sampling(interventions: &[Intervention]) -> Sampling<'_> {
    Sampling {
        num_steps: Some(NUM_STEPS),
        interventions,
        ..Sampling::default()
    }
}

pub fn all(group: Group) -> Tokens {
    Tokens { group, indices: None }
}

pub fn some(group: Group, indices: &[usize]) -> Tokens {
    Tokens {
        group,
        indices: Some(indices.to_vec()),
    }
}

pub fn array(values: &[f32], shape: &[usize]) -> OwnedArray {
    OwnedArray::new(values.to_vec(), shape).unwrap()
}

pub fn cut(reader: Tokens, source: Tokens) -> Intervention {
    Intervention {
        cut: vec![(reader, source)],
        ..Intervention::default()
    }
}

pub fn bias(tokens: Tokens, values: &[f32], shape: &[usize]) -> Intervention {
    Intervention {
        key_bias: vec![(tokens, array(values, shape))],
        ..Intervention::default()
    }
}

pub fn future_tokens(shape: &[usize]) -> Intervention {
    Intervention {
        future_tokens: Some(array(&vec![0.0; shape.iter().product()], shape)),
        ..Intervention::default()
    }
}

pub fn patch(step: usize, block: usize, tokens: Tokens, shape: &[usize]) -> Intervention {
    let values = (0..shape.iter().product()).map(|index: usize| index as f32);
    let rows = OwnedArray::new(values.collect(), shape).unwrap();
    Intervention {
        patch: vec![Patch {
            step,
            block,
            tokens,
            rows,
        }],
        ..Intervention::default()
    }
}
