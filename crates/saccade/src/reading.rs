//! Reading ahead: a thread reads the next tensor while the layers are made of the last one.

use std::sync::mpsc::{Receiver, Sender, SyncSender, channel, sync_channel};
use std::thread::Builder;

use crate::checkpoint::{Checkpoint, Elements};
use crate::error::Result;
use crate::layout::Wanted;
use crate::nn::weights::{Request, Source, Tensor};

/// A checkpoint in which the head stands under a prefix.
pub(crate) struct HeadTensors<'a> {
    checkpoint: &'a Checkpoint,
    prefix: &'static str,
    /// What the thread has read, in the order given to [`HeadTensors::read_ahead`]; none where the system grants no thread.
    ahead: Option<Receiver<Read>>,
    /// Memory of tensors that were used, for the thread.
    spare: Sender<Elements>,
}

/// A tensor that was asked for, and what came of it.
struct Read {
    wanted: Wanted,
    elements: Result<Elements>,
}

impl HeadTensors<'_> {
    /// Calls `load` with tensors that are read ahead in the order `wanted`, in which it must ask for them.
    ///
    /// There are at most three tensors in memory: the one that the thread reads, one that waits, and the one that `load` has.
    pub(crate) fn read_ahead<R>(
        checkpoint: &Checkpoint,
        prefix: &'static str,
        wanted: Vec<Wanted>,
        load: impl FnOnce(&HeadTensors<'_>) -> Result<R>,
    ) -> Result<R> {
        let (sender, receiver) = sync_channel(1);
        let (spare, used) = channel();
        std::thread::scope(|scope| {
            let read = move || read_all(checkpoint, prefix, wanted, &sender, &used);
            let thread = Builder::new()
                .name("saccade-read".to_owned())
                .spawn_scoped(scope, read);
            // The receiver is dropped with these tensors, before the scope waits for the thread: a load that fails stops the reading.
            load(&HeadTensors {
                checkpoint,
                prefix,
                ahead: thread.is_ok().then_some(receiver),
                spare,
            })
        })
    }

    fn take(&self, wanted: Wanted) -> Result<Elements> {
        let Some(ahead) = &self.ahead else {
            return read(self.checkpoint, self.prefix, &wanted, None);
        };
        let read = ahead.recv().expect("the thread reads all that was wanted");
        assert_eq!(
            (&read.wanted.name, &read.wanted.slices),
            (&wanted.name, &wanted.slices),
            "tensors are asked for in the order in which they are read"
        );
        read.elements
    }
}

impl Source for HeadTensors<'_> {
    fn tensor(&self, request: &Request) -> Result<Tensor> {
        let Request {
            spec,
            slices,
            is_given_back,
        } = request;
        if spec.shape.contains(&0) {
            return Ok(Tensor::Held(Elements::F32(Vec::new())));
        }
        let elements = self.take(Wanted {
            name: spec.name.clone(),
            slices: slices.clone(),
            is_given_back: *is_given_back,
        })?;
        Ok(Tensor::Held(elements))
    }

    fn give_back(&self, used: Elements) {
        // Without a thread nobody takes it.
        let _ = self.spare.send(used);
    }
}

fn read_all(
    checkpoint: &Checkpoint,
    prefix: &str,
    wanted: Vec<Wanted>,
    sender: &SyncSender<Read>,
    used: &Receiver<Elements>,
) {
    for wanted in wanted {
        let spare = wanted.is_given_back.then(|| used.try_recv().ok()).flatten();
        let elements = read(checkpoint, prefix, &wanted, spare);
        if sender.send(Read { wanted, elements }).is_err() {
            return;
        }
    }
}

fn read(checkpoint: &Checkpoint, prefix: &str, wanted: &Wanted, spare: Option<Elements>) -> Result<Elements> {
    checkpoint.read_into(&format!("{prefix}{}", wanted.name), wanted.slices.clone(), spare)
}
