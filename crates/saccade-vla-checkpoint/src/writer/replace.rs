//! Giving a directory that was written its final name. Nothing is deleted before its replacement has that name.

use std::collections::BTreeSet;
use std::fs::File;
use std::io::{ErrorKind, Result as IoResult};
use std::path::{Path, PathBuf};

use super::temporary::{TemporaryDirectory, parent_of, unique};
use crate::companions::OWN_CONFIG;
use crate::ensure;
use crate::error::{Error, Result};
use crate::names::is_processor;

/// What a checkpoint may hold in addition to its weights and companions.
const OWN_FILES: [&str; 3] = ["config.json", "model.safetensors.index.json", OWN_CONFIG];

/// Checks whether something has the name `out`, and whether a checkpoint with these companions may replace it.
///
/// # Errors
/// [`Error::Input`] if it may not: `force` is not given, or something in it is no part of a checkpoint and would be lost.
pub(super) fn check_replaceable(out: &Path, companions: &BTreeSet<PathBuf>, force: bool) -> Result<bool> {
    let shown = out.display();
    let failed = |error| Error::writing(out, error);
    let metadata = match std::fs::metadata(out) {
        Err(error) if error.kind() == ErrorKind::NotFound && !out.is_symlink() => return Ok(false),
        Err(error) => return Err(failed(error)),
        Ok(metadata) => metadata,
    };
    ensure!(metadata.is_dir(), Input, "out"; "{shown} exists and is not a directory");
    let is_empty = std::fs::read_dir(out).map_err(failed)?.next().is_none();
    let mut folders = vec![PathBuf::new()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(out.join(&folder)).map_err(failed)? {
            let entry = entry.map_err(failed)?;
            let path = folder.join(entry.file_name());
            let kind = entry.file_type().map_err(failed)?;
            if kind.is_dir() && companions.iter().any(|file| file.starts_with(&path)) {
                folders.push(path);
                continue;
            }
            let name = path.to_string_lossy();
            let is_own = folder.as_os_str().is_empty()
                && (OWN_FILES.contains(&&*name) || name.ends_with(".safetensors") && !is_processor(&name));
            ensure!(
                kind.is_file() && (is_own || companions.contains(&path)), Input, "out";
                "{shown} holds {name}, which is no part of this checkpoint: choose another directory"
            );
        }
    }
    ensure!(is_empty || force, Input, "out"; "{shown} exists already; force replaces it");
    Ok(true)
}

/// What the file system does with names. Tests put other programs in between.
pub(super) trait FileSystem {
    /// Exchanges two directories in one step; false where the system cannot.
    fn exchange(&self, one: &Path, other: &Path) -> bool;

    fn rename(&self, from: &Path, to: &Path) -> IoResult<()>;
}

/// The file system as it is.
pub(super) struct Disk;

impl FileSystem for Disk {
    #[cfg(target_os = "linux")]
    fn exchange(&self, one: &Path, other: &Path) -> bool {
        use rustix::fs::{CWD, RenameFlags, renameat_with};
        renameat_with(CWD, one, CWD, other, RenameFlags::EXCHANGE).is_ok()
    }

    #[cfg(not(target_os = "linux"))]
    fn exchange(&self, _one: &Path, _other: &Path) -> bool {
        false
    }

    fn rename(&self, from: &Path, to: &Path) -> IoResult<()> {
        std::fs::rename(from, to)
    }
}

/// Gives the directory `new` the name `out`, which nothing should have.
///
/// # Errors
/// [`Error::Output`] where a file, or a directory with something in it, has taken the name in the meantime.
pub(super) fn place(disk: &impl FileSystem, mut new: TemporaryDirectory, out: &Path) -> Result<()> {
    disk.rename(new.path(), out)
        .map_err(|error| Error::writing(out, error))?;
    new.disarm();
    sync_names(out);
    Ok(())
}

/// Gives the directory `new` the name `out`. The directory that has this name is removed once that is done.
///
/// # Errors
/// [`Error::Output`] if that failed and the old directory still has its name; [`Error::Stranded`] if neither has it: then both are kept, under
/// names that nobody removes.
pub(super) fn replace(disk: &impl FileSystem, mut new: TemporaryDirectory, out: &Path) -> Result<()> {
    if disk.exchange(new.path(), out) {
        sync_names(out);
        // The old directory has the temporary name now, and is removed under it.
        return Ok(());
    }
    // Not a name that looks abandoned: if the process is killed here, this is the only checkpoint that is certain to be whole.
    let old = sibling(out, "old");
    match disk.rename(out, &old) {
        Ok(()) => {}
        Err(error) if error.kind() == ErrorKind::NotFound => return place(disk, new, out),
        Err(error) => return Err(Error::writing(out, error)),
    }
    let Err(error) = disk.rename(new.path(), out) else {
        new.disarm();
        sync_names(out);
        let _ = std::fs::remove_dir_all(&old);
        return Ok(());
    };
    if disk.rename(&old, out).is_ok() {
        return Err(Error::writing(out, error));
    }
    let kept = sibling(out, "new");
    let kept = match disk.rename(new.path(), &kept) {
        Ok(()) => kept,
        Err(_) => new.path().to_owned(),
    };
    new.disarm();
    Err(Error::Stranded {
        path: out.to_owned(),
        old,
        new: kept,
        source: error,
    })
}

/// A free name next to `out` that a user sees.
fn sibling(out: &Path, role: &str) -> PathBuf {
    let name = out.file_name().unwrap_or_default().to_string_lossy();
    loop {
        let path = parent_of(out).join(format!("{name}.{role}-{}", unique()));
        // To a link or a directory that is there, renaming would fail or replace it.
        if path.symlink_metadata().is_err() {
            return path;
        }
    }
}

/// Asks for the names in the directory of `out` to be on the disk, where the file system can be asked.
fn sync_names(out: &Path) {
    let parent = File::open(parent_of(out));
    let _ = parent.and_then(|directory| directory.sync_all());
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;
    use std::fs;

    use super::*;

    /// A file system that cannot exchange, in which something happens before the rename of this number.
    struct Raced<'a> {
        renames: Cell<usize>,
        before: usize,
        happens: &'a dyn Fn(),
    }

    impl FileSystem for Raced<'_> {
        fn exchange(&self, _: &Path, _: &Path) -> bool {
            false
        }

        fn rename(&self, from: &Path, to: &Path) -> IoResult<()> {
            if self.renames.get() == self.before {
                (self.happens)();
            }
            self.renames.set(self.renames.get() + 1);
            fs::rename(from, to)
        }
    }

    fn raced(before: usize, happens: &dyn Fn()) -> Raced<'_> {
        let renames = Cell::new(0);
        Raced {
            renames,
            before,
            happens,
        }
    }

    /// A directory with an `out` that holds `old`, and one to replace it that holds `new`.
    fn set_up() -> (PathBuf, PathBuf, TemporaryDirectory) {
        let parent = std::env::temp_dir().join(format!("saccade-replace-{}", unique()));
        let out = parent.join("out");
        fs::create_dir_all(&out).unwrap();
        fs::write(out.join("old"), "old").unwrap();
        let new = TemporaryDirectory::next_to(&out).unwrap();
        fs::write(new.path().join("new"), "new").unwrap();
        (parent, out, new)
    }

    fn names(parent: &Path) -> Vec<String> {
        let entries = fs::read_dir(parent).unwrap();
        let mut names: Vec<String> = entries
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        names.sort();
        names
    }

    fn take_name(out: &Path) {
        fs::create_dir(out).unwrap();
        fs::write(out.join("other"), "other").unwrap();
    }

    #[test]
    fn with_and_without_exchange_the_new_one_has_the_name() {
        for exchanges in [true, false] {
            let (parent, out, new) = set_up();
            match exchanges {
                true => replace(&Disk, new, &out).unwrap(),
                false => replace(&raced(usize::MAX, &|| {}), new, &out).unwrap(),
            }
            assert_eq!(names(&parent), ["out"]);
            assert_eq!(names(&out), ["new"]);
            fs::remove_dir_all(parent).unwrap();
        }
    }

    #[test]
    fn both_are_kept_where_something_takes_the_name_in_between() {
        let (parent, out, new) = set_up();
        let happens = || take_name(&out);
        let error = replace(&raced(1, &happens), new, &out).unwrap_err();
        let Error::Stranded { old, new, .. } = &error else {
            panic!("{error}");
        };
        assert_eq!(fs::read_to_string(old.join("old")).unwrap(), "old");
        assert_eq!(fs::read_to_string(new.join("new")).unwrap(), "new");
        assert_eq!(fs::read_to_string(out.join("other")).unwrap(), "other");
        let message = error.to_string();
        for path in [&out, old, new] {
            assert!(message.contains(&*path.to_string_lossy()), "{message}");
        }
        // Names that the next writer takes for abandoned begin with a dot.
        assert!(names(&parent).iter().all(|name| name.starts_with("out")));
        fs::remove_dir_all(parent).unwrap();
    }

    #[test]
    fn the_old_one_gets_its_name_back() {
        let (parent, out, new) = set_up();
        // What is to be renamed is not there any more.
        let path = new.path().to_owned();
        let happens = || fs::remove_dir_all(&path).unwrap();
        let error = replace(&raced(1, &happens), new, &out).unwrap_err();
        assert!(matches!(error, Error::Output { .. }), "{error}");
        assert_eq!(names(&parent), ["out"]);
        assert_eq!(names(&out), ["old"]);
        fs::remove_dir_all(parent).unwrap();
    }

    #[test]
    fn a_name_that_became_free_is_taken() {
        let (parent, out, new) = set_up();
        let happens = || fs::rename(&out, parent.join("moved")).unwrap();
        replace(&raced(0, &happens), new, &out).unwrap();
        assert_eq!(names(&out), ["new"]);
        assert_eq!(names(&parent), ["moved", "out"]);
        fs::remove_dir_all(parent).unwrap();
    }

    #[test]
    fn a_name_that_is_taken_is_left_alone() {
        let (parent, _, new) = set_up();
        let other = parent.join("other");
        take_name(&other);
        let error = place(&Disk, new, &other).unwrap_err();
        assert!(matches!(error, Error::Output { .. }), "{error}");
        assert_eq!(names(&other), ["other"]);
        assert_eq!(names(&parent), ["other", "out"]);
        fs::remove_dir_all(parent).unwrap();
    }
}
