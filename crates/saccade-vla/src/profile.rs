//! The time of a thread's calls, by part. Costs a branch around every kernel call unless that thread asked
//! for it.

use std::cell::{Cell, RefCell};
use std::marker::PhantomData;
use std::time::{Duration, Instant};

/// The table of parts: each with its documentation and its name in a report, in the order of the calls.
macro_rules! parts {
    ($($(#[$doc:meta])* $part:ident = $name:literal,)*) => {
        /// A part of the work of a head or a backbone.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        #[non_exhaustive]
        pub enum Part {
            $($(#[$doc])* $part,)*
        }

        impl Part {
            /// All parts, in the order of the calls.
            pub const ALL: [Self; [$(Self::$part),*].len()] = [$(Self::$part),*];

            /// The name in a report.
            #[must_use]
            pub fn name(self) -> &'static str {
                match self {
                    $(Self::$part => $name,)*
                }
            }
        }
    };
}

parts! {
    /// Queries of all attentions.
    ToQ = "to_q",
    /// Keys and values of the self-attentions.
    ToKv = "to_kv",
    /// Keys and values of the cross-attentions, once an observation.
    ContextToKv = "context_to_kv",
    /// Packing of keys and values into KV caches, and rotary embedding.
    Pack = "pack",
    /// Scores, softmax and the sum of values.
    Attention = "attention",
    /// The projection after the attention.
    ToOut = "to_out",
    /// First layer of the feed-forward, with its activation.
    FeedForwardIn = "feed_forward_in",
    /// Its second layer.
    FeedForwardOut = "feed_forward_out",
    /// Norms, with their scale and shift.
    Norm = "norm",
    /// The layers with separate weights for each embodiment: encoders of state and actions, decoder of
    /// actions.
    Embodiment = "embodiment",
    /// The projection after the last block.
    Output = "output",
    /// The patch embedding of views.
    Patches = "patches",
    /// The connector from patches to tokens.
    Connector = "connector",
}

/// The work done in one part.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counter {
    /// Calls of a kernel.
    pub calls: u64,
    /// Time in them.
    pub time: Duration,
    /// Multiply-adds of their matrix products.
    pub multiply_adds: u64,
    /// Bytes of weights, or of held keys and values, that they read at least once.
    pub bytes: u64,
    /// The kernel of the last call, of parts that are linear layers: `avx512-vnni-int8`, for example.
    pub kernel: Option<&'static str>,
}

/// Counters of every part.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Profile {
    counters: [Counter; Part::ALL.len()],
}

impl Profile {
    /// Counts what this thread does, until what this returns is finished or dropped.
    pub fn start() -> Profiling {
        GUARDS.set(GUARDS.get() + 1);
        Profiling {
            before: COUNTED.with_borrow(|counted| *counted),
            of_thread: PhantomData,
        }
    }

    /// The counter of a part.
    #[must_use]
    pub fn part(&self, part: Part) -> Counter {
        self.counters[part as usize]
    }
}

/// The guard of [`Profile::start`]. It belongs to the thread that made it; where there are several, each
/// counts all that is done while it is there.
#[derive(Debug)]
#[must_use = "nothing is counted once it is dropped"]
pub struct Profiling {
    /// The counters of the thread before.
    before: Profile,
    of_thread: PhantomData<*const ()>,
}

impl Profiling {
    /// Ends it, and hands over the counters.
    #[must_use]
    pub fn finish(self) -> Profile {
        let mut counters = COUNTED.with_borrow(|counted| counted.counters);
        for (counter, before) in counters.iter_mut().zip(self.before.counters) {
            counter.calls -= before.calls;
            counter.time -= before.time;
            counter.multiply_adds -= before.multiply_adds;
            counter.bytes -= before.bytes;
            counter.kernel = counter.kernel.filter(|_| counter.calls > 0);
        }
        Profile { counters }
    }
}

impl Drop for Profiling {
    fn drop(&mut self) {
        GUARDS.set(GUARDS.get() - 1);
    }
}

thread_local! {
    /// The number of guards of this thread.
    static GUARDS: Cell<usize> = const { Cell::new(0) };
    /// Everything counted while there was any.
    static COUNTED: RefCell<Profile> = RefCell::default();
}

/// Runs `call`, whose work is `(multiply_adds, bytes)`, and counts it under `part` if this thread counts.
pub(crate) fn counted<R>(part: Option<Part>, work: (usize, usize), call: impl FnOnce() -> R) -> R {
    counted_by(None, part, work, call)
}

/// The same of a call that `kernel` computes.
pub(crate) fn counted_by<R>(
    kernel: Option<&'static str>,
    part: Option<Part>,
    work: (usize, usize),
    call: impl FnOnce() -> R,
) -> R {
    let Some(part) = part.filter(|_| GUARDS.get() > 0) else {
        return call();
    };
    let start = Instant::now();
    let result = call();
    let time = start.elapsed();
    COUNTED.with_borrow_mut(|counted| {
        let counter = &mut counted.counters[part as usize];
        counter.calls += 1;
        counter.time += time;
        counter.multiply_adds += work.0 as u64;
        counter.bytes += work.1 as u64;
        counter.kernel = kernel.or(counter.kernel);
    });
    result
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_is_counted_after_an_error() {
        let fails = || -> Result<(), ()> {
            let _profiling = Profile::start();
            Err(())
        };
        assert_eq!((fails(), GUARDS.get()), (Err(()), 0));
        let panics = std::panic::catch_unwind(|| {
            let _profiling = Profile::start();
            panic!("within");
        });
        assert!(panics.is_err() && GUARDS.get() == 0);
    }
}
