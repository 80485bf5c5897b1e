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

#[cfg(test)]
mod tests {
    use super::*;

    fn wanted(name: &str, slices: Option<Range<usize>>) -> Wanted {
        Wanted {
            name: name.to_owned(),
            slices,
            is_given_back: true,
        }
    }

    #[test]
    fn tensors_come_in_any_order() {
        let path = std::env::temp_dir().join(format!("saccade-{}-ahead", std::process::id()));
        let header = r#"{"a":{"dtype":"F32","shape":[2],"data_offsets":[0,8]},"b":{"dtype":"F32","shape":[1],"data_offsets":[8,12]}}"#;
        let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
        bytes.extend(header.as_bytes());
        bytes.extend([1.0f32, 2.0, 3.0].iter().flat_map(|value| value.to_le_bytes()));
        std::fs::write(&path, bytes).unwrap();
        let checkpoint = Checkpoint::open(&path).unwrap();
        let order = vec![wanted("a", None), wanted("b", None), wanted("a", Some(1..2))];
        let expected = |name: &str, slices: &Option<Range<usize>>| match (name, slices) {
            ("b", _) => Elements::F32(vec![3.0]),
            (_, Some(_)) => Elements::F32(vec![2.0]),
            _ => Elements::F32(vec![1.0, 2.0]),
        };
        for asked in [
            vec![0, 1, 2],
            vec![2, 1, 0],
            vec![1],
            vec![0, 0, 1, 1, 2, 2],
            vec![],
        ] {
            checkpoint.read_ahead(order.clone(), |tensors| {
                for index in asked {
                    let Wanted { name, slices, .. } = &order[index];
                    let read = tensors.take(name, slices.clone()).unwrap();
                    assert_eq!(read, expected(name, slices));
                    tensors.give_back(read);
                }
            });
        }
        let missing = vec![wanted("c", None)];
        assert!(checkpoint.read_ahead(missing, |tensors| tensors.take("c", None).is_err()));
        std::fs::remove_file(&path).unwrap();
    }
}
