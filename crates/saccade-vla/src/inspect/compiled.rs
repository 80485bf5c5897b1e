//! What interventions mean at one step, in one block: biases of logits, and rows that are replaced.

use std::collections::BTreeMap;
use std::collections::btree_map::Entry;

use saccade_vla_kernels::{LogitBias, RowsMut};

use super::call_sizes::CallSizes;
use super::check::{check, check_not_empty, is_read};
use super::groups::{Group, Groups, check_indices};
use super::intervention::{Intervention, Patch};
use crate::alloc::{filled, product, reserve};
use crate::array::first_not_bias;
use crate::error::{Error, Result, bail, ensure, problem, show_shape};

/// All interventions of one call, in the form in which blocks use them.
pub(crate) struct CompiledInterventions<'a> {
    pub sizes: CallSizes<'a>,
    /// Those of one kind of block in which the same interventions act.
    biases: Vec<DenseBias>,
    /// Which of the biases acts, by step and block; empty if none ever does.
    acting: Vec<Option<usize>>,
    patches: Vec<PatchedRows<'a>>,
}

/// What is added to the logits of one kind of block, `(heads, rows, keys)`; a single head if it is the same for all of them.
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

impl<'a> CompiledInterventions<'a> {
    /// Checks the interventions and works out where each acts. With none of them nothing is allocated.
    ///
    /// # Errors
    /// [`Error::Shape`] and [`Error::Input`] for what does not fit the call.
    pub(crate) fn new(interventions: &'a [Intervention], sizes: CallSizes<'a>) -> Result<Self> {
        let mut compiled = Self {
            sizes,
            biases: Vec::new(),
            acting: Vec::new(),
            patches: Vec::new(),
        };
        for intervention in interventions {
            check(intervention, &sizes)?;
            for patch in &intervention.patch {
                compiled.patches.push(PatchedRows::new(patch, &sizes)?);
            }
        }
        let adds = |one: &Intervention| !one.cut.is_empty() || !one.key_bias.is_empty();
        if sizes.future_key_bias.is_some() || interventions.iter().any(adds) {
            compiled.find_biases(interventions)?;
        }
        Ok(compiled)
    }

    /// That no row is patched at a step at which it does not run: at evaluations of the velocity that `refresh` does not divide only
    /// action rows do. A step has `in_step` evaluations.
    ///
    /// # Errors
    /// [`Error::Input`] for such a patch.
    pub(crate) fn check_refresh(&self, refresh: usize, in_step: usize) -> Result<()> {
        let actions = self.sizes.groups.range(Group::Action).start;
        let stays = |patch: &&PatchedRows<'_>| {
            let mut evaluations = patch.step * in_step..(patch.step + 1) * in_step;
            patch.rows.iter().any(|row| *row < actions)
                && evaluations.any(|evaluation| !evaluation.is_multiple_of(refresh))
        };
        match self.patches.iter().find(stays) {
            None => Ok(()),
            Some(PatchedRows { step, block, .. }) => Err(Error::Input(problem!(
                format_args!("patch[({step}, {block})]");
                "expected action tokens, since with future_refresh {refresh} the rows of state and future tokens \
                 do not always run at step {step}"
            ))),
        }
    }

    /// Blocks of one kind in which the same interventions act share a bias.
    fn find_biases(&mut self, interventions: &[Intervention]) -> Result<()> {
        let mut known: BTreeMap<(bool, Vec<usize>), usize> = BTreeMap::new();
        let config = self.sizes.config;
        let count = product("intervention", &[self.sizes.num_steps, config.num_layers])?;
        reserve("intervention", &mut self.acting, count)?;
        for step in 0..self.sizes.num_steps {
            for block in 0..config.num_layers {
                let is_cross = config.is_cross(block);
                let acting: Vec<usize> = (0..interventions.len())
                    .filter(|&index| acts(&interventions[index], step, block, is_cross))
                    .collect();
                let has_own = !is_cross && self.sizes.future_key_bias.is_some();
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
        let CallSizes { groups, config, .. } = self.sizes;
        let rows = groups.num_rows();
        let keys = if is_cross { groups.vl } else { rows };
        let everywhere = acting.iter().all(|one| one.heads.is_none());
        let heads = if everywhere { 1 } else { config.num_heads };
        let held: usize = self.biases.iter().map(|bias| bias.values.len()).sum();
        let bytes = 4 * (held as u128 + heads as u128 * rows as u128 * keys as u128);
        ensure!(
            bytes <= MAX_BIAS_BYTES, Input, "intervention";
            "cuts and biases over {heads} heads, {rows} rows and {keys} keys need {bytes} bytes, expected at most \
             {MAX_BIAS_BYTES}; give fewer of them heads, blocks or steps of their own"
        );
        let mut bias = DenseBias {
            values: filled("intervention", heads * rows * keys, 0.0)?,
            heads,
            rows,
            keys,
        };
        if let Some(own) = self.sizes.future_key_bias.filter(|_| !is_cross) {
            for row in bias.values.chunks_exact_mut(keys) {
                row[groups.range(Group::Future)].copy_from_slice(own);
            }
        }
        for intervention in acting {
            bias.add(intervention, &groups, is_cross);
        }
        // Each is below infinity; a sum of several may still reach it.
        ensure!(
            first_not_bias(&bias.values).is_none(), Input, "key_bias";
            "expected biases whose sum for a key is below infinity"
        );
        Ok(bias)
    }

    /// What is added to the logits of `block` at `step`, for the rows from `first_row` on.
    pub(crate) fn bias(&self, step: usize, block: usize, first_row: usize) -> Option<LogitBias<'_>> {
        let acting = self.acting.get(step * self.sizes.config.num_layers + block)?;
        let bias = &self.biases[(*acting)?];
        Some(LogitBias {
            values: &bias.values[first_row * bias.keys..],
            head_stride: if bias.heads == 1 { 0 } else { bias.rows * bias.keys },
            query_stride: bias.keys,
        })
    }

    /// Replaces rows after `block` at `step`. `x` has the rows from `first_row` on of each sequence, of which there are
    /// `samples` for each observation.
    pub(crate) fn patch(
        &self,
        step: usize,
        block: usize,
        first_row: usize,
        samples: usize,
        mut x: RowsMut<'_>,
    ) {
        let CallSizes { groups, config, .. } = self.sizes;
        let sequence_len = groups.num_rows() - first_row;
        let patches = self.patches.iter();
        for patch in patches.filter(|patch| (patch.step, patch.block) == (step, block)) {
            for sequence in 0..x.num_rows() / sequence_len {
                let values = &patch.values[sequence / samples * patch.element_stride..];
                for (row, value) in patch.rows.iter().zip(values.chunks_exact(config.width)) {
                    if let Some(row) = row.checked_sub(first_row) {
                        x.row_mut(sequence * sequence_len + row).copy_from_slice(value);
                    }
                }
            }
        }
    }
}

/// Whether an intervention adds to the logits of this block.
fn acts(intervention: &Intervention, step: usize, block: usize, is_cross: bool) -> bool {
    let limited_to =
        |chosen: &Option<Vec<usize>>, index| chosen.as_ref().is_none_or(|chosen| chosen.contains(&index));
    let sources = intervention.cut.iter().map(|(_, source)| source);
    let mut keys = sources.chain(intervention.key_bias.iter().map(|(tokens, _)| tokens));
    limited_to(&intervention.steps, step)
        && limited_to(&intervention.blocks, block)
        && keys.any(|tokens| is_read(tokens, is_cross))
}

impl DenseBias {
    /// Adds the cuts and biases of an intervention.
    fn add(&mut self, intervention: &Intervention, groups: &Groups, is_cross: bool) {
        let chosen = intervention.heads.as_ref();
        let is_chosen = |head: &usize| chosen.is_none_or(|heads| heads.contains(head));
        let heads: Vec<usize> = (0..self.heads).filter(is_chosen).collect();
        let everyone: Vec<usize> = (0..self.rows).collect();
        let mut add = |readers: &[usize], keys: &[usize], values: &dyn Fn(usize) -> f32| {
            for &head in &heads {
                for &reader in readers {
                    let row = &mut self.values[(head * self.rows + reader) * self.keys..][..self.keys];
                    for (index, &key) in keys.iter().enumerate() {
                        row[key] += values(index);
                    }
                }
            }
        };
        for (reader, source) in &intervention.cut {
            if is_read(source, is_cross) {
                add(&groups.positions(reader), &groups.positions(source), &|_| {
                    f32::NEG_INFINITY
                });
            }
        }
        for (tokens, bias) in &intervention.key_bias {
            if is_read(tokens, is_cross) {
                let of_key = |index: usize| match bias.data() {
                    [one] => *one,
                    several => several[index],
                };
                add(&everyone, &groups.positions(tokens), &of_key);
            }
        }
    }
}

impl<'a> PatchedRows<'a> {
    /// # Errors
    /// [`Error::Shape`] and [`Error::Input`] for a patch that does not fit the call.
    fn new(patch: &'a Patch, sizes: &CallSizes<'_>) -> Result<Self> {
        let CallSizes { config, groups, .. } = sizes;
        let width = config.width;
        check_indices("patch: step", &[patch.step], sizes.num_steps)?;
        check_indices("patch: block", &[patch.block], config.num_layers)?;
        ensure!(
            patch.tokens.group != Group::Vl, Input, "patch";
            "blocks change rows, not vl; expected state, future or action"
        );
        let name = format!("patch[({}, {})]", patch.step, patch.block);
        let count = groups.check(&name, &patch.tokens)?;
        check_not_empty(&name, &patch.tokens, count)?;
        let element_stride = match patch.rows.shape() {
            shape if shape == [count, width] => 0,
            shape if shape == [sizes.batch, count, width] => count * width,
            shape => {
                bail!(
                    Shape, name;
                    expected "(tokens, width) = {} or (batch, tokens, width) = {} for {}",
                    show_shape(&[count, width]), show_shape(&[sizes.batch, count, width]), patch.tokens.group.name();
                    got "{}", show_shape(shape)
                );
            }
        };
        Ok(Self {
            step: patch.step,
            block: patch.block,
            rows: groups.positions(&patch.tokens),
            values: patch.rows.view().check_finite(&name)?.data(),
            element_stride,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::HeadConfig;
    use crate::inspect::groups::Tokens;

    #[test]
    fn blocks_of_one_kind_share_a_bias() {
        let config = HeadConfig::from_json(include_str!("../../examples/tiny/config.json")).unwrap();
        let all = |group| Tokens { group, indices: None };
        let interventions = [Intervention {
            cut: vec![
                (all(Group::Action), all(Group::Future)),
                (all(Group::Future), all(Group::Vl)),
            ],
            ..Intervention::default()
        }];
        let learned = vec![0.0; config.num_future_tokens * config.width];
        let sizes = CallSizes::new(&config, &learned, &interventions, [1, 5], 3).unwrap();
        let compiled = CompiledInterventions::new(&interventions, sizes).unwrap();
        assert_eq!(compiled.biases.len(), 2, "at all steps");
    }
}
