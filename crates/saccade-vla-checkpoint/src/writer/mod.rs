//! Writing checkpoints: `config.json` and one or more `.safetensors`, tensor by tensor, all of them or nothing.
//!
//! Everything goes to a temporary directory next to the wanted one, which gets its name at the end. Whoever looks finds what was there before,
//! or a whole checkpoint. A program that is killed leaves at most a directory whose name begins with a dot, which the next writer under that
//! name removes. Linux exchanges the two directories in one step. Elsewhere, and on file systems that cannot, there is a moment between two
//! renames in which neither has the name; a program that is killed in it leaves the old checkpoint in `NAME.old-PID.N`.

mod replace;
mod temporary;

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::{Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use safetensors::Dtype;
use safetensors::tensor::TensorInfo;

use crate::companions::Companions;
use crate::error::{Error, Result};
use replace::{Disk, check_replaceable, place, replace};
use temporary::TemporaryDirectory;

/// Bytes that are looked at together: if all are zero, they become a hole.
const HOLE: usize = 1 << 16;

/// A tensor to be written.
#[derive(Clone, Debug)]
pub struct PlannedTensor {
    /// Its name.
    pub name: String,
    /// The type it is stored in.
    pub dtype: Dtype,
    /// Its shape.
    pub shape: Vec<usize>,
}

impl PlannedTensor {
    /// Bytes in the file.
    #[must_use]
    pub fn nbytes(&self) -> usize {
        let elements: u128 = self.shape.iter().map(|&size| size as u128).product();
        let bits = elements.saturating_mul(self.dtype.bitsize() as u128);
        usize::try_from(bits / 8).unwrap_or(usize::MAX)
    }
}

/// Where a tensor's bytes are in the files.
struct Region {
    shard: usize,
    start: u64,
    nbytes: u64,
    written: u64,
}

/// A checkpoint that is being written; dropped before [`CheckpointWriter::finish`], it leaves nothing.
pub struct CheckpointWriter {
    out: PathBuf,
    force: bool,
    companions: BTreeSet<PathBuf>,
    temporary: TemporaryDirectory,
    shards: Vec<(String, File)>,
    regions: BTreeMap<String, Region>,
}

impl CheckpointWriter {
    /// Prepares `out` for the `planned` tensors, in files of at most `max_shard_bytes` unless one tensor is larger, and writes `companions`.
    ///
    /// # Errors
    /// [`Error::Input`] if `out` is there and `force` is not given, or `out` holds anything but a checkpoint; [`Error::Output`] if it
    /// cannot be written.
    pub fn create(
        out: &Path,
        mut planned: Vec<PlannedTensor>,
        metadata: &BTreeMap<String, String>,
        companions: &Companions,
        max_shard_bytes: u64,
        force: bool,
    ) -> Result<Self> {
        // Behind a link, what it leads to is replaced and not the link.
        let out = &out.canonicalize().unwrap_or_else(|_| out.to_owned());
        let carried = companions.all_paths();
        check_replaceable(out, &carried, force)?;
        let temporary = TemporaryDirectory::next_to(out)?;
        // Wide elements first, as the format's own writer does: each tensor then starts at a multiple of its element size.
        planned.sort_by(|a, b| (b.dtype.bitsize(), &a.name).cmp(&(a.dtype.bitsize(), &b.name)));
        let mut sharded: Vec<Vec<PlannedTensor>> = vec![Vec::new()];
        let mut held = 0;
        for tensor in planned {
            let nbytes = tensor.nbytes() as u64;
            if held > 0 && u64::saturating_add(held, nbytes) > max_shard_bytes {
                sharded.push(Vec::new());
                held = 0;
            }
            held = u64::saturating_add(held, nbytes);
            sharded.last_mut().expect("there is at least one").push(tensor);
        }
        let mut writer = Self {
            out: out.to_owned(),
            force,
            companions: carried,
            temporary,
            shards: Vec::new(),
            regions: BTreeMap::new(),
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
        companions.copy_to(writer.temporary.path())?;
        Ok(writer)
    }

    fn add_shard(
        &mut self,
        name: String,
        tensors: Vec<PlannedTensor>,
        metadata: &BTreeMap<String, String>,
    ) -> Result<()> {
        let shard = self.shards.len();
        let mut header = serde_json::Map::new();
        if !metadata.is_empty() {
            header.insert("__metadata__".to_owned(), serde_json::json!(metadata));
        }
        let (mut offset, mut offsets) = (0, Vec::new());
        for tensor in tensors {
            let end = usize::saturating_add(offset, tensor.nbytes());
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
            let region = Region {
                shard,
                start: data.saturating_add(start),
                nbytes,
                written: 0,
            };
            self.regions.insert(name, region);
        }
        let path = self.temporary.path().join(&name);
        let write = || {
            let mut file = File::create_new(&path)?;
            file.write_all(&(header.len() as u64).to_le_bytes())?;
            file.write_all(header.as_bytes())?;
            file.set_len(data.saturating_add(offset as u64))?;
            Ok(file)
        };
        let file = write().map_err(|error| Error::writing(&path, error))?;
        self.shards.push((name, file));
        Ok(())
    }

    fn write_index(&self) -> Result<()> {
        let total: u64 = self.regions.values().map(|region| region.nbytes).sum();
        let map: BTreeMap<&str, &str> = self
            .regions
            .iter()
            .map(|(name, region)| (name.as_str(), self.shards[region.shard].0.as_str()))
            .collect();
        let index = serde_json::json!({ "metadata": { "total_size": total }, "weight_map": map });
        self.file("model.safetensors.index.json", &format!("{index:#}\n"))
    }

    /// Writes a small file next to the tensors.
    ///
    /// # Errors
    /// [`Error::Output`] if it cannot be written.
    pub fn file(&self, name: &str, contents: &str) -> Result<()> {
        let path = self.temporary.path().join(name);
        let write = || {
            let mut file = File::create_new(&path)?;
            file.write_all(contents.as_bytes())?;
            file.sync_all()
        };
        write().map_err(|error| Error::writing(&path, error))
    }

    /// Writes the next bytes of tensor `name`, one of the planned; tensors may come in any order. Long runs of zeros are
    /// left out, as [`CheckpointWriter::zeros`] does: the layers of embodiments that a copy does not have.
    ///
    /// # Errors
    /// [`Error::Output`] if they cannot be written.
    ///
    /// # Panics
    /// If there is no such tensor, or it is shorter.
    pub fn tensor(&mut self, name: &str, bytes: &[u8]) -> Result<()> {
        for piece in bytes.chunks(HOLE) {
            let first = self.passed(name, piece.len() as u64);
            if piece.iter().any(|&byte| byte != 0) {
                let (shard, file) = &mut self.shards[self.regions[name].shard];
                file.seek(SeekFrom::Start(first))
                    .and_then(|_| file.write_all(piece))
                    .map_err(|error| Error::writing(&self.temporary.path().join(shard), error))?;
            }
        }
        Ok(())
    }

    /// Leaves the next `nbytes` bytes of tensor `name` zero: a hole in the file, where the file system has such.
    ///
    /// # Panics
    /// As [`CheckpointWriter::tensor`].
    pub fn zeros(&mut self, name: &str, nbytes: u64) {
        self.passed(name, nbytes);
    }

    /// Counts bytes as written; where in the file they are.
    fn passed(&mut self, name: &str, nbytes: u64) -> u64 {
        let region = self.regions.get_mut(name).expect("the tensor was planned");
        let first = region.start + region.written;
        region.written += nbytes;
        assert!(
            region.written <= region.nbytes,
            "{name}: more bytes than were planned"
        );
        first
    }

    /// Gives the checkpoint its name; returns those of the files with tensors.
    ///
    /// # Panics
    /// If a planned tensor was not written whole.
    ///
    /// # Errors
    /// [`Error::Input`] if something has taken the name that may not be replaced; [`Error::Output`] if the disk is full or the name cannot be
    /// given; what had the name then still has it. [`Error::Stranded`] if neither could get the name; both are then kept.
    pub fn finish(self) -> Result<Vec<String>> {
        assert!(
            self.regions
                .values()
                .all(|region| region.written == region.nbytes),
            "all planned tensors are written"
        );
        for (name, file) in &self.shards {
            file.sync_all()
                .map_err(|error| Error::writing(&self.temporary.path().join(name), error))?;
        }
        let files = self.shards.iter().map(|(name, _)| name.clone()).collect();
        // Another writer may have taken the name by now, or added to what has it.
        if check_replaceable(&self.out, &self.companions, self.force)? {
            replace(&Disk, self.temporary, &self.out)?;
        } else {
            place(&Disk, self.temporary, &self.out)?;
        }
        Ok(files)
    }
}
