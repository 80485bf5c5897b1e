//! Encoding observations: checks of the features, what each kind of block sees of them, and the context.

use saccade_vla_kernels::Rows;

use super::action_head::ActionHead;
use super::context::{Context, Seen};
use super::vl_encoder::VlTokens;
use crate::alloc::{collected, reserved};
use crate::array::Array;
use crate::config::Reads;
use crate::engine::Kernels;
use crate::error::{Error, Result, bail, ensure, show_shape};
use crate::inspect::trace::Keep;

/// The observation given to [`ActionHead::encode`].
#[derive(Clone, Copy, Debug)]
pub struct Features<'a> {
    /// `(batch, num_vl_tokens, context_dim)`.
    pub backbone_features: Array<'a>,
    /// `(batch, num_vl_tokens)`, true = attended; none if all are. A head that ignores padding takes an
    /// all-true mask only.
    pub attention_mask: Option<Array<'a, bool>>,
    /// `(batch, num_vl_tokens)`, true = image token. A head whose blocks alternate between text and images
    /// needs it; every head keeps it, for maps.
    pub image_mask: Option<Array<'a, bool>>,
    /// `(batch, num_vl_tokens)`, true = as if the position were not there.
    pub drop_vl: Option<Array<'a, bool>>,
    /// The parts of the VL self-attention to record.
    pub record: Keep,
}

impl<'a> Features<'a> {
    /// Features without masks.
    #[must_use]
    pub fn new(backbone_features: Array<'a>) -> Self {
        Self {
            backbone_features,
            attention_mask: None,
            image_mask: None,
            drop_vl: None,
            record: Keep::default(),
        }
    }

    fn is_image(&self, token: usize) -> bool {
        self.image_mask.is_some_and(|mask| mask.data()[token])
    }

    /// True for a position that is attended and not dropped.
    fn is_left(&self, token: usize) -> bool {
        self.attention_mask.is_none_or(|mask| mask.data()[token])
            && !self.drop_vl.is_some_and(|mask| mask.data()[token])
    }
}

impl ActionHead {
    /// Encodes observations: `vlln`, the VL self-attention, and the keys and values of every cross-attention
    /// block.
    ///
    /// ```
    /// # use saccade_vla::{ActionHead, Array, Features, LoadOptions};
    /// # let head = ActionHead::load("examples/tiny".as_ref(), &LoadOptions::default())?;
    /// let shape = [2, 20, head.config().context_dim]; // two observations of 20 tokens
    /// let tokens = vec![0.1; shape.iter().product()];
    /// let padding: Vec<bool> = (0..40).map(|token| token < 5).collect();
    /// let features = Features {
    ///     drop_vl: Some(Array::new(&padding, &shape[..2])?),
    ///     ..Features::new(Array::new(&tokens, &shape)?)
    /// };
    /// let context = head.encode(&features)?;
    /// assert_eq!((context.batch(), context.num_vl_tokens()), (2, 20));
    /// # Ok::<(), saccade_vla::Error>(())
    /// ```
    ///
    /// # Errors
    /// [`Error::Shape`] and [`Error::Input`] for features or masks that do not fit, [`Error::Input`] also for
    /// a result that is not finite; [`Error::Memory`].
    pub fn encode(&self, features: &Features<'_>) -> Result<Context> {
        let (batch, num_vl_tokens) = self.check_features(features)?;
        let removed = match features.drop_vl.filter(|mask| mask.data().contains(&true)) {
            Some(mask) => Some(removed_keys(mask.data())?),
            None => None,
        };
        let seen = self.seen(features, batch, num_vl_tokens)?;
        let image_mask = match features.image_mask {
            Some(mask) => Some(collected(
                "image_mask",
                mask.data().len(),
                mask.data().iter().copied(),
            )?),
            None => None,
        };
        let vl = &self.layers.vl;
        let mut recorded = vl.recorded(features.record, batch, num_vl_tokens)?;
        let tokens = VlTokens {
            features: Rows::new(features.backbone_features.data(), self.config.context_dim),
            batch,
            num_vl_tokens,
            removed: removed.as_deref(),
            seen: &seen,
            cross: &self.layers.dit.cross_attentions(),
        };
        let (vl_embs, keys_values) = self.with_workspace(|workspace| {
            let kernels = &mut Kernels::new(self.engine, &mut workspace.linear);
            vl.encode(kernels, &tokens, &mut recorded, &mut workspace.vl)
        })?;
        let shape = [batch, num_vl_tokens, self.config.context_dim];
        Array::new(&vl_embs, &shape)?.check_result("vl_embs")?;
        Ok(Context {
            head: self.id,
            batch,
            num_vl_tokens,
            vl_embs,
            keys_values,
            seen,
            image_mask,
            recorded,
        })
    }

    fn check_features(&self, features: &Features<'_>) -> Result<(usize, usize)> {
        let array = features.backbone_features;
        let context_dim = self.config.context_dim;
        let (batch, num_vl_tokens) = match *array.shape() {
            [batch, tokens, width] if width == context_dim && batch > 0 && tokens > 0 => (batch, tokens),
            _ => {
                bail!(
                    Shape, "backbone_features";
                    expected "(batch, num_vl_tokens, {context_dim}) with at least one observation and token";
                    got "{}", show_shape(array.shape())
                );
            }
        };
        array.check_finite("backbone_features")?;
        let masks = [
            ("attention_mask", features.attention_mask),
            ("image_mask", features.image_mask),
            ("drop_vl", features.drop_vl),
        ];
        for (name, mask) in masks {
            if let Some(mask) = mask {
                mask.check_shape(name, "(batch, num_vl_tokens)", &[batch, num_vl_tokens])?;
            }
        }
        let ignores_masks = self.config.attend_text_every_n_blocks == 0;
        ensure!(
            !(ignores_masks && features.attention_mask.is_some_and(|mask| mask.data().contains(&false))),
            Input, "attention_mask";
            "expected no false entry, since this head (GR00T {}) ignores padding masks: leave the mask out to attend to \
             padding as the released code does, or give its complement as drop_vl to remove these positions",
             self.config.version
        );
        ensure!(
            ignores_masks || features.image_mask.is_some(), Input, "image_mask";
            expected "(batch, num_vl_tokens) booleans, true for image tokens, since this head's blocks alternate between \
             text and images";
            got "none"
        );
        Ok((batch, num_vl_tokens))
    }

    /// The tokens that each kind of the head's blocks sees.
    ///
    /// # Errors
    /// [`Error::Input`] if a kind that alternates with another sees nothing of an observation: its softmax is
    /// not defined.
    fn seen(&self, features: &Features<'_>, batch: usize, num_vl_tokens: usize) -> Result<Vec<Seen>> {
        let all_are_left = (0..batch * num_vl_tokens).all(|token| features.is_left(token));
        let mut seen = Vec::new();
        for reads in self.kinds() {
            let is_seen = |token: usize| {
                features.is_left(token)
                    && match reads {
                        Reads::All => true,
                        Reads::Text => !features.is_image(token),
                        Reads::Images => features.is_image(token),
                    }
            };
            let positions = match reads {
                Reads::All if all_are_left => None,
                _ => Some(positions(batch, num_vl_tokens, is_seen)?),
            };
            let nothing = positions.iter().flatten().position(Vec::is_empty);
            if let Some(element) = nothing.filter(|_| reads != Reads::All) {
                let (kind, what) = match reads {
                    Reads::Images => ("image", "true"),
                    _ => ("text", "false"),
                };
                bail!(
                    Input, "image_mask";
                    expected "at least one {kind} token ({what}) in each observation that is attended and not dropped, since some \
                     of this head's blocks see nothing else";
                    got "none in observation {element}"
                );
            }
            seen.push(Seen { reads, positions });
        }
        Ok(seen)
    }
}

/// By observation, the positions whose tokens are seen.
fn positions(batch: usize, num_vl_tokens: usize, is_seen: impl Fn(usize) -> bool) -> Result<Vec<Vec<usize>>> {
    let mut all = reserved("masks", batch)?;
    for element in 0..batch {
        let tokens = element * num_vl_tokens..(element + 1) * num_vl_tokens;
        let count = tokens.clone().filter(|&token| is_seen(token)).count();
        let seen = tokens
            .clone()
            .filter(|&token| is_seen(token))
            .map(|token| token - tokens.start);
        all.push(collected("masks", count, seen)?);
    }
    Ok(all)
}

/// The logit biases, 0 or minus infinity, that take these positions away.
fn removed_keys(removed: &[bool]) -> Result<Vec<f32>> {
    let biases = removed
        .iter()
        .map(|&removed| if removed { f32::NEG_INFINITY } else { 0.0 });
    collected("drop_vl", removed.len(), biases)
}
