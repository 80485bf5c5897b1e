//! Files that are read: regular ones only, by position, and unchanged since they were opened.

use std::fs::{File, Metadata};
use std::io::{Error as IoError, Read, Result as IoResult};
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use crate::bail;
use crate::error::{Error, Result};
use crate::lfs::pointer_problem;

/// A longer header, index or config is hostile: the released head has 314 tensors in 40 kB.
pub(crate) const MAX_TEXT_BYTES: u64 = 100_000_000;

/// A file that is open. Reading moves no cursor, so that threads can share it.
pub(crate) struct SourceFile {
    pub path: PathBuf,
    file: File,
    /// What it was when it was opened.
    stamp: Stamp,
}

/// What changes when a file is written to.
#[derive(PartialEq)]
struct Stamp {
    length: u64,
    /// None where the system does not say.
    modified: Option<SystemTime>,
}

impl Stamp {
    fn of(file: &File) -> IoResult<Self> {
        let metadata = file.metadata()?;
        Ok(Self {
            length: metadata.len(),
            modified: metadata.modified().ok(),
        })
    }
}

impl SourceFile {
    pub(crate) fn open(path: &Path) -> IoResult<Self> {
        let file = open_regular(path)?;
        Ok(Self {
            path: path.to_owned(),
            stamp: Stamp::of(&file)?,
            file,
        })
    }

    /// Bytes in the file.
    pub(crate) fn length(&self) -> u64 {
        self.stamp.length
    }

    /// Fills `bytes` from the file, beginning with byte `start`.
    ///
    /// # Errors
    /// If the file ends before, cannot be read, or is not what it was when it was opened.
    pub(crate) fn read_at(&self, bytes: &mut [u8], start: u64) -> IoResult<()> {
        read_exact_at(&self.file, bytes, start)?;
        // Half of one file and half of another must not become a model.
        if Stamp::of(&self.file)? != self.stamp {
            return Err(IoError::other("it changed while it was read"));
        }
        Ok(())
    }
}

#[cfg(unix)]
fn read_exact_at(file: &File, bytes: &mut [u8], start: u64) -> IoResult<()> {
    std::os::unix::fs::FileExt::read_exact_at(file, bytes, start)
}

#[cfg(windows)]
fn read_exact_at(file: &File, mut bytes: &mut [u8], mut start: u64) -> IoResult<()> {
    use std::io::ErrorKind;
    use std::os::windows::fs::FileExt;
    while !bytes.is_empty() {
        match file.seek_read(bytes, start) {
            Ok(0) => {
                return Err(IoError::new(
                    ErrorKind::UnexpectedEof,
                    "failed to fill whole buffer",
                ));
            }
            Ok(count) => {
                bytes = &mut bytes[count..];
                start += count as u64;
            }
            Err(error) if error.kind() == ErrorKind::Interrupted => {}
            Err(error) => return Err(error),
        }
    }
    Ok(())
}

/// Opens a file that may be read to its end: opening a pipe would wait for somebody to write to it, and a device has no end.
pub(crate) fn open_regular(path: &Path) -> IoResult<File> {
    let is_file = |metadata: IoResult<Metadata>| match metadata?.is_file() {
        true => Ok(()),
        false => Err(IoError::other("not a regular file")),
    };
    is_file(std::fs::metadata(path))?;
    let file = File::open(path)?;
    is_file(file.metadata())?;
    Ok(file)
}

/// The text of the file `path`, an index or a config, which errors call `what`.
///
/// # Errors
/// [`Error::NotFound`] if it is not there; [`Error::Unreadable`] if it is no regular file, not UTF-8, or larger than 100 MB;
/// [`Error::Checkpoint`] if it is a Git LFS pointer.
pub fn read_text(what: &'static str, path: &Path) -> Result<String> {
    let read = || {
        let mut text = String::new();
        // One byte more than is allowed shows that there are more.
        open_regular(path)?
            .take(MAX_TEXT_BYTES + 1)
            .read_to_string(&mut text)?;
        if text.len() as u64 > MAX_TEXT_BYTES {
            let problem = format!("more than {MAX_TEXT_BYTES} bytes");
            return Err(IoError::other(problem));
        }
        Ok(text)
    };
    let text = read().map_err(|error| Error::reading(what, path, error))?;
    match pointer_problem(path, text.as_bytes()) {
        None => Ok(text),
        Some(problem) => bail!(Checkpoint, what; "{}: {problem}", path.display()),
    }
}
