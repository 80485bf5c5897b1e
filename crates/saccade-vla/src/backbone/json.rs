//! Reading a backbone's config from JSON: every key is checked, and one error lists all problems.

use std::ops::RangeInclusive;

use serde_json::{Map, Value};

use super::config::{BackboneConfig, CHANNELS, LanguageConfig, Tower, VisionConfig};
use super::consistency::contradictions;
use crate::config::{MAX_LAYERS, MAX_SIZE, Object, Problems, config_object, whole_numbers};
use crate::error::{Error, Problem, Result, problem};
use crate::release::{BackboneRules, TowerKind, Version};

/// The key of the backbone's config in a whole checkpoint's.
const BACKBONE_KEY: &str = "backbone_cfg";

/// A config as it is given: of a whole checkpoint, or of a backbone alone.
#[derive(Default)]
pub(crate) struct GivenConfig {
    top: Object,
    /// `backbone_cfg` of a whole checkpoint; empty if there is none.
    backbone: Object,
    /// The sizes: `eagle_config` of a whole checkpoint, or the config itself; empty if it has none.
    sizes: Object,
}

impl GivenConfig {
    /// # Errors
    /// [`Error::Json`] for text that is not JSON; [`Error::Checkpoint`] if it is no object.
    pub(crate) fn parse(text: &str) -> Result<Self> {
        Self::of(config_object(text)?)
    }

    /// # Errors
    /// [`Error::Checkpoint`] if a part of it is no object.
    pub(crate) fn of(top: Object) -> Result<Self> {
        let bad = |problem: String| Err(Error::Checkpoint(Problem::new("config", problem)));
        let mut backbone = match top.get(BACKBONE_KEY) {
            Some(Value::Object(backbone)) => backbone.clone(),
            None | Some(Value::Null) => Map::new(),
            Some(_) => return bad(format!("{BACKBONE_KEY}: expected an object")),
        };
        let sizes = match backbone.remove("eagle_config") {
            Some(Value::Object(sizes)) => sizes,
            None | Some(Value::Null) if is_of_sizes(&top) => top.clone(),
            None | Some(Value::Null) => Map::new(),
            Some(_) => return bad(format!("{BACKBONE_KEY}.eagle_config: expected an object")),
        };
        Ok(Self { top, backbone, sizes })
    }

    /// The version that the config names, with its words; none if it names none.
    ///
    /// # Errors
    /// [`Error::Checkpoint`] for names of GR00T models that are unknown.
    pub(crate) fn version(&self) -> Result<Option<(Version, String)>> {
        let unknown = |what: &str, name: &str| {
            let names = Version::model_types();
            Err(Error::Checkpoint(problem!(
                "config"; "{what} is \"{name}\", expected one of {names}"
            )))
        };
        if let Some(Value::String(kind)) = self.top.get("kind") {
            let name = kind.split_whitespace().next().unwrap_or_default();
            return match Version::named(name) {
                Some(version) => Ok(Some((version, format!("kind is \"{kind}\"")))),
                None => unknown("kind", kind),
            };
        }
        let Some(Value::String(name)) = self.top.get("model_type") else {
            return Ok(None);
        };
        match Version::of_model(name) {
            Ok(version) => Ok(version.map(|version| (version, format!("model_type is \"{name}\"")))),
            Err(()) => unknown("model_type", name),
        }
    }

    /// The config of a backbone of this release: sizes that are not given are the released ones.
    ///
    /// # Errors
    /// [`Error::Checkpoint`] with everything that is of the wrong type or contradictory.
    pub(crate) fn read(&self, version: Version, rules: &BackboneRules) -> Result<BackboneConfig> {
        let Ok(Value::Object(released)) = serde_json::from_str(rules.sizes) else {
            unreachable!("the released sizes are an object");
        };
        let mut reader = Reader {
            given: self,
            released,
            problems: Problems::default(),
        };
        let config = reader.config(version, rules);
        reader.problems.finish(config, contradictions)
    }
}

/// Whether an object holds sizes of a backbone.
fn is_of_sizes(object: &Object) -> bool {
    ["kind", "vision_config", "text_config", "eagle"]
        .iter()
        .any(|key| object.contains_key(*key))
}

/// The keys of the parts in which a size is looked up.
const VISION: &str = "vision_config";
const TEXT: &str = "text_config";
const EAGLE: &str = "eagle";
const TOKENS: &str = "token_ids";

/// Reads keys and collects all problems, so that one error lists everything.
struct Reader<'a> {
    given: &'a GivenConfig,
    released: Object,
    problems: Problems,
}

impl Reader<'_> {
    fn config(&mut self, version: Version, rules: &BackboneRules) -> BackboneConfig {
        for key in [VISION, TEXT, EAGLE, TOKENS] {
            if self.given.sizes.get(key).is_some_and(|value| !value.is_object()) {
                self.problems.add(format!("{key}: expected an object"));
            }
        }
        let vision = self.vision(rules);
        let language = self.language(rules);
        BackboneConfig {
            version,
            project_to_dim: self.project_to_dim(),
            image_token_id: self.image_token_id(rules),
            vision,
            language,
        }
    }

    fn vision(&mut self, rules: &BackboneRules) -> VisionConfig {
        let [layers, heads] = match rules.tower {
            TowerKind::Siglip { .. } => ["num_hidden_layers", "num_attention_heads"],
            TowerKind::Qwen3Vl => ["depth", "num_heads"],
        };
        self.expect(VISION, "hidden_act", "gelu_pytorch_tanh");
        for key in ["num_channels", "in_channels"] {
            self.expect(VISION, key, CHANNELS);
        }
        self.expect(VISION, "use_rope", false);
        let (width, num_heads) = (self.size(VISION, "hidden_size"), self.size(VISION, heads));
        let patch_size = self.size(VISION, "patch_size");
        let mut config = VisionConfig {
            width,
            num_layers: self.within(VISION, layers, 1..=MAX_LAYERS),
            num_heads,
            head_dim: width / num_heads,
            hidden_dim: self.size(VISION, "intermediate_size"),
            norm_eps: 1e-6,
            patch_size,
            image_size: None,
            num_positions: 1,
            merge: 1,
            connector_layers: 2,
            deepstack: Vec::new(),
            tower: Tower::Qwen3Vl {
                patch_elements: 0,
                frames: 0,
            },
        };
        match rules.tower {
            TowerKind::Siglip {
                pixels,
                patches,
                is_fixed,
            } => {
                config.tower = Tower::Siglip { pixels, patches };
                config.norm_eps = self.number(VISION, "layer_norm_eps");
                if is_fixed {
                    let image_size = self.size(VISION, "image_size");
                    config.image_size = Some(image_size);
                    config.num_positions = (image_size / patch_size).saturating_pow(2);
                } else {
                    config.num_positions = self.size(VISION, "num_patches");
                }
                if self.flag(EAGLE, "use_pixel_shuffle") {
                    self.expect(EAGLE, "downsample_ratio", 0.5);
                    config.merge = 2;
                }
                config.connector_layers = self.within(EAGLE, "mlp_connector_layers", 1..=2);
                self.expect_last_vision_layer();
            }
            TowerKind::Qwen3Vl => {
                let frames = self.within(VISION, "temporal_patch_size", 1..=16);
                config.tower = Tower::Qwen3Vl {
                    patch_elements: (CHANNELS * frames).saturating_mul(patch_size.saturating_pow(2)),
                    frames,
                };
                config.num_positions = self.size(VISION, "num_position_embeddings");
                config.merge = self.within(VISION, "spatial_merge_size", 1..=16);
                config.deepstack = self.sizes(VISION, "deepstack_visual_indexes");
            }
        }
        config
    }

    fn language(&mut self, rules: &BackboneRules) -> LanguageConfig {
        self.expect(TEXT, "hidden_act", "silu");
        self.expect(TEXT, "attention_bias", false);
        self.expect(TEXT, "use_sliding_window", false);
        let mrope_section = match self.value(TEXT, "rope_scaling") {
            Some(Value::Object(scaling)) => self.mrope_section(&scaling),
            None | Some(Value::Null) => None,
            Some(_) => {
                self.problems
                    .add("text_config.rope_scaling: expected an object or null".to_owned());
                None
            }
        };
        LanguageConfig {
            width: self.size(TEXT, "hidden_size"),
            num_layers: self.select_layer(),
            num_heads: self.size(TEXT, "num_attention_heads"),
            num_kv_heads: self.size(TEXT, "num_key_value_heads"),
            head_dim: self.size(TEXT, "head_dim"),
            hidden_dim: self.size(TEXT, "intermediate_size"),
            vocab_size: self.size(TEXT, "vocab_size"),
            norm_eps: self.number(TEXT, "rms_norm_eps"),
            rope_theta: self.number(TEXT, "rope_theta"),
            mrope_section,
            has_final_norm: rules.has_final_norm,
        }
    }

    /// Layers of the language model that are kept.
    fn select_layer(&mut self) -> usize {
        let given = self.given;
        // The sizes may have one of the vision tower, which is negative.
        let found = [&given.top, &given.backbone, &given.sizes]
            .into_iter()
            .filter_map(|object| object.get("select_layer"))
            .find(|value| !value.as_f64().is_some_and(|layer| layer < 0.0))
            .or_else(|| self.released.get("select_layer"))
            .cloned();
        self.problems
            .whole("select_layer", found.as_ref(), 1..=MAX_LAYERS)
    }

    /// That the vision tower's last layer is taken.
    fn expect_last_vision_layer(&mut self) {
        let eagle = self
            .given
            .sizes
            .get("eagle")
            .and_then(|eagle| eagle.get("select_layer"));
        let plain = self.given.sizes.get("select_layer");
        let of_vision = plain.filter(|layer| layer.as_f64().is_some_and(|layer| layer < 0.0));
        if let Some(layer) = eagle.or(of_vision)
            && layer.as_i64() != Some(-1)
        {
            let expected = "-1, the last layer of the vision tower";
            self.problems.differs("eagle.select_layer", Some(layer), expected);
        }
    }

    fn project_to_dim(&mut self) -> Option<usize> {
        let given = self.given;
        let found = [&given.top, &given.backbone, &given.sizes]
            .into_iter()
            .find_map(|object| object.get("project_to_dim"))
            .filter(|value| !value.is_null())?;
        Some(self.problems.whole("project_to_dim", Some(found), 1..=MAX_SIZE))
    }

    fn image_token_id(&mut self, rules: &BackboneRules) -> usize {
        let (section, key) = match rules.tower {
            TowerKind::Siglip { .. } => (EAGLE, "image_token_index"),
            TowerKind::Qwen3Vl => (TOKENS, "image_token_id"),
        };
        self.within(section, key, 0..=MAX_SIZE)
    }

    /// The pairs that turn with time, height and width, if they are interleaved as released.
    fn mrope_section(&mut self, scaling: &Object) -> Option<[usize; 3]> {
        let is_known = scaling.get("mrope_interleaved") == Some(&Value::Bool(true))
            && scaling.get("rope_type").is_none_or(|kind| kind == "default");
        let section = scaling.get("mrope_section").and_then(whole_numbers);
        if let Some(&[time, height, width]) = section.as_deref()
            && is_known
        {
            return Some([time, height, width]);
        }
        self.problems.differs(
            "text_config.rope_scaling",
            Some(&Value::Object(scaling.clone())),
            "interleaved mrope with a mrope_section of three numbers",
        );
        None
    }

    /// The value of a key: as it is given, or else as it was released.
    fn value(&self, section: &str, key: &str) -> Option<Value> {
        let sizes = &self.given.sizes;
        let of = |object: &Object| object.get(section).and_then(|part| part.get(key)).cloned();
        let beside = match section {
            EAGLE | TOKENS => sizes.get(key).cloned(),
            _ => None,
        };
        of(sizes).or(beside).or_else(|| of(&self.released))
    }

    /// A key that may be absent, but if present must have a value that the released code was run with.
    fn expect(&mut self, section: &str, key: &str, expected: impl Into<Value>) {
        let (given, expected) = (self.value(section, key), expected.into());
        if given.as_ref().is_some_and(|given| *given != expected) {
            self.problems
                .differs(&format!("{section}.{key}"), given.as_ref(), &expected.to_string());
        }
    }

    fn size(&mut self, section: &str, key: &str) -> usize {
        self.within(section, key, 1..=MAX_SIZE)
    }

    fn within(&mut self, section: &str, key: &str, sizes: RangeInclusive<u64>) -> usize {
        let given = self.value(section, key);
        self.problems
            .whole(&format!("{section}.{key}"), given.as_ref(), sizes)
    }

    fn sizes(&mut self, section: &str, key: &str) -> Vec<usize> {
        let given = self.value(section, key);
        given.as_ref().and_then(whole_numbers).unwrap_or_else(|| {
            self.problems
                .add(format!("{section}.{key}: expected a list of whole numbers"));
            Vec::new()
        })
    }

    fn number(&mut self, section: &str, key: &str) -> f64 {
        let given = self.value(section, key);
        self.problems
            .positive(&format!("{section}.{key}"), given.as_ref())
    }

    fn flag(&mut self, section: &str, key: &str) -> bool {
        let given = self.value(section, key);
        self.problems.flag(&format!("{section}.{key}"), given.as_ref())
    }
}
