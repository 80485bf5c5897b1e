//! Reading a head's config from JSON: every key is checked, and one error lists all problems.

use serde_json::Value;

use super::checkpoint_config::{CheckpointConfig, OWN_KEY};
use super::consistency::{SizesSaidTwice, contradictions};
use super::head_config::HeadConfig;
use super::values::{MAX_LAYERS, MAX_SIZE, Object, Problems};
use crate::error::Result;
use crate::release::{FEATURE_KEYS, Feature, Version};

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
    /// [`Error::Checkpoint`](crate::Error::Checkpoint) with everything that is missing, of the wrong type or
    /// contradictory.
    pub fn from_json(text: &str) -> Result<Self> {
        let config = CheckpointConfig::parse(text)?;
        let mut problems = Problems::default();
        let reader = Reader {
            version: version_of(&config, &mut problems),
            head: Part {
                object: Some(config.head()),
                path: "",
            },
            problems,
        };
        reader.read()
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

/// The version that `model_type` names. Without it, the one that the keys of the head belong to: configs of
/// heads alone did not always name a model.
fn version_of(config: &CheckpointConfig, problems: &mut Problems) -> Version {
    let declared = config.declared();
    if let Some(first) = declared.first() {
        if let Some(other) = declared.iter().find(|other| other.version != first.version) {
            problems.add(format!("{}, but {}", first.text, other.text));
        }
        match first.version {
            Some(version) => return version,
            None => {
                let known = Version::model_types();
                problems.add(format!("{}, expected one of {known}", first.text));
            }
        }
    }
    let names = |keys: &[&str]| keys.iter().any(|key| config.head().contains_key(*key));
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

/// An object of the config, if it is there, and what the paths of its keys begin with.
#[derive(Clone, Copy)]
struct Part<'a> {
    object: Option<&'a Object>,
    path: &'static str,
}

impl<'a> Part<'a> {
    fn get(self, key: &str) -> Option<&'a Value> {
        self.object?.get(key)
    }

    /// The value of a key that is not null.
    fn given(self, key: &str) -> Option<&'a Value> {
        self.get(key).filter(|value| !value.is_null())
    }
}

/// Reads keys and collects all problems, so that one error lists everything.
struct Reader<'a> {
    version: Version,
    head: Part<'a>,
    problems: Problems,
}

impl<'a> Reader<'a> {
    fn read(mut self) -> Result<HeadConfig> {
        let version = self.version;
        let head = self.head;
        self.refuse_keys_of_other_versions();
        let dit = self.object("diffusion_model_cfg", "diffusion_model_cfg.");
        self.expect_defaults(
            dit,
            &[
                ("norm_type", Value::from("ada_norm")),
                ("norm_elementwise_affine", Value::from(false)),
            ],
        );
        self.expect_plain_blocks(dit);
        let num_layers = self.layers(dit, 1);
        let num_heads = self.size(dit, "num_attention_heads");
        let head_dim = self.size(dit, "attention_head_dim");
        let interleave_self_attention = self.flag(dit, "interleave_self_attention", None);
        // The width appears twice; upstream's default for one of them fits a single size of the other.
        let width = match head.get("input_embedding_dim") {
            Some(_) => self.size(head, "input_embedding_dim"),
            None => num_heads.saturating_mul(head_dim),
        };
        let cross_dim = dit.given("cross_attention_dim");
        let context_dim = match version.has(Feature::ContextWidth) {
            true => self.size_of("backbone_embedding_dim"),
            // The width that keys and values are made from, where it is not the transformer's own.
            false => cross_dim.map_or(width, |_| self.size(dit, "cross_attention_dim")),
        };
        let use_vlln = version.has(Feature::VlNorm) && self.flag(head, "use_vlln", Some(true));
        let [vl_num_layers, vl_num_heads, vl_head_dim] = match self.has_vl_self_attention(use_vlln) {
            true => self.vl_sizes(),
            false => [0, 1, context_dim],
        };
        let alternates =
            version.has(Feature::AlternatingBlocks) && self.flag(head, "use_alternate_vl_dit", Some(true));
        let (encoder_action_dim, decoders) = self.actions();
        let state_history = match version.has(Feature::StateHistory) {
            true => self.size_of("state_history_length"),
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
                true => self.size_of("attend_text_every_n_blocks"),
                false => 0,
            },
            use_vlln,
            vl_num_layers,
            vl_num_heads,
            vl_head_dim,
            num_future_tokens: match version.has(Feature::FutureTokens) {
                true => self.size_from(0, "num_target_vision_tokens"),
                false => 0,
            },
            future_key_bias: self.future_key_bias(),
            action_horizon: self.size_of("action_horizon"),
            action_dim: decoders.iter().map(|(_, width)| width).sum(),
            encoder_action_dim,
            decoders,
            state_dim: self.size_of("max_state_dim"),
            state_history,
            num_states: state_history,
            hidden_dim: self.size_of("hidden_size"),
            num_embodiments: self.size_of("max_num_embodiments"),
            num_timestep_buckets: self.size_of("num_timestep_buckets"),
            num_steps: self.size_of("num_inference_timesteps"),
            max_positions: self.size_of("max_seq_len"),
            add_pos_embed: self.flag(head, "add_pos_embed", Some(true)),
        };
        let number = |part: Part<'_>, key| {
            let number = part.get(key).and_then(Value::as_u64);
            number.map(|number| usize::try_from(number).unwrap_or(usize::MAX))
        };
        let twice = SizesSaidTwice {
            cross_attention_dim: number(dit, "cross_attention_dim"),
            output_dim: number(dit, "output_dim"),
            action_dim: number(head, "action_dim"),
        };
        self.problems
            .finish(config, |config| contradictions(config, &twice))
    }

    /// Lists keys that ask for what the version's class does not have: a head without it would be silently
    /// wrong.
    fn refuse_keys_of_other_versions(&mut self) {
        for (key, feature) in FEATURE_KEYS {
            if let Some(given) = self.head.get(key)
                && is_asked_for(key, given)
                && !self.version.has(feature)
            {
                let names: Vec<_> = Version::with(feature).iter().map(Version::to_string).collect();
                self.problems.add(format!(
                    "{key} is {given}, which only {} has, but this is a config of {}",
                    names.join(", "),
                    self.version
                ));
            }
        }
    }

    /// Whether the version's class builds a VL self-attention.
    fn has_vl_self_attention(&self, use_vlln: bool) -> bool {
        let is_built = match self.version.is_flat() {
            false => use_vlln,
            true => self.head.get("vl_self_attention_cfg").is_some_and(has_layers),
        };
        is_built && self.version.has(Feature::VlSelfAttention)
    }

    /// Blocks, attention heads and width of one of these of the VL self-attention.
    fn vl_sizes(&mut self) -> [usize; 3] {
        let vl = self.object("vl_self_attention_cfg", "vl_self_attention_cfg.");
        self.expect_plain_blocks(vl);
        [
            self.layers(vl, 0),
            self.size(vl, "num_attention_heads"),
            self.size(vl, "attention_head_dim"),
        ]
    }

    /// The width of an action as it is denoised, and the decoders (equation 13 of docs/equations.md).
    fn actions(&mut self) -> (usize, Vec<(String, usize)>) {
        let head = self.head;
        let one = |width| vec![("action_decoder".to_owned(), width)];
        if self.version.is_flat() {
            let width = self.size_of("max_action_dim");
            return (width, one(width));
        }
        let action_dim = self.size(head, "action_dim");
        let pretrained = head.given("pretrained_action_dim");
        let pretrained = pretrained.map(|_| self.size(head, "pretrained_action_dim"));
        if !self.flag(head, "use_multi_action_heads", Some(false)) {
            return (pretrained.unwrap_or(action_dim), one(action_dim));
        }
        let parts: &[&str] = match self.flag(head, "split_arm_heads", Some(false)) {
            false => &["arm", "claw"],
            true => &["left_arm", "right_arm", "claw"],
        };
        if parts.len() == 3 && self.flag(head, "use_shared_arm_features", Some(false)) {
            self.problems.add(
                "use_shared_arm_features is true, expected false: arms with a decoder of their own each"
                    .to_owned(),
            );
        }
        let decoder = |part: &&str| {
            let width = self.size_of(&format!("action_{part}_dim"));
            (format!("action_{part}_decoder"), width)
        };
        let decoders: Vec<_> = parts.iter().map(decoder).collect();
        let together: usize = decoders.iter().map(|(_, width)| width).sum();
        // The fork writes the width of the pretrained encoder as `action_dim` and makes both of it when it
        // loads.
        if pretrained.is_some() && action_dim != together {
            self.problems.add(format!(
                "action_dim is {action_dim}, but the decoders of {} have {together} outputs",
                parts.join(", ")
            ));
        }
        (pretrained.unwrap_or(action_dim), decoders)
    }

    /// `saccade.future_key_bias`: one finite number for each future token.
    fn future_key_bias(&mut self) -> Option<Vec<f32>> {
        let own = self.head.get(OWN_KEY)?;
        let Value::Object(own) = own else {
            self.problems.add("saccade: expected an object".to_owned());
            return None;
        };
        for key in own.keys().filter(|key| *key != "future_key_bias") {
            self.problems
                .add(format!("saccade.{key} is unknown, expected future_key_bias"));
        }
        let given = own.get("future_key_bias").filter(|given| !given.is_null())?;
        let number = |value: &Value| Some(value.as_f64()? as f32).filter(|number| number.is_finite());
        let numbers: Option<Vec<f32>> = given
            .as_array()
            .and_then(|given| given.iter().map(number).collect());
        if numbers.is_none() {
            let problem = "saccade.future_key_bias: expected a list of finite numbers";
            self.problems.add(problem.to_owned());
        }
        numbers
    }

    /// What the blocks of both transformers have in common.
    fn expect_plain_blocks(&mut self, part: Part<'_>) {
        // Left out, upstream's class adds sinusoidal ones.
        if part.get("positional_embeddings").is_none() {
            let path = format!("{}positional_embeddings", part.path);
            self.problems.differs(&path, None, "null");
        }
        self.expect_defaults(
            part,
            &[
                ("positional_embeddings", Value::Null),
                ("activation_fn", Value::from("gelu-approximate")),
                ("attention_bias", Value::from(true)),
                ("norm_eps", Value::from(1e-5)),
            ],
        );
    }

    /// Keys that may be absent, but if present must have the value that the released head was built with.
    fn expect_defaults(&mut self, part: Part<'_>, expected: &[(&str, Value)]) {
        for (key, value) in expected {
            if let Some(given) = part.get(key).filter(|given| *given != value) {
                let path = format!("{}{key}", part.path);
                self.problems.differs(&path, Some(given), &value.to_string());
            }
        }
    }

    fn object(&mut self, key: &str, path: &'static str) -> Part<'a> {
        let given = self.head.get(key);
        let object = given.and_then(Value::as_object);
        if object.is_none() {
            self.problems.add(match given {
                Some(_) => format!("{key}: expected an object"),
                None => format!("{key} is missing"),
            });
        }
        Part { object, path }
    }

    fn layers(&mut self, part: Part<'_>, least: u64) -> usize {
        let path = format!("{}num_layers", part.path);
        self.problems
            .whole(&path, part.get("num_layers"), least..=MAX_LAYERS)
    }

    fn size(&mut self, part: Part<'_>, key: &str) -> usize {
        self.problems
            .whole(&format!("{}{key}", part.path), part.get(key), 1..=MAX_SIZE)
    }

    /// A size of the head, or what the version's class takes in its place.
    fn size_of(&mut self, key: &str) -> usize {
        self.size_from(1, key)
    }

    fn size_from(&mut self, least: u64, key: &str) -> usize {
        match (self.head.get(key), self.version.default_size(key)) {
            (None, Some(default)) => default,
            (given, _) => self.problems.whole(key, given, least..=MAX_SIZE),
        }
    }

    fn flag(&mut self, part: Part<'_>, key: &str, default: Option<bool>) -> bool {
        match (part.get(key), default) {
            (None, Some(default)) => default,
            (given, _) => self.problems.flag(&format!("{}{key}", part.path), given),
        }
    }
}
