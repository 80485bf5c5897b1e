//! Sizes of a head from the shapes of its tensors.

use saccade_vla_checkpoint::{Checkpoint, Dtype};
use serde_json::{Value, json};

use crate::config::Object;
use crate::error::show_shape;
use crate::release::{Feature, Version};

/// The name, without a prefix, of the future tokens.
pub(crate) const FUTURE_TOKENS: &str = "future_tokens.weight";

/// The projection of the vision-language tokens to keys, in the first block.
const CROSS_KEYS: &str = "model.transformer_blocks.0.attn1.to_k.weight";

const DECODER: &str = "action_decoder";
const ARM: &str = "action_arm_decoder";
const LEFT_ARM: &str = "action_left_arm_decoder";
const RIGHT_ARM: &str = "action_right_arm_decoder";
const CLAW: &str = "action_claw_decoder";

/// The shapes of the head's tensors, by their names without the prefix.
pub(super) struct HeadShapes<'a> {
    pub checkpoint: &'a Checkpoint,
    pub prefix: &'static str,
}

impl HeadShapes<'_> {
    pub(super) fn shape(&self, name: &str) -> Option<&[usize]> {
        self.checkpoint.shape(&format!("{}{name}", self.prefix))
    }

    /// The size of tensor `name` on `axis`, if it is there with `axes` axes. Rows of int4 have two elements in a byte: of an odd
    /// number the size is one more.
    pub(super) fn size(&self, name: &str, axes: usize, axis: usize) -> Option<usize> {
        let per_element = if axis + 1 == axes && self.is_int4(name) {
            2
        } else {
            1
        };
        self.shape(name)
            .filter(|shape| shape.len() == axes)
            .map(|shape| shape[axis].saturating_mul(per_element))
    }

    fn is_int4(&self, name: &str) -> bool {
        let dtype = self.checkpoint.dtype(&format!("{}{name}", self.prefix));
        matches!(dtype, Ok(Dtype::U8))
    }

    /// Whether a tensor's name begins with `start`.
    pub(super) fn any(&self, start: &str) -> bool {
        let start = format!("{}{start}", self.prefix);
        self.checkpoint.names().any(|name| name.starts_with(&start))
    }

    /// How many blocks `path.0`, `path.1`, ... have a query projection.
    pub(super) fn blocks(&self, path: &str) -> usize {
        (0..)
            .take_while(|index| self.shape(&format!("{path}.{index}.attn1.to_q.weight")).is_some())
            .count()
    }

    /// Outputs of an action decoder, if it is there.
    pub(super) fn decoder(&self, name: &str) -> Option<usize> {
        self.size(&format!("{name}.layer2.W"), 3, 2)
    }

    /// Whether it has the fork's action decoders.
    pub(super) fn has_several_decoders(&self) -> bool {
        DECODERS.iter().any(|(name, _)| self.decoder(name).is_some())
    }

    /// A tensor's full name and its shape, for messages.
    pub(super) fn show(&self, name: &str) -> String {
        let shape = self.shape(name).unwrap_or_default();
        format!("{}{name} is {}", self.prefix, show_shape(shape))
    }
}

/// Sizes that shapes of tensors prove, under the keys of the head's config; each with the tensor that does.
pub(super) fn proved(version: Version, tensors: &HeadShapes<'_>) -> Vec<(&'static str, usize, String)> {
    let mut sizes = Vec::new();
    let mut add = |key, name: &str, axes, axis| {
        if let Some(size) = tensors.size(name, axes, axis) {
            sizes.push((key, size, tensors.show(name)));
        }
    };
    add("input_embedding_dim", "action_encoder.W3.W", 3, 2);
    add("hidden_size", "state_encoder.layer1.W", 3, 2);
    add("max_num_embodiments", "state_encoder.layer1.W", 3, 0);
    add("max_seq_len", "position_embedding.weight", 2, 0);
    add("backbone_embedding_dim", CROSS_KEYS, 2, 1);
    let action_dim = match (version.is_flat(), tensors.has_several_decoders()) {
        (true, _) => "max_action_dim",
        (false, true) => "pretrained_action_dim",
        (false, false) => "action_dim",
    };
    add(action_dim, "action_encoder.W1.W", 3, 1);
    // With a history, the inputs of the state encoder are several states.
    if !version.has(Feature::StateHistory) {
        add("max_state_dim", "state_encoder.layer1.W", 3, 1);
    }
    if version.has(Feature::FutureTokens) {
        add("num_target_vision_tokens", FUTURE_TOKENS, 2, 0);
    }
    for (name, key) in DECODERS {
        add(key, &format!("{name}.layer2.W"), 3, 2);
    }
    sizes
}

/// The fork's decoders and the keys of their widths.
pub(super) const DECODERS: [(&str, &str); 4] = [
    (ARM, "action_arm_dim"),
    (LEFT_ARM, "action_left_arm_dim"),
    (RIGHT_ARM, "action_right_arm_dim"),
    (CLAW, "action_claw_dim"),
];

/// The head's config with what tensors prove and the published file leaves out, and where the two disagree.
pub(super) fn complete(head: &Object, version: Version, tensors: &HeadShapes<'_>) -> (Object, Vec<String>) {
    let mut head = head.clone();
    head.insert("model_type".to_owned(), json!(version.release().model_type));
    if version.has(Feature::FutureTokens) && !tensors.any("future_tokens.") {
        // The first files of N1.5 were without.
        head.entry("num_target_vision_tokens").or_insert(json!(0));
    }
    add_decoders(&mut head, tensors);
    let mut problems = Vec::new();
    for (key, size, shown) in proved(version, tensors) {
        // Whether it is odd is not told by int4; all shapes are compared with the config's later.
        let may_be_less = key == "backbone_embedding_dim" && tensors.is_int4(CROSS_KEYS);
        match head.get(key).map(Value::as_u64) {
            Some(Some(given)) if given != size as u64 && !(may_be_less && given + 1 == size as u64) => {
                problems.push(format!("{key} is {given} in the config, but {shown}"));
            }
            // `HeadConfig` refuses values that are no numbers.
            Some(_) => {}
            None if MAY_BE_LEFT_OUT.contains(&key) => {
                head.insert(key.to_owned(), json!(size));
            }
            None => {}
        }
    }
    for (cfg, path) in BLOCKS {
        let (given, found) = (
            head.get(cfg)
                .and_then(|cfg| cfg.get("num_layers"))
                .and_then(Value::as_u64),
            tensors.blocks(path),
        );
        if let Some(given) = given
            && given != found as u64
            && found > 0
        {
            problems.push(format!(
                "{cfg}.num_layers is {given} in the config, but {path} has {found} blocks"
            ));
        }
    }
    (head, problems)
}

/// Keys that published files leave to the defaults of a class, which need not be what the tensors are.
const MAY_BE_LEFT_OUT: [&str; 7] = [
    "max_num_embodiments",
    "max_seq_len",
    "pretrained_action_dim",
    "action_arm_dim",
    "action_left_arm_dim",
    "action_right_arm_dim",
    "action_claw_dim",
];

/// The keys of the transformers' configs, and where their blocks are.
pub(super) const BLOCKS: [(&str, &str); 2] = [
    ("diffusion_model_cfg", "model.transformer_blocks"),
    ("vl_self_attention_cfg", "vl_self_attention.transformer_blocks"),
];

/// The fork's keys, where its decoders are there and the file does not name them: its code makes them up
/// while it loads.
pub(super) fn add_decoders(head: &mut Object, tensors: &HeadShapes<'_>) {
    let widths = DECODERS.iter().filter_map(|(name, _)| tensors.decoder(name));
    // Shapes of tensors without elements may be anything.
    let Some(together) = widths.reduce(usize::saturating_add) else {
        return;
    };
    if tensors.decoder(DECODER).is_some() {
        return;
    }
    head.entry("use_multi_action_heads").or_insert(json!(true));
    if let (Some(left), Some(right)) = (tensors.decoder(LEFT_ARM), tensors.decoder(RIGHT_ARM)) {
        head.entry("split_arm_heads").or_insert(json!(true));
        head.entry("action_arm_dim")
            .or_insert(json!(left.saturating_add(right)));
    }
    if !head.contains_key("pretrained_action_dim") || !head.contains_key("action_dim") {
        // What the file calls action_dim is then the width of the model that the fork started from.
        head.insert("action_dim".to_owned(), json!(together));
    }
}
