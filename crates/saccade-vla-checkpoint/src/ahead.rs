//! Reading ahead: a thread reads the next tensors while the last ones are used.

use std::cell::Cell;
use std::ops::Range;
use std::sync::mpsc::{Receiver, Sender, SyncSender, channel, sync_channel};
use std::thread::Builder;

use crate::elements::Elements;
use crate::error::{Result, probe_allocation};
use crate::reader::Checkpoint;

/// Address space that must be free before a thread is started: with little more than a stack, the standard library aborts the process when
/// the thread begins.
const THREAD_ROOM: usize = 80 << 20;

/// A tensor to read, or some slices of its first axis.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Wanted {
    /// Its name in the checkpoint.
    pub name: String,
    /// Slices of the first axis; none for the whole tensor.
    pub slices: Option<Range<usize>>,
    /// Whether it comes back by [`ReadAhead::give_back`], so that its memory is used again. What is kept must not be read into memory larger
    /// than it needs.
    pub is_given_back: bool,
}

/// A tensor that was read ahead, and what came of it.
struct TensorRead {
    wanted: Wanted,
    elements: Result<Elements>,
}

/// Tensors of a checkpoint that a thread reads ahead.
pub struct ReadAhead<'a> {
    checkpoint: &'a Checkpoint,
    /// What the thread has read, in the order that it was given; none where the system grants no thread.
    ahead: Option<Receiver<TensorRead>>,
    /// The next one, if something else was asked for before it.
    next: Cell<Option<Box<TensorRead>>>,
    /// Memory of tensors that were used, for the thread.
    spare: Sender<Elements>,
}

impl Checkpoint {
    /// Calls `work` with tensors that a thread reads ahead in the order `wanted`.
    ///
    /// At most three tensors are in memory: the one that the thread reads, one that waits, and the one that `work` uses.
    pub fn read_ahead<R>(&self, wanted: Vec<Wanted>, work: impl FnOnce(&ReadAhead<'_>) -> R) -> R {
        let (sender, receiver) = sync_channel(1);
        let (spare, used) = channel();
        std::thread::scope(|scope| {
            let read = move || read_all(self, wanted, &sender, &used);
            let thread = match probe_allocation("source", THREAD_ROOM) {
                Ok(()) => Builder::new()
                    .name("saccade-read".to_owned())
                    .spawn_scoped(scope, read)
                    .ok(),
                // Its channels end with it: nothing is sent to a thread that is not there.
                Err(_) => {
                    drop(read);
                    None
                }
            };
            // The receiver is dropped with these tensors, before the scope waits for the thread: work that fails stops the reading.
            work(&ReadAhead {
                checkpoint: self,
                ahead: thread.is_some().then_some(receiver),
                next: Cell::new(None),
                spare,
            })
        })
    }
}

impl ReadAhead<'_> {
    /// The tensor `name`, or slices of its first axis: from the thread if it is next in its order, and otherwise read now.
    ///
    /// # Errors
    /// As [`Checkpoint::read`] and [`Checkpoint::read_slices`].
    pub fn take(&self, name: &str, slices: Option<Range<usize>>) -> Result<Elements> {
        let next = self.next.take();
        let next = next.or_else(|| self.ahead.as_ref()?.recv().ok().map(Box::new));
        match next {
            Some(read) if read.wanted.name == name && read.wanted.slices == slices => read.elements,
            other => {
                self.next.set(other);
                self.checkpoint.read_into(name, slices, None)
            }
        }
    }

    /// Takes a tensor back, whose memory is used again.
    pub fn give_back(&self, used: Elements) {
        // Without a thread nobody takes it.
        let _ = self.spare.send(used);
    }
}

fn read_all(
    checkpoint: &Checkpoint,
    wanted: Vec<Wanted>,
    sender: &SyncSender<TensorRead>,
    used: &Receiver<Elements>,
) {
    for wanted in wanted {
        let spare = wanted.is_given_back.then(|| used.try_recv().ok()).flatten();
        let elements = checkpoint.read_into(&wanted.name, wanted.slices.clone(), spare);
        if sender.send(TensorRead { wanted, elements }).is_err() {
            return;
        }
    }
}
