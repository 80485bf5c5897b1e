//! What a checkpoint is: its layout, the version of the architecture, and the head's whole config, from `config.json` and from the tensors.
//!
//! Every command and [`ActionHead::load`](crate::ActionHead::load) come in here. Sizes that published configs leave out are taken from the
//! shapes of the tensors; lerobot's holds no size of the head at all, and what no shape tells (how wide an attention head is, how many steps)
//! is then what the published checkpoints of that version have. Where config and tensors disagree, one error says all that was found.

use std::fmt;
use std::path::Path;

use serde_json::{Map, Value, json};

use saccade_checkpoint::{Checkpoint, OWN_CONFIG, read_text};

use crate::checkpoint::{check, head_prefix, kept_embodiments};
use crate::config::Version::{self, N1, N15, N16, N17};
use crate::config::{HeadConfig, misplaced_own_key};
use crate::error::{Error, Result, show_shape};

/// Who wrote a checkpoint, and so where things are in it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Layout {
    /// NVIDIA's: `action_head.*` beside `backbone.*`.
    Nvidia,
    /// The same with what Isaac-GR00T's trainer leaves beside it.
    IsaacFineTune,
    /// lerobot's: everything under `_groot_model.`, the policy's `config.json`.
    Lerobot,
    /// lerobot's, of a fork with several action decoders.
    Fork,
    /// A head of saccade's own, or a head alone.
    Saccade,
}

impl fmt::Display for Layout {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(match self {
            Self::Nvidia => "nvidia",
            Self::IsaacFineTune => "isaac",
            Self::Lerobot => "lerobot",
            Self::Fork => "fork",
            Self::Saccade => "saccade",
        })
    }
}

/// A checkpoint, open, and what it is.
pub struct Published {
    /// Its tensors.
    pub checkpoint: Checkpoint,
    /// Where the head's tensors stand in it.
    pub prefix: &'static str,
    /// Who wrote it.
    pub layout: Layout,
    /// The head's sizes and switches.
    pub config: HeadConfig,
    /// The same in the released key names, as JSON: [`HeadConfig::from_json`] needs nothing else.
    pub config_json: String,
    /// The config as it was given, or as it stands in `config.json`.
    pub given_config: String,
    /// What tells the version, a sentence each.
    pub evidence: Vec<String>,
}

impl Published {
    /// Opens `source`, one `.safetensors` file or a directory of them, with `config`, as JSON, or the `config.json` beside the weights.
    ///
    /// The names and shapes of single tensors are checked where they are read.
    ///
    /// # Errors
    /// [`Error::NotFound`] for a path or a config that is not there; [`Error::Checkpoint`] for files that are broken, a config that is
    /// none, and for whatever config and tensors disagree on: all of it is listed.
    pub fn open(source: &Path, config: Option<&str>) -> Result<Self> {
        let checkpoint = Checkpoint::open(source)?;
        let directory = match source.is_dir() {
            true => source,
            false => source.parent().unwrap_or(Path::new("")),
        };
        let given_config = match config {
            Some(text) => text.to_owned(),
            None => read_text("config", &directory.join("config.json"))?,
        };
        let prefix = head_prefix(&checkpoint)?;
        let tensors = HeadShapes {
            checkpoint: &checkpoint,
            prefix,
        };
        let config = Config::parse(&given_config)?;
        let own = match config.head {
            Some(_) => None,
            None => beside_lerobots_config(directory)?,
        };
        let (version, evidence) = recognise_version(&config, &tensors)?;
        let (mut head, problems) = match config.head {
            Some(head) => complete(head, version, &tensors),
            None => (
                from_tensors(&config.top, version, &tensors, chunk_of_processors(directory))?,
                Vec::new(),
            ),
        };
        if let Some(own) = own {
            head.insert("saccade".to_owned(), own);
        }
        let config_json = Value::Object(head).to_string();
        // What is wrong with the config alone comes first.
        let head = HeadConfig::from_json(&config_json)?;
        if !problems.is_empty() {
            return Err(Error::Checkpoint(format!(
                "source: config and tensors disagree (GR00T {}):\n  {}",
                show(version),
                problems.join("\n  ")
            )));
        }
        Ok(Self {
            config: head,
            config_json,
            layout: layout(&config.top, &tensors, directory),
            prefix,
            given_config,
            evidence,
            checkpoint,
        })
    }

    /// All tensors of the checkpoint, sorted by name; without those that stand in two files, which [`Published::check`] refuses in a head.
    pub fn tensors(&self) -> impl Iterator<Item = TensorFacts> {
        let checkpoint = &self.checkpoint;
        checkpoint.names().filter_map(|name| {
            Some(TensorFacts {
                name: name.to_owned(),
                dtype: format!("{:?}", checkpoint.dtype(name).ok()?),
                shape: checkpoint.shape(name)?.to_vec(),
                nbytes: checkpoint.nbytes(name).ok()?,
            })
        })
    }

    /// That exactly the head's tensors stand under the prefix, each of the right shape and a readable type.
    ///
    /// # Errors
    /// [`Error::Checkpoint`] that lists every tensor that is missing, unknown, misshaped or of another type.
    pub fn check(&self) -> Result<()> {
        check(&self.checkpoint, self.prefix, &self.config)
    }

    /// The embodiments whose layers were kept when others were removed; none if all are there.
    ///
    /// # Errors
    /// [`Error::Checkpoint`] if the files' metadata list anything but numbers.
    pub fn kept_embodiments(&self) -> Result<Option<Vec<i64>>> {
        kept_embodiments(&self.checkpoint)
    }

    /// The files that tensors are read from.
    pub fn files(&self) -> impl Iterator<Item = &Path> {
        self.checkpoint.files()
    }
}

/// A tensor, by what its file's header says.
#[derive(Clone, Debug)]
pub struct TensorFacts {
    /// Its name, prefix included.
    pub name: String,
    /// Its type in the words of safetensors: `F32`, `BF16`.
    pub dtype: String,
    /// Its shape.
    pub shape: Vec<usize>,
    /// Its bytes in the file.
    pub nbytes: u64,
}

/// A config as it was given: the whole object, and the head's where it holds one.
struct Config {
    top: Map<String, Value>,
    /// None where it is lerobot's of a policy, which has none.
    head: Option<Map<String, Value>>,
}

impl Config {
    fn parse(text: &str) -> Result<Self> {
        let bad = |problem: String| Err(Error::Checkpoint(format!("config: {problem}")));
        let top = match serde_json::from_str(text) {
            Ok(Value::Object(top)) => top,
            Ok(_) => return bad("expected a JSON object".to_owned()),
            Err(error) => return bad(format!("not valid JSON: {error}")),
        };
        let head = match (top.get("action_head_cfg"), top.get("type")) {
            (Some(Value::Object(head)), _) => match misplaced_own_key(&top) {
                None => Some(head.clone()),
                Some(problem) => return bad(problem),
            },
            (Some(_), _) => return bad("action_head_cfg: expected an object".to_owned()),
            (None, Some(Value::String(policy))) if policy == LEROBOT_POLICY => None,
            (None, Some(policy)) => {
                return bad(format!(
                    "type is {policy}: lerobot's config of another policy, expected \"{LEROBOT_POLICY}\""
                ));
            }
            (None, None) => Some(top.clone()),
        };
        Ok(Self { top, head })
    }

    /// A value of the head's config or of what surrounds it.
    fn get(&self, key: &str) -> Option<&Value> {
        let head = self.head.as_ref().and_then(|head| head.get(key));
        head.or_else(|| self.top.get(key))
    }

    fn is_true(&self, key: &str) -> bool {
        self.get(key) == Some(&Value::Bool(true))
    }
}

/// `type` in lerobot's `config.json` of a GR00T policy.
const LEROBOT_POLICY: &str = "groot";

/// The head's tensors, by the names that they have without prefix.
struct HeadShapes<'a> {
    checkpoint: &'a Checkpoint,
    prefix: &'static str,
}

impl HeadShapes<'_> {
    fn shape(&self, name: &str) -> Option<&[usize]> {
        self.checkpoint.shape(&format!("{}{name}", self.prefix))
    }

    /// The size of tensor `name` on `axis`, if it is there with `axes` axes.
    fn size(&self, name: &str, axes: usize, axis: usize) -> Option<usize> {
        self.shape(name)
            .filter(|shape| shape.len() == axes)
            .map(|shape| shape[axis])
    }

    /// Whether a tensor's name begins with `start`.
    fn any(&self, start: &str) -> bool {
        let start = format!("{}{start}", self.prefix);
        self.checkpoint.names().any(|name| name.starts_with(&start))
    }

    /// How many blocks `path.0`, `path.1`, ... have a query projection.
    fn blocks(&self, path: &str) -> usize {
        (0..)
            .take_while(|index| self.shape(&format!("{path}.{index}.attn1.to_q.weight")).is_some())
            .count()
    }

    /// Outputs of an action decoder, if it is there.
    fn decoder(&self, name: &str) -> Option<usize> {
        self.size(&format!("{name}.layer2.W"), 3, 2)
    }

    fn show(&self, name: &str) -> String {
        let shape = self.shape(name).unwrap_or_default();
        format!("{}{name} is {}", self.prefix, show_shape(shape))
    }
}

const DECODER: &str = "action_decoder";
const ARM: &str = "action_arm_decoder";
const LEFT_ARM: &str = "action_left_arm_decoder";
const RIGHT_ARM: &str = "action_right_arm_decoder";
const CLAW: &str = "action_claw_decoder";
const FUTURE_TOKENS: &str = "future_tokens.weight";

/// A version as its models are named: `N1.5`.
fn show(version: Version) -> String {
    version.name().to_uppercase()
}

/// Something that only some versions have.
struct Evidence {
    versions: &'static [Version],
    what: String,
}

/// The one version that everything points to, and what did.
fn recognise_version(config: &Config, tensors: &HeadShapes<'_>) -> Result<(Version, Vec<String>)> {
    let found = evidence(config, tensors)?;
    let fits = |version: &Version| found.iter().all(|one| one.versions.contains(version));
    let possible: Vec<Version> = Version::ALL.into_iter().filter(fits).collect();
    let sentences = found.iter().map(|one| {
        let versions: Vec<String> = one.versions.iter().copied().map(show).collect();
        format!("{}: {}", one.what, versions.join(" or "))
    });
    let version = match possible[..] {
        [one] => one,
        [] => {
            let sentences: Vec<String> = sentences.collect();
            return Err(Error::Checkpoint(format!(
                "source: what is found belongs to different versions of GR00T:\n  {}",
                sentences.join("\n  ")
            )));
        }
        // Nothing says which: a head alone, whose config names no model.
        _ => *possible
            .iter()
            .find(|version| **version == usual_version(config, tensors))
            .unwrap_or(&possible[0]),
    };
    Ok((version, sentences.collect()))
}

/// The version that a head of these keys and tensors usually has.
fn usual_version(config: &Config, tensors: &HeadShapes<'_>) -> Version {
    let is_flat = config.get("max_action_dim").is_some() && config.get("action_dim").is_none();
    match (
        is_flat || config.is_true("use_alternate_vl_dit"),
        tensors.any("vl_self_attention."),
    ) {
        (true, true) => N17,
        (true, false) => N16,
        // lerobot's: every N1.5 that it can read has future tokens, which say so.
        (false, _) if config.head.is_none() => N17,
        (false, _) if config.get("use_vlln").is_none() && !tensors.any("vlln.") => N1,
        (false, _) => N15,
    }
}

fn evidence(config: &Config, tensors: &HeadShapes<'_>) -> Result<Vec<Evidence>> {
    let mut found = Vec::new();
    let mut add = |versions, what| found.push(Evidence { versions, what });
    let own = config.head.as_ref().filter(|head| **head != config.top);
    for (path, map) in [("", Some(&config.top)), ("action_head_cfg.", own)] {
        let given = map.and_then(|map| map.get("model_type"));
        // A head's own config that a program wrote whole has an empty one.
        let Some(model_type) = given.filter(|given| !given.is_null() && **given != "") else {
            continue;
        };
        match versions_of_name(model_type)? {
            Some(versions) => add(versions, format!("{path}model_type is {model_type}")),
            None => return Err(unknown_model(&format!("{path}model_type is {model_type}"))),
        }
    }
    if let Some(Value::Array(classes)) = config.top.get("architectures") {
        for class in classes {
            if let Some(versions) = versions_of_name(class)? {
                add(versions, format!("architectures names {class}"));
            }
        }
    }
    if config.head.is_none() {
        add(
            &[N15, N17],
            format!("config.json is lerobot's, type \"{LEROBOT_POLICY}\""),
        );
        if let Some(Value::String(base)) = config.top.get("base_model_path") {
            let base_version = version_in_path(base);
            if let Some(versions) = base_version {
                add(versions, format!("base_model_path is \"{base}\""));
            }
        }
    }
    if config.is_true("use_alternate_vl_dit") {
        add(&[N16, N17], "use_alternate_vl_dit is true".to_owned());
    }
    for key in ["use_multi_action_heads", "split_arm_heads"] {
        if config.is_true(key) {
            add(&[N15], format!("{key} is true"));
        }
    }
    if let Some(count) = config.get("num_target_vision_tokens").and_then(Value::as_u64)
        && count > 0
    {
        add(&[N15], format!("num_target_vision_tokens is {count}"));
    }
    if tensors.any("future_tokens.") {
        add(&[N15], tensors.show(FUTURE_TOKENS));
    }
    for name in [ARM, LEFT_ARM, RIGHT_ARM, CLAW] {
        if tensors.any(&format!("{name}.")) {
            add(&[N15], tensors.show(&format!("{name}.layer2.W")));
        }
    }
    if tensors.any("vlln.") {
        add(&[N15, N16, N17], tensors.show("vlln.weight"));
    }
    if tensors.any("vl_self_attention.") {
        let blocks = tensors.blocks("vl_self_attention.transformer_blocks");
        add(&[N15, N17], format!("vl_self_attention has {blocks} blocks"));
    }
    if tensors.any("mask_token") {
        add(&[N16], tensors.show("mask_token"));
    }
    Ok(found)
}

/// The versions whose models have this name; none says that it is no name of GR00T.
fn versions_of_name(name: &Value) -> Result<Option<&'static [Version]>> {
    let Value::String(text) = name else {
        return Ok(None);
    };
    let plain: String = text
        .chars()
        .filter(char::is_ascii_alphanumeric)
        .map(|letter| letter.to_ascii_lowercase())
        .collect();
    match plain.as_str() {
        "gr00tn1" => Ok(Some(&[N1])),
        "gr00tn15" | "gr00tn1d5" => Ok(Some(&[N15])),
        "gr00tn16" | "gr00tn1d6" => Ok(Some(&[N16])),
        "gr00tn17" | "gr00tn1d7" => Ok(Some(&[N17])),
        _ if plain.starts_with("gr00t") => Err(unknown_model(&format!("the model is {name}"))),
        _ => Ok(None),
    }
}

fn unknown_model(what: &str) -> Error {
    let names = Version::ALL.map(Version::model_type).join(", ");
    Error::Checkpoint(format!("config: {what}, expected one of {names}"))
}

/// As lerobot reads the version from the name of the model that a policy was made from.
fn version_in_path(path: &str) -> Option<&'static [Version]> {
    let path = path.to_ascii_lowercase();
    let names = |version: &str| {
        ["gr00t-", "gr00t_"]
            .iter()
            .any(|start| path.contains(&format!("{start}{version}")))
    };
    [("n1.5", &[N15]), ("n1.6", &[N16]), ("n1.7", &[N17])]
        .into_iter()
        .find_map(|(name, versions)| names(name).then_some(versions as &'static [Version]))
}

/// Sizes that shapes of tensors prove, under the keys of the head's config; each with the tensor that does.
fn proved(version: Version, tensors: &HeadShapes<'_>) -> Vec<(&'static str, usize, String)> {
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
    add(
        "backbone_embedding_dim",
        "model.transformer_blocks.0.attn1.to_k.weight",
        2,
        1,
    );
    match version {
        N1 | N15 => {
            let several = DECODERS.iter().any(|(name, _)| tensors.decoder(name).is_some());
            add(
                if several {
                    "pretrained_action_dim"
                } else {
                    "action_dim"
                },
                "action_encoder.W1.W",
                3,
                1,
            );
            add("max_state_dim", "state_encoder.layer1.W", 3, 1);
        }
        N16 | N17 => add("max_action_dim", "action_encoder.W1.W", 3, 1),
    }
    if version == N15 {
        add("num_target_vision_tokens", FUTURE_TOKENS, 2, 0);
    }
    if version == N16 {
        add("max_state_dim", "state_encoder.layer1.W", 3, 1);
    }
    for (name, key) in DECODERS {
        add(key, &format!("{name}.layer2.W"), 3, 2);
    }
    sizes
}

/// The fork's decoders and the keys of their widths.
const DECODERS: [(&str, &str); 4] = [
    (ARM, "action_arm_dim"),
    (LEFT_ARM, "action_left_arm_dim"),
    (RIGHT_ARM, "action_right_arm_dim"),
    (CLAW, "action_claw_dim"),
];

/// The head's config with what tensors prove and the published file leaves out, and where the two disagree.
fn complete(
    mut head: Map<String, Value>,
    version: Version,
    tensors: &HeadShapes<'_>,
) -> (Map<String, Value>, Vec<String>) {
    head.insert("model_type".to_owned(), json!(version.model_type()));
    if version == N15 && !tensors.any("future_tokens.") {
        // The first files of N1.5 were without.
        head.entry("num_target_vision_tokens").or_insert(json!(0));
    }
    add_decoders(&mut head, tensors);
    let mut problems = Vec::new();
    for (key, size, shown) in proved(version, tensors) {
        match head.get(key).map(Value::as_u64) {
            Some(Some(given)) if given != size as u64 => {
                problems.push(format!("{key} is {given} in the config, but {shown}"));
            }
            Some(_) => {} // Of values that are no numbers `HeadConfig` says so.
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

const BLOCKS: [(&str, &str); 2] = [
    ("diffusion_model_cfg", "model.transformer_blocks"),
    ("vl_self_attention_cfg", "vl_self_attention.transformer_blocks"),
];

/// The fork's keys, where its decoders are there and the file does not name them: its code makes them up while it loads.
fn add_decoders(head: &mut Map<String, Value>, tensors: &HeadShapes<'_>) {
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

/// The head's config where the file holds none of it: sizes from the tensors, the rest as the published models of that version have it.
fn from_tensors(
    policy: &Map<String, Value>,
    version: Version,
    tensors: &HeadShapes<'_>,
    chunk: Option<u64>,
) -> Result<Map<String, Value>> {
    let sizes = proved(version, tensors);
    let size = |key: &str| {
        sizes
            .iter()
            .find(|(name, _, _)| *name == key)
            .map(|(_, size, _)| *size)
    };
    let mut problems = Vec::new();
    let mut needed = |key: &str| {
        size(key).unwrap_or_else(|| {
            problems.push(format!(
                "{key} is not in lerobot's config.json, and no tensor tells it"
            ));
            1
        })
    };
    let (width, context) = (needed("input_embedding_dim"), needed("backbone_embedding_dim"));
    let hidden = needed("hidden_size");
    let inputs = tensors.size("state_encoder.layer1.W", 3, 1).unwrap_or(1);
    let number = |key: &str| policy.get(key).and_then(Value::as_u64);
    let max_state = number("max_state_dim").map(|dim| if version == N17 && dim == 64 { 132 } else { dim });
    let history = match (version, max_state) {
        (N17, Some(dim)) if dim > 0 && (inputs as u64).is_multiple_of(dim) => inputs as u64 / dim,
        _ => 1,
    };
    let mut head = Map::new();
    let mut set = |key: &str, value: Value| head.insert(key.to_owned(), value);
    set("model_type", json!(version.model_type()));
    for (key, size, _) in &sizes {
        set(key, json!(size));
    }
    set("max_state_dim", json!(inputs as u64 / history));
    set("add_pos_embed", json!(tensors.any("position_embedding.")));
    set("use_vlln", json!(tensors.any("vlln.")));
    set("num_timestep_buckets", json!(1000));
    set(
        "num_inference_timesteps",
        json!(number("num_inference_timesteps").unwrap_or(4)),
    );
    let mut heads = |what: &str, width: usize, head_dim: usize| {
        if !width.is_multiple_of(head_dim) {
            problems.push(format!(
                "{what} is {width}: not a multiple of {head_dim}, the width of an attention head in GR00T {}; lerobot's config.json \
                 does not say how wide they are here",
                show(version)
            ));
        }
        width / head_dim
    };
    let mut dit = json!({
        "attention_head_dim": DIT_HEAD_DIM,
        "interleave_self_attention": true,
        "norm_type": "ada_norm",
        "num_attention_heads": heads("input_embedding_dim", width, DIT_HEAD_DIM),
        "num_layers": tensors.blocks(BLOCKS[0].1),
        "output_dim": hidden,
        "positional_embeddings": null,
    });
    let vl_layers = tensors.blocks(BLOCKS[1].1);
    if vl_layers > 0 || version == N15 {
        let vl = json!({
            "attention_head_dim": VL_HEAD_DIM,
            "num_attention_heads": heads("backbone_embedding_dim", context, VL_HEAD_DIM),
            "num_layers": vl_layers,
            "positional_embeddings": null,
        });
        set("vl_self_attention_cfg", vl);
    }
    match version {
        N1 | N15 => {
            dit["cross_attention_dim"] = json!(context);
            set(
                "num_target_vision_tokens",
                json!(size("num_target_vision_tokens").unwrap_or(0)),
            );
            // lerobot trains chunks of at most the published model's rows, and only where that is what the model has.
            set(
                "action_horizon",
                json!(number("chunk_size").unwrap_or(N15_HORIZON).min(N15_HORIZON)),
            );
        }
        N16 | N17 => {
            set("use_alternate_vl_dit", json!(true));
            set("attend_text_every_n_blocks", json!(2));
            set("state_history_length", json!(history));
            // Whatever the policy's chunk_size: it cuts what the model returns.
            set("action_horizon", json!(chunk.unwrap_or(N17_HORIZON)));
        }
    }
    set("diffusion_model_cfg", dit);
    add_decoders(&mut head, tensors);
    let padded = [
        (
            "max_state_dim",
            max_state,
            "state_encoder.layer1.W",
            inputs as u64 / history,
        ),
        (
            "max_action_dim",
            number("max_action_dim").map(|dim| if version == N17 && dim == 32 { 132 } else { dim }),
            "action_encoder.W1.W",
            tensors.size("action_encoder.W1.W", 3, 1).unwrap_or(0) as u64,
        ),
    ];
    for (key, given, name, found) in padded {
        if let Some(given) = given
            && given != found
        {
            problems.push(format!(
                "{key} is {given} in the config, but {}",
                tensors.show(name)
            ));
        }
    }
    if problems.is_empty() {
        return Ok(head);
    }
    Err(Error::Checkpoint(format!(
        "source: config.json (lerobot's, GR00T {}) and tensors do not make a head; the head's own config can be given as \
         `config`:\n  {}",
        show(version),
        problems.join("\n  ")
    )))
}

/// Widths of an attention head in every published model.
const DIT_HEAD_DIM: usize = 48;
const VL_HEAD_DIM: usize = 64;

/// Actions in a chunk of the published models.
const N15_HORIZON: u64 = 16;
const N17_HORIZON: u64 = 40;

/// Actions in a chunk as lerobot's processors write them down; its newest take them from the model that the policy was made from.
fn chunk_of_processors(directory: &Path) -> Option<u64> {
    let text = read_text(
        "policy_preprocessor.json",
        &directory.join("policy_preprocessor.json"),
    )
    .ok()?;
    let processors: Value = serde_json::from_str(&text).ok()?;
    let steps = processors.get("steps")?.as_array()?;
    steps
        .iter()
        .find_map(|step| step.get("config")?.get("action_horizon")?.as_u64())
}

/// What saccade keeps in a file of its own, since lerobot refuses a `config.json` with keys that it does not know.
fn beside_lerobots_config(directory: &Path) -> Result<Option<Value>> {
    let path = directory.join(OWN_CONFIG);
    if !path.exists() {
        return Ok(None);
    }
    let bad = |problem: String| Error::Checkpoint(format!("source: {}: {problem}", path.display()));
    let own: Value = serde_json::from_str(&read_text("source", &path)?)
        .map_err(|error| bad(format!("not valid JSON: {error}")))?;
    match own {
        Value::Object(_) => Ok(Some(own)),
        _ => Err(bad("expected a JSON object".to_owned())),
    }
}

/// Who wrote it.
fn layout(top: &Map<String, Value>, tensors: &HeadShapes<'_>, directory: &Path) -> Layout {
    let several = DECODERS.iter().any(|(name, _)| tensors.decoder(name).is_some());
    let is_lerobot = tensors.prefix.starts_with("_groot_model.") || top.contains_key("type");
    match (is_lerobot || several, several) {
        (true, true) => Layout::Fork,
        (true, false) => Layout::Lerobot,
        _ if !["backbone_cfg", "backbone_model_type", "model_name"]
            .iter()
            .any(|key| top.contains_key(*key)) =>
        {
            Layout::Saccade
        }
        _ if directory.join("trainer_state.json").is_file() => Layout::IsaacFineTune,
        _ => Layout::Nvidia,
    }
}
