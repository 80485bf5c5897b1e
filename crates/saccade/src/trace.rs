//! What is kept of the inside of the head: attention probabilities, and the rows after a block.

use std::collections::BTreeMap;

use crate::array::OwnedArray;
use crate::error::{Error, Result};
use crate::intervention::{Groups, check_indices};

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

/// What was kept, by place: [`StepBlock`], or the block of the VL self-attention.
#[derive(Clone, Debug)]
pub struct Recorded<Place> {
    /// The probabilities used, `(batch, heads, queries, keys)`; exactly 0 for keys that were cut, dropped or are not seen.
    pub attention: BTreeMap<Place, OwnedArray>,
    /// Rows after the block, `(batch, rows, width)`.
    pub hidden: BTreeMap<Place, OwnedArray>,
}

impl<Place> Default for Recorded<Place> {
    /// Keeps nothing.
    fn default() -> Self {
        Self {
            attention: BTreeMap::new(),
            hidden: BTreeMap::new(),
        }
    }
}

/// What a place would keep: the shapes of its probabilities and rows.
pub(crate) struct Shapes {
    pub attention: [usize; 4],
    pub hidden: [usize; 3],
}

impl<Place: Ord + Copy> Recorded<Place> {
    /// Memory for `record` of these places. `argument` is what a caller would change to be allowed more.
    ///
    /// # Errors
    /// [`Error::Input`] if that is more than `max_bytes`, before anything is allocated, or does not fit in memory.
    pub(crate) fn claim(
        argument: &str,
        record: Keep,
        places: &[(Place, Shapes)],
        max_bytes: u64,
    ) -> Result<Self> {
        let bytes = |shape: &[usize]| 4 * shape.iter().map(|&size| size as u128).product::<u128>();
        let of_place = |shapes: &Shapes| {
            u128::from(record.attention) * bytes(&shapes.attention)
                + u128::from(record.hidden) * bytes(&shapes.hidden)
        };
        let needed: u128 = places.iter().map(|(_, shapes)| of_place(shapes)).sum();
        if needed > u128::from(max_bytes) {
            return Err(Error::Input(format!(
                "{argument}: what is to be recorded takes {needed} bytes, expected at most {max_bytes}; record less at a time"
            )));
        }
        let reserve = |shape: &[usize]| {
            let mut data: Vec<f32> = Vec::new();
            let elements = shape.iter().product(); // fits: it is below needed, which is at most max_bytes
            match data.try_reserve_exact(elements) {
                Ok(()) => Ok((data, shape.to_vec())),
                Err(_) => Err(Error::Input(format!(
                    "{argument}: what is to be recorded takes {needed} bytes, which do not fit in memory; record less at a time"
                ))),
            }
        };
        // All is reserved before any of it is touched: what does not fit is refused at once.
        let (mut attention, mut hidden) = (Vec::new(), Vec::new());
        for (place, shapes) in places {
            if record.attention {
                attention.push((*place, reserve(&shapes.attention)?));
            }
            if record.hidden {
                hidden.push((*place, reserve(&shapes.hidden)?));
            }
        }
        let filled = |(place, (mut data, shape)): (Place, (Vec<f32>, Vec<usize>))| {
            data.resize(shape.iter().product(), 0.0);
            (place, OwnedArray { data, shape })
        };
        Ok(Self {
            attention: attention.into_iter().map(filled).collect(),
            hidden: hidden.into_iter().map(filled).collect(),
        })
    }

    /// Where the probabilities at `place` go, if they are wanted.
    pub(crate) fn attention(&mut self, place: Place) -> Option<&mut [f32]> {
        self.attention
            .get_mut(&place)
            .map(|array| array.data.as_mut_slice())
    }

    /// Where the rows after `place` go, if they are wanted.
    pub(crate) fn hidden(&mut self, place: Place) -> Option<&mut [f32]> {
        self.hidden.get_mut(&place).map(|array| array.data.as_mut_slice())
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

impl TraceOptions {
    /// The places that are kept, of `num_steps` steps and `num_layers` blocks.
    ///
    /// # Errors
    /// [`Error::Input`] for a step or block that is not there.
    pub(crate) fn places(&self, num_steps: usize, num_layers: usize) -> Result<Vec<StepBlock>> {
        let chosen = |name, given: &Option<Vec<usize>>, count| match given {
            None => Ok((0..count).collect()),
            Some(indices) => check_indices(name, indices, count).map(|()| indices.clone()),
        };
        let steps = chosen("steps", &self.steps, num_steps)?;
        let blocks = chosen("blocks", &self.blocks, num_layers)?;
        Ok(steps
            .iter()
            .flat_map(|&step| blocks.iter().map(move |&block| (step, block)))
            .collect())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BOTH: Keep = Keep {
        attention: true,
        hidden: true,
    };

    #[test]
    fn one_byte_too_much_is_refused() {
        let places = || {
            [0, 2].map(|block| {
                let (attention, hidden) = ([2, 3, 4, 5], [2, 4, 7]);
                (block, Shapes { attention, hidden })
            })
        };
        let bytes = 2 * 4 * (2 * 3 * 4 * 5 + 2 * 4 * 7);
        let recorded = Recorded::claim("max_bytes", BOTH, &places(), bytes).unwrap();
        assert_eq!(recorded.attention[&2].shape, [2, 3, 4, 5]);
        assert_eq!(recorded.hidden[&0].data.len(), 2 * 4 * 7);
        assert_eq!(
            Recorded::claim("max_bytes", BOTH, &places(), bytes - 1)
                .unwrap_err()
                .to_string(),
            format!(
                "max_bytes: what is to be recorded takes {bytes} bytes, expected at most {}; record less at a time",
                bytes - 1
            )
        );
        let nothing = Recorded::claim("max_bytes", Keep::default(), &places(), 0).unwrap();
        assert!(nothing.attention.is_empty() && nothing.hidden.is_empty());
    }

    #[test]
    fn sizes_beyond_64_bits_are_refused() {
        let (attention, hidden) = ([1 << 20; 4], [1 << 20; 3]);
        let error =
            Recorded::claim("max_bytes", BOTH, &[(0, Shapes { attention, hidden })], u64::MAX).unwrap_err();
        let bytes = (1_u128 << 82) + (1 << 62);
        assert!(
            error
                .to_string()
                .contains(&format!("takes {bytes} bytes, expected at most"))
        );
    }
}
