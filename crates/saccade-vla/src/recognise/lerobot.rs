//! lerobot's checkpoints, whose `config.json` describes a policy and holds no size of the head. Sizes come
//! from the tensors; what no shape determines is taken from the published models.

use saccade_vla_checkpoint::OWN_CONFIG;
use serde_json::{Map, Value, json};

use super::layout::{Contents, Evidence};
use super::sizes::{BLOCKS, FUTURE_TOKENS, HeadShapes, add_decoders, proved};
use crate::config::{CheckpointConfig, OWN_KEY, Object, object_in_any};
use crate::error::{Error, Result, ensure, problem};
use crate::release::{Feature, Version};

/// `type` in lerobot's `config.json` of a GR00T policy.
const POLICY: &str = "groot";

/// Whether a config is lerobot's and holds no head, whose sizes must then come from the tensors.
///
/// # Errors
/// [`Error::Checkpoint`] for a config of another kind of policy.
pub(super) fn is_without_head(config: &CheckpointConfig) -> Result<bool> {
    match config.top().get("type") {
        _ if config.is_nested() => Ok(false),
        None => Ok(false),
        Some(Value::String(policy)) if policy == POLICY => Ok(true),
        Some(policy) => Err(Error::Checkpoint(problem!(
            "config"; "type is {policy}: lerobot's config of another policy, expected \"{POLICY}\""
        ))),
    }
}

/// What a config without a head says about the version.
pub(super) fn evidence(policy: &Object) -> Vec<Evidence> {
    let mut found = vec![Evidence {
        versions: Version::all()
            .filter(|version| version.release().lerobot.is_some())
            .collect(),
        what: format!("config.json is lerobot's, type \"{POLICY}\""),
    }];
    if let Some(Value::String(base)) = policy.get("base_model_path")
        && let Some(version) = Version::in_path(base)
    {
        found.push(Evidence {
            versions: vec![version],
            what: format!("base_model_path is \"{base}\""),
        });
    }
    found
}

/// The head's config in the released keys, where the file holds none of it.
///
/// # Errors
/// [`Error::Checkpoint`] if the tensors do not make one.
pub(super) fn head_config(contents: &Contents<'_>, version: Version) -> Result<Object> {
    let mut head = from_tensors(contents.config.top(), version, &contents.tensors)?;
    // lerobot refuses a `config.json` with keys that it does not know.
    if let Some(own) = object_in_any("source", &contents.directory.join(OWN_CONFIG))? {
        head.insert(OWN_KEY.to_owned(), Value::Object(own));
    }
    Ok(head)
}

/// Widths of an attention head in every published model.
const DIT_HEAD_DIM: usize = 48;
const VL_HEAD_DIM: usize = 64;

/// Sizes from the tensors, the rest as the published models of that version have it.
fn from_tensors(policy: &Object, version: Version, tensors: &HeadShapes<'_>) -> Result<Object> {
    let number = |key: &str| policy.get(key).and_then(Value::as_u64);
    let sizes = proved(version, tensors);
    let mut head = Map::new();
    head.insert("model_type".to_owned(), json!(version.release().model_type));
    for (key, size, _) in &sizes {
        head.insert((*key).to_owned(), json!(size));
    }
    let mut problems = Vec::new();
    add_transformers(&mut head, version, tensors, &mut problems);
    let state = state_sizes(policy, version, tensors);
    head.insert("max_state_dim".to_owned(), json!(state.found));
    let mut set = |key: &str, value: Value| head.insert(key.to_owned(), value);
    set("add_pos_embed", json!(tensors.any("position_embedding.")));
    set("use_vlln", json!(tensors.any("vlln.")));
    set("num_timestep_buckets", json!(1000));
    let steps = number("num_inference_timesteps").unwrap_or(4);
    set("num_inference_timesteps", json!(steps));
    if let Some(lerobot) = &version.release().lerobot {
        set("action_horizon", json!(lerobot.action_horizon));
    }
    if version.is_flat() {
        set("use_alternate_vl_dit", json!(true));
        set("attend_text_every_n_blocks", json!(2));
        set("state_history_length", json!(state.history));
    } else {
        let tokens = tensors.size(FUTURE_TOKENS, 2, 0).unwrap_or(0);
        set("num_target_vision_tokens", json!(tokens));
    }
    add_decoders(&mut head, tensors);
    let action_dim = number("max_action_dim").map(|dim| widened(version, dim, 32));
    let actions = tensors.size("action_encoder.W1.W", 3, 1).unwrap_or(0) as u64;
    for (key, given, name, found) in [
        (
            "max_state_dim",
            state.given,
            "state_encoder.layer1.W",
            state.found,
        ),
        ("max_action_dim", action_dim, "action_encoder.W1.W", actions),
    ] {
        if let Some(given) = given.filter(|given| *given != found) {
            let shown = tensors.show(name);
            problems.push(format!("{key} is {given} in the config, but {shown}"));
        }
    }
    ensure!(
        problems.is_empty(), Checkpoint, "source";
        "config.json (lerobot's, GR00T {}) and tensors do not make a head; the head's own config can be given as \
         `config`:\n  {}",
         version, problems.join("\n  ")
    );
    Ok(head)
}

/// Adds both transformers' configs, and to `problems` what the tensors do not determine.
fn add_transformers(
    head: &mut Object,
    version: Version,
    tensors: &HeadShapes<'_>,
    problems: &mut Vec<String>,
) {
    let mut needed = |key: &str| {
        let size = head
            .get(key)
            .and_then(Value::as_u64)
            .and_then(|size| usize::try_from(size).ok());
        size.unwrap_or_else(|| {
            problems.push(format!(
                "{key} is not in lerobot's config.json, and no tensor tells it"
            ));
            1
        })
    };
    let (width, context) = (needed("input_embedding_dim"), needed("backbone_embedding_dim"));
    let hidden = needed("hidden_size");
    let mut heads = |what: &str, width: usize, head_dim: usize| {
        if !width.is_multiple_of(head_dim) {
            problems.push(format!(
                "{what} is {width}: not a multiple of {head_dim}, the width of an attention head in GR00T {}; lerobot's config.json \
                 does not say how wide they are here",
                version
            ));
        }
        width / head_dim
    };
    let [(dit_key, dit_blocks), (vl_key, vl_blocks)] = BLOCKS;
    let mut dit = json!({
        "attention_head_dim": DIT_HEAD_DIM,
        "interleave_self_attention": true,
        "norm_type": "ada_norm",
        "num_attention_heads": heads("input_embedding_dim", width, DIT_HEAD_DIM),
        "num_layers": tensors.blocks(dit_blocks),
        "output_dim": hidden,
        "positional_embeddings": null,
    });
    if !version.is_flat() {
        dit["cross_attention_dim"] = json!(context);
    }
    let vl_layers = tensors.blocks(vl_blocks);
    if vl_layers > 0 || !version.is_flat() {
        let vl = json!({
            "attention_head_dim": VL_HEAD_DIM,
            "num_attention_heads": heads("backbone_embedding_dim", context, VL_HEAD_DIM),
            "num_layers": vl_layers,
            "positional_embeddings": null,
        });
        head.insert(vl_key.to_owned(), vl);
    }
    head.insert(dit_key.to_owned(), dit);
}

/// The width of a state: by the policy's config, by the tensors, and how many of them make the state row.
struct StateSizes {
    given: Option<u64>,
    found: u64,
    history: u64,
}

fn state_sizes(policy: &Object, version: Version, tensors: &HeadShapes<'_>) -> StateSizes {
    let inputs = tensors.size("state_encoder.layer1.W", 3, 1).unwrap_or(1) as u64;
    let given = policy.get("max_state_dim").and_then(Value::as_u64);
    let given = given.map(|dim| widened(version, dim, 64));
    let history = match given {
        // An encoder without inputs is refused later, by its size.
        Some(dim) if version.has(Feature::StateHistory) && dim > 0 && inputs.is_multiple_of(dim) => {
            (inputs / dim).max(1)
        }
        _ => 1,
    };
    StateSizes {
        given,
        found: inputs / history,
        history,
    }
}

/// The width that lerobot pads to, where a policy's config may still have the `default` of N1.5.
fn widened(version: Version, dim: u64, default: u64) -> u64 {
    let padded_to = version
        .release()
        .lerobot
        .as_ref()
        .and_then(|lerobot| lerobot.padded_to);
    padded_to.filter(|_| dim == default).unwrap_or(dim)
}
