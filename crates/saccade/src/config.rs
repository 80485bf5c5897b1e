//! The head's configuration, read from a checkpoint's `config.json`.
//!
//! The names in JSON are the released ones (`input_embedding_dim`, `num_target_vision_tokens`); the fields here are the house's.

use serde_json::{Map, Value};

use crate::error::{Error, Result};

/// The sizes and switches of an action head.
#[derive(Clone, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub struct HeadConfig {
    /// Release of the architecture, `"n1.5"`.
    pub version: String,
    /// Width of the diffusion transformer (`input_embedding_dim`).
    pub width: usize,
    /// Blocks of the diffusion transformer.
    pub num_layers: usize,
    /// Attention heads of the diffusion transformer.
    pub num_heads: usize,
    /// Width of one of these heads; `num_heads * head_dim == width`.
    pub head_dim: usize,
    /// Width of the vision-language tokens (`backbone_embedding_dim`).
    pub context_dim: usize,
    /// Whether every second block is self-attention; otherwise all are cross-attention.
    pub interleave_self_attention: bool,
    /// Whether `vlln` and the VL self-attention are there.
    pub use_vlln: bool,
    /// Blocks of the VL self-attention; 0 without `use_vlln`.
    pub vl_num_layers: usize,
    /// Attention heads of the VL self-attention.
    pub vl_num_heads: usize,
    /// Width of one of these heads; `vl_num_heads * vl_head_dim == context_dim`.
    pub vl_head_dim: usize,
    /// Learned query rows between state and actions (`num_target_vision_tokens`).
    pub num_future_tokens: usize,
    /// Actions in a chunk.
    pub action_horizon: usize,
    /// Width of an action as it is returned.
    pub action_dim: usize,
    /// Width of an action as it is denoised.
    pub encoder_action_dim: usize,
    /// Width of the state vector (`max_state_dim`).
    pub state_dim: usize,
    /// State vectors that make the state row.
    pub state_history: usize,
    /// Hidden width of the encoders and the decoder (`hidden_size`).
    pub hidden_dim: usize,
    /// Slices of the category-specific layers (`max_num_embodiments`).
    pub num_embodiments: usize,
    /// Buckets that time 0..1 is cut into.
    pub num_timestep_buckets: usize,
    /// Euler steps unless a call says otherwise (`num_inference_timesteps`).
    pub num_steps: usize,
    /// Rows of the position table (`max_seq_len`).
    pub max_positions: usize,
    /// Whether action rows get a position.
    pub add_pos_embed: bool,
}

impl HeadConfig {
    /// Reads a whole checkpoint config (with `action_head_cfg`) or the head's own.
    ///
    /// # Errors
    /// [`Error::Checkpoint`] with everything that is missing, of the wrong type or contradictory.
    pub fn from_json(text: &str) -> Result<Self> {
        let value: Value = serde_json::from_str(text)
            .map_err(|error| Error::Checkpoint(format!("config: not valid JSON: {error}")))?;
        let Value::Object(top) = &value else {
            return Err(Error::Checkpoint("config: expected a JSON object".to_owned()));
        };
        let head = match top.get("action_head_cfg") {
            None => top,
            Some(Value::Object(head)) => head,
            Some(_) => {
                return Err(Error::Checkpoint(
                    "config: action_head_cfg: expected an object".to_owned(),
                ));
            }
        };
        let mut reader = Reader { problems: Vec::new() };
        let config = reader.head(head);
        if reader.problems.is_empty() {
            Ok(config)
        } else {
            Err(Error::Checkpoint(format!(
                "config: {}",
                reader.problems.join("; ")
            )))
        }
    }

    /// Rows of the query sequence: state, future, action.
    #[must_use]
    pub fn num_rows(&self) -> usize {
        1 + self.num_future_tokens + self.action_horizon
    }

    /// Whether block `index` attends to the vision-language tokens.
    #[must_use]
    pub fn is_cross(&self, index: usize) -> bool {
        !self.interleave_self_attention || index.is_multiple_of(2)
    }
}

/// No size in a config is larger: products of three of them stay far below `u64::MAX`.
const MAX_SIZE: u64 = 1 << 20;

/// Class defaults of the released code for keys that published configs leave out.
const DEFAULT_NUM_EMBODIMENTS: usize = 32;
const DEFAULT_MAX_POSITIONS: usize = 1024;

/// Reads keys and remembers all that is wrong, so that one error lists everything.
struct Reader {
    problems: Vec<String>,
}

impl Reader {
    fn head(&mut self, head: &Map<String, Value>) -> HeadConfig {
        self.refuse_other_versions(head);
        let empty = Map::new();
        let dit = self.object(head, "diffusion_model_cfg").unwrap_or(&empty);
        let (dit_path, vl_path) = ("diffusion_model_cfg.", "vl_self_attention_cfg.");

        let use_vlln = self.flag(head, "", "use_vlln");
        let context_dim = self.size(head, "", "backbone_embedding_dim", 1);
        let (vl_num_layers, vl_num_heads, vl_head_dim) = if use_vlln {
            let vl = self.object(head, "vl_self_attention_cfg").unwrap_or(&empty);
            self.expect_defaults(
                vl,
                vl_path,
                &[
                    ("positional_embeddings", Value::Null),
                    ("activation_fn", Value::from("gelu-approximate")),
                    ("attention_bias", Value::from(true)),
                    ("norm_eps", Value::from(1e-5)),
                ],
            );
            (
                self.size(vl, vl_path, "num_layers", 0),
                self.size(vl, vl_path, "num_attention_heads", 1),
                self.size(vl, vl_path, "attention_head_dim", 1),
            )
        } else {
            (0, 1, context_dim)
        };
        self.expect_defaults(
            dit,
            dit_path,
            &[
                ("norm_type", Value::from("ada_norm")),
                ("positional_embeddings", Value::Null),
                ("activation_fn", Value::from("gelu-approximate")),
                ("attention_bias", Value::from(true)),
                ("norm_elementwise_affine", Value::from(false)),
                ("norm_eps", Value::from(1e-5)),
            ],
        );
        let action_dim = self.size(head, "", "action_dim", 1);
        let config = HeadConfig {
            version: "n1.5".to_owned(),
            width: self.size(head, "", "input_embedding_dim", 1),
            num_layers: self.size(dit, dit_path, "num_layers", 1),
            num_heads: self.size(dit, dit_path, "num_attention_heads", 1),
            head_dim: self.size(dit, dit_path, "attention_head_dim", 1),
            context_dim,
            interleave_self_attention: self.flag(dit, dit_path, "interleave_self_attention"),
            use_vlln,
            vl_num_layers,
            vl_num_heads,
            vl_head_dim,
            num_future_tokens: self.size(head, "", "num_target_vision_tokens", 0),
            action_horizon: self.size(head, "", "action_horizon", 1),
            action_dim,
            encoder_action_dim: action_dim,
            state_dim: self.size(head, "", "max_state_dim", 1),
            state_history: 1,
            hidden_dim: self.size(head, "", "hidden_size", 1),
            num_embodiments: self.size_or(head, "max_num_embodiments", DEFAULT_NUM_EMBODIMENTS),
            num_timestep_buckets: self.size(head, "", "num_timestep_buckets", 1),
            num_steps: self.size(head, "", "num_inference_timesteps", 1),
            max_positions: self.size_or(head, "max_seq_len", DEFAULT_MAX_POSITIONS),
            add_pos_embed: self.flag(head, "", "add_pos_embed"),
        };
        if self.problems.is_empty() {
            self.check_agreement(&config, head, dit);
        }
        config
    }

    /// Later versions and forks have other layers: running them as N1.5 would be silently wrong.
    fn refuse_other_versions(&mut self, head: &Map<String, Value>) {
        for key in [
            "use_alternate_vl_dit",
            "use_multi_action_heads",
            "split_arm_heads",
        ] {
            if head.get(key) == Some(&Value::Bool(true)) {
                self.problems.push(format!(
                    "{key} is true: expected a GR00T N1.5 head, the only kind read so far"
                ));
            }
        }
    }

    fn check_agreement(&mut self, config: &HeadConfig, head: &Map<String, Value>, dit: &Map<String, Value>) {
        let mut equal = |what: &str, given: usize, other: &str, expected: usize| {
            if given != expected {
                self.problems
                    .push(format!("{what} is {given}, but {other} is {expected}"));
            }
        };
        equal(
            "input_embedding_dim",
            config.width,
            "diffusion_model_cfg.num_attention_heads x attention_head_dim",
            config.num_heads * config.head_dim,
        );
        if config.use_vlln && config.vl_num_layers > 0 {
            equal(
                "backbone_embedding_dim",
                config.context_dim,
                "vl_self_attention_cfg.num_attention_heads x attention_head_dim",
                config.vl_num_heads * config.vl_head_dim,
            );
        }
        let number = |map: &Map<String, Value>, key: &str| map.get(key).and_then(Value::as_u64);
        if let Some(cross) = number(dit, "cross_attention_dim") {
            equal(
                "diffusion_model_cfg.cross_attention_dim",
                usize::try_from(cross).unwrap_or(usize::MAX),
                "backbone_embedding_dim",
                config.context_dim,
            );
        }
        if let Some(output) = number(dit, "output_dim") {
            equal(
                "diffusion_model_cfg.output_dim",
                usize::try_from(output).unwrap_or(usize::MAX),
                "hidden_size",
                config.hidden_dim,
            );
        }
        if let Some(pretrained) = number(head, "pretrained_action_dim") {
            equal(
                "pretrained_action_dim",
                usize::try_from(pretrained).unwrap_or(usize::MAX),
                "action_dim",
                config.action_dim,
            );
        }
        if !config.width.is_multiple_of(2) {
            self.problems.push(format!(
                "input_embedding_dim is {}, expected an even number (half sines, half cosines)",
                config.width
            ));
        }
        if config.add_pos_embed && config.action_horizon > config.max_positions {
            self.problems.push(format!(
                "action_horizon is {}, more than the {} rows of the position table (max_seq_len)",
                config.action_horizon, config.max_positions
            ));
        }
        if config.num_steps > config.num_timestep_buckets {
            self.problems.push(format!(
                "num_inference_timesteps is {}, more than num_timestep_buckets {}",
                config.num_steps, config.num_timestep_buckets
            ));
        }
    }

    /// Keys that may be absent, but if present must have the value that the released head was built with.
    fn expect_defaults(&mut self, map: &Map<String, Value>, path: &str, expected: &[(&str, Value)]) {
        for (key, value) in expected {
            if let Some(given) = map.get(*key)
                && given != value
            {
                self.problems
                    .push(format!("{path}{key} is {given}, expected {value}"));
            }
        }
    }

    fn object<'a>(&mut self, map: &'a Map<String, Value>, key: &str) -> Option<&'a Map<String, Value>> {
        match map.get(key) {
            Some(Value::Object(object)) => return Some(object),
            Some(_) => self.problems.push(format!("{key}: expected an object")),
            None => self.problems.push(format!("{key} is missing")),
        }
        None
    }

    fn size(&mut self, map: &Map<String, Value>, path: &str, key: &str, least: u64) -> usize {
        let problem = match map.get(key) {
            None => format!("{path}{key} is missing"),
            Some(value) => match value.as_u64() {
                Some(size) if (least..=MAX_SIZE).contains(&size) => return size as usize,
                _ => format!("{path}{key} is {value}, expected a whole number from {least} to {MAX_SIZE}"),
            },
        };
        self.problems.push(problem);
        1
    }

    fn size_or(&mut self, map: &Map<String, Value>, key: &str, default: usize) -> usize {
        if map.contains_key(key) {
            self.size(map, "", key, 1)
        } else {
            default
        }
    }

    fn flag(&mut self, map: &Map<String, Value>, path: &str, key: &str) -> bool {
        let problem = match map.get(key) {
            None => format!("{path}{key} is missing"),
            Some(Value::Bool(flag)) => return *flag,
            Some(value) => format!("{path}{key} is {value}, expected true or false"),
        };
        self.problems.push(problem);
        false
    }
}
