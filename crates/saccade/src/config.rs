//! The head's configuration, read from a checkpoint's `config.json`.
//!
//! The names in JSON are the released ones (`input_embedding_dim`, `num_target_vision_tokens`); the fields here are the house's.

use std::ops::RangeInclusive;

use serde_json::{Map, Value};

use crate::error::{Error, Result};

/// The sizes and switches of an action head.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub struct HeadConfig {
    /// Release of the architecture: `"n1"`, `"n1.5"`, `"n1.6"` or `"n1.7"`. What the head computes is said by the other fields.
    pub version: String,
    /// Width of the diffusion transformer (`input_embedding_dim`).
    pub width: usize,
    /// Blocks of the diffusion transformer.
    pub num_layers: usize,
    /// Attention heads of the diffusion transformer.
    pub num_heads: usize,
    /// Width of one of these heads; `num_heads * head_dim == width`.
    pub head_dim: usize,
    /// Width of the vision-language tokens (`backbone_embedding_dim`; N1: `cross_attention_dim`).
    pub context_dim: usize,
    /// Whether every second block is self-attention; otherwise all are cross-attention.
    pub interleave_self_attention: bool,
    /// If not 0, cross-attention blocks see attended positions only: of text in every so many of them, from the first one on, and of images in
    /// the others (spec 5.3). 0: all of them see all positions, masks or not (spec 1.9).
    pub attend_text_every_n_blocks: usize,
    /// Whether the vision-language tokens pass the norm `vlln`.
    pub use_vlln: bool,
    /// Blocks of the VL self-attention, 0 without one.
    pub vl_num_layers: usize,
    /// Attention heads of the VL self-attention.
    pub vl_num_heads: usize,
    /// Width of one of these heads; `vl_num_heads * vl_head_dim == context_dim`.
    pub vl_head_dim: usize,
    /// Learned query rows between state and actions (`num_target_vision_tokens`).
    pub num_future_tokens: usize,
    /// What is added to the logits of each future key in every self-attention block: the logarithms of how many tokens each stands for
    /// (spec I2). Saccade's own: no published program reads it.
    pub future_key_bias: Option<Vec<f32>>,
    /// Actions in a chunk.
    pub action_horizon: usize,
    /// Width of an action as it is returned.
    pub action_dim: usize,
    /// Width of an action as it is denoised (`pretrained_action_dim`); what it has beyond `action_dim` is held at zero.
    pub encoder_action_dim: usize,
    /// The decoders: module and width, in the order in which their outputs stand side by side; together `action_dim` wide.
    pub decoders: Vec<(String, usize)>,
    /// Width of the state vector (`max_state_dim`).
    pub state_dim: usize,
    /// State vectors that make the state row (`state_history_length`).
    pub state_history: usize,
    /// Hidden width of the encoders and the decoders (`hidden_size`).
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

/// Which of the vision-language tokens a cross-attention block sees.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Reads {
    /// All, masks or not.
    All,
    /// Those of text that are attended.
    Text,
    /// Those of images that are attended.
    Images,
}

impl HeadConfig {
    /// Reads a whole checkpoint config (with `action_head_cfg`, or flat as those of N1.6 and N1.7 are) or the head's own.
    ///
    /// `model_type` says the version; without it the keys do.
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
        reader.problems.extend(misplaced_own_key(top));
        let version = reader.version(top, head);
        let config = reader.head(version, head);
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

    /// How cross-attention blocks take masks: `"none"` ignores them, `"alternate"` is the rule of `attend_text_every_n_blocks`.
    #[must_use]
    pub fn mask_mode(&self) -> &'static str {
        match self.attend_text_every_n_blocks {
            0 => "none",
            _ => "alternate",
        }
    }

    /// What block `index` sees of the vision-language tokens, if it is cross-attention.
    pub(crate) fn reads(&self, index: usize) -> Option<Reads> {
        let every = self.attend_text_every_n_blocks;
        self.is_cross(index).then_some(match every {
            0 => Reads::All,
            _ if index.is_multiple_of(2 * every) => Reads::Text,
            _ => Reads::Images,
        })
    }
}

/// What is wrong with saccade's own key in a whole checkpoint config, whose head would not have it.
pub(crate) fn misplaced_own_key(top: &Map<String, Value>) -> Option<String> {
    let both = top.contains_key("action_head_cfg") && top.contains_key("saccade");
    both.then(|| "saccade stands beside action_head_cfg, expected inside".to_owned())
}

/// No size in a config is larger: products of three of them stay far below `u64::MAX`.
const MAX_SIZE: u64 = 1 << 20;

/// No head has more blocks; the names of their tensors are written out.
const MAX_LAYERS: u64 = 1024;

/// A release of the architecture, for what its class does with the keys that its config names or leaves out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Version {
    N1,
    N15,
    N16,
    N17,
}

impl Version {
    pub(crate) const ALL: [Self; 4] = [Self::N1, Self::N15, Self::N16, Self::N17];

    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::N1 => "n1",
            Self::N15 => "n1.5",
            Self::N16 => "n1.6",
            Self::N17 => "n1.7",
        }
    }

    pub(crate) fn model_type(self) -> &'static str {
        match self {
            Self::N1 => "gr00t_n1",
            Self::N15 => "gr00t_n1_5",
            Self::N16 => "Gr00tN1d6",
            Self::N17 => "Gr00tN1d7",
        }
    }

    /// Whether it is one of those that name `max_action_dim` and choose their transformer by `use_alternate_vl_dit`.
    fn is_flat(self) -> bool {
        matches!(self, Self::N16 | Self::N17)
    }

    /// What the version's class takes for a size that its config leaves out; none if the config must name it.
    fn default_size(self, key: &str) -> Option<usize> {
        let by_version = match (key, self) {
            ("max_state_dim" | "max_action_dim", Self::N16) => 29,
            ("max_state_dim" | "max_action_dim", Self::N17) => 132,
            ("action_horizon", Self::N16) => 16,
            ("action_horizon", Self::N17) => 40,
            ("num_inference_timesteps", Self::N16 | Self::N17) => 4,
            ("backbone_embedding_dim", Self::N16 | Self::N17) => 2048,
            ("backbone_embedding_dim", Self::N15) => 1536,
            ("num_target_vision_tokens", Self::N15) => 32,
            ("hidden_size" | "max_seq_len", _) => 1024,
            ("num_timestep_buckets", _) => 1000,
            ("max_num_embodiments", _) => 32,
            ("attend_text_every_n_blocks" | "action_claw_dim", _) => 2,
            ("action_arm_dim", _) => 14,
            ("action_left_arm_dim" | "action_right_arm_dim", _) => 7,
            ("state_history_length", _) => 1,
            _ => return None,
        };
        Some(by_version)
    }
}

/// Whether a transformer is asked for: N1.7's class builds none of null, nor of a config without layers.
fn has_layers(cfg: &Value) -> bool {
    match cfg {
        Value::Object(cfg) => cfg.get("num_layers").is_some_and(|layers| *layers != 0),
        _ => !cfg.is_null(),
    }
}

/// Reads keys and remembers all that is wrong, so that one error lists everything.
struct Reader {
    problems: Vec<String>,
}

type Object = Map<String, Value>;

impl Reader {
    /// What `model_type` says, or else what the keys of the head tell.
    fn version(&mut self, top: &Object, head: &Object) -> Version {
        // A head's own config that a program wrote whole has an empty one.
        let given = [top, head].into_iter().filter_map(|map| map.get("model_type"));
        let mut given = given.filter(|given| !given.is_null() && **given != "");
        if let Some(first) = given.next() {
            if let Some(other) = given.find(|other| *other != first) {
                self.problems.push(format!(
                    "model_type is {first}, but action_head_cfg.model_type is {other}"
                ));
            }
            let given = first;
            let known = Version::ALL
                .into_iter()
                .find(|version| *given == version.model_type());
            if let Some(version) = known {
                return version;
            }
            let names = Version::ALL.map(Version::model_type).join(", ");
            self.problems
                .push(format!("model_type is {given}, expected one of {names}"));
        }
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
        // The width is said twice; upstream's default for one of them fits a single size of the other.
        let width = match head.contains_key("input_embedding_dim") {
            true => self.size(head, "", "input_embedding_dim", 1),
            false => num_heads * head_dim,
        };
        let context_dim = match version {
            Version::N1 => self.cross_dim(dit).unwrap_or(width),
            _ => self.size_of(version, head, "backbone_embedding_dim", 1),
        };
        let use_vlln = version != Version::N1 && self.flag(head, "", "use_vlln", Some(true));
        let (vl_num_layers, vl_num_heads, vl_head_dim) = match self.vl_self_attention(version, head, use_vlln)
        {
            None => (0, 1, context_dim),
            Some(vl) => {
                let path = "vl_self_attention_cfg.";
                self.expect_plain_blocks(vl, path);
                (
                    self.layers(vl, path, 0),
                    self.size(vl, path, "num_attention_heads", 1),
                    self.size(vl, path, "attention_head_dim", 1),
                )
            }
        };
        let alternates = version.is_flat() && self.flag(head, "", "use_alternate_vl_dit", Some(true));
        let (encoder_action_dim, decoders) = self.actions(version, head);
        let config = HeadConfig {
            version: version.name().to_owned(),
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
            num_future_tokens: match version {
                Version::N15 => self.size_of(version, head, "num_target_vision_tokens", 0),
                _ => 0,
            },
            future_key_bias: self.future_key_bias(head),
            action_horizon: self.size_of(version, head, "action_horizon", 1),
            action_dim: decoders.iter().map(|(_, width)| width).sum(),
            encoder_action_dim,
            decoders,
            state_dim: self.size_of(version, head, "max_state_dim", 1),
            state_history: match version {
                Version::N17 => self.size_of(version, head, "state_history_length", 1),
                _ => 1,
            },
            hidden_dim: self.size_of(version, head, "hidden_size", 1),
            num_embodiments: self.size_of(version, head, "max_num_embodiments", 1),
            num_timestep_buckets: self.size_of(version, head, "num_timestep_buckets", 1),
            num_steps: self.size_of(version, head, "num_inference_timesteps", 1),
            max_positions: self.size_of(version, head, "max_seq_len", 1),
            add_pos_embed: self.flag(head, "", "add_pos_embed", Some(true)),
        };
        if self.problems.is_empty() {
            self.check_agreement(version, &config, head, dit);
        }
        config
    }

    /// A version's class does not have the layers that these keys ask for: a head without them would be silently wrong.
    fn refuse_keys_of_other_versions(&mut self, version: Version, head: &Object) {
        let (on, none) = (Value::from(true), Value::from(0));
        let is_on = |key: &str| head.get(key) == Some(&on);
        let is_some = |key: &str| {
            head.get(key)
                .is_some_and(|value| *value != none && !value.is_null())
        };
        for (key, is_asked_for, versions) in [
            (
                "use_alternate_vl_dit",
                is_on("use_alternate_vl_dit"),
                &[Version::N16, Version::N17][..],
            ),
            (
                "use_multi_action_heads",
                is_on("use_multi_action_heads"),
                &[Version::N15],
            ),
            (
                "num_target_vision_tokens",
                is_some("num_target_vision_tokens"),
                &[Version::N15],
            ),
            (
                "use_vlln",
                is_on("use_vlln"),
                &[Version::N15, Version::N16, Version::N17],
            ),
            (
                "vl_self_attention_cfg",
                head.get("vl_self_attention_cfg").is_some_and(has_layers),
                &[Version::N15, Version::N17],
            ),
            (
                "state_history_length",
                is_some("state_history_length") && head["state_history_length"] != 1,
                &[Version::N17],
            ),
        ] {
            if is_asked_for && !versions.contains(&version) {
                let names: Vec<_> = versions.iter().map(|version| version.name()).collect();
                self.problems.push(format!(
                    "{key} is {}, which only {} has, but this is a config of {}",
                    head[key],
                    names.join(", "),
                    version.name(),
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
        match version {
            Version::N15 if use_vlln => self.object(head, key),
            Version::N17 if head.get(key).is_some_and(has_layers) => self.object(head, key),
            _ => None,
        }
    }

    /// The width of an action as it is denoised, and the decoders (spec 1.11).
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
        // The fork writes the width of the pretrained encoder as `action_dim` and makes both of it when it loads.
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
        let own = match head.get("saccade") {
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

    fn check_agreement(&mut self, version: Version, config: &HeadConfig, head: &Object, dit: &Object) {
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
        if config.vl_num_layers > 0 {
            equal(
                "backbone_embedding_dim",
                config.context_dim,
                "vl_self_attention_cfg.num_attention_heads x attention_head_dim",
                config.vl_num_heads * config.vl_head_dim,
            );
        }
        let number = |map: &Object, key: &str| {
            let number = map.get(key).and_then(Value::as_u64);
            number.map(|number| usize::try_from(number).unwrap_or(usize::MAX))
        };
        let cross = "diffusion_model_cfg.cross_attention_dim";
        match number(dit, "cross_attention_dim") {
            Some(given) => equal(cross, given, "backbone_embedding_dim", config.context_dim),
            // What stands for null is the width; the later versions give their class `backbone_embedding_dim` instead.
            None if version == Version::N15 => equal(
                &format!("{cross} (null, so input_embedding_dim)"),
                config.width,
                "backbone_embedding_dim",
                config.context_dim,
            ),
            None => {}
        }
        if let Some(output) = number(dit, "output_dim") {
            equal(
                "diffusion_model_cfg.output_dim",
                output,
                "hidden_size",
                config.hidden_dim,
            );
        }
        if version.is_flat()
            && let Some(action_dim) = number(head, "action_dim")
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
        if config.encoder_action_dim < config.action_dim {
            self.problems.push(format!(
                "pretrained_action_dim is {}, expected at least the {} of the actions that are decoded",
                config.encoder_action_dim, config.action_dim
            ));
        }
        if config.attend_text_every_n_blocks > 0 && !config.interleave_self_attention {
            self.problems.push(
                "diffusion_model_cfg.interleave_self_attention is false, expected true with use_alternate_vl_dit"
                    .to_owned(),
            );
        }
        for (what, size) in [
            (
                "diffusion_model_cfg.num_attention_heads x attention_head_dim",
                config.width,
            ),
            (
                "max_state_dim x state_history_length",
                config.state_dim * config.state_history,
            ),
        ] {
            if size as u64 > MAX_SIZE {
                self.problems
                    .push(format!("{what} is {size}, expected at most {MAX_SIZE}"));
            }
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

    /// The width that keys and values of the cross-attention are made from, where it is not the transformer's own.
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
