//! Features of prompts as the input of an action head.

use std::borrow::Cow;

use super::features::BackboneFeatures;
use crate::alloc::{filled, product, reserved};
use crate::array::{Array, OwnedArray};
use crate::error::{Error, Result, bail};
use crate::head::encode::Features;

/// Features of prompts of any lengths as one batch for an action head.
///
/// The features of a single prompt are borrowed. Those of several are copied, the shorter ones padded with zeros on
/// the right; the head drops that padding, so that each prompt has the bits that it has alone.
pub struct FeatureBatch<'a> {
    features: Cow<'a, [f32]>,
    shape: [usize; 3],
    attention_mask: OwnedArray<bool>,
    image_mask: OwnedArray<bool>,
    /// The padding, if there is any.
    drop_vl: Option<OwnedArray<bool>>,
}

impl<'a> FeatureBatch<'a> {
    /// The prompts of `all`, in their order.
    ///
    /// # Errors
    /// [`Error::Shape`] for features of different widths; [`Error::Memory`].
    pub fn new(all: &[&'a BackboneFeatures]) -> Result<Self> {
        const WHAT: &str = "backbone_features";
        let width = all.first().map_or(0, |features| features.feature_dim());
        if let Some(other) = all.iter().find(|features| features.feature_dim() != width) {
            bail!(Shape, WHAT; expected "features of one width"; got "{width} and {}", other.feature_dim());
        }
        let count = all.iter().map(|features| features.batch()).sum();
        let longest = all
            .iter()
            .map(|features| features.num_tokens())
            .max()
            .unwrap_or(0);
        let mask = |name, value| {
            let shape = [count, longest];
            OwnedArray::new(filled(name, product(name, &shape)?, value)?, &shape)
        };
        let is_ragged = all.iter().any(|features| features.num_tokens() < longest);
        let mut attention_mask = mask("attention_mask", true)?;
        let mut image_mask = mask("image_mask", false)?;
        let mut drop_vl = is_ragged.then(|| mask("drop_vl", true)).transpose()?;
        let prompts = || {
            all.iter()
                .flat_map(|features| (0..features.batch()).map(move |prompt| (*features, prompt)))
        };
        for (row, (features, prompt)) in prompts().enumerate() {
            let first = row * longest;
            let own = first..first + features.num_tokens();
            if let Some(dropped) = &mut drop_vl {
                dropped.data_mut()[own.clone()].fill(false);
            }
            attention_mask.data_mut()[own].copy_from_slice(features.attention_mask(prompt));
            for &place in features.views(prompt).flatten() {
                image_mask.data_mut()[first + place] = true;
            }
        }
        let shape = [count, longest, width];
        let features = match *all {
            [one] if count == 1 => Cow::Borrowed(one.features(0)),
            _ => {
                let mut joined = reserved(WHAT, product(WHAT, &shape)?)?;
                for (row, (features, prompt)) in prompts().enumerate() {
                    joined.extend_from_slice(features.features(prompt));
                    joined.resize((row + 1) * longest * width, 0.0);
                }
                Cow::Owned(joined)
            }
        };
        Ok(Self {
            features,
            shape,
            attention_mask,
            image_mask,
            drop_vl,
        })
    }

    /// The input of [`ActionHead::encode`](crate::ActionHead::encode), which does not check again that the features
    /// are finite, since the backbone did.
    #[must_use]
    pub fn as_features(&self) -> Features<'_> {
        Features {
            attention_mask: Some(self.attention_mask.view()),
            image_mask: Some(self.image_mask.view()),
            drop_vl: self.drop_vl.as_ref().map(OwnedArray::view),
            ..Features::new(Array::finite(&self.features, &self.shape))
        }
    }
}
