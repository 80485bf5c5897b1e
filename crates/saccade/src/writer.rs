//! Writing checkpoints: `config.json` and one or more `.safetensors`, tensor by tensor, all of them or nothing.
//!
//! Everything goes to a directory beside the wanted one, which takes its name at the end. Whoever looks finds what was there before, or
//! a whole checkpoint; a program that is killed leaves at most a directory whose name begins with a dot, which the next one to write under
//! that name removes. Linux exchanges the two directories in one step; elsewhere, and on file systems that cannot, there is a moment
//! between two renames in which neither has the name.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::time::Duration;

use safetensors::Dtype;
use safetensors::tensor::TensorInfo;

use crate::companions::{Companions, is_processor};
use crate::error::{Error, Result};

/// A tensor to be written.
pub(crate) struct Planned {
    pub name: String,
    pub dtype: Dtype,
    pub shape: Vec<usize>,
}

impl Planned {
    pub(crate) fn nbytes(&self) -> usize {
        self.shape.iter().product::<usize>() * self.dtype.bitsize() / 8
    }
}

/// Where a tensor's bytes go.
struct Place {
    shard: usize,
    start: u64,
    nbytes: u64,
    written: u64,
}

/// A checkpoint that is being written; dropped before [`CheckpointWriter::finish`], it leaves nothing.
pub(crate) struct CheckpointWriter {
    out: PathBuf,
    /// Whether something has that name already, which the checkpoint may replace.
    replaces: bool,
    force: bool,
    companions: BTreeSet<PathBuf>,
    temporary: TemporaryDirectory,
    shards: Vec<(String, File)>,
    places: BTreeMap<String, Place>,
}

impl CheckpointWriter {
    /// Prepares `out` for the `planned` tensors, in files of at most `max_shard_bytes` unless one tensor is larger, and writes `companions`.
    ///
    /// # Errors
    /// [`Error::Input`] if `out` is there and `force` is not given, or `out` holds anything but a checkpoint; [`Error::Output`] if it
    /// cannot be written.
    pub(crate) fn create(
        out: &Path,
        mut planned: Vec<Planned>,
        metadata: &BTreeMap<String, String>,
        companions: &Companions,
        max_shard_bytes: u64,
        force: bool,
    ) -> Result<Self> {
        // Behind a link, what it leads to is replaced and not the link.
        let out = &out.canonicalize().unwrap_or_else(|_| out.to_owned());
        let carried = companions.all_paths();
        let replaces = check_replaceable(out, &carried, force)?;
        let temporary = TemporaryDirectory::beside(out)?;
        // Wide elements first, as the format's own writer does: each tensor then lies at a multiple of its element.
        planned.sort_by(|a, b| (b.dtype.bitsize(), &a.name).cmp(&(a.dtype.bitsize(), &b.name)));
        let mut sharded: Vec<Vec<Planned>> = vec![Vec::new()];
        let mut held = 0;
        for tensor in planned {
            let nbytes = tensor.nbytes() as u64;
            if held > 0 && held + nbytes > max_shard_bytes {
                sharded.push(Vec::new());
                held = 0;
            }
            held += nbytes;
            sharded.last_mut().expect("there is at least one").push(tensor);
        }
        let mut writer = Self {
            out: out.to_owned(),
            replaces,
            force,
            companions: carried,
            temporary,
            shards: Vec::new(),
            places: BTreeMap::new(),
        };
        let count = sharded.len();
        for (index, tensors) in sharded.into_iter().enumerate() {
            let name = match count {
                1 => "model.safetensors".to_owned(),
                _ => format!("model-{:05}-of-{count:05}.safetensors", index + 1),
            };
            writer.add_shard(name, tensors, metadata)?;
        }
        if count > 1 {
            writer.write_index()?;
        }
        companions.copy_to(&writer.temporary.path)?;
        Ok(writer)
    }

    fn add_shard(
        &mut self,
        name: String,
        tensors: Vec<Planned>,
        metadata: &BTreeMap<String, String>,
    ) -> Result<()> {
        let shard = self.shards.len();
        let mut header = serde_json::Map::new();
        if !metadata.is_empty() {
            header.insert("__metadata__".to_owned(), serde_json::json!(metadata));
        }
        let (mut offset, mut offsets) = (0, Vec::new());
        for tensor in tensors {
            let end = offset + tensor.nbytes();
            let info = TensorInfo {
                dtype: tensor.dtype,
                shape: tensor.shape,
                data_offsets: (offset, end),
            };
            header.insert(tensor.name.clone(), serde_json::json!(info));
            offsets.push((tensor.name, offset as u64, (end - offset) as u64));
            offset = end;
        }
        let mut header = serde_json::Value::Object(header).to_string();
        // The data begins at a multiple of 8.
        header.push_str(&" ".repeat(header.len().next_multiple_of(8) - header.len()));
        let data = 8 + header.len() as u64;
        for (name, start, nbytes) in offsets {
            let place = Place {
                shard,
                start: data + start,
                nbytes,
                written: 0,
            };
            self.places.insert(name, place);
        }
        let path = self.temporary.path.join(&name);
        let write = || {
            let mut file = File::create_new(&path)?;
            file.write_all(&(header.len() as u64).to_le_bytes())?;
            file.write_all(header.as_bytes())?;
            file.set_len(data + offset as u64)?;
            Ok(file)
        };
        let file = write().map_err(|error| failed(&path, &error))?;
        self.shards.push((name, file));
        Ok(())
    }

    fn write_index(&self) -> Result<()> {
        let total: u64 = self.places.values().map(|place| place.nbytes).sum();
        let map: BTreeMap<&str, &str> = self
            .places
            .iter()
            .map(|(name, place)| (name.as_str(), self.shards[place.shard].0.as_str()))
            .collect();
        let index = serde_json::json!({ "metadata": { "total_size": total }, "weight_map": map });
        self.file("model.safetensors.index.json", &format!("{index:#}\n"))
    }

    /// Writes a small file beside the tensors.
    pub(crate) fn file(&self, name: &str, contents: &str) -> Result<()> {
        let path = self.temporary.path.join(name);
        let write = || {
            let mut file = File::create_new(&path)?;
            file.write_all(contents.as_bytes())?;
            file.sync_all()
        };
        write().map_err(|error| failed(&path, &error))
    }

    /// Writes the next bytes of tensor `name`, one of the planned; tensors may come in any order.
    pub(crate) fn tensor(&mut self, name: &str, bytes: &[u8]) -> Result<()> {
        let place = self.places.get_mut(name).expect("the tensor was planned");
        let (shard, file) = &mut self.shards[place.shard];
        let first = place.written;
        place.written += bytes.len() as u64;
        assert!(
            place.written <= place.nbytes,
            "{name}: more bytes than were planned"
        );
        file.seek(SeekFrom::Start(place.start + first))
            .and_then(|_| file.write_all(bytes))
            .map_err(|error| failed(&self.temporary.path.join(shard), &error))
    }

    /// Leaves the next `nbytes` bytes of tensor `name` zero: a hole in the file, where the file system has such.
    pub(crate) fn zeros(&mut self, name: &str, nbytes: u64) {
        let place = self.places.get_mut(name).expect("the tensor was planned");
        place.written += nbytes;
        assert!(
            place.written <= place.nbytes,
            "{name}: more bytes than were planned"
        );
    }

    /// Gives the checkpoint its name; returns those of the files with tensors.
    ///
    /// # Errors
    /// [`Error::Output`] if the disk is full or the name cannot be given; what was there is then there still.
    pub(crate) fn finish(self) -> Result<Vec<String>> {
        assert!(
            self.places.values().all(|place| place.written == place.nbytes),
            "all planned tensors are written"
        );
        for (name, file) in &self.shards {
            file.sync_all()
                .map_err(|error| failed(&self.temporary.path.join(name), &error))?;
        }
        let files = self.shards.iter().map(|(name, _)| name.clone()).collect();
        if self.replaces {
            // It may hold more by now.
            check_replaceable(&self.out, &self.companions, self.force)?;
            replace(&self.temporary.path, &self.out)?;
        } else {
            // Fails where a directory with something in it has taken the name in the meantime.
            rename(&self.temporary.path, &self.out)?;
        }
        // A system that crashes now finds the new name, where its file system can be told to make sure.
        let parent = File::open(parent_of(&self.out));
        let _ = parent.and_then(|directory| directory.sync_all());
        Ok(files)
    }
}

fn rename(from: &Path, to: &Path) -> Result<()> {
    std::fs::rename(from, to).map_err(|error| failed(to, &error))
}

/// Gives the directory `new` the name `out`, whose directory is removed.
fn replace(new: &Path, out: &Path) -> Result<()> {
    if exchange(new, out) {
        // What was there has the temporary name now, and is removed under it.
        return Ok(());
    }
    let replaced = TemporaryDirectory::beside(out)?;
    let old = replaced.path.join("replaced");
    rename(out, &old)?;
    rename(new, out).inspect_err(|_| {
        // As it was; the first error is the one to tell.
        let _ = std::fs::rename(&old, out);
    })
}

/// Exchanges two directories in one step; false where the system cannot.
#[cfg(target_os = "linux")]
fn exchange(new: &Path, out: &Path) -> bool {
    use rustix::fs::{CWD, RenameFlags, renameat_with};
    renameat_with(CWD, new, CWD, out, RenameFlags::EXCHANGE).is_ok()
}

/// Exchanges two directories in one step; false where the system cannot.
#[cfg(not(target_os = "linux"))]
fn exchange(_new: &Path, _out: &Path) -> bool {
    false
}

/// Whether something has the name `out`, which a checkpoint with these files beside its weights may then replace.
///
/// # Errors
/// [`Error::Input`] if it may not: `force` is not given, or something there is no part of a checkpoint and would be lost.
fn check_replaceable(out: &Path, companions: &BTreeSet<PathBuf>, force: bool) -> Result<bool> {
    let shown = out.display();
    let metadata = match std::fs::metadata(out) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound && !out.is_symlink() => return Ok(false),
        Err(error) => return Err(failed(out, &error)),
        Ok(metadata) => metadata,
    };
    if !metadata.is_dir() {
        return Err(Error::Input(format!("out: {shown} is there and is no directory")));
    }
    let is_empty = std::fs::read_dir(out)
        .map_err(|error| failed(out, &error))?
        .next()
        .is_none();
    let mut folders = vec![PathBuf::new()];
    while let Some(folder) = folders.pop() {
        let entries = std::fs::read_dir(out.join(&folder)).map_err(|error| failed(out, &error))?;
        for entry in entries {
            let entry = entry.map_err(|error| failed(out, &error))?;
            let path = folder.join(entry.file_name());
            let kind = entry.file_type().map_err(|error| failed(out, &error))?;
            if kind.is_dir() && companions.iter().any(|file| file.starts_with(&path)) {
                folders.push(path);
                continue;
            }
            let name = path.to_string_lossy();
            let is_own = folder.as_os_str().is_empty()
                && (OWN_FILES.contains(&&*name) || name.ends_with(".safetensors") && !is_processor(&name));
            if !(kind.is_file() && (is_own || companions.contains(&path))) {
                return Err(Error::Input(format!(
                    "out: {shown} holds {name}, which is no part of this checkpoint: choose another directory"
                )));
            }
        }
    }
    if is_empty || force {
        return Ok(true);
    }
    Err(Error::Input(format!(
        "out: {shown} is there already; force replaces it"
    )))
}

/// What a checkpoint may hold beside its weights and companions.
const OWN_FILES: [&str; 3] = ["config.json", "model.safetensors.index.json", OWN_CONFIG];

/// What of a config is saccade's own, for layouts whose `config.json` takes no other keys.
pub(crate) const OWN_CONFIG: &str = "saccade.json";

/// A directory with a name of its own, removed with all that is in it.
struct TemporaryDirectory {
    path: PathBuf,
    /// Locked as long as somebody writes to it.
    _lock: Option<File>,
}

/// A directory that nobody has locked and that is older was left by a program that was killed; a younger one may be about to be locked.
const ABANDONED_AFTER: Duration = Duration::from_secs(60);

impl TemporaryDirectory {
    /// In the directory of `out`, so that renaming needs no copy.
    fn beside(out: &Path) -> Result<Self> {
        let name = out.file_name().ok_or_else(|| {
            Error::Input(format!(
                "out: expected the name of a directory, got {}",
                out.display()
            ))
        })?;
        let parent = parent_of(out);
        std::fs::create_dir_all(parent).map_err(|error| failed(parent, &error))?;
        let start = format!(".{}.saccade-", name.to_string_lossy());
        remove_abandoned(parent, &start);
        for attempt in 0.. {
            let path = parent.join(format!("{start}{}.{attempt}", std::process::id()));
            match std::fs::create_dir(&path) {
                Ok(()) => {
                    let lock = File::open(&path).ok().filter(|file| file.try_lock().is_ok());
                    return Ok(Self { path, _lock: lock });
                }
                Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => {}
                Err(error) => return Err(failed(&path, &error)),
            }
        }
        unreachable!("some number is free")
    }
}

impl Drop for TemporaryDirectory {
    fn drop(&mut self) {
        // After `finish` there is none under this name, or what was replaced.
        let _ = std::fs::remove_dir_all(&self.path);
    }
}

/// Removes what programs that were killed left in `parent` under names that begin with `start`, as far as it can be.
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
fn parent_of(path: &Path) -> &Path {
    match path.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        Some(_) => Path::new("."),
        None => path,
    }
}

pub(crate) fn failed(path: &Path, error: &std::io::Error) -> Error {
    Error::Output(format!("out: {} cannot be written: {error}", path.display()))
}
