//! The pool under stress: more callers than slots, more threads than cores, cores that others keep busy, tasks that sleep, panic or nest.
//! A pool that hangs ends the process, so that the tests fail.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Once;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::Duration;

use saccade_vla_kernels::parallel_for;

/// Ends the process after two minutes. They are counted in short sleeps: a process that is stopped for a while loses one of them only.
fn watch() {
    static WATCH: Once = Once::new();
    WATCH.call_once(|| {
        std::thread::spawn(|| {
            (0..1200).for_each(|_| std::thread::sleep(Duration::from_millis(100)));
            eprintln!("the pool hangs");
            std::process::abort();
        });
    });
}

/// Numbers without a pattern.
fn noise(seed: usize) -> usize {
    let mixed = (seed as u64 + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    usize::try_from((mixed ^ (mixed >> 29)).wrapping_mul(0xBF58_476D_1CE4_E5B9) >> 40).unwrap()
}

/// A task: usually short, sometimes long, sometimes asleep, so that callers spin, sleep and are woken.
fn work(seed: usize) {
    match noise(seed) % 64 {
        0 => std::thread::sleep(Duration::from_micros(700)),
        1 => std::thread::yield_now(),
        2 => (0..20_000).for_each(|i| {
            std::hint::black_box(i);
        }),
        _ => {}
    }
}

/// Loops of many sizes, each of whose tasks must run once before the loop ends. Every ninth loop has a task that panics.
fn loops(caller: usize, count: usize) {
    for index in 0..count {
        let seed = 1000 * caller + index;
        let (threads, tasks) = (2 + noise(seed) % 6, noise(seed + 7) % 40);
        let panics = index % 9 == 0 && tasks > 0;
        let visits: Vec<AtomicUsize> = (0..tasks).map(|_| AtomicUsize::new(0)).collect();
        let outcome = catch_unwind(AssertUnwindSafe(|| {
            parallel_for(threads, tasks, &|task| {
                visits[task].fetch_add(1, Ordering::Relaxed);
                if panics && task == tasks / 2 {
                    std::panic::resume_unwind(Box::new(seed)); // without the hook's message
                }
                work(seed + task);
                if task % 8 == 3 {
                    let inner = AtomicUsize::new(0);
                    parallel_for(threads, 5, &|_| {
                        inner.fetch_add(1, Ordering::Relaxed);
                    });
                    assert_eq!(inner.into_inner(), 5);
                }
            });
        }));
        assert!(
            visits.iter().all(|visits| visits.load(Ordering::Relaxed) == 1),
            "caller {caller}, loop {index}: a task ran not once"
        );
        match outcome {
            Ok(()) => assert!(!panics),
            Err(panic) => assert_eq!(panic.downcast_ref(), Some(&seed), "another caller's panic"),
        }
    }
}

#[test]
fn one_caller() {
    watch();
    loops(0, 400);
}

#[test]
fn more_callers_than_slots() {
    watch();
    std::thread::scope(|scope| {
        for caller in 1..=20 {
            scope.spawn(move || loops(caller, 60));
        }
    });
}

#[test]
fn many_more_threads_than_cores() {
    watch();
    for round in 0..30 {
        let visits = AtomicUsize::new(0);
        parallel_for(100, 300, &|task| {
            work(300 * round + task);
            visits.fetch_add(1, Ordering::Relaxed);
        });
        assert_eq!(visits.into_inner(), 300);
    }
}

#[test]
fn cores_that_others_keep_busy() {
    watch();
    let over = AtomicBool::new(false);
    std::thread::scope(|scope| {
        for _ in 0..2 * std::thread::available_parallelism().unwrap().get() {
            scope.spawn(|| {
                while !over.load(Ordering::Relaxed) {
                    std::hint::spin_loop();
                }
            });
        }
        let outcome = catch_unwind(|| loops(100, 150));
        over.store(true, Ordering::Relaxed);
        outcome.unwrap();
    });
}
