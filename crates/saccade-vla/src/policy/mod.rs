//! A whole policy: camera frames and words in, a context out, and chunks of actions from it.

mod load;

use std::sync::Arc;

use crate::array::{Array, ArrayMut};
use crate::backbone::{Backbone, BackboneFeatures, BackboneInputs, BackboneKeep, FeatureBatch};
use crate::error::{Error, Result, ensure};
use crate::head::action_head::ActionHead;
use crate::head::context::Context;
use crate::head::sample::Sampling;
use crate::processor::{Observation, Prepared, Processor};

pub use load::PolicyLoadOptions;

/// The three models of a policy: the processor of its frames and words, its backbone and its action head.
///
/// The state and the actions of [`sample`](Self::sample) are the head's: normalised, and padded with zeros to the
/// widths of its config. Converting them from and to a robot's units takes the robot's statistics, which the Python
/// package reads (`saccade.Normalizer`).
///
/// Immutable; serves any number of threads at once. A clone shares the models.
///
/// ```no_run
/// use saccade_vla::{Array, Frame, Observation, Policy, PolicyLoadOptions};
/// let policy = Policy::load("checkpoint".as_ref(), &PolicyLoadOptions::default())?;
/// let pixels = vec![0; 480 * 640 * 3];
/// let frame = Frame::U8(Array::new(&pixels, &[480, 640, 3])?);
/// let views = vec![(Some("front"), frame)];
/// let seen = [Observation { views, instruction: Some("open the drawer"), ..Observation::default() }];
/// let context = policy.encode(&seen, None)?;
/// let next = policy.encode(&seen, Some(&context))?; // the same frame is not encoded again
/// assert_eq!(next.batch(), 1);
/// # Ok::<(), saccade_vla::Error>(())
/// ```
#[derive(Clone)]
pub struct Policy {
    /// The processor of frames and words.
    pub processor: Arc<Processor>,
    /// The vision-language backbone.
    pub backbone: Arc<Backbone>,
    /// The action head.
    pub head: Arc<ActionHead>,
}

/// Encoded observations of a policy. Immutable; serves any number of calls and threads.
#[derive(Clone)]
pub struct PolicyContext {
    /// The head's context: shorter observations padded, and the padding dropped.
    pub context: Arc<Context>,
    /// The backbone's features of each observation, that it was made from.
    pub features: Vec<Arc<BackboneFeatures>>,
}

impl PolicyContext {
    /// Number of observations.
    #[must_use]
    pub fn batch(&self) -> usize {
        self.context.batch()
    }

    /// Number of vision-language tokens of the longest observation.
    #[must_use]
    pub fn num_vl_tokens(&self) -> usize {
        self.context.num_vl_tokens()
    }
}

impl Policy {
    /// A policy of models that are loaded already.
    #[must_use]
    pub fn new(
        processor: impl Into<Arc<Processor>>,
        backbone: impl Into<Arc<Backbone>>,
        head: impl Into<Arc<ActionHead>>,
    ) -> Self {
        Self {
            processor: processor.into(),
            backbone: backbone.into(),
            head: head.into(),
        }
    }

    /// Encodes observations, which need not agree in their views or in the length of their prompts. Each has the
    /// bits that it has alone. Frames are prepared on the threads of the backbone.
    ///
    /// From `previous`, a context whose features this backbone made, the tokens of views with the same frames and
    /// the unchanged beginning of a prompt are taken. The bits are the same without it.
    ///
    /// # Errors
    /// [`Error::Input`] for no observations, and those of [`Processor::process`], [`Backbone::encode`] and
    /// [`ActionHead::encode`].
    pub fn encode(
        &self,
        observations: &[Observation<'_>],
        previous: Option<&PolicyContext>,
    ) -> Result<PolicyContext> {
        ensure!(!observations.is_empty(), Input, "observations"; expected "at least one"; got "none");
        let previous = previous.into_iter().flat_map(|previous| &previous.features);
        let previous: Vec<&BackboneFeatures> = previous.map(|features| &**features).collect();
        let features = {
            let prepared = self
                .processor
                .process_each(self.backbone.engine().threads, observations)?;
            let inputs: Vec<_> = prepared.iter().map(Prepared::as_inputs).collect();
            self.backbone
                .encode(&inputs, &previous, BackboneKeep::default())?
        };
        let context = {
            let features: Vec<&BackboneFeatures> = features.iter().collect();
            self.head.encode(&FeatureBatch::new(&features)?.as_features())?
        };
        Ok(PolicyContext {
            context: Arc::new(context),
            features: features.into_iter().map(Arc::new).collect(),
        })
    }

    /// Samples chunks of normalised actions, as [`ActionHead::sample`] does.
    ///
    /// For [`Guidance`](crate::Guidance) away from the same observations without their instructions, encode these
    /// with the first context as `previous`: the views and the common beginning of the prompt are taken from it.
    ///
    /// # Errors
    /// As [`ActionHead::sample`].
    pub fn sample(
        &self,
        context: &PolicyContext,
        state: Array<'_>,
        embodiment_id: Array<'_, i64>,
        noise: Array<'_>,
        sampling: &Sampling<'_>,
        out: ArrayMut<'_>,
    ) -> Result<()> {
        self.head
            .sample(&context.context, state, embodiment_id, noise, sampling, out)
    }
}

impl Prepared {
    /// The inputs of a backbone, without a copy.
    #[must_use]
    pub fn as_inputs(&self) -> BackboneInputs<'_> {
        let pixel_values = self.pixel_values.iter().map(|pixels| pixels.view()).collect();
        BackboneInputs {
            pixel_values,
            input_ids: self.input_ids.view(),
            attention_mask: Some(self.attention_mask.view()),
            image_grid_thw: self.image_grid_thw.as_ref().map(|grid| grid.view()),
        }
    }
}
