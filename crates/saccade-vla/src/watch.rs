//! Which linear layers the calls of a thread run, and what these are given. Costs a branch in every layer unless that
//! thread asked for it.

use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};
use std::marker::PhantomData;

use saccade_vla_kernels::Rows;

use crate::error::{Error, Result, ensure};
use crate::gram::Gram;

/// A linear layer that was run.
#[derive(Clone, Debug)]
pub struct WatchedLinear {
    /// The names of its weights, without the prefix of their model: several where one layer computes them together.
    pub weights: Vec<String>,
    /// Number of its inputs.
    pub in_features: usize,
    /// What it was given, if that was asked for.
    pub gram: Option<Gram>,
}

/// A watch over the linear layers that this thread runs, from its start to its end. Those with weights of their own for
/// each embodiment are left out.
///
/// ```
/// # use std::collections::BTreeSet;
/// # use saccade_vla::{Array, ActionHead, Features, LoadOptions, LinearWatch};
/// let head = ActionHead::load("examples/tiny".as_ref(), &LoadOptions::default())?;
/// let shape = [1, 3, head.config().context_dim];
/// let values = vec![0.5; shape.iter().product()];
/// let features = Features::new(Array::new(&values, &shape)?);
///
/// let watch = LinearWatch::start(BTreeSet::new())?;
/// head.encode(&features)?;
/// let layers = watch.finish()?;
/// let wanted = layers[0].weights[0].clone();
///
/// let watch = LinearWatch::start([wanted].into())?;
/// head.encode(&features)?;
/// let gram = watch.finish()?[0].gram.clone().unwrap();
/// assert_eq!((gram.num_rows(), gram.width()), (3, layers[0].in_features));
/// # Ok::<(), saccade_vla::Error>(())
/// ```
#[derive(Debug)]
#[must_use = "nothing is watched once it is dropped"]
pub struct LinearWatch {
    of_thread: PhantomData<*const ()>,
}

/// What a watch saw.
#[derive(Default)]
struct Seen {
    wanted: BTreeSet<String>,
    layers: Vec<WatchedLinear>,
    /// Where each is, by its first weight.
    places: BTreeMap<String, usize>,
}

thread_local! {
    static SEEN: RefCell<Option<Seen>> = const { RefCell::new(None) };
}

impl LinearWatch {
    /// Starts a watch that keeps the inputs of the layers whose first weight is one of `wanted`.
    ///
    /// # Errors
    /// [`Error::Input`] if this thread has a watch.
    pub fn start(wanted: BTreeSet<String>) -> Result<Self> {
        SEEN.with_borrow_mut(|seen| {
            ensure!(seen.is_none(), Input, "watch"; expected "one for each thread"; got "a second one");
            *seen = Some(Seen {
                wanted,
                ..Seen::default()
            });
            Ok(Self {
                of_thread: PhantomData,
            })
        })
    }

    /// Ends it: the layers in the order in which they first ran.
    ///
    /// # Errors
    /// [`Error::Input`] if the inputs of a layer were not finite, or so large that their squares are not.
    pub fn finish(self) -> Result<Vec<WatchedLinear>> {
        let seen = SEEN.take().expect("it is there as long as the guard");
        for layer in &seen.layers {
            if let Some(gram) = &layer.gram {
                gram.check_finite(&format!("inputs of {}", layer.weights[0]))?;
            }
        }
        Ok(seen.layers)
    }
}

impl Drop for LinearWatch {
    fn drop(&mut self) {
        SEEN.set(None);
    }
}

/// Notes that a layer of these weights is given `x`, if this thread watches.
///
/// # Errors
/// [`Error::Memory`] for a Gram matrix; [`Error::Interrupted`].
pub(crate) fn note(weights: &[String], x: Rows<'_>, threads: usize) -> Result<()> {
    SEEN.with_borrow_mut(|seen| {
        let (Some(seen), Some(first)) = (seen, weights.first()) else {
            return Ok(());
        };
        let place = match seen.places.get(first) {
            Some(&place) => place,
            None => {
                let in_features = x.num_columns();
                let is_wanted = seen.wanted.contains(first);
                let gram = is_wanted.then(|| Gram::new(in_features)).transpose()?;
                seen.layers.push(WatchedLinear {
                    weights: weights.to_vec(),
                    in_features,
                    gram,
                });
                seen.places.insert(first.clone(), seen.layers.len() - 1);
                seen.layers.len() - 1
            }
        };
        match &mut seen.layers[place].gram {
            Some(gram) => gram.add_rows(x, threads),
            None => Ok(()),
        }
    })
}
