//! A thread on a slow core, as hybrid CPUs have them: it gets fewer tasks, and none of the last ones, so that nobody waits for it.
//!
//! Slowness is counted in tasks and not in time, so that a busy machine changes nothing. The only test of its program: others would take
//! the worker away from it.

use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use saccade_kernels::parallel_for;

/// Tasks that the caller begins while the worker does one.
const FACTOR: usize = 9;

/// Waits until `count` is `wanted`. After a minute, which only a pool that hangs or splits in halves can take, the test fails.
fn wait_for(count: &AtomicUsize, wanted: usize) {
    let since = Instant::now();
    while count.load(Ordering::SeqCst) < wanted {
        assert!(
            since.elapsed() < Duration::from_secs(60),
            "waits for {wanted} tasks"
        );
        std::thread::yield_now();
    }
}

/// The tasks of a slow worker, in a loop of `tasks` on two threads.
fn tasks_of_slow_worker(tasks: usize) -> Vec<usize> {
    let caller = std::thread::current().id();
    let begun = AtomicUsize::new(0);
    let of_worker = Mutex::new(Vec::new());
    parallel_for(2, tasks, &|task| {
        let before = begun.fetch_add(1, Ordering::SeqCst);
        if std::thread::current().id() != caller {
            of_worker.lock().unwrap().push(task);
            wait_for(&begun, tasks.min(before + 1 + FACTOR));
        } else if before == 0 {
            // A worker that comes late is not a slow one.
            wait_for(&begun, 2);
        }
    });
    assert_eq!(begun.into_inner(), tasks);
    of_worker.into_inner().unwrap()
}

#[test]
fn nobody_waits_for_a_slow_core() {
    for tasks in [20, 200, 5000] {
        let of_worker = tasks_of_slow_worker(tasks);
        // A fair share would be half of them.
        assert!(
            of_worker.len() <= tasks.div_ceil(FACTOR + 1),
            "{} of {tasks}",
            of_worker.len()
        );
        // The caller does the last ones in the time in which the worker does one.
        let last = of_worker.last().unwrap();
        assert!(last + FACTOR - 2 <= tasks, "task {last} of {tasks}");
    }
}
