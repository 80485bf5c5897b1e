//! What is kept of the inside of the head: attention probabilities, and the rows after a block.

use std::collections::BTreeMap;

use super::groups::{Groups, check_indices};
use crate::alloc::reserve;
use crate::array::OwnedArray;
use crate::error::{Error, Result, ensure};
use crate::ops::check_interrupted;

/// What to keep.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Keep {
    /// Attention probabilities.
    pub attention: bool,
    /// The rows after a block.
    pub hidden: bool,
}

/// What [`ActionHead::trace`](crate::ActionHead::trace) keeps, and how much of it at most.
#[derive(Clone, Debug)]
pub struct TraceOptions {
    /// What to keep.
    pub record: Keep,
    /// Of which blocks; default all.
    pub blocks: Option<Vec<usize>>,
    /// Of which Euler steps; default all.
    pub steps: Option<Vec<usize>>,
    /// More than this is refused.
    pub max_bytes: u64,
}

/// An Euler step and a block of the transformer.
pub type StepBlock = (usize, usize);

/// What was kept, by [`StepBlock`], or by block of the VL self-attention.
#[derive(Clone, Debug)]
pub struct Recorded<Key> {
    /// The probabilities used, `(batch, heads, queries, keys)`; exactly 0 for keys that were cut, dropped or are not seen.
    pub attention: BTreeMap<Key, OwnedArray>,
    /// Rows after the block, `(batch, rows, width)`.
    pub hidden: BTreeMap<Key, OwnedArray>,
}

impl<Key> Default for Recorded<Key> {
    /// Keeps nothing.
    fn default() -> Self {
        Self {
            attention: BTreeMap::new(),
            hidden: BTreeMap::new(),
        }
    }
}

/// What is kept of a block: the shapes of its probabilities and rows.
pub(crate) struct Shapes {
    pub attention: [usize; 4],
    pub hidden: [usize; 3],
}

impl<Key: Ord + Copy> Recorded<Key> {
    /// Memory for `record` of these keys, each a block or a step and a block. `argument` is what a caller would change to be allowed more.
    ///
    /// # Errors
    /// [`Error::Input`] if that is more than `max_bytes`, before anything is allocated; [`Error::Memory`] if the system refuses it.
    pub(crate) fn allocate(
        argument: &str,
        record: Keep,
        keys: &[(Key, Shapes)],
        max_bytes: u64,
    ) -> Result<Self> {
        let bytes = |shape: &[usize]| 4 * shape.iter().map(|&size| size as u128).product::<u128>();
        let of_key = |shapes: &Shapes| {
            u128::from(record.attention) * bytes(&shapes.attention)
                + u128::from(record.hidden) * bytes(&shapes.hidden)
        };
        let needed: u128 = keys.iter().map(|(_, shapes)| of_key(shapes)).sum();
        ensure!(
            needed <= u128::from(max_bytes), Input, argument;
            "what is to be recorded takes {needed} bytes, expected at most {max_bytes}; record less at a time"
        );
        // All is reserved before any of it is touched: what does not fit is refused at once.
        let reserved = |shape: &[usize]| {
            let mut data: Vec<f32> = Vec::new();
            let elements = shape.iter().product(); // fits: it is below needed, which is at most max_bytes
            reserve("record", &mut data, elements).map_err(|_| Error::Memory {
                what: "record",
                bytes: usize::try_from(needed).unwrap_or(usize::MAX),
            })?;
            Ok::<_, Error>((data, shape.to_vec()))
        };
        let (mut attention, mut hidden) = (Vec::new(), Vec::new());
        for (key, shapes) in keys {
            if record.attention {
                attention.push((*key, reserved(&shapes.attention)?));
            }
            if record.hidden {
                hidden.push((*key, reserved(&shapes.hidden)?));
            }
        }
        let zeros = |(key, (mut data, shape)): (Key, (Vec<f32>, Vec<usize>))| {
            check_interrupted()?;
            data.resize(shape.iter().product(), 0.0);
            Ok((key, OwnedArray::new(data, &shape)?))
        };
        Ok(Self {
            attention: attention.into_iter().map(zeros).collect::<Result<_>>()?,
            hidden: hidden.into_iter().map(zeros).collect::<Result<_>>()?,
        })
    }

    /// Where the probabilities of `key` go, if they are wanted.
    pub(crate) fn attention(&mut self, key: Key) -> Option<&mut [f32]> {
        self.attention.get_mut(&key).map(OwnedArray::data_mut)
    }

    /// Where the rows of `key` go, if they are wanted.
    pub(crate) fn hidden(&mut self, key: Key) -> Option<&mut [f32]> {
        self.hidden.get_mut(&key).map(OwnedArray::data_mut)
    }
}

/// One call of [`ActionHead::trace`](crate::ActionHead::trace).
#[derive(Clone, Debug)]
pub struct Trace {
    /// What was asked for.
    pub recorded: Recorded<StepBlock>,
    /// Which rows are which.
    pub groups: Groups,
    /// `(batch, action_horizon, action_dim)`: the bits that [`ActionHead::sample`](crate::ActionHead::sample) gives.
    pub actions: OwnedArray,
}

/// What is kept by default at most.
const MAX_BYTES: u64 = 1 << 31;

impl Default for TraceOptions {
    /// Keeps nothing, of all blocks and steps, and 2 GiB at most.
    fn default() -> Self {
        Self {
            record: Keep::default(),
            blocks: None,
            steps: None,
            max_bytes: MAX_BYTES,
        }
    }
}

impl TraceOptions {
    /// The steps and blocks that are kept, of `num_steps` steps and `num_layers` blocks.
    ///
    /// # Errors
    /// [`Error::Input`] for a step or block that is not there.
    pub(crate) fn chosen(&self, num_steps: usize, num_layers: usize) -> Result<Vec<StepBlock>> {
        let of = |name, given: &Option<Vec<usize>>, count| match given {
            None => Ok((0..count).collect()),
            Some(indices) => check_indices(name, indices, count).map(|()| indices.clone()),
        };
        let steps = of("steps", &self.steps, num_steps)?;
        let blocks = of("blocks", &self.blocks, num_layers)?;
        Ok(steps
            .iter()
            .flat_map(|&step| blocks.iter().map(move |&block| (step, block)))
            .collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_beyond_64_bits_are_refused() {
        let (attention, hidden) = ([1 << 20; 4], [1 << 20; 3]);
        let both = Keep {
            attention: true,
            hidden: true,
        };
        let shapes = [(0, Shapes { attention, hidden })];
        let error = Recorded::allocate("max_bytes", both, &shapes, u64::MAX).unwrap_err();
        let bytes = (1_u128 << 82) + (1 << 62);
        assert!(
            error
                .to_string()
                .contains(&format!("takes {bytes} bytes, expected at most"))
        );
    }
}
