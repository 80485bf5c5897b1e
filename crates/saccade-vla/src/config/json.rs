//! Reading a head's config from JSON: every key is checked, and one error lists all problems.

use std::ops::RangeInclusive;

use serde_json::{Map, Value};

use super::checkpoint_config::{CheckpointConfig, OWN_KEY, Object};
use super::consistency::contradictions;
use super::head_config::{HeadConfig, MAX_SIZE};
use crate::error::{Error, Result, problem};
use crate::release::{FEATURE_KEYS, Feature, Version};

/// No head has more blocks; the names of their tensors are written out.
const MAX_LAYERS: u64 = 1024;

/// Whether a transformer is asked for: N1.7's class builds none of null, nor of a config without layers.
fn has_layers(cfg: &Value) -> bool {
    match cfg {
        Value::Object(cfg) => cfg.get("num_layers").is_some_and(|layers| *layers != 0),
        _ => !cfg.is_null(),
    }
}

impl HeadConfig {
    /// Reads a whole checkpoint config (with `action_head_cfg`, or flat as those of N1.6 and N1.7 are) or the
    /// head's own.
    ///
    /// `model_type` says the version; without it the keys do.
    ///
    /// # Errors
    /// [`Error::Checkpoint`] with everything that is missing, of the wrong type or contradictory.
    pub fn from_json(text: &str) -> Result<Self> {
        let config = CheckpointConfig::parse(text)?;
        let mut reader = Reader { problems: Vec::new() };
        let version = reader.version(&config);
        let head = reader.head(version, config.head());
        if reader.problems.is_empty() {
            return Ok(head);
        }
        Err(Error::Checkpoint(problem!(
            "config"; "{}", reader.problems.join("; ")
        )))
    }
}

/// Whether a key that only some versions have asks for something.
fn is_asked_for(key: &str, given: &Value) -> bool {
    match (key, given) {
        (_, Value::Bool(flag)) if key.starts_with("use_") => *flag,
        _ if key.starts_with("use_") => false,
        ("vl_self_attention_cfg", cfg) => has_layers(cfg),
        ("state_history_length", length) => *length != 0 && *length != 1 && !length.is_null(),
        (_, size) => *size != 0 && !size.is_null(),
    }
}

/// Reads keys and collects all problems, so that one error lists everything.
struct Reader {
    problems: Vec<String>,
}

impl Reader {
    /// The version that `model_type` names. Without it, the one that the keys of the head belong to: configs
    /// of heads alone did not always name a model.
    fn version(&mut self, config: &CheckpointConfig) -> Version {
        let declared = config.declared();
        if let Some(first) = declared.first() {
            if let Some(other) = declared.iter().find(|other| other.version != first.version) {
                self.problems.push(format!("{}, but {}", first.text, other.text));
            }
            match first.version {
                Some(version) => return version,
                None => self.problems.push(format!(
                    "{}, expected one of {}",
                    first.text,
                    Version::model_types()
                )),
            }
        }
        let head = config.head();
        let names = |keys: &[&str]| keys.iter().any(|key| head.contains_key(*key));
        if names(&["num_target_vision_tokens", "use_multi_action_heads"]) {
            Version::N15
        } else if names(&["state_history_length"]) {
            Version::N17
        } else if names(&["use_alternate_vl_dit"]) || names(&["max_action_dim"]) && !names(&["action_dim"]) {
            match names(&["vl_self_attention_cfg"]) {
                true => Version::N17,
                false => Version::N16,
            }
        } else if names(&["use_vlln", "vl_self_attention_cfg"]) {
            Version::N15
        } else {
            Version::N1
        }
    }

    fn head(&mut self, version: Version, head: &Object) -> HeadConfig {
        self.refuse_keys_of_other_versions(version, head);
        let empty = Map::new();
        let dit = self.object(head, "diffusion_model_cfg").unwrap_or(&empty);
        let path = "diffusion_model_cfg.";
        self.expect_defaults(
            dit,
            path,
            &[
                ("norm_type", Value::from("ada_norm")),
                ("norm_elementwise_affine", Value::from(false)),
            ],
        );
        self.expect_plain_blocks(dit, path);
        let num_layers = self.layers(dit, path, 1);
        let num_heads = self.size(dit, path, "num_attention_heads", 1);
        let head_dim = self.size(dit, path, "attention_head_dim", 1);
        let interleave_self_attention = self.flag(dit, path, "interleave_self_attention", None);
        // The width appears twice; upstream's default for one of them fits a single size of the other.
        let width = match head.contains_key("input_embedding_dim") {
            true => self.size(head, "", "input_embedding_dim", 1),
            false => num_heads * head_dim,
        };
        let context_dim = match version.has(Feature::ContextWidth) {
            true => self.size_of(version, head, "backbone_embedding_dim", 1),
            false => self.cross_dim(dit).unwrap_or(width),
        };
        let use_vlln = version.has(Feature::VlNorm) && self.flag(head, "", "use_vlln", Some(true));
        let [vl_num_layers, vl_num_heads, vl_head_dim] = match self.vl_self_attention(version, head, use_vlln)
        {
            Some(vl) => self.vl_sizes(vl),
            None => [0, 1, context_dim],
        };
        let alternates = version.has(Feature::AlternatingBlocks)
            && self.flag(head, "", "use_alternate_vl_dit", Some(true));
        let (encoder_action_dim, decoders) = self.actions(version, head);
        let state_history = match version.has(Feature::StateHistory) {
            true => self.size_of(version, head, "state_history_length", 1),
            false => 1,
        };
        let config = HeadConfig {
            version,
            width,
            num_layers,
            num_heads,
            head_dim,
            context_dim,
            interleave_self_attention,
            attend_text_every_n_blocks: match alternates {
                true => self.size_of(version, head, "attend_text_every_n_blocks", 1),
                false => 0,
            },
            use_vlln,
            vl_num_layers,
            vl_num_heads,
            vl_head_dim,
            num_future_tokens: match version.has(Feature::FutureTokens) {
                true => self.size_of(version, head, "num_target_vision_tokens", 0),
                false => 0,
            },
            future_key_bias: self.future_key_bias(head),
            action_horizon: self.size_of(version, head, "action_horizon", 1),
            action_dim: decoders.iter().map(|(_, width)| width).sum(),
            encoder_action_dim,
            decoders,
            state_dim: self.size_of(version, head, "max_state_dim", 1),
            state_history,
            num_states: state_history,
            hidden_dim: self.size_of(version, head, "hidden_size", 1),
            num_embodiments: self.size_of(version, head, "max_num_embodiments", 1),
            num_timestep_buckets: self.size_of(version, head, "num_timestep_buckets", 1),
            num_steps: self.size_of(version, head, "num_inference_timesteps", 1),
            max_positions: self.size_of(version, head, "max_seq_len", 1),
            add_pos_embed: self.flag(head, "", "add_pos_embed", Some(true)),
        };
        if self.problems.is_empty() {
            self.problems = contradictions(version, &config, head, dit);
        }
        config
    }

    /// Lists keys that ask for what the version's class does not have: a head without it would be silently
    /// wrong.
    fn refuse_keys_of_other_versions(&mut self, version: Version, head: &Object) {
        for (key, feature) in FEATURE_KEYS {
            let Some(given) = head.get(key).filter(|given| is_asked_for(key, given)) else {
                continue;
            };
            if !version.has(feature) {
                let names: Vec<_> = Version::with(feature).iter().map(Version::to_string).collect();
                self.problems.push(format!(
                    "{key} is {given}, which only {} has, but this is a config of {version}",
                    names.join(", "),
                ));
            }
        }
    }

    /// The config of the VL self-attention, where the version's class builds one.
    fn vl_self_attention<'a>(
        &mut self,
        version: Version,
        head: &'a Object,
        use_vlln: bool,
    ) -> Option<&'a Object> {
        let key = "vl_self_attention_cfg";
        let is_built = match version.is_flat() {
            false => use_vlln,
            true => head.get(key).is_some_and(has_layers),
        };
        if is_built && version.has(Feature::VlSelfAttention) {
            return self.object(head, key);
        }
        None
    }

    /// Blocks, attention heads and width of one of these of the VL self-attention.
    fn vl_sizes(&mut self, vl: &Object) -> [usize; 3] {
        let path = "vl_self_attention_cfg.";
        self.expect_plain_blocks(vl, path);
        [
            self.layers(vl, path, 0),
            self.size(vl, path, "num_attention_heads", 1),
            self.size(vl, path, "attention_head_dim", 1),
        ]
    }

    /// The width of an action as it is denoised, and the decoders (equation 13 of docs/equations.md).
    fn actions(&mut self, version: Version, head: &Object) -> (usize, Vec<(String, usize)>) {
        let one = |width| vec![("action_decoder".to_owned(), width)];
        if version.is_flat() {
            let width = self.size_of(version, head, "max_action_dim", 1);
            return (width, one(width));
        }
        let action_dim = self.size(head, "", "action_dim", 1);
        let pretrained = head
            .get("pretrained_action_dim")
            .is_some_and(|value| !value.is_null());
        let pretrained = pretrained.then(|| self.size(head, "", "pretrained_action_dim", 1));
        if !self.flag(head, "", "use_multi_action_heads", Some(false)) {
            return (pretrained.unwrap_or(action_dim), one(action_dim));
        }
        let parts: &[&str] = match self.flag(head, "", "split_arm_heads", Some(false)) {
            false => &["arm", "claw"],
            true => &["left_arm", "right_arm", "claw"],
        };
        if parts.len() == 3 && self.flag(head, "", "use_shared_arm_features", Some(false)) {
            self.problems.push(
                "use_shared_arm_features is true, expected false: arms with a decoder of their own each"
                    .to_owned(),
            );
        }
        let decoders: Vec<_> = parts
            .iter()
            .map(|part| {
                let width = self.size_of(version, head, &format!("action_{part}_dim"), 1);
                (format!("action_{part}_decoder"), width)
            })
            .collect();
        let together: usize = decoders.iter().map(|(_, width)| width).sum();
        // The fork writes the width of the pretrained encoder as `action_dim` and makes both of it when it
        // loads.
        if pretrained.is_some() && action_dim != together {
            self.problems.push(format!(
                "action_dim is {action_dim}, but the decoders of {} have {together} outputs",
                parts.join(", ")
            ));
        }
        (pretrained.unwrap_or(action_dim), decoders)
    }

    /// `saccade.future_key_bias`: one finite number for each future token.
    fn future_key_bias(&mut self, head: &Object) -> Option<Vec<f32>> {
        let own = match head.get(OWN_KEY) {
            None => return None,
            Some(Value::Object(own)) => own,
            Some(_) => {
                self.problems.push("saccade: expected an object".to_owned());
                return None;
            }
        };
        let unknown = own.keys().filter(|key| *key != "future_key_bias");
        self.problems
            .extend(unknown.map(|key| format!("saccade.{key} is unknown, expected future_key_bias")));
        let given = own.get("future_key_bias").filter(|given| !given.is_null())?;
        let numbers: Option<Vec<f32>> = given.as_array().and_then(|given| {
            let number = |value: &Value| value.as_f64().map(|number| number as f32);
            given.iter().map(number).collect()
        });
        match numbers {
            Some(numbers) if numbers.iter().all(|number| number.is_finite()) => Some(numbers),
            _ => {
                self.problems
                    .push("saccade.future_key_bias: expected a list of finite numbers".to_owned());
                None
            }
        }
    }

    /// What the blocks of both transformers have in common.
    fn expect_plain_blocks(&mut self, cfg: &Object, path: &str) {
        // Left out, upstream's class adds sinusoidal ones.
        if !cfg.contains_key("positional_embeddings") {
            self.problems
                .push(format!("{path}positional_embeddings is missing, expected null"));
        }
        self.expect_defaults(
            cfg,
            path,
            &[
                ("positional_embeddings", Value::Null),
                ("activation_fn", Value::from("gelu-approximate")),
                ("attention_bias", Value::from(true)),
                ("norm_eps", Value::from(1e-5)),
            ],
        );
    }

    /// Keys that may be absent, but if present must have the value that the released head was built with.
    fn expect_defaults(&mut self, map: &Object, path: &str, expected: &[(&str, Value)]) {
        for (key, value) in expected {
            if let Some(given) = map.get(*key)
                && given != value
            {
                self.problems
                    .push(format!("{path}{key} is {given}, expected {value}"));
            }
        }
    }

    fn object<'a>(&mut self, map: &'a Object, key: &str) -> Option<&'a Object> {
        match map.get(key) {
            Some(Value::Object(object)) => return Some(object),
            Some(_) => self.problems.push(format!("{key}: expected an object")),
            None => self.problems.push(format!("{key} is missing")),
        }
        None
    }

    /// The width that keys and values of the cross-attention are made from, where it is not the transformer's
    /// own.
    fn cross_dim(&mut self, dit: &Object) -> Option<usize> {
        let is_given = dit
            .get("cross_attention_dim")
            .is_some_and(|value| !value.is_null());
        is_given.then(|| self.size(dit, "diffusion_model_cfg.", "cross_attention_dim", 1))
    }

    fn layers(&mut self, map: &Object, path: &str, least: u64) -> usize {
        self.size_within(map, path, "num_layers", least..=MAX_LAYERS)
    }

    fn size(&mut self, map: &Object, path: &str, key: &str, least: u64) -> usize {
        self.size_within(map, path, key, least..=MAX_SIZE)
    }

    /// A size of the head, or what the version's class takes in its place.
    fn size_of(&mut self, version: Version, head: &Object, key: &str, least: u64) -> usize {
        match version.default_size(key) {
            Some(default) if !head.contains_key(key) => default,
            _ => self.size(head, "", key, least),
        }
    }

    fn size_within(&mut self, map: &Object, path: &str, key: &str, sizes: RangeInclusive<u64>) -> usize {
        let problem = match map.get(key) {
            None => format!("{path}{key} is missing"),
            Some(value) => match value.as_u64() {
                Some(size) if sizes.contains(&size) => return size as usize,
                _ => format!(
                    "{path}{key} is {value}, expected a whole number from {} to {}",
                    sizes.start(),
                    sizes.end()
                ),
            },
        };
        self.problems.push(problem);
        1
    }

    fn flag(&mut self, map: &Object, path: &str, key: &str, default: Option<bool>) -> bool {
        let problem = match (map.get(key), default) {
            (Some(Value::Bool(flag)), _) => return *flag,
            (None, Some(flag)) => return flag,
            (None, None) => format!("{path}{key} is missing"),
            (Some(value), _) => format!("{path}{key} is {value}, expected true or false"),
        };
        self.problems.push(problem);
        false
    }
}
