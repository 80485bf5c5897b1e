//! A bounded cache of things that are cheap to hold and costly to compute again.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex};

use crate::error::Result;

/// The values last used, at most `capacity` of them.
pub(crate) struct Cache<K, V> {
    entries: Mutex<VecDeque<(K, Arc<V>)>>,
    capacity: usize,
}

impl<K: Eq, V> Cache<K, V> {
    pub(crate) fn new(capacity: usize) -> Self {
        Self {
            entries: Mutex::new(VecDeque::with_capacity(capacity)),
            capacity,
        }
    }

    /// The value of `key`, computed if it is not there. A computation that fails leaves nothing.
    ///
    /// The lock is never waited for, nor held while computing: a thread that finds it taken computes for
    /// itself. So callers never stop each other, and a fork that copies a taken lock leaves the child slower,
    /// not stuck.
    pub(crate) fn get_or_insert(&self, key: K, compute: impl FnOnce() -> Result<V>) -> Result<Arc<V>> {
        if let Ok(mut entries) = self.entries.try_lock()
            && let Some(position) = entries.iter().position(|(known, _)| *known == key)
        {
            let entry = entries.remove(position).expect("the position was just found");
            let value = Arc::clone(&entry.1);
            entries.push_back(entry);
            return Ok(value);
        }
        let value = Arc::new(compute()?);
        if let Ok(mut entries) = self.entries.try_lock()
            && entries.iter().all(|(known, _)| *known != key)
        {
            if entries.len() == self.capacity {
                entries.pop_front();
            }
            entries.push_back((key, Arc::clone(&value)));
        }
        Ok(value)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::error::Error;

    #[test]
    fn keeps_what_was_used_last_and_no_more_than_its_capacity() {
        let cache = Cache::new(2);
        let mut computed = Vec::new();
        for key in [1, 2, 1, 3, 1, 2] {
            let value = cache.get_or_insert(key, || {
                computed.push(key);
                Ok(10 * key)
            });
            assert_eq!(*value.unwrap(), 10 * key);
        }
        assert_eq!(
            computed,
            [1, 2, 3, 2],
            "2 was the one not used for longest when 3 came"
        );
    }

    #[test]
    fn what_failed_is_not_kept() {
        let cache = Cache::new(2);
        assert!(cache.get_or_insert(1, || Err(Error::Interrupted)).is_err());
        assert_eq!(*cache.get_or_insert(1, || Ok(7)).unwrap(), 7);
    }
}
