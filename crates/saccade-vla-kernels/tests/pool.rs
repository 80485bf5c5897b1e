//! The pool under stress: more callers than slots, more threads than cores, cores that others keep busy, tasks that sleep, panic or nest.
//! A pool that hangs ends the process, so that the tests fail.

use std::collections::HashSet;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Mutex, Once};
use std::thread::ThreadId;
use std::time::{Duration, Instant};

use saccade_vla_kernels::{parallel_for, stay_on_this_thread};

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

/// How often each task of a loop ran.
fn visits(threads: usize, tasks: usize) -> Vec<usize> {
    let visits: Vec<AtomicUsize> = (0..tasks).map(|_| AtomicUsize::new(0)).collect();
    parallel_for(threads, tasks, &|task| {
        visits[task].fetch_add(1, Ordering::Relaxed);
    });
    visits.into_iter().map(AtomicUsize::into_inner).collect()
}

#[test]
fn every_task_runs_once() {
    watch();
    for threads in [0, 1, 2, 3, 8, 33] {
        for tasks in [0, 1, 2, 3, 7, 100, 5000] {
            let counts = visits(threads, tasks);
            assert_eq!(counts, vec![1; tasks], "{threads} threads, {tasks} tasks");
        }
    }
}

#[test]
fn many_short_loops_in_a_row() {
    watch();
    for _ in 0..20_000 {
        assert_eq!(visits(2, 3), [1, 1, 1]);
    }
}

#[test]
fn many_callers_at_once() {
    watch();
    std::thread::scope(|scope| {
        for _ in 0..16 {
            scope.spawn(|| {
                for _ in 0..200 {
                    assert_eq!(visits(3, 17), vec![1; 17]);
                }
            });
        }
    });
}

/// The threads of a loop of two tasks, neither of which ends before the other has begun, unless one thread has both: a
/// busy machine only makes this longer.
fn threads_of_two_tasks(patience: Duration) -> HashSet<ThreadId> {
    let threads = Mutex::new(HashSet::new());
    let since = Instant::now();
    parallel_for(2, 2, &|_| {
        threads.lock().unwrap().insert(std::thread::current().id());
        while threads.lock().unwrap().len() < 2 && since.elapsed() < patience {
            std::thread::yield_now();
        }
    });
    threads.into_inner().unwrap()
}

/// Whether the loops of this thread run on it alone.
fn is_alone() -> bool {
    let threads = threads_of_two_tasks(Duration::from_millis(1));
    threads == HashSet::from([std::thread::current().id()])
}

#[test]
fn workers_that_slept_come_back() {
    watch();
    for _ in 0..20 {
        // Four times as long as a worker spins.
        std::thread::sleep(Duration::from_micros(200));
        assert_eq!(threads_of_two_tasks(Duration::from_secs(20)).len(), 2);
    }
}

#[test]
fn a_loop_within_a_task_runs_on_its_thread() {
    watch();
    parallel_for(2, 8, &|_| assert!(is_alone()));
}

#[test]
fn a_thread_stays_alone_until_its_last_guard_is_gone_also_after_errors() {
    watch();
    let two = || threads_of_two_tasks(Duration::from_secs(20)).len() == 2;
    let fails = || -> Result<(), ()> {
        let _alone = stay_on_this_thread();
        assert!(is_alone());
        Err(())
    };
    assert!(fails().is_err() && two());
    let panics = catch_unwind(|| {
        let _alone = stay_on_this_thread();
        std::panic::resume_unwind(Box::new("within"));
    });
    assert!(panics.is_err() && two());
    let (first, second) = (stay_on_this_thread(), stay_on_this_thread());
    drop(first);
    assert!(is_alone());
    drop(second);
    assert!(two());
}

#[test]
fn a_panic_reaches_the_caller_after_all_tasks_and_the_pool_lives_on() {
    watch();
    for threads in [2, 8] {
        let done = AtomicUsize::new(0);
        let outcome = catch_unwind(AssertUnwindSafe(|| {
            parallel_for(threads, 50, &|task| {
                assert_ne!(task, 20, "this one fails");
                done.fetch_add(1, Ordering::Relaxed);
            });
        }));
        let panic = outcome.unwrap_err();
        assert!(panic.downcast_ref::<String>().unwrap().contains("this one fails"));
        assert_eq!(done.into_inner(), 49);
        assert_eq!(visits(threads, 50), vec![1; 50]);
    }
}
