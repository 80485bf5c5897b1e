//! Which inputs an output is made of, and with which weights.

use super::reserved;
use crate::aligned::AllocError;

/// The inputs of every output along one axis.
pub(super) struct Taps<W> {
    /// For each output, its first input and where its weights begin; at the end, where they end.
    outputs: Vec<(usize, usize)>,
    weights: Vec<W>,
}

impl<W> Taps<W> {
    /// None yet, with room for those of `num_outputs`.
    pub(super) fn with_room(num_outputs: usize) -> Result<Self, AllocError> {
        Ok(Self {
            outputs: reserved(num_outputs)?,
            weights: Vec::new(),
        })
    }

    /// Adds an output: the inputs from `first` on, one for each weight.
    pub(super) fn push(&mut self, first: usize, weights: &[W]) -> Result<(), AllocError>
    where
        W: Copy,
    {
        self.weights.try_reserve(weights.len()).map_err(|_| AllocError {
            bytes: (self.weights.len() + weights.len()).saturating_mul(size_of::<W>()),
        })?;
        self.outputs.push((first, self.weights.len()));
        self.weights.extend_from_slice(weights);
        Ok(())
    }

    /// Number of outputs.
    #[inline(always)]
    pub(super) fn len(&self) -> usize {
        self.outputs.len()
    }

    /// The first input of an output, and the weights of the inputs from there on.
    #[inline(always)]
    pub(super) fn of(&self, index: usize) -> (usize, &[W]) {
        let (first, start) = self.outputs[index];
        let end = self
            .outputs
            .get(index + 1)
            .map_or(self.weights.len(), |next| next.1);
        (first, &self.weights[start..end])
    }

    /// All weights.
    pub(super) fn weights(&self) -> &[W] {
        &self.weights
    }

    /// The same with other weights.
    pub(super) fn map<V>(self, weight: impl Fn(W) -> V) -> Result<Taps<V>, AllocError> {
        let mut weights = reserved(self.weights.len())?;
        weights.extend(self.weights.into_iter().map(weight));
        Ok(Taps {
            outputs: self.outputs,
            weights,
        })
    }
}
