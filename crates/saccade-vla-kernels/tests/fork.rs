//! The pool after `fork`: a child has the memory of its parent, but none of the threads.
#![cfg(all(unix, not(saccade_portable)))]

use std::collections::HashSet;
use std::sync::Mutex;
use std::time::Duration;

use saccade_vla_kernels::parallel_for;

/// How many threads run tasks that take a while.
fn threads_at_work(threads: usize) -> usize {
    let seen = Mutex::new(HashSet::new());
    parallel_for(threads, 40, &|_| {
        seen.lock().unwrap().insert(std::thread::current().id());
        std::thread::sleep(Duration::from_millis(2));
    });
    seen.into_inner().unwrap().len()
}

/// Ends the process if it hangs, so that a child cannot outlive the test.
fn watch() {
    std::thread::spawn(|| {
        // Counted in short sleeps: of a while in which the process is stopped only one is lost.
        (0..600).for_each(|_| std::thread::sleep(Duration::from_millis(100)));
        // SAFETY: ends the process without running anything of the parent's.
        unsafe { libc::_exit(3) }
    });
}

fn child(work: impl Fn() -> bool) -> libc::pid_t {
    // SAFETY: the child uses the pool, the allocator (which glibc and macOS keep usable after fork) and `_exit`.
    let id = unsafe { libc::fork() };
    assert!(id >= 0, "fork failed");
    if id == 0 {
        watch();
        let code = if work() { 0 } else { 1 };
        // SAFETY: as above.
        unsafe { libc::_exit(code) }
    }
    id
}

fn wait(id: libc::pid_t) -> bool {
    let mut status = 0;
    // SAFETY: waits for a child of this process.
    let waited = unsafe { libc::waitpid(id, &raw mut status, 0) };
    waited == id && libc::WIFEXITED(status) && libc::WEXITSTATUS(status) == 0
}

#[test]
fn the_pool_works_in_children_and_grandchildren() {
    let before = child(|| threads_at_work(3) == 3);
    assert_eq!(threads_at_work(3), 3);
    let after = child(|| {
        let grandchild = child(|| threads_at_work(3) == 3);
        threads_at_work(3) == 3 && wait(grandchild)
    });
    assert_eq!(threads_at_work(4), 4);
    assert!(wait(before), "a child forked before the pool was used");
    assert!(wait(after), "a child forked after the pool was used");
}
