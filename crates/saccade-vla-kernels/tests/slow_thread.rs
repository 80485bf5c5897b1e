//! A thread on a slow core, as hybrid CPUs have them: it gets fewer tasks. A worker gets none of the last ones, so that nobody waits for it. A
//! caller takes tasks to the end, because workers may leave or never come: at most one of the last ones is its own.
//!
//! Slowness is counted in tasks and not in time, so that a busy machine changes nothing. The only tests of their program, and one at a time:
//! others would take the worker away from them.

use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use saccade_vla_kernels::parallel_for;

/// Tasks that the other thread begins while the slow one does one.
const FACTOR: usize = 9;

/// Held by the test that runs.
static TURN: Mutex<()> = Mutex::new(());

#[derive(Clone, Copy, PartialEq)]
enum Thread {
    Caller,
    Worker,
}

/// Waits until `count` is `wanted`. A minute after `since`, which only a pool that hangs or splits in halves can take, the test fails.
fn wait_for(count: &AtomicUsize, wanted: usize, since: Instant) {
    while count.load(Ordering::SeqCst) < wanted {
        assert!(
            since.elapsed() < Duration::from_secs(60),
            "waits for {wanted} tasks"
        );
        std::thread::yield_now();
    }
}

/// The tasks of the `slow` one of two threads, in a loop of `tasks`.
fn tasks_of(slow: Thread, tasks: usize) -> Vec<usize> {
    let caller = std::thread::current().id();
    let since = Instant::now();
    let begun = AtomicUsize::new(0);
    let of_slow = Mutex::new(Vec::new());
    parallel_for(2, tasks, &|task| {
        let this = if std::thread::current().id() == caller {
            Thread::Caller
        } else {
            Thread::Worker
        };
        let before = begun.fetch_add(1, Ordering::SeqCst);
        if this == slow {
            of_slow.lock().unwrap().push(task);
            wait_for(&begun, tasks.min(before + 1 + FACTOR), since);
        } else if before == 0 {
            // A thread that comes late is not a slow one.
            wait_for(&begun, 2, since);
        }
    });
    assert_eq!(begun.into_inner(), tasks);
    of_slow.into_inner().unwrap()
}

/// The same, where it is as many as its pace allows at most. A fair share would be half of them.
fn few_tasks_of(slow: Thread, tasks: usize) -> Vec<usize> {
    let of_slow = tasks_of(slow, tasks);
    assert!(
        of_slow.len() <= tasks.div_ceil(FACTOR + 1),
        "{} of {tasks}",
        of_slow.len()
    );
    of_slow
}

#[test]
fn nobody_waits_for_a_slow_core() {
    let _turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
    for tasks in [20, 200, 5000] {
        let of_worker = few_tasks_of(Thread::Worker, tasks);
        // The caller does the last ones in the time in which the worker does one.
        let last = of_worker.last().unwrap();
        assert!(last + FACTOR - 2 <= tasks, "task {last} of {tasks}");
    }
}

#[test]
fn a_slow_caller_leaves_most_tasks_to_the_worker() {
    let _turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
    for tasks in [20, 200, 5000] {
        let of_caller = few_tasks_of(Thread::Caller, tasks);
        // The worker does not leave before the end, so it waits for one task of the caller and no more.
        let last_ones = of_caller.iter().filter(|&task| task + FACTOR > tasks);
        assert!(last_ones.count() <= 1, "{of_caller:?} of {tasks}");
    }
}
