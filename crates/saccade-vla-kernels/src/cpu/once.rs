//! A value that is made once, without a lock: a fork while another thread makes it leaves the child nothing to wait for.

use std::ptr;
use std::sync::atomic::{AtomicPtr, Ordering};

/// Empty at first; what is stored stays for the life of the process.
pub(super) struct Once<T>(AtomicPtr<T>);

impl<T: Send + Sync + 'static> Once<T> {
    pub(super) const fn new() -> Self {
        Self(AtomicPtr::new(ptr::null_mut()))
    }

    /// The value. Threads that come before there is one each make their own, and all get the one that was stored first.
    pub(super) fn get_or_make(&'static self, make: impl FnOnce() -> T) -> &'static T {
        // SAFETY: what is stored came from a box, and is never changed or freed.
        if let Some(held) = unsafe { self.0.load(Ordering::Acquire).as_ref() } {
            return held;
        }
        let made = Box::into_raw(Box::new(make()));
        let stored = self
            .0
            .compare_exchange(ptr::null_mut(), made, Ordering::AcqRel, Ordering::Acquire);
        match stored {
            // SAFETY: as above.
            Ok(_) => unsafe { &*made },
            Err(first) => {
                // SAFETY: nobody else has seen the box.
                drop(unsafe { Box::from_raw(made) });
                // SAFETY: as above.
                unsafe { &*first }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc;

    use super::*;

    /// Nobody waits for a thread that is making the value: after a fork it might not be there.
    #[test]
    fn nobody_waits_for_another_thread() {
        static ONCE: Once<i32> = Once::new();
        let (begin, begun) = mpsc::channel();
        let (end, ended) = mpsc::channel();
        let slow = std::thread::spawn(move || {
            *ONCE.get_or_make(|| {
                begin.send(()).unwrap();
                ended.recv().unwrap();
                1
            })
        });
        begun.recv().unwrap();
        assert_eq!(*ONCE.get_or_make(|| 2), 2);
        end.send(()).unwrap();
        assert_eq!(slow.join().unwrap(), 2);
        assert_eq!(*ONCE.get_or_make(|| 3), 2);
    }
}
