//! LoRA adapters of PEFT, merged into the weights of their base: `W + scaling * B A`.
//!
//! As PEFT's `merge_and_unload` on a CPU: the product and the sum are computed in float32, also for weights of 16 bits, and the sum is rounded to
//! the type of the weight. The bits are those of torch's matrix product on x86; other libraries may add in another order.

mod config;
mod delta;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use saccade_vla_checkpoint::spec::SCALE_SUFFIX;
use saccade_vla_checkpoint::{
    ADAPTER_CONFIG, ADAPTER_WEIGHTS, Checkpoint, Dtype, directory_of, plain_name, read_text, show_shape,
};
use serde_json::value::RawValue;

use crate::error::{Error, Result, bail, ensure, problem};
use crate::recognise::HeadCheckpoint;
use crate::rewrite::float::Float;
use crate::rewrite::json_edit::{find, span};
use config::{AdapterConfig, Names, is_end};
use delta::Factors;

pub(crate) use delta::Delta;

/// What the names of an adapter's tensors begin with, before the names of its base.
const PREFIX: &str = "base_model.model.";

/// Problems that a message lists.
const SHOWN: usize = 20;

/// What becomes of a tensor of the base.
enum Change {
    Add(Factors),
    /// The tensor of the adapter's file that takes its place.
    Replace(String),
}

/// An adapter that fits its base.
pub(crate) struct Adapter {
    checkpoint: Checkpoint,
    /// By the names of the base's tensors.
    changes: BTreeMap<String, Change>,
}

/// Opens the checkpoint `source`, to which an adapter may be added: the one in the directory `adapter` may then be beside its weights, and its
/// `config.json`, if it has one, takes the place of the base's, as in lerobot.
///
/// # Errors
/// As [`HeadCheckpoint::open`].
pub fn open_base(source: &Path, config: Option<&str>, adapter: Option<&Path>) -> Result<HeadCheckpoint> {
    let Some(adapter) = adapter else {
        return HeadCheckpoint::open(source, config);
    };
    let own = match config {
        Some(_) => None,
        None => own_config(adapter)?,
    };
    let checkpoint = match is_beside(source, adapter) {
        true => Checkpoint::open_beside_adapter(source)?,
        false => Checkpoint::open(source)?,
    };
    HeadCheckpoint::of(checkpoint, source, config.or(own.as_deref()))
}

/// Whether the adapter is in the directory of its base.
pub(crate) fn is_beside(source: &Path, adapter: &Path) -> bool {
    let folder = directory_of(source);
    matches!((folder.canonicalize(), adapter.canonicalize()), (Ok(one), Ok(two)) if one == two)
}

/// The `config.json` of an adapter, in which `use_peft` is false: lerobot's says that there is one.
fn own_config(adapter: &Path) -> Result<Option<String>> {
    let path = adapter.join("config.json");
    if !path.exists() {
        return Ok(None);
    }
    let text = read_text("adapter", &path)?;
    let whole: &RawValue = serde_json::from_str(&text)
        .map_err(|source| Error::json(format!("adapter: {}", path.display()), source))?;
    let mut values = Vec::new();
    find("", whole, &mut values)?;
    let switch = values.iter().find(|value| value.path == "use_peft");
    Ok(Some(match switch {
        None => text,
        Some(switch) => {
            let place = span(&text, switch.value);
            format!("{}false{}", &text[..place.start], &text[place.end..])
        }
    }))
}

/// The type of a tensor that is int8, or int4, which its scales tell from other bytes.
fn quantized_dtype(base: &Checkpoint, name: &str) -> Option<Dtype> {
    let dtype = base.dtype(name).ok()?;
    let is_int4 = || dtype == Dtype::U8 && base.dtype(&format!("{name}{SCALE_SUFFIX}")).is_ok();
    (dtype == Dtype::I8 || is_int4()).then_some(dtype)
}

impl Adapter {
    /// Opens the adapter in `directory` for the checkpoint `base`.
    ///
    /// # Errors
    /// [`Error::File`] for files that are not there or broken; [`Error::Checkpoint`] for an adapter of another kind, for one that does not fit
    /// the base, and for a base that is quantised.
    pub(crate) fn open(directory: &Path, base: &Checkpoint) -> Result<Self> {
        ensure!(
            directory.is_dir(), Input, "adapter";
            expected "a directory with {ADAPTER_CONFIG} and {ADAPTER_WEIGHTS}"; got "{}", directory.display()
        );
        let config = AdapterConfig::read(directory)?;
        let checkpoint = Checkpoint::open_file(&weights_of(directory)?)?;
        let quantized = |name| Some((name, quantized_dtype(base, name)?));
        if let Some((name, dtype)) = base.names().find_map(quantized) {
            bail!(
                Checkpoint, "source";
                "{name} is {dtype:?}: expected weights that are not quantised; merge the adapter first, then quantise"
            );
        }
        let mut changes = BTreeMap::new();
        let mut problems = Vec::new();
        let fitting = Fitting {
            checkpoint: &checkpoint,
            base,
            config: &config,
        };
        for name in checkpoint.names() {
            match fitting.change_of(name) {
                Ok(Some((target, _))) if changes.contains_key(&target) => {
                    problems.push(format!(
                        "{name}: another tensor of the adapter changes {target} too"
                    ));
                }
                Ok(Some((target, change))) => {
                    changes.insert(target, change);
                }
                Ok(None) => {}
                Err(problem) => problems.push(problem),
            }
        }
        problems.extend(fitting.left_over(&changes));
        if problems.is_empty() {
            return Ok(Self { checkpoint, changes });
        }
        let more = problems.len().saturating_sub(SHOWN);
        problems.truncate(SHOWN);
        if more > 0 {
            problems.push(format!("and {more} more"));
        }
        Err(Error::Checkpoint(problem!(
            "adapter"; "{} does not fit the base:\n  {}", directory.display(), problems.join("\n  ")
        )))
    }

    /// What is added to tensor `name` of the base, if anything is.
    pub(crate) fn delta(&self, name: &str) -> Result<Option<Delta>> {
        match self.changes.get(name) {
            Some(Change::Add(factors)) => Ok(Some(Delta::read(&self.checkpoint, factors)?)),
            _ => Ok(None),
        }
    }

    /// The adapter's file, and the tensor in it that takes the place of tensor `name` of the base, if one does.
    pub(crate) fn replacement(&self, name: &str) -> Option<(&Checkpoint, &str)> {
        match self.changes.get(name) {
            Some(Change::Replace(own)) => Some((&self.checkpoint, own)),
            _ => None,
        }
    }

    /// Numbers of weights that are added to, and of tensors that are replaced.
    pub(crate) fn counts(&self) -> (usize, usize) {
        let is_added = |change: &&Change| matches!(change, Change::Add(_));
        let added = self.changes.values().filter(is_added).count();
        (added, self.changes.len() - added)
    }
}

fn weights_of(directory: &Path) -> Result<PathBuf> {
    let weights = directory.join(ADAPTER_WEIGHTS);
    ensure!(
        weights.exists() || !directory.join("adapter_model.bin").exists(), Checkpoint, "adapter";
        "{} holds adapter_model.bin, expected {ADAPTER_WEIGHTS}: save it again with PEFT's save_pretrained, which writes that",
        directory.display()
    );
    Ok(weights)
}

/// Whether tensor `name` is in a module whose name ends so. PEFT compares letters here, not parts of the path.
fn saves(end: &str, name: &str) -> bool {
    name.match_indices('.').any(|(dot, _)| name[..dot].ends_with(end))
}

/// Whether a tensor that is there holds floating-point numbers.
fn is_float(checkpoint: &Checkpoint, name: &str) -> bool {
    checkpoint.dtype(name).ok().and_then(Float::of).is_some()
}

/// An adapter on its way onto its base.
struct Fitting<'a> {
    checkpoint: &'a Checkpoint,
    base: &'a Checkpoint,
    config: &'a AdapterConfig,
}

impl Fitting<'_> {
    /// The tensor of the base that the adapter's tensor `name` changes, and how; none for the second factor of
    /// a product.
    fn change_of(&self, name: &str) -> std::result::Result<Option<(String, Change)>, String> {
        let Some(inner) = name.strip_prefix(PREFIX) else {
            return Err(format!("{name}: expected a name that begins with {PREFIX}"));
        };
        let inner = plain_name(inner);
        for (a, b, is_embedding) in [
            (".lora_A.weight", ".lora_B.weight", false),
            (".lora_embedding_A", ".lora_embedding_B", true),
        ] {
            let (own, other) = (inner.strip_suffix(a), inner.strip_suffix(b));
            let Some(module) = own.or(other) else { continue };
            let (end, wanted) = if own.is_some() { (a, b) } else { (b, a) };
            let pair = format!("{}{wanted}", &name[..name.len() - end.len()]);
            if self.checkpoint.shape(&pair).is_none() {
                return Err(format!("{name} is there without {pair}"));
            }
            if own.is_none() {
                return Ok(None);
            }
            if !self.config.adapts(module) {
                return Err(format!(
                    "{name}: {module} is not one of target_modules: PEFT would ignore it"
                ));
            }
            let factors = self.factors(module, name, &pair, is_embedding)?;
            return Ok(Some((format!("{module}.weight"), Change::Add(factors))));
        }
        if self.config.saved.iter().any(|end| saves(end, &inner)) {
            self.check_replacement(&inner, name)?;
            return Ok(Some((inner.into_owned(), Change::Replace(name.to_owned()))));
        }
        Err(format!(
            "{name}: expected a lora_A or lora_B, or a tensor of modules_to_save"
        ))
    }

    /// The shape of tensor `target` of the base, which the adapter's tensor `name` changes.
    fn base_shape(&self, target: &str, name: &str) -> std::result::Result<&[usize], String> {
        const LEROBOT: &str = "_groot_model.";
        let is_lerobot = |name: &str| name.starts_with(LEROBOT);
        self.base.shape(target).ok_or_else(|| {
            let hint = match (is_lerobot(target), self.base.names().any(is_lerobot)) {
                (true, false) => ": the adapter is of a checkpoint in lerobot's layout, the base is not",
                (false, true) => ": the base is in lerobot's layout, the adapter is of another",
                _ => "",
            };
            format!("{name}: the base has no {target}{hint}")
        })
    }

    /// That the adapter's tensor `name` can take the place of tensor `target` of the base.
    fn check_replacement(&self, target: &str, name: &str) -> std::result::Result<(), String> {
        let (shape, there) = (
            self.checkpoint.shape(name).unwrap_or_default(),
            self.base_shape(target, name)?,
        );
        if there != shape {
            let (shape, there) = (show_shape(shape), show_shape(there));
            return Err(format!("{name} has shape {shape}, expected {there}"));
        }
        match is_float(self.base, target) && is_float(self.checkpoint, name) {
            true => Ok(()),
            false => Err(format!(
                "{name}: expected F32, BF16 or F16 in the adapter and in the base"
            )),
        }
    }

    fn factors(
        &self,
        module: &str,
        a: &str,
        b: &str,
        is_embedding: bool,
    ) -> std::result::Result<Factors, String> {
        let target = format!("{module}.weight");
        let weight = self.base_shape(&target, a)?;
        let [shape_a, shape_b] = [a, b].map(|name| self.checkpoint.shape(name).unwrap_or_default());
        let (rank, scaling) = self.config.scaling(module);
        let rank = rank as usize;
        let shown = format!(
            "{a} {}, {b} {} and {target} {}",
            show_shape(shape_a),
            show_shape(shape_b),
            show_shape(weight)
        );
        let fits = match (is_embedding, weight) {
            (true, &[rows, columns]) => shape_a == [rank, rows] && shape_b == [columns, rank],
            // The second layer of a convolution has a kernel of one.
            (false, [rows, columns @ ..]) if !columns.is_empty() => {
                shape_a.first() == Some(&rank)
                    && shape_a[1..] == *columns
                    && shape_b.get(..2) == Some(&[*rows, rank])
                    && shape_b.len() == weight.len()
                    && shape_b[2..].iter().all(|&size| size == 1)
            }
            _ => false,
        };
        if !fits || weight.contains(&0) {
            return Err(format!(
                "{shown} do not fit each other and rank {rank} of the config"
            ));
        }
        let are_floats =
            is_float(self.base, &target) && [a, b].iter().all(|name| is_float(self.checkpoint, name));
        if !are_floats {
            return Err(format!("{shown}: expected F32, BF16 or F16"));
        }
        Ok(Factors {
            a: a.to_owned(),
            b: b.to_owned(),
            is_embedding,
            rows: weight[0],
            columns: weight[1..].iter().product(),
            rank,
            scaling,
        })
    }

    /// Names in the config that nothing in the adapter's file fits, and tensors of the base that the file
    /// should replace.
    fn left_over(&self, changes: &BTreeMap<String, Change>) -> Vec<String> {
        let modules: Vec<&str> = changes
            .iter()
            .filter(|(_, change)| matches!(change, Change::Add(_)))
            .filter_map(|(name, _)| name.strip_suffix(".weight"))
            .collect();
        let nothing = |what: &str| format!("target_modules: {what} fits no tensor of the adapter");
        let mut problems = match &self.config.targets {
            Names::Ends(ends) => {
                let unused = ends
                    .iter()
                    .filter(|end| !modules.iter().any(|module| is_end(end, module)));
                unused.map(|end| nothing(end)).collect()
            }
            Names::Pattern(_) if modules.is_empty() => vec![nothing("its pattern")],
            Names::Pattern(_) => Vec::new(),
        };
        for end in &self.config.saved {
            let in_base: Vec<&str> = self.base.names().filter(|name| saves(end, name)).collect();
            if in_base.is_empty() {
                problems.push(format!("modules_to_save: {end} fits no tensor of the base"));
            }
            let absent = in_base.into_iter().filter(|name| !changes.contains_key(*name));
            problems.extend(absent.map(|name| format!("{name} of modules_to_save is not in the adapter")));
        }
        problems
    }
}
