//! Writing checkpoints: `config.json` and one or more `.safetensors`, tensor by tensor, all of them or nothing.
//!
//! Everything goes to a directory beside the wanted one, which takes its name at the end. Whoever looks finds what was there before, or
//! a whole checkpoint; a program that is killed leaves at most a directory whose name begins with a dot.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use safetensors::Dtype;
use safetensors::tensor::TensorInfo;

use crate::error::{Error, Result};

/// A tensor to be written.
pub(crate) struct Planned {
    pub name: String,
    pub dtype: Dtype,
    pub shape: Vec<usize>,
}

impl Planned {
    fn nbytes(&self) -> usize {
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
    temporary: TemporaryDirectory,
    shards: Vec<(String, File)>,
    places: BTreeMap<String, Place>,
}

impl CheckpointWriter {
    /// Prepares `out` for the `planned` tensors, in files of at most `max_shard_bytes` unless one tensor is larger.
    ///
    /// # Errors
    /// [`Error::Input`] if `out` is there and `force` is not given, or `out` holds anything but a checkpoint; [`Error::Output`] if it
    /// cannot be written.
    pub(crate) fn create(
        out: &Path,
        mut planned: Vec<Planned>,
        metadata: &BTreeMap<String, String>,
        max_shard_bytes: u64,
        force: bool,
    ) -> Result<Self> {
        check_replaceable(out, force)?;
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

    /// Gives the checkpoint its name.
    ///
    /// # Errors
    /// [`Error::Output`] if the disk is full or the name cannot be given; what was there is then there still.
    pub(crate) fn finish(self) -> Result<Vec<PathBuf>> {
        assert!(
            self.places.values().all(|place| place.written == place.nbytes),
            "all planned tensors are written"
        );
        for (name, file) in &self.shards {
            file.sync_all()
                .map_err(|error| failed(&self.temporary.path.join(name), &error))?;
        }
        let rename = |from: &Path, to: &Path| std::fs::rename(from, to).map_err(|error| failed(to, &error));
        if self.out.exists() {
            let replaced = TemporaryDirectory::beside(&self.out)?;
            let old = replaced.path.join("replaced");
            rename(&self.out, &old)?;
            if let Err(error) = rename(&self.temporary.path, &self.out) {
                // As it was; the first error is the one to tell.
                let _ = std::fs::rename(&old, &self.out);
                return Err(error);
            }
        } else {
            rename(&self.temporary.path, &self.out)?;
        }
        Ok(self.shards.iter().map(|(name, _)| self.out.join(name)).collect())
    }
}

/// That a checkpoint may take the name `out`.
fn check_replaceable(out: &Path, force: bool) -> Result<()> {
    let shown = out.display();
    let metadata = match std::fs::metadata(out) {
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(()),
        Err(error) => return Err(failed(out, &error)),
        Ok(metadata) => metadata,
    };
    if !metadata.is_dir() {
        return Err(Error::Input(format!("out: {shown} is there and is no directory")));
    }
    let mut is_empty = true;
    for entry in std::fs::read_dir(out).map_err(|error| failed(out, &error))? {
        let entry = entry.map_err(|error| failed(out, &error))?;
        is_empty = false;
        let name = entry.file_name();
        let name = name.to_string_lossy();
        let is_file = entry.file_type().is_ok_and(|kind| kind.is_file());
        let known = ["config.json", "model.safetensors.index.json"].contains(&&*name)
            || name.ends_with(".safetensors");
        if !(is_file && known) {
            return Err(Error::Input(format!(
                "out: {shown} holds {name}, which is no part of a checkpoint: choose another directory"
            )));
        }
    }
    if is_empty || force {
        return Ok(());
    }
    Err(Error::Input(format!(
        "out: {shown} is there already; force replaces it"
    )))
}

/// A directory with a name of its own, removed with all that is in it.
struct TemporaryDirectory {
    path: PathBuf,
}

impl TemporaryDirectory {
    /// In the directory of `out`, so that renaming needs no copy.
    fn beside(out: &Path) -> Result<Self> {
        let name = out.file_name().ok_or_else(|| {
            Error::Input(format!(
                "out: expected the name of a directory, got {}",
                out.display()
            ))
        })?;
        let parent = out.parent().unwrap_or(Path::new(""));
        if !parent.as_os_str().is_empty() {
            std::fs::create_dir_all(parent).map_err(|error| failed(parent, &error))?;
        }
        for attempt in 0.. {
            let name = format!(".{}.{}.{attempt}", name.to_string_lossy(), std::process::id());
            let path = parent.join(name);
            match std::fs::create_dir(&path) {
                Ok(()) => return Ok(Self { path }),
                Err(error) if error.kind() == std::io::ErrorKind::AlreadyExists => {}
                Err(error) => return Err(failed(&path, &error)),
            }
        }
        unreachable!("some number is free")
    }
}

impl Drop for TemporaryDirectory {
    fn drop(&mut self) {
        // After `finish` there is none under this name.
        let _ = std::fs::remove_dir_all(&self.path);
    }
}

fn failed(path: &Path, error: &std::io::Error) -> Error {
    Error::Output(format!("out: {} cannot be written: {error}", path.display()))
}
