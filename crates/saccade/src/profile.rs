//! Where the time of a thread's calls goes, by part. Costs a branch around every kernel call unless that thread asked for it.

use std::cell::RefCell;
use std::time::{Duration, Instant};

/// A part of the work of a head or a backbone.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Part {
    /// Queries of all attentions.
    ToQ,
    /// Keys and values of the self-attentions.
    ToKv,
    /// Keys and values of the cross-attentions, once an observation.
    ContextToKv,
    /// Bringing keys and values into the layout that the attention reads.
    Pack,
    /// Scores, softmax and the sum of values.
    Attention,
    /// The projection after the attention.
    ToOut,
    /// First layer of the feed-forward, with its activation.
    FeedForwardIn,
    /// Its second layer.
    FeedForwardOut,
    /// Layer norms, with what they scale and shift by.
    Norm,
    /// The layers with separate weights for each embodiment: encoders of state and actions, decoder of actions.
    Embodiment,
    /// The projection after the last block.
    Output,
    /// What makes rows of the patches of views.
    Patches,
    /// What makes tokens of the rows of views.
    Connector,
}

impl Part {
    /// All parts, in the order of the calls.
    pub const ALL: [Self; 13] = [
        Self::ToQ,
        Self::ToKv,
        Self::ContextToKv,
        Self::Pack,
        Self::Attention,
        Self::ToOut,
        Self::FeedForwardIn,
        Self::FeedForwardOut,
        Self::Norm,
        Self::Embodiment,
        Self::Output,
        Self::Patches,
        Self::Connector,
    ];

    /// Its name in a report.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::ToQ => "to_q",
            Self::ToKv => "to_kv",
            Self::ContextToKv => "context_to_kv",
            Self::Pack => "pack",
            Self::Attention => "attention",
            Self::ToOut => "to_out",
            Self::FeedForwardIn => "feed_forward_in",
            Self::FeedForwardOut => "feed_forward_out",
            Self::Norm => "norm",
            Self::Embodiment => "embodiment",
            Self::Output => "output",
            Self::Patches => "patches",
            Self::Connector => "connector",
        }
    }
}

/// What was done in one part.
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
}

/// Counters of every part.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Profile {
    counters: [Counter; Part::ALL.len()],
}

impl Profile {
    /// Begins to count what this thread does from now on; earlier counts are forgotten.
    pub fn start() {
        CURRENT.replace(Some(Self::default()));
    }

    /// Ends it, and hands over what was counted; none if it was not begun.
    #[must_use]
    pub fn take() -> Option<Self> {
        CURRENT.take()
    }

    /// What was counted of a part.
    #[must_use]
    pub fn part(&self, part: Part) -> Counter {
        self.counters[part as usize]
    }
}

thread_local! {
    static CURRENT: RefCell<Option<Profile>> = const { RefCell::new(None) };
}

/// Runs `call`, whose work is `(multiply_adds, bytes)`, and counts it under `part` if this thread counts.
pub(crate) fn counted<R>(part: Option<Part>, work: (usize, usize), call: impl FnOnce() -> R) -> R {
    let Some(part) = part.filter(|_| CURRENT.with_borrow(Option::is_some)) else {
        return call();
    };
    let start = Instant::now();
    let result = call();
    let time = start.elapsed();
    CURRENT.with_borrow_mut(|profile| {
        if let Some(profile) = profile {
            let counter = &mut profile.counters[part as usize];
            counter.calls += 1;
            counter.time += time;
            counter.multiply_adds += work.0 as u64;
            counter.bytes += work.1 as u64;
        }
    });
    result
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_between_start_and_take_on_this_thread_only() {
        let work = || counted(Some(Part::ToQ), (6, 24), || 7);
        assert_eq!(work(), 7);
        assert_eq!(Profile::take(), None, "nothing is counted before");
        Profile::start();
        std::thread::scope(|scope| {
            scope.spawn(work);
        });
        work();
        work();
        let profile = Profile::take().unwrap();
        let Counter {
            calls,
            multiply_adds,
            bytes,
            ..
        } = profile.part(Part::ToQ);
        assert_eq!((calls, multiply_adds, bytes), (2, 12, 48));
        assert_eq!(profile.part(Part::Norm), Counter::default());
        work();
        assert_eq!(Profile::take(), None);
    }

    #[test]
    fn parts_are_listed_in_their_order() {
        for (index, part) in Part::ALL.into_iter().enumerate() {
            assert_eq!(part as usize, index);
        }
    }
}
