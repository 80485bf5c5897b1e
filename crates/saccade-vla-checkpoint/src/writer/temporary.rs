//! Directories that a checkpoint is written to before it gets its name.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use crate::error::{Error, Problem, Result};

/// Numbers the names that this process has used, so that none is used twice.
static COUNTER: AtomicU64 = AtomicU64::new(0);

/// A process number and a number that no other call in this process gets.
pub(super) fn unique() -> String {
    format!(
        "{}.{}",
        std::process::id(),
        COUNTER.fetch_add(1, Ordering::Relaxed)
    )
}

/// A directory with a unique name. Dropped, it is removed with all that is in it.
pub(super) struct TemporaryDirectory {
    path: PathBuf,
    /// Whether it is there under its own name, to be removed.
    is_armed: bool,
    /// Locked as long as somebody writes to it.
    _lock: Option<File>,
}

/// A directory that nobody has locked and that is older was left by a program that was killed; a younger one may be about to be locked.
const ABANDONED_AFTER: Duration = Duration::from_secs(60);

impl TemporaryDirectory {
    /// In the directory of `out`, so that renaming needs no copy.
    pub(super) fn next_to(out: &Path) -> Result<Self> {
        let name = out.file_name().ok_or_else(|| {
            Error::Input(Problem::expected("out", "the name of a directory", out.display()))
        })?;
        let parent = parent_of(out);
        std::fs::create_dir_all(parent).map_err(|error| Error::writing(parent, error))?;
        let start = format!(".{}.saccade-", name.to_string_lossy());
        remove_abandoned(parent, &start);
        loop {
            let path = parent.join(format!("{start}{}", unique()));
            match std::fs::create_dir(&path) {
                Ok(()) => {
                    let lock = File::open(&path).ok().filter(|file| file.try_lock().is_ok());
                    return Ok(Self {
                        path,
                        is_armed: true,
                        _lock: lock,
                    });
                }
                // A process with the same number left it, in another container or before a restart.
                Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => {}
                Err(error) => return Err(Error::writing(&path, error)),
            }
        }
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    /// Leaves what has this name alone: the directory has another name now, or is to be kept.
    pub(super) fn disarm(&mut self) {
        self.is_armed = false;
    }
}

impl Drop for TemporaryDirectory {
    fn drop(&mut self) {
        if self.is_armed {
            let _ = std::fs::remove_dir_all(&self.path);
        }
    }
}

/// Removes what programs that were killed left in `parent` under names that begin with `start`, as far as it can be removed.
fn remove_abandoned(parent: &Path, start: &str) {
    let Ok(entries) = std::fs::read_dir(parent) else {
        return;
    };
    for entry in entries.flatten() {
        let is_old = || {
            let modified = entry.metadata().and_then(|metadata| metadata.modified());
            modified.is_ok_and(|time| time.elapsed().is_ok_and(|age| age > ABANDONED_AFTER))
        };
        let is_directory = || entry.file_type().is_ok_and(|kind| kind.is_dir());
        let is_unlocked = || File::open(entry.path()).is_ok_and(|file| file.try_lock().is_ok());
        let is_ours = entry.file_name().to_string_lossy().starts_with(start);
        if is_ours && is_directory() && is_old() && is_unlocked() {
            let _ = std::fs::remove_dir_all(entry.path());
        }
    }
}

/// The directory that `path` is in.
pub(super) fn parent_of(path: &Path) -> &Path {
    match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        Some(_) => Path::new("."),
        None => path,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_writer_that_is_done_takes_nothing_from_the_next() {
        let parent = std::env::temp_dir().join(format!("saccade-temporary-{}", unique()));
        let out = parent.join("out");
        let mut first = TemporaryDirectory::next_to(&out).unwrap();
        std::fs::rename(first.path(), &out).unwrap();
        // The name is free, and the next writer begins before the first one is dropped.
        let second = TemporaryDirectory::next_to(&out).unwrap();
        assert_ne!(first.path(), second.path());
        first.disarm();
        drop(first);
        assert!(second.path().is_dir());
        assert!(out.is_dir());
        let path = second.path().to_owned();
        drop(second);
        assert!(!path.exists());
        std::fs::remove_dir_all(parent).unwrap();
    }
}
