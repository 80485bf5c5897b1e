//! Interruption: work ends soon after the question is answered with yes, whoever asks and however it is nested.

mod common;

use std::cell::Cell;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use common::{numbers, rows, rows_mut};
use saccade_vla_kernels::{
    Arithmetic, Epilogue, Interrupted, Isa, KernelError, LinearScratch, Matrix, PackedLinear, WeightRef,
    interrupted, interruptible, parallel_for,
};

/// A loop that would take a quarter of a minute; returns how many of its tasks ran.
fn long_loop(threads: usize) -> usize {
    let ran = AtomicUsize::new(0);
    parallel_for(threads, 15_000, &|_| {
        ran.fetch_add(1, Ordering::Relaxed);
        std::thread::sleep(Duration::from_millis(1));
    });
    ran.into_inner()
}

/// Loops as short as those of the kernels, until one is stopped.
fn until_stopped(threads: usize) {
    loop {
        let ran = AtomicUsize::new(0);
        parallel_for(threads, 4, &|_| {
            ran.fetch_add(1, Ordering::Relaxed);
        });
        if ran.into_inner() < 4 {
            return;
        }
    }
}

#[test]
fn work_that_is_not_stopped_runs_whole() {
    for threads in [1, 2, 4] {
        let asked = Cell::new(0);
        let poll = || {
            asked.set(asked.get() + 1);
            false
        };
        let ran = interruptible(&poll, || {
            let ran = AtomicUsize::new(0);
            parallel_for(threads, 100, &|_| {
                ran.fetch_add(1, Ordering::Relaxed);
                std::thread::sleep(Duration::from_millis(2));
            });
            ran.into_inner()
        });
        assert_eq!(ran, Ok(100));
        assert!(asked.get() >= 1, "it was asked");
    }
}

#[test]
fn a_loop_stops_between_tasks_and_later_loops_do_not_run() {
    for threads in [1, 2, 4] {
        let asked = Cell::new(0);
        let caller = std::thread::current().id();
        let poll = || {
            assert_eq!(std::thread::current().id(), caller);
            asked.set(asked.get() + 1);
            asked.get() == 3
        };
        let ran = Cell::new((0, 0));
        let outcome = interruptible(&poll, || ran.set((long_loop(threads), long_loop(threads))));
        assert_eq!(outcome, Err(Interrupted));
        let (first, second) = ran.get();
        assert!((1..15_000).contains(&first), "{first} tasks ran");
        assert_eq!(second, 0);
        assert_eq!(asked.get(), 3, "nobody is asked after yes");
        // The thread and the pool are as before.
        assert!(!interrupted());
        assert_eq!(interruptible(&|| false, || 5), Ok(5));
        let whole = AtomicUsize::new(0);
        parallel_for(threads, 50, &|_| {
            whole.fetch_add(1, Ordering::Relaxed);
        });
        assert_eq!(whole.into_inner(), 50);
    }
}

#[test]
fn many_short_loops_are_stopped_too() {
    for threads in [1, 2] {
        assert_eq!(
            interruptible(&|| true, || until_stopped(threads)),
            Err(Interrupted)
        );
    }
}

#[test]
fn an_inner_call_stops_with_the_outer_one_and_not_the_reverse() {
    let outer = Cell::new(false);
    let inner = Cell::new(Ok(()));
    let poll = || outer.replace(true);
    let outcome = interruptible(&poll, || {
        inner.set(interruptible(&|| false, || until_stopped(2)));
    });
    assert_eq!((inner.get(), outcome), (Err(Interrupted), Err(Interrupted)));
    let outcome = interruptible(&|| false, || {
        let inner = interruptible(&|| true, || until_stopped(2));
        let after = AtomicUsize::new(0);
        parallel_for(2, 30, &|_| {
            after.fetch_add(1, Ordering::Relaxed);
        });
        (inner, after.into_inner(), interrupted())
    });
    assert_eq!(outcome, Ok((Err(Interrupted), 30, false)));
}

#[test]
fn other_threads_go_on() {
    std::thread::scope(|scope| {
        let other = scope.spawn(|| {
            let ran = AtomicUsize::new(0);
            parallel_for(2, 300, &|_| {
                ran.fetch_add(1, Ordering::Relaxed);
                std::thread::sleep(Duration::from_micros(300));
            });
            (ran.into_inner(), interrupted())
        });
        assert_eq!(interruptible(&|| true, || until_stopped(3)), Err(Interrupted));
        assert_eq!(other.join().unwrap(), (300, false));
    });
}

#[test]
fn panics_pass_through() {
    let of_work = catch_unwind(|| interruptible(&|| false, || panic!("of the work")));
    assert_eq!(of_work.unwrap_err().downcast_ref(), Some(&"of the work"));
    for threads in [1, 3] {
        let poll = || panic!("of the question");
        let of_poll = catch_unwind(AssertUnwindSafe(|| {
            interruptible(&poll, || until_stopped(threads))
        }));
        assert_eq!(of_poll.unwrap_err().downcast_ref(), Some(&"of the question"));
        assert!(!interrupted(), "no call is left over");
    }
}

/// Large layers are made of small tasks: the loop below would take minutes.
#[test]
fn layers_of_thousands_of_rows_are_stopped() {
    const WIDTH: usize = 6144;
    let weight = numbers(1, 512 * WIDTH, 1.0);
    let x = numbers(2, 4096 * WIDTH, 1.0);
    let isa = Isa::Portable;
    let part = (WeightRef::F32(Matrix::new(&weight, WIDTH)), None);
    let layer = PackedLinear::pack(isa, Arithmetic::Float32, 2, &[part]).unwrap();
    let mut out = vec![0.0; 4096 * 512];
    for threads in [1, 2] {
        let outcome = interruptible(&|| true, || {
            while !interrupted() {
                let (x, out) = (rows(&x, WIDTH), rows_mut(&mut out, 512));
                layer
                    .apply(threads, x, Epilogue::Store, out, &mut LinearScratch::new())
                    .unwrap();
            }
        });
        assert_eq!(outcome, Err(Interrupted));
    }
}

/// Panels that were not written must not be read.
#[test]
fn packing_that_is_stopped_is_an_error() {
    let weight = vec![1.0; 64 * 64];
    let part = (WeightRef::F32(Matrix::new(&weight, 64)), None);
    let packed = Cell::new(false);
    let outcome = interruptible(&|| true, || {
        until_stopped(2);
        let layer = PackedLinear::pack(Isa::best(), Arithmetic::Int8, 2, &[part]);
        packed.set(!matches!(layer, Err(KernelError::Interrupted(Interrupted))));
    });
    assert_eq!((outcome, packed.get()), (Err(Interrupted), false));
}
