//! Encoding prompts: views through the tower, then the rows of all prompts together through the language
//! model.

use std::sync::Arc;

use saccade_vla_kernels::{Epilogue, PackedKeyValues, Rows, RowsMut};

use super::features::{BackboneFeatures, BackboneRecord, EncodedPrompt, View};
use super::inputs::{BackboneInputs, Checked, Prompt, ViewPixels};
use super::model::{Backbone, BackboneWorkspace};
use super::qwen3::{Additions, NewRows};
use super::reuse::{longest_prefix, same_view};
use super::token_positions::{rope_pairs, token_positions};
use crate::alloc::{collected, filled, product, reserve, reserved};
use crate::array::{Array, OwnedArray};
use crate::engine::Kernels;
use crate::error::{Error, Result, ensure};
use crate::nn::kv_cache;
use crate::nn::rope::Rope;

/// Rows of the language model that are computed together. More read the weights less often; fewer keep the
/// activations small: at 2048 rows the weights are read once for 7 prompts of one view, and the largest
/// buffer is 50 MB at the released size.
const LANGUAGE_ROWS: usize = 2048;

/// The parts of a call to record.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct BackboneKeep {
    /// The rows after each layer of the language model.
    pub hidden: bool,
    /// The patches after the vision tower.
    pub vision: bool,
    /// The tokens of each view.
    pub image_tokens: bool,
}

/// A prompt on its way.
struct Sequence<'a> {
    prompt: &'a Prompt<'a>,
    views: Vec<Arc<View>>,
    /// Where it begins in the same way, and the number of tokens that are the same.
    known: Option<(&'a Arc<EncodedPrompt>, usize)>,
    positions: Vec<[usize; 3]>,
    /// Of which inputs, and which of their prompts.
    place: [usize; 2],
}

impl Sequence<'_> {
    /// The first row that is computed.
    fn first(&self) -> usize {
        self.known.map_or(0, |(_, len)| len)
    }

    fn num_rows(&self) -> usize {
        self.prompt.ids.len() - self.first()
    }
}

impl Backbone {
    /// Encodes prompts. Each has the bits that it has alone: several inputs share the reading of the weights,
    /// and their prompts may be of different lengths.
    ///
    /// From `previous`, features that this backbone made, views with the same pixels are taken, and the rows,
    /// keys and values of tokens at the beginning of a prompt that are the same. The result has the same bits
    /// without. Where something is recorded, all of it is computed.
    ///
    /// ```
    /// # use saccade_vla::{Array, Backbone, BackboneInputs, BackboneKeep, BackboneLoadOptions};
    /// # let backbone = Backbone::load("examples/tiny".as_ref(), &BackboneLoadOptions::default())?;
    /// let pixels = vec![0.0; 3 * 56 * 56];
    /// let pixels = Array::new(&pixels, &[1, 3, 56, 56])?;
    /// // Two words and the 16 tokens of the image. A later prompt begins in the same way.
    /// let image = [backbone.config().image_token_id as i64; 16];
    /// let ids: Vec<i64> = [5, 6].into_iter().chain(image).collect();
    /// let inputs = BackboneInputs::new(vec![pixels], Array::new(&ids, &[1, 18])?);
    /// let first = backbone.encode(&[inputs], &[], BackboneKeep::default())?;
    /// assert_eq!((first[0].num_tokens(), first[0].feature_dim()), (18, 32));
    ///
    /// let longer: Vec<i64> = ids.iter().copied().chain([7]).collect();
    /// let inputs = BackboneInputs::new(vec![pixels], Array::new(&longer, &[1, 19])?);
    /// let second = backbone.encode(&[inputs], &[&first[0]], BackboneKeep::default())?;
    /// assert_eq!(first[0].features(0), &second[0].features(0)[..18 * 32]);
    /// # Ok::<(), saccade_vla::Error>(())
    /// ```
    ///
    /// # Errors
    /// [`Error::Shape`] and [`Error::Input`] for inputs that do not fit, features of another backbone, and a
    /// result that is not finite; [`Error::Memory`].
    pub fn encode(
        &self,
        inputs: &[BackboneInputs<'_>],
        previous: &[&BackboneFeatures],
        keep: BackboneKeep,
    ) -> Result<Vec<BackboneFeatures>> {
        ensure!(
            !previous.iter().any(|features| features.backbone != self.id), Input, "previous";
            expected "features that this backbone made"; got "those of another backbone"
        );
        let previous = if keep == BackboneKeep::default() {
            previous
        } else {
            &[]
        };
        let checked: Vec<Checked<'_>> = inputs
            .iter()
            .map(|inputs| Checked::new(&self.config, inputs))
            .collect::<Result<_>>()?;
        self.workspaces.with(Default::default, |workspace| {
            let views = self.views(&checked, previous, keep.vision, workspace)?;
            let sequences = self.sequences(&checked, views, previous)?;
            let mut results = checked
                .iter()
                .map(|inputs| self.empty(inputs, keep))
                .collect::<Result<Vec<_>>>()?;
            let mut left = &sequences[..];
            while !left.is_empty() {
                let mut rows = 0;
                let together = left.iter().take_while(|sequence| {
                    rows += sequence.num_rows();
                    rows <= LANGUAGE_ROWS
                });
                let (group, rest) = left.split_at(together.count().max(1));
                left = rest;
                let encoded = self.encode_group(group, &mut results, workspace)?;
                for (sequence, encoded) in group.iter().zip(encoded) {
                    let [input, _] = sequence.place;
                    let result = &mut results[input];
                    record_views(&encoded, keep, self.config.vision.width, &mut result.recorded)?;
                    result.prompts.push(encoded);
                }
            }
            Ok(results)
        })
    }

    /// The views of each of the inputs: taken from `previous`, or encoded, those of all inputs together.
    fn views(
        &self,
        inputs: &[Checked<'_>],
        previous: &[&BackboneFeatures],
        record: bool,
        workspace: &mut BackboneWorkspace,
    ) -> Result<Vec<Vec<Arc<View>>>> {
        let mut found: Vec<Vec<Option<Arc<View>>>> = Vec::new();
        let mut new: Vec<ViewPixels<'_>> = Vec::new();
        let count = inputs.iter().map(|inputs| inputs.views.len()).sum();
        reserve("views", &mut new, count)?;
        let mut number = 0;
        for inputs in inputs {
            let mut of_inputs = reserved("views", inputs.views.len())?;
            for prompt in &inputs.prompts {
                for (place, view) in inputs.views[prompt.views.clone()].iter().enumerate() {
                    let same = same_view(previous, (number, place), view);
                    if same.is_none() {
                        new.push(*view);
                    }
                    of_inputs.push(same);
                }
                number += 1;
            }
            found.push(of_inputs);
        }
        let kernels = &mut Kernels::new(self.engine, &mut workspace.linear);
        let tower = &self.layers.vision;
        let encoded = tower.encode(kernels, &self.config, &new, record, &mut workspace.vision)?;
        let mut encoded = encoded.into_iter();
        let views = found.into_iter().map(|of_inputs| {
            let one = |view: Option<Arc<View>>| view.or_else(|| encoded.next());
            of_inputs.into_iter().filter_map(one).collect()
        });
        Ok(views.collect())
    }

    /// The prompts of all inputs, with what is known of them.
    fn sequences<'a>(
        &self,
        inputs: &'a [Checked<'a>],
        views: Vec<Vec<Arc<View>>>,
        previous: &[&'a BackboneFeatures],
    ) -> Result<Vec<Sequence<'a>>> {
        let mut sequences = Vec::new();
        let count = inputs.iter().map(|inputs| inputs.prompts.len()).sum();
        reserve("prompts", &mut sequences, count)?;
        for (index, (inputs, views)) in inputs.iter().zip(views).enumerate() {
            for (row, prompt) in inputs.prompts.iter().enumerate() {
                let views = views[prompt.views.clone()].to_vec();
                let last = prompt.ids.len() - 1;
                let known = longest_prefix(previous, prompt, &views);
                sequences.push(Sequence {
                    positions: token_positions(&self.config, prompt, &inputs.views)?,
                    known: known.map(|(held, len)| match len == held.ids.len() && len > last {
                        true => (held, len),
                        // The last row is computed, so that there is one to compute.
                        false => (held, len.min(last)),
                    }),
                    prompt,
                    views,
                    place: [index, row],
                });
            }
        }
        Ok(sequences)
    }

    /// Empty features for inputs, with memory for what is recorded.
    fn empty(&self, inputs: &Checked<'_>, keep: BackboneKeep) -> Result<BackboneFeatures> {
        let mut recorded = BackboneRecord::default();
        if keep.hidden {
            let shape = [
                inputs.prompts.len(),
                inputs.num_tokens,
                self.config.language.width,
            ];
            let len = product("record", &shape)?;
            for _ in 0..self.config.language.num_layers {
                recorded
                    .hidden
                    .push(OwnedArray::new(filled("record", len, 0.0)?, &shape)?);
            }
        }
        Ok(BackboneFeatures {
            backbone: self.id,
            prompts: reserved("prompts", inputs.prompts.len())?,
            num_tokens: inputs.num_tokens,
            feature_dim: self.config.feature_dim(),
            recorded,
        })
    }

    /// Encodes some prompts together.
    fn encode_group(
        &self,
        group: &[Sequence<'_>],
        results: &mut [BackboneFeatures],
        workspace: &mut BackboneWorkspace,
    ) -> Result<Vec<Arc<EncodedPrompt>>> {
        let rows: usize = group.iter().map(Sequence::num_rows).sum();
        let mut caches: Vec<Vec<PackedKeyValues>> = Vec::new();
        let mut positions = reserved("positions", rows)?;
        for sequence in group {
            positions.extend_from_slice(&sequence.positions[sequence.first()..]);
            caches.push(match sequence.num_rows() {
                0 => Vec::new(),
                _ => self.caches(sequence)?,
            });
        }
        let BackboneWorkspace { language, linear, .. } = workspace;
        let deepstack = self.embed(group, language.x.rows(rows, self.config.language.width)?)?;
        let rope = Rope::new(
            self.config.language.head_dim,
            &rope_pairs(&self.config),
            &positions,
        )?;
        if rows > 0 {
            let mut prompts: Vec<NewRows<'_>> = group
                .iter()
                .zip(&mut caches)
                .filter(|(sequence, _)| sequence.num_rows() > 0)
                .map(|(sequence, caches)| NewRows {
                    attended: &sequence.prompt.attended[sequence.first()..],
                    caches,
                })
                .collect();
            let kernels = &mut Kernels::new(self.engine, linear);
            let record = |layer: usize, x: Rows<'_>| record_hidden(group, layer, x, results);
            let model = &self.layers.language;
            model.run(kernels, &rope, &mut prompts, &deepstack, language, record)?;
        }
        self.collect(group, caches, workspace)
    }

    /// The KV cache of each layer: of the tokens that are known, with capacity for all.
    fn caches(&self, sequence: &Sequence<'_>) -> Result<Vec<PackedKeyValues>> {
        let language = &self.config.language;
        let count = |attended: &[bool]| attended.iter().filter(|attended| **attended).count();
        let capacity = count(&sequence.prompt.attended);
        let known = count(&sequence.prompt.attended[..sequence.first()]);
        (0..language.num_layers)
            .map(|layer| match sequence.known {
                Some((held, _)) => kv_cache::first(&held.keys_values[layer], known, capacity),
                None => {
                    let heads = [language.num_kv_heads, language.head_dim];
                    kv_cache::with_capacity(self.engine, heads, capacity)
                }
            })
            .collect()
    }

    /// Writes the tokens of words and views to the rows of `x`; returns the rows that are added to them after
    /// the first layers.
    fn embed<'a>(&self, group: &'a [Sequence<'_>], mut x: RowsMut<'_>) -> Result<Vec<Additions<'a>>> {
        let width = x.num_columns();
        let mut deepstack: Vec<Additions<'a>> = vec![Vec::new(); self.config.vision.deepstack.len()];
        let count = group
            .iter()
            .map(|sequence| sequence.prompt.image_tokens.len())
            .sum();
        for additions in &mut deepstack {
            reserve("activations", additions, count)?;
        }
        let mut first_row = 0;
        for sequence in group {
            let first = sequence.first();
            for (place, &id) in sequence.prompt.ids.iter().enumerate().skip(first) {
                let row = x.row_mut(first_row + place - first);
                self.layers.embedding.look_up(id as usize, row);
            }
            let mut places = sequence.prompt.image_tokens.iter();
            for view in &sequence.views {
                let tokens = Rows::new(&view.tokens, width);
                for (token, &place) in places.by_ref().take(view.num_tokens).enumerate() {
                    if place < first {
                        continue;
                    }
                    let row = first_row + place - first;
                    x.row_mut(row).copy_from_slice(tokens.row(token));
                    for (additions, rows) in deepstack.iter_mut().zip(&view.deepstack) {
                        additions.push((row, Rows::new(rows, width).row(token)));
                    }
                }
            }
            first_row += sequence.num_rows();
        }
        Ok(deepstack)
    }

    /// The features of rows that have passed the language model, and all that is held of their prompts.
    fn collect(
        &self,
        group: &[Sequence<'_>],
        caches: Vec<Vec<PackedKeyValues>>,
        workspace: &mut BackboneWorkspace,
    ) -> Result<Vec<Arc<EncodedPrompt>>> {
        let language = &mut workspace.language;
        let (model, x) = (&self.layers.language, language.x.as_rows());
        let mut features = model.finish(self.engine, x, &mut language.y)?;
        if let Some(layer) = &self.layers.projection {
            let out = workspace
                .projected
                .rows(features.num_rows(), layer.out_features())?;
            let kernels = &mut Kernels::new(self.engine, &mut workspace.linear);
            layer.apply(kernels, features, Epilogue::Store, out)?;
            features = workspace.projected.as_rows();
        }
        let mut first = 0;
        let mut encoded = Vec::new();
        for (sequence, caches) in group.iter().zip(caches) {
            let rows = first..first + sequence.num_rows();
            first = rows.end;
            encoded.push(match sequence.known {
                Some((held, _)) if rows.is_empty() => Arc::clone(held),
                _ => Arc::new(encoded_prompt(sequence, features.rows(rows), caches)?),
            });
        }
        Ok(encoded)
    }
}

/// A prompt whose new features are the rows of `new`.
fn encoded_prompt(
    sequence: &Sequence<'_>,
    new: Rows<'_>,
    keys_values: Vec<PackedKeyValues>,
) -> Result<EncodedPrompt> {
    let prompt = sequence.prompt;
    let (ids, dim) = (prompt.ids, new.num_columns());
    let mut features = reserved("backbone_features", ids.len() * dim)?;
    if let Some((held, len)) = sequence.known {
        features.extend_from_slice(&held.features[..len * dim]);
    }
    new.iter().for_each(|row| features.extend_from_slice(row));
    Array::new(&features, &[ids.len(), dim])?.check_result("backbone_features")?;
    Ok(EncodedPrompt {
        ids: collected("input_ids", ids.len(), ids.iter().copied())?,
        attended: collected("attention_mask", ids.len(), prompt.attended.iter().copied())?,
        views: sequence.views.clone(),
        image_tokens: collected(
            "image_mask",
            prompt.image_tokens.len(),
            prompt.image_tokens.iter().copied(),
        )?,
        features,
        keys_values,
    })
}

/// Records the rows of a group after a layer, where that is asked for.
fn record_hidden(group: &[Sequence<'_>], layer: usize, x: Rows<'_>, results: &mut [BackboneFeatures]) {
    let mut first = 0;
    for sequence in group {
        let [input, prompt] = sequence.place;
        let rows = first..first + sequence.num_rows();
        first = rows.end;
        if let Some(recorded) = results[input].recorded.hidden.get_mut(layer) {
            let tokens = prompt * rows.len()..(prompt + 1) * rows.len();
            let recorded = RowsMut::new(recorded.data_mut(), x.num_columns());
            recorded.rows(tokens).copy_from(x.rows(rows));
        }
    }
}

/// Keeps the patches and tokens of a prompt's views, where that is asked for.
fn record_views(
    prompt: &EncodedPrompt,
    keep: BackboneKeep,
    vision_width: usize,
    recorded: &mut BackboneRecord,
) -> Result<()> {
    let copies = |rows: &dyn Fn(&View) -> (&[f32], usize)| {
        let copy = |view: &Arc<View>| {
            let (rows, count) = rows(view);
            let data = collected("record", rows.len(), rows.iter().copied())?;
            OwnedArray::new(data, &[count, rows.len() / count])
        };
        prompt.views.iter().map(copy).collect::<Result<Vec<_>>>()
    };
    if keep.vision {
        let of_prompt = copies(&|view| (&view.patches, view.patches.len() / vision_width))?;
        recorded.vision.push(of_prompt);
    }
    if keep.image_tokens {
        recorded
            .image_tokens
            .push(copies(&|view| (&view.tokens, view.num_tokens))?);
    }
    Ok(())
}
