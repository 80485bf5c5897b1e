//! What to change inside the head while it runs, and what that means at one step, in one block.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;
use std::ops::Range;

use saccade_kernels::LogitBias;

use crate::array::OwnedArray;
use crate::config::HeadConfig;
use crate::context::Context;
use crate::error::{Error, Result, show_shape};

/// A group of tokens.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Group {
    /// The one state row.
    State,
    /// The future rows.
    Future,
    /// The action rows.
    Action,
    /// The vision-language tokens, which cross-attention blocks read.
    Vl,
}

impl Group {
    /// From its name: `state`, `future`, `action` or `vl`.
    ///
    /// # Errors
    /// [`Error::Input`] for any other name.
    pub fn from_name(name: &str) -> Result<Self> {
        [Self::State, Self::Future, Self::Action, Self::Vl]
            .into_iter()
            .find(|group| group.name() == name)
            .ok_or_else(|| Error::Input(format!("group: expected state, future, action or vl, got {name}")))
    }

    /// Its name.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::State => "state",
            Self::Future => "future",
            Self::Action => "action",
            Self::Vl => "vl",
        }
    }
}

/// A group, or some of its tokens.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Tokens {
    /// The group.
    pub group: Group,
    /// Indices within the group; none stands for all of it.
    pub indices: Option<Vec<usize>>,
}

/// Rows that replace those of some tokens after one block of one step.
#[derive(Clone, Debug)]
pub struct Patch {
    /// The Euler step.
    pub step: usize,
    /// The block.
    pub block: usize,
    /// Whose rows.
    pub tokens: Tokens,
    /// `(tokens, width)`, or `(batch, tokens, width)`.
    pub rows: OwnedArray,
}

/// A change of what the head computes. Several act together: biases add up, of two patches of one row the later counts, and at most one
/// replaces the future tokens.
///
/// ```
/// use saccade::{Group, Intervention, Tokens};
/// let all = |group| Tokens { group, indices: None };
/// let blind = Intervention { cut: vec![(all(Group::Future), all(Group::Vl))], ..Intervention::default() };
/// assert!(blind.blocks.is_none(), "in every block");
/// ```
#[derive(Clone, Debug, Default)]
pub struct Intervention {
    /// `(reader, source)`: the reader's rows no longer see the source's keys. A row with no key left gets zero from the attention.
    pub cut: Vec<(Tokens, Tokens)>,
    /// Added to the logits of these keys, for every reader: one number, or `(tokens,)`. Minus infinity removes a key.
    pub key_bias: Vec<(Tokens, OwnedArray)>,
    /// Replaced rows; `blocks`, `steps` and `heads` do not limit them.
    pub patch: Vec<Patch>,
    /// `(tokens, width)`, in place of the learned ones and of the biases that these have; any number of tokens.
    pub future_tokens: Option<OwnedArray>,
    /// Blocks in which cuts and biases act; default all.
    pub blocks: Option<Vec<usize>>,
    /// Euler steps at which they act; default all.
    pub steps: Option<Vec<usize>>,
    /// Attention heads in which they act; default all.
    pub heads: Option<Vec<usize>>,
}

/// How many tokens there are. Rows lie in the order state, future, action.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Groups {
    /// Future rows.
    pub future: usize,
    /// Action rows.
    pub action: usize,
    /// Vision-language tokens.
    pub vl: usize,
}

impl Groups {
    /// Rows of a sequence.
    #[must_use]
    pub fn num_rows(&self) -> usize {
        1 + self.future + self.action
    }

    /// Where a group's tokens lie: among the rows, or among the vision-language tokens.
    #[must_use]
    pub fn range(&self, group: Group) -> Range<usize> {
        match group {
            Group::State => 0..1,
            Group::Future => 1..1 + self.future,
            Group::Action => 1 + self.future..self.num_rows(),
            Group::Vl => 0..self.vl,
        }
    }

    /// The positions of `tokens`, in the order given.
    fn positions(&self, tokens: &Tokens) -> Vec<usize> {
        let range = self.range(tokens.group);
        match &tokens.indices {
            None => range.collect(),
            Some(indices) => indices.iter().map(|index| range.start + index).collect(),
        }
    }

    /// How many `tokens` are.
    ///
    /// # Errors
    /// [`Error::Input`] for an index that is not in the group.
    fn check(&self, name: &str, tokens: &Tokens) -> Result<usize> {
        let count = self.range(tokens.group).len();
        let Some(indices) = &tokens.indices else {
            return Ok(count);
        };
        match indices.iter().find(|index| **index >= count) {
            None => Ok(indices.len()),
            Some(index) => Err(Error::Input(format!(
                "{name}: {} token {index}, expected {}",
                tokens.group.name(),
                span(count)
            ))),
        }
    }
}

/// What one call is over.
#[derive(Clone, Copy)]
pub(crate) struct Extent<'a> {
    pub config: &'a HeadConfig,
    pub batch: usize,
    pub num_steps: usize,
    /// `(groups.future, width)`: the learned ones, or those in their place.
    pub future_tokens: &'a [f32],
    /// What is added to the logits of these keys, with or without an intervention.
    pub future_key_bias: Option<&'a [f32]>,
    pub groups: Groups,
}

impl<'a> Extent<'a> {
    /// # Errors
    /// [`Error::Shape`] and [`Error::Input`] for future tokens that cannot replace the learned ones.
    pub(crate) fn new(
        config: &'a HeadConfig,
        learned: &'a [f32],
        interventions: &'a [Intervention],
        context: &Context,
        num_steps: usize,
    ) -> Result<Self> {
        let replaced = replaced_future_tokens(interventions, config.width)?;
        let future_tokens = replaced.unwrap_or(learned);
        // The config's biases are those of the learned tokens.
        let future_key_bias = match replaced {
            None => config.future_key_bias.as_deref(),
            Some(_) => None,
        };
        Ok(Self {
            config,
            batch: context.batch,
            num_steps,
            future_tokens,
            future_key_bias,
            groups: Groups {
                future: future_tokens.len() / config.width,
                action: config.action_horizon,
                vl: context.num_vl_tokens,
            },
        })
    }
}

/// All interventions of one call, in the form in which blocks use them.
pub(crate) struct Changes<'a> {
    pub extent: Extent<'a>,
    biases: Vec<DenseBias>,
    /// Which of the biases acts, by step and block; empty if none ever does.
    acting: Vec<Option<usize>>,
    patches: Vec<PatchedRows<'a>>,
}

/// What is added to the logits of one kind of block, `(heads, rows, keys)`; one head stands for all if it is the same for all of them.
struct DenseBias {
    values: Vec<f32>,
    heads: usize,
    rows: usize,
    keys: usize,
}

struct PatchedRows<'a> {
    step: usize,
    block: usize,
    /// Positions among all rows.
    rows: Vec<usize>,
    values: &'a [f32],
    /// Elements from one batch element's values to the next one's; 0 if all have the same.
    element_stride: usize,
}

/// Bytes of biases that one call may hold: some two hundred, each different for every head, at N1.5's size with three cameras.
const MAX_BIAS_BYTES: u128 = 1 << 30;

impl<'a> Changes<'a> {
    /// Checks the interventions and works out where each acts. With none of them nothing is allocated.
    ///
    /// # Errors
    /// [`Error::Shape`] and [`Error::Input`] for what does not fit the call.
    pub(crate) fn new(interventions: &'a [Intervention], extent: Extent<'a>) -> Result<Self> {
        let mut changes = Self {
            extent,
            biases: Vec::new(),
            acting: Vec::new(),
            patches: Vec::new(),
        };
        for intervention in interventions {
            intervention.check(&extent)?;
            for patch in &intervention.patch {
                changes.patches.push(patch.check(&extent)?);
            }
        }
        let adds = |one: &Intervention| !one.cut.is_empty() || !one.key_bias.is_empty();
        if extent.future_key_bias.is_some() || interventions.iter().any(adds) {
            changes.find_biases(interventions)?;
        }
        Ok(changes)
    }

    /// That no row is patched at a step at which it does not run: at evaluations of the velocity that `refresh` does not divide only
    /// action rows do. A step has `in_step` evaluations.
    ///
    /// # Errors
    /// [`Error::Input`] for such a patch.
    pub(crate) fn check_refresh(&self, refresh: usize, in_step: usize) -> Result<()> {
        let actions = self.extent.groups.range(Group::Action).start;
        let stays = |patch: &&PatchedRows<'_>| {
            let mut evaluations = patch.step * in_step..(patch.step + 1) * in_step;
            patch.rows.iter().any(|row| *row < actions)
                && evaluations.any(|evaluation| !evaluation.is_multiple_of(refresh))
        };
        match self.patches.iter().find(stays) {
            None => Ok(()),
            Some(PatchedRows { step, block, .. }) => Err(Error::Input(format!(
                "patch[({step}, {block})]: expected action tokens, since with future_refresh {refresh} the rows of state and future tokens \
                 do not always run at step {step}"
            ))),
        }
    }

    /// Blocks of one kind in which the same interventions act share a bias.
    fn find_biases(&mut self, interventions: &[Intervention]) -> Result<()> {
        let mut known: BTreeMap<(bool, Vec<usize>), usize> = BTreeMap::new();
        let config = self.extent.config;
        for step in 0..self.extent.num_steps {
            for block in 0..config.num_layers {
                let is_cross = config.is_cross(block);
                let acting: Vec<usize> = (0..interventions.len())
                    .filter(|&index| interventions[index].acts(step, block, is_cross))
                    .collect();
                let has_own = !is_cross && self.extent.future_key_bias.is_some();
                let index = if acting.is_empty() && !has_own {
                    None
                } else {
                    Some(match known.entry((is_cross, acting)) {
                        Entry::Occupied(entry) => *entry.get(),
                        Entry::Vacant(entry) => {
                            let acting = entry.key().1.iter().map(|&index| &interventions[index]);
                            let bias = self.sum(&acting.collect::<Vec<_>>(), is_cross)?;
                            self.biases.push(bias);
                            *entry.insert(self.biases.len() - 1)
                        }
                    })
                };
                self.acting.push(index);
            }
        }
        Ok(())
    }

    /// The sum of what `acting` add in blocks of one kind, and of what these have of their own.
    fn sum(&self, acting: &[&Intervention], is_cross: bool) -> Result<DenseBias> {
        let Extent { groups, config, .. } = self.extent;
        let rows = groups.num_rows();
        let keys = if is_cross { groups.vl } else { rows };
        let everywhere = acting.iter().all(|one| one.heads.is_none());
        let heads = if everywhere { 1 } else { config.num_heads };
        let held: usize = self.biases.iter().map(|bias| bias.values.len()).sum();
        let bytes = 4 * (held as u128 + heads as u128 * rows as u128 * keys as u128);
        if bytes > MAX_BIAS_BYTES {
            return Err(Error::Input(format!(
                "intervention: cuts and biases over {heads} heads, {rows} rows and {keys} keys need {bytes} bytes, expected at most \
                 {MAX_BIAS_BYTES}; give fewer of them heads, blocks or steps of their own"
            )));
        }
        let mut bias = DenseBias {
            values: vec![0.0; heads * rows * keys],
            heads,
            rows,
            keys,
        };
        if let Some(own) = self.extent.future_key_bias.filter(|_| !is_cross) {
            for row in bias.values.chunks_exact_mut(keys) {
                row[groups.range(Group::Future)].copy_from_slice(own);
            }
        }
        for intervention in acting {
            intervention.add(&groups, is_cross, &mut bias);
        }
        // Each is below infinity; a sum of several may still reach it.
        if bias
            .values
            .iter()
            .any(|value| value.is_nan() || *value == f32::INFINITY)
        {
            return Err(Error::Input(
                "key_bias: expected biases whose sum for a key is below infinity".to_owned(),
            ));
        }
        Ok(bias)
    }

    /// What is added to the logits of `block` at `step`, for the rows from `first_row` on.
    pub(crate) fn bias(&self, step: usize, block: usize, first_row: usize) -> Option<LogitBias<'_>> {
        let acting = self.acting.get(step * self.extent.config.num_layers + block)?;
        let bias = &self.biases[(*acting)?];
        Some(LogitBias {
            values: &bias.values[first_row * bias.keys..],
            head_stride: if bias.heads == 1 { 0 } else { bias.rows * bias.keys },
            query_stride: bias.keys,
        })
    }

    /// Replaces rows after `block` at `step`. `x` holds the rows from `first_row` on of `samples` sequences for each batch element.
    pub(crate) fn patch(&self, step: usize, block: usize, first_row: usize, samples: usize, x: &mut [f32]) {
        let Extent { groups, config, .. } = self.extent;
        let width = config.width;
        let sequence_len = (groups.num_rows() - first_row) * width;
        let patches = self.patches.iter();
        for patch in patches.filter(|patch| (patch.step, patch.block) == (step, block)) {
            for (index, sequence) in x.chunks_exact_mut(sequence_len).enumerate() {
                let values = &patch.values[index / samples * patch.element_stride..];
                for (row, value) in patch.rows.iter().zip(values.chunks_exact(width)) {
                    if let Some(row) = row.checked_sub(first_row) {
                        sequence[row * width..(row + 1) * width].copy_from_slice(value);
                    }
                }
            }
        }
    }
}

fn replaced_future_tokens(interventions: &[Intervention], width: usize) -> Result<Option<&[f32]>> {
    let mut given = interventions.iter().filter_map(|one| one.future_tokens.as_ref());
    let Some(tokens) = given.next() else {
        return Ok(None);
    };
    if given.next().is_some() {
        return Err(Error::Input(
            "future_tokens: expected at most one intervention that replaces them, got several".to_owned(),
        ));
    }
    if tokens.shape.len() != 2 || tokens.shape[1] != width {
        return Err(Error::Shape(format!(
            "future_tokens: expected (tokens, width) with width {width}, got {}",
            show_shape(&tokens.shape)
        )));
    }
    Ok(Some(tokens.view().check_finite("future_tokens")?.data))
}

impl Intervention {
    /// Everything but patches and future tokens.
    fn check(&self, extent: &Extent<'_>) -> Result<()> {
        let Extent { config, groups, .. } = extent;
        for (name, indices, count) in [
            ("intervention: blocks", &self.blocks, config.num_layers),
            ("intervention: steps", &self.steps, extent.num_steps),
            ("intervention: heads", &self.heads, config.num_heads),
        ] {
            check_indices(name, indices.as_deref().unwrap_or(&[]), count)?;
        }
        for (reader, source) in &self.cut {
            if reader.group == Group::Vl {
                return Err(Error::Input(
                    "cut: vl is read, it does not read; expected a reader among state, future, action"
                        .to_owned(),
                ));
            }
            groups.check("cut", reader)?;
            groups.check("cut", source)?;
        }
        for (tokens, bias) in &self.key_bias {
            let count = groups.check("key_bias", tokens)?;
            if !bias.shape.is_empty() && bias.shape != [count] {
                return Err(Error::Shape(format!(
                    "key_bias: expected a number or ({count},) for {}, got {}",
                    tokens.group.name(),
                    show_shape(&bias.shape)
                )));
            }
            if let Some(bad) = bias
                .data
                .iter()
                .find(|value| value.is_nan() || **value == f32::INFINITY)
            {
                return Err(Error::Input(format!(
                    "key_bias: expected numbers below infinity, got {bad}"
                )));
            }
        }
        Ok(())
    }

    /// Whether it adds to the logits of this block.
    fn acts(&self, step: usize, block: usize, is_cross: bool) -> bool {
        let limited_to =
            |chosen: &Option<Vec<usize>>, index| chosen.as_ref().is_none_or(|chosen| chosen.contains(&index));
        let sources = self.cut.iter().map(|(_, source)| source);
        let mut keys = sources.chain(self.key_bias.iter().map(|(tokens, _)| tokens));
        limited_to(&self.steps, step)
            && limited_to(&self.blocks, block)
            && keys.any(|tokens| is_read(tokens, is_cross))
    }

    /// Adds its cuts and biases to those of one kind of block.
    fn add(&self, groups: &Groups, is_cross: bool, to: &mut DenseBias) {
        let heads: Vec<usize> = match &self.heads {
            Some(heads) => heads.clone(),
            None => (0..to.heads).collect(),
        };
        let everyone: Vec<usize> = (0..to.rows).collect();
        let mut add = |readers: &[usize], keys: &[usize], values: &dyn Fn(usize) -> f32| {
            for &head in &heads {
                for &reader in readers {
                    let row = &mut to.values[(head * to.rows + reader) * to.keys..][..to.keys];
                    for (index, &key) in keys.iter().enumerate() {
                        row[key] += values(index);
                    }
                }
            }
        };
        for (reader, source) in &self.cut {
            if is_read(source, is_cross) {
                add(&groups.positions(reader), &groups.positions(source), &|_| {
                    f32::NEG_INFINITY
                });
            }
        }
        for (tokens, bias) in &self.key_bias {
            if is_read(tokens, is_cross) {
                add(
                    &everyone,
                    &groups.positions(tokens),
                    &|index| match bias.shape.as_slice() {
                        [] => bias.data[0],
                        _ => bias.data[index],
                    },
                );
            }
        }
    }
}

/// Whether blocks of this kind have these keys.
fn is_read(tokens: &Tokens, is_cross: bool) -> bool {
    (tokens.group == Group::Vl) == is_cross
}

impl Patch {
    fn check(&self, extent: &Extent<'_>) -> Result<PatchedRows<'_>> {
        let Extent { config, groups, .. } = extent;
        let width = config.width;
        check_indices("patch: step", &[self.step], extent.num_steps)?;
        check_indices("patch: block", &[self.block], config.num_layers)?;
        if self.tokens.group == Group::Vl {
            return Err(Error::Input(
                "patch: blocks change rows, not vl; expected state, future or action".to_owned(),
            ));
        }
        let name = format!("patch[({}, {})]", self.step, self.block);
        let count = groups.check(&name, &self.tokens)?;
        let element_stride = match self.rows.shape.as_slice() {
            shape if shape == [count, width] => 0,
            shape if shape == [extent.batch, count, width] => count * width,
            shape => {
                return Err(Error::Shape(format!(
                    "{name}: expected (tokens, width) = {} or (batch, tokens, width) = {} for {}, got {}",
                    show_shape(&[count, width]),
                    show_shape(&[extent.batch, count, width]),
                    self.tokens.group.name(),
                    show_shape(shape)
                )));
            }
        };
        Ok(PatchedRows {
            step: self.step,
            block: self.block,
            rows: groups.positions(&self.tokens),
            values: self.rows.view().check_finite(&name)?.data,
            element_stride,
        })
    }
}

/// That all indices are below `count`.
pub(crate) fn check_indices(name: &str, indices: &[usize], count: usize) -> Result<()> {
    match indices.iter().find(|index| **index >= count) {
        None => Ok(()),
        Some(index) => Err(Error::Input(format!(
            "{name}: expected {}, got {index}",
            span(count)
        ))),
    }
}

fn span(count: usize) -> String {
    match count {
        0 => "none, since the group has no token".to_owned(),
        _ => format!("0 to {}", count - 1),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::trace::Recorded;

    /// Four blocks, two heads, three future and two action rows, width 4.
    fn config() -> HeadConfig {
        HeadConfig::from_json(
            r#"{
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
            }"#,
        )
        .unwrap()
    }

    const LEARNED: [f32; 12] = [0.5; 12];
    const CUT: f32 = f32::NEG_INFINITY;

    /// What the interventions mean for two observations of five tokens and three steps.
    fn changes<'a>(config: &'a HeadConfig, interventions: &'a [Intervention]) -> Result<Changes<'a>> {
        let context = Context {
            head: 0,
            batch: 2,
            num_vl_tokens: 5,
            vl_embs: Vec::new(),
            keys_values: Vec::new(),
            seen: Vec::new(),
            image_mask: None,
            recorded: Recorded::default(),
        };
        Changes::new(
            interventions,
            Extent::new(config, &LEARNED, interventions, &context, 3)?,
        )
    }

    fn message(intervention: Intervention) -> String {
        changes(&config(), &[intervention])
            .err()
            .expect("an error")
            .to_string()
    }

    fn all(group: Group) -> Tokens {
        Tokens { group, indices: None }
    }

    fn some(group: Group, indices: &[usize]) -> Tokens {
        Tokens {
            group,
            indices: Some(indices.to_vec()),
        }
    }

    fn patch(step: usize, block: usize, tokens: Tokens, shape: &[usize]) -> Intervention {
        let values = (0..shape.iter().product()).map(|index: usize| index as f32);
        let rows = OwnedArray::new(values.collect(), shape);
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

    /// The bias of one head and query.
    fn row(bias: LogitBias<'_>, head: usize, query: usize, keys: usize) -> Vec<f32> {
        bias.values[head * bias.head_stride + query * bias.query_stride..][..keys].to_vec()
    }

    #[test]
    fn a_cut_is_where_its_keys_are() {
        let config = config();
        let interventions = [Intervention {
            cut: vec![
                (some(Group::Action, &[1]), some(Group::Future, &[2, 0])),
                (all(Group::Future), some(Group::Vl, &[4])),
            ],
            ..Intervention::default()
        }];
        let changes = changes(&config, &interventions).unwrap();
        // Rows: state 0, future 1 to 3, action 4 and 5.
        for step in 0..3 {
            for block in [1, 3] {
                let bias = changes.bias(step, block, 0).unwrap();
                assert_eq!(row(bias, 1, 5, 6), [0.0, CUT, 0.0, CUT, 0.0, 0.0]);
                for query in 0..5 {
                    assert_eq!(row(bias, 0, query, 6), [0.0; 6]);
                }
                let of_actions = changes.bias(step, block, 4).unwrap();
                assert_eq!(row(of_actions, 0, 1, 6), row(bias, 0, 5, 6));
            }
            for block in [0, 2] {
                let bias = changes.bias(step, block, 0).unwrap();
                assert_eq!(row(bias, 0, 0, 5), [0.0; 5]);
                assert_eq!(row(bias, 0, 2, 5), [0.0, 0.0, 0.0, 0.0, CUT]);
            }
        }
        assert_eq!(changes.biases.len(), 2, "one for each kind of block");
    }

    #[test]
    fn biases_of_several_add_up_where_they_act_together() {
        let config = config();
        let bias =
            |tokens, values: &[f32], shape: &[usize]| vec![(tokens, OwnedArray::new(values.to_vec(), shape))];
        let interventions = [
            Intervention {
                key_bias: bias(some(Group::Future, &[2, 1]), &[1.0, 2.0], &[2]),
                heads: Some(vec![1]),
                ..Intervention::default()
            },
            Intervention {
                key_bias: bias(all(Group::Future), &[0.25], &[]),
                blocks: Some(vec![3]),
                steps: Some(vec![2, 0]),
                ..Intervention::default()
            },
        ];
        let changes = changes(&config, &interventions).unwrap();
        let alone = changes.bias(1, 3, 0).unwrap();
        assert_eq!(row(alone, 0, 0, 6), [0.0; 6]);
        assert_eq!(row(alone, 1, 0, 6), [0.0, 0.0, 2.0, 1.0, 0.0, 0.0]);
        let both = changes.bias(2, 3, 0).unwrap();
        assert_eq!(row(both, 0, 0, 6), [0.0, 0.25, 0.25, 0.25, 0.0, 0.0]);
        assert_eq!(row(both, 1, 0, 6), [0.0, 0.25, 2.25, 1.25, 0.0, 0.0]);
        assert!(changes.bias(0, 2, 0).is_none(), "none of the keys is read there");
        assert_eq!(changes.biases.len(), 2);
    }

    #[test]
    fn the_configs_own_bias_is_in_every_self_attention_block_and_under_all_others() {
        let config = HeadConfig {
            future_key_bias: Some(vec![0.5, -1.0, 2.0]),
            ..config()
        };
        let own = [0.0, 0.5, -1.0, 2.0, 0.0, 0.0];
        let plain = changes(&config, &[]).unwrap();
        for (step, block) in [(0, 1), (2, 3)] {
            let bias = plain.bias(step, block, 4).unwrap();
            assert_eq!(
                (row(bias, 0, 0, 6), row(bias, 1, 1, 6)),
                (own.to_vec(), own.to_vec())
            );
        }
        assert!(
            plain.bias(0, 0, 0).is_none(),
            "cross-attention has no future keys"
        );
        assert_eq!(plain.biases.len(), 1);

        let interventions = [Intervention {
            cut: vec![(some(Group::State, &[0]), some(Group::Future, &[1]))],
            key_bias: vec![(all(Group::Future), OwnedArray::new(vec![0.25], &[]))],
            steps: Some(vec![1]),
            ..Intervention::default()
        }];
        let both = changes(&config, &interventions).unwrap();
        assert_eq!(row(both.bias(0, 1, 0).unwrap(), 0, 0, 6), own);
        let bias = both.bias(1, 1, 0).unwrap();
        assert_eq!(row(bias, 0, 0, 6), [0.0, 0.75, CUT, 2.25, 0.0, 0.0]);
        assert_eq!(row(bias, 0, 1, 6), [0.0, 0.75, -0.75, 2.25, 0.0, 0.0]);

        let replaced = [Intervention {
            future_tokens: Some(OwnedArray::new(vec![0.0; 8], &[2, 4])),
            ..Intervention::default()
        }];
        let replaced = changes(&config, &replaced).unwrap();
        assert!(replaced.bias(0, 1, 0).is_none(), "it is the learned tokens' own");
    }

    #[test]
    fn what_adds_nothing_is_no_bias() {
        let config = config();
        let empty = [
            Intervention {
                future_tokens: Some(OwnedArray::new(vec![], &[0, 4])),
                ..Intervention::default()
            },
            patch(1, 3, some(Group::State, &[0]), &[1, 4]),
            Intervention {
                cut: vec![(all(Group::State), all(Group::Action))],
                blocks: Some(vec![]),
                ..Intervention::default()
            },
        ];
        let changes = changes(&config, &empty).unwrap();
        assert_eq!(
            (changes.extent.groups.future, changes.extent.groups.num_rows()),
            (0, 3)
        );
        assert!((0..4).all(|block| changes.bias(0, block, 0).is_none()));
    }

    #[test]
    fn patches_replace_rows_of_every_sample() {
        let config = config();
        let interventions = [
            patch(1, 2, some(Group::Action, &[1, 0]), &[2, 2, 4]),
            patch(1, 2, all(Group::State), &[1, 4]),
        ];
        let changes = changes(&config, &interventions).unwrap();
        let samples = 3;
        let mut x = vec![-1.0; 2 * samples * 6 * 4];
        changes.patch(0, 2, 0, samples, &mut x);
        changes.patch(1, 3, 0, samples, &mut x);
        assert!(x.iter().all(|&value| value == -1.0), "elsewhere");
        changes.patch(1, 2, 0, samples, &mut x);
        for (index, sequence) in x.chunks_exact(6 * 4).enumerate() {
            let first = (index / samples * 8) as f32;
            assert_eq!(sequence[..4], [0.0, 1.0, 2.0, 3.0]);
            assert!(sequence[4..16].iter().all(|&value| value == -1.0));
            assert_eq!(sequence[16..20], [4.0, 5.0, 6.0, 7.0].map(|value| first + value));
            assert_eq!(sequence[20..], [0.0, 1.0, 2.0, 3.0].map(|value| first + value));
        }
        let mut actions = vec![-1.0; 2 * samples * 2 * 4];
        changes.patch(1, 2, 4, samples, &mut actions);
        for (sequence, actions) in x.chunks_exact(6 * 4).zip(actions.chunks_exact(2 * 4)) {
            assert_eq!(actions, &sequence[16..], "the action rows alone");
        }
    }

    #[test]
    fn messages_name_what_was_given_and_expected() {
        let limited = |blocks: &[usize], steps: &[usize], heads: &[usize]| Intervention {
            blocks: Some(blocks.to_vec()),
            steps: Some(steps.to_vec()),
            heads: Some(heads.to_vec()),
            ..Intervention::default()
        };
        let cut = |reader, source| Intervention {
            cut: vec![(reader, source)],
            ..Intervention::default()
        };
        let bias = |values: &[f32], shape: &[usize]| Intervention {
            key_bias: vec![(all(Group::Future), OwnedArray::new(values.to_vec(), shape))],
            ..Intervention::default()
        };
        let tokens = |shape: &[usize]| Intervention {
            future_tokens: Some(OwnedArray::new(vec![0.0; shape.iter().product()], shape)),
            ..Intervention::default()
        };
        let state = || some(Group::State, &[0]);
        for (intervention, expected) in [
            (
                limited(&[0, 4], &[], &[]),
                "intervention: blocks: expected 0 to 3, got 4",
            ),
            (
                limited(&[], &[3], &[]),
                "intervention: steps: expected 0 to 2, got 3",
            ),
            (
                limited(&[], &[], &[2]),
                "intervention: heads: expected 0 to 1, got 2",
            ),
            (
                cut(state(), some(Group::Future, &[40])),
                "cut: future token 40, expected 0 to 2",
            ),
            (
                cut(some(Group::State, &[1]), state()),
                "cut: state token 1, expected 0 to 0",
            ),
            (
                cut(all(Group::Vl), state()),
                "cut: vl is read, it does not read; expected a reader among state, future, action",
            ),
            (
                bias(&[0.0; 2], &[2]),
                "key_bias: expected a number or (3,) for future, got (2,)",
            ),
            (
                bias(&[f32::NAN], &[]),
                "key_bias: expected numbers below infinity, got NaN",
            ),
            (
                tokens(&[2, 5]),
                "future_tokens: expected (tokens, width) with width 4, got (2, 5)",
            ),
            (
                patch(3, 0, state(), &[1, 4]),
                "patch: step: expected 0 to 2, got 3",
            ),
            (
                patch(0, 4, state(), &[1, 4]),
                "patch: block: expected 0 to 3, got 4",
            ),
            (
                patch(0, 1, state(), &[3, 1, 4]),
                "patch[(0, 1)]: expected (tokens, width) = (1, 4) or (batch, tokens, width) = (2, 1, 4) for state, got (3, 1, 4)",
            ),
            (
                patch(0, 1, all(Group::Vl), &[5, 4]),
                "patch: blocks change rows, not vl; expected state, future or action",
            ),
        ] {
            assert_eq!(message(intervention), expected);
        }
        let mut none_left = cut(state(), some(Group::Future, &[0]));
        none_left.future_tokens = tokens(&[0, 4]).future_tokens;
        assert_eq!(
            message(none_left),
            "cut: future token 0, expected none, since the group has no token"
        );
        let twice = [tokens(&[1, 4]), tokens(&[1, 4])];
        assert_eq!(
            changes(&config(), &twice).err().unwrap().to_string(),
            "future_tokens: expected at most one intervention that replaces them, got several"
        );
        let huge = [bias(&[f32::MAX], &[]), bias(&[f32::MAX], &[])];
        assert_eq!(
            changes(&config(), &huge).err().unwrap().to_string(),
            "key_bias: expected biases whose sum for a key is below infinity"
        );
        let mut many = tokens(&[20_000, 4]);
        many.cut.push((all(Group::State), all(Group::Future)));
        assert!(
            message(many)
                .contains("20003 rows and 20003 keys need 1600480036 bytes, expected at most 1073741824")
        );
    }
}
