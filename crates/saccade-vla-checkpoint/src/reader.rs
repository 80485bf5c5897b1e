//! A checkpoint that is open: its tensors by name, each read when asked for.

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;

use bytemuck::Pod;
use half::{bf16, f16};
use safetensors::Dtype;
use safetensors::tensor::TensorInfo;

use crate::adapter::{refuse_adapter, refuse_use_peft};
use crate::elements::{Elements, check_quantized};
use crate::error::{Error, Problem, Result, probe_allocation, reserve, show_shape};
use crate::header::Header;
use crate::index::WeightFiles;
use crate::names::plain_name;
use crate::source::SourceFile;
use crate::spec::{self, SCALE_SUFFIX, TensorProblem, TensorSpec, is_quantized};
use crate::{bail, problem};

/// Bytes that are copied together.
const PIECE: usize = 1 << 24;

struct Entry {
    file: usize,
    info: TensorInfo,
    /// The position of the tensor's first byte in the file.
    start: u64,
    /// Its name in the file, where that is another.
    wrapped: Option<String>,
}

/// The tensors of one checkpoint, by name.
pub struct Checkpoint {
    files: Vec<SourceFile>,
    entries: BTreeMap<String, Entry>,
    /// Names that are in more than one file, with what to say of them: an error only where the tensor is wanted.
    duplicates: BTreeMap<String, String>,
    /// What the files say of themselves.
    metadata: BTreeMap<String, String>,
}

impl Checkpoint {
    /// Opens `path`: one `.safetensors` file, or a directory with one or more of them.
    ///
    /// Of a directory, `model.safetensors` counts alone if it is there; otherwise an index (`*.safetensors.index.json`) says which files do;
    /// otherwise every `.safetensors` file in it does. Names lose what wrappers of a model add to them, see [`plain_name`].
    ///
    /// # Errors
    /// [`Error::NotFound`] for a path that is not there; [`Error::Checkpoint`] for a file that is not safetensors, is truncated, names a
    /// tensor twice, or is a Git LFS pointer; for an adapter, whether alone or beside a model. A name in two files is an error only where that
    /// tensor is wanted.
    pub fn open(path: &Path) -> Result<Self> {
        let metadata = std::fs::metadata(path).map_err(|error| Error::reading("source", path, error))?;
        refuse_use_peft(path)?;
        refuse_adapter(path)?;
        Self::open_weights(path, metadata.is_dir())
    }

    /// As [`Checkpoint::open`], where an adapter beside the weights is known and will be merged into them.
    ///
    /// # Errors
    /// Those of [`Checkpoint::open`], except for an adapter beside a model.
    pub fn open_beside_adapter(path: &Path) -> Result<Self> {
        let metadata = std::fs::metadata(path).map_err(|error| Error::reading("source", path, error))?;
        refuse_use_peft(path)?;
        Self::open_weights(path, metadata.is_dir())
    }

    /// Opens one file that need not be a model's weights: names stay as they are, and what is beside it does not count.
    ///
    /// # Errors
    /// [`Error::NotFound`] and [`Error::Checkpoint`] as for [`Checkpoint::open`].
    pub fn open_file(path: &Path) -> Result<Self> {
        let mut checkpoint = Self::empty();
        checkpoint.add_file(path, |name| name)?;
        Ok(checkpoint)
    }

    fn open_weights(path: &Path, is_directory: bool) -> Result<Self> {
        let plain = |name: String| plain_name(&name).into_owned();
        let mut checkpoint = Self::empty();
        if is_directory {
            let weights = WeightFiles::of(path)?;
            for file in &weights.files {
                checkpoint.add_file(file, plain)?;
            }
            checkpoint.check_index(&weights)?;
        } else {
            checkpoint.add_file(path, plain)?;
        }
        Ok(checkpoint)
    }

    fn empty() -> Self {
        Self {
            files: Vec::new(),
            entries: BTreeMap::new(),
            duplicates: BTreeMap::new(),
            metadata: BTreeMap::new(),
        }
    }

    /// What the files say of themselves; where they differ, what the first one says.
    #[must_use]
    pub fn metadata(&self) -> &BTreeMap<String, String> {
        &self.metadata
    }

    /// The files that tensors are read from.
    pub fn files(&self) -> impl Iterator<Item = &Path> {
        self.files.iter().map(|source| source.path.as_path())
    }

    /// The names of all tensors, sorted.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.entries.keys().map(String::as_str)
    }

    /// The shape of tensor `name`.
    #[must_use]
    pub fn shape(&self, name: &str) -> Option<&[usize]> {
        self.entries.get(name).map(|entry| entry.info.shape.as_slice())
    }

    /// All that is wrong with the tensors under `prefix`, which should be the `expected` ones; those for which `is_unused(name without the
    /// prefix, shape)` is true may be there too.
    pub fn problems(
        &self,
        prefix: &str,
        expected: &[TensorSpec],
        is_unused: impl Fn(&str, &[usize]) -> bool,
    ) -> Vec<TensorProblem> {
        let describe = |name: &str| self.describe(name);
        let mut problems = spec::problems(self.names(), describe, prefix, expected, is_unused);
        let twice = self
            .duplicates
            .iter()
            .filter(|(name, _)| name.starts_with(prefix));
        problems.extend(twice.map(|(_, problem)| TensorProblem::Other(problem.clone())));
        problems
    }

    fn describe(&self, name: &str) -> Option<(Dtype, &[usize])> {
        let entry = self.entries.get(name)?;
        Some((entry.info.dtype, &entry.info.shape))
    }

    /// Reads tensor `name` whole; int8 and int4 (U8) with their scales.
    ///
    /// # Errors
    /// [`Error::Checkpoint`] if there is no such tensor or its type is not F32, BF16, F16, or I8 or U8 with scales; [`Error::UnreadableTensor`] if the
    /// file cannot be read or has changed since it was opened; [`Error::Memory`] if there is no memory for the tensor.
    pub fn read(&self, name: &str) -> Result<Elements> {
        self.read_into(name, None, None)
    }

    /// Reads tensor `name` whole as float32, as [`Elements::into_f32`] has it.
    ///
    /// # Errors
    /// As [`Checkpoint::read`].
    pub fn read_f32(&self, name: &str) -> Result<Vec<f32>> {
        let elements: usize = self.entry(name)?.info.shape.iter().product();
        probe_allocation("source", elements.saturating_mul(size_of::<f32>()))?;
        self.read(name)?.into_f32()
    }

    /// Reads the slices `wanted` of the first axis of tensor `name`.
    ///
    /// # Errors
    /// As [`Checkpoint::read`], and if there are no such slices. int8 and int4 are read whole only.
    pub fn read_slices(&self, name: &str, wanted: Range<usize>) -> Result<Elements> {
        self.read_into(name, Some(wanted), None)
    }

    /// Reads tensor `name`, or the slices `wanted` of its first axis, into the memory of `spare` if that has its type: fresh memory is
    /// given page by page, which takes longer than the reading.
    pub(crate) fn read_into(
        &self,
        name: &str,
        wanted: Option<Range<usize>>,
        spare: Option<Elements>,
    ) -> Result<Elements> {
        let entry = self.entry(name)?;
        let Some(wanted) = wanted else {
            if is_quantized(entry.info.dtype) {
                return self.read_quantized(name, entry);
            }
            let elements = entry.info.shape.iter().product();
            return self.read_elements(name, entry, 0, elements, spare);
        };
        match entry.info.shape.split_first() {
            Some((&size, rest)) if wanted.start <= wanted.end && wanted.end <= size => {
                let elements = rest
                    .iter()
                    .fold(1, |product, &size| usize::saturating_mul(product, size));
                let (first, count) = (wanted.start * elements, wanted.len() * elements);
                self.read_elements(name, entry, first, count, spare)
            }
            _ => Err(Error::Checkpoint(problem!(
                "source"; "{name} has shape {} and no slices {wanted:?}", show_shape(&entry.info.shape)
            ))),
        }
    }

    /// The type of tensor `name`.
    ///
    /// # Errors
    /// [`Error::Checkpoint`] if there is no such tensor, or it is in two files.
    pub fn dtype(&self, name: &str) -> Result<Dtype> {
        Ok(self.entry(name)?.info.dtype)
    }

    /// Bytes of tensor `name` in its file.
    ///
    /// # Errors
    /// As [`Checkpoint::dtype`].
    pub fn nbytes(&self, name: &str) -> Result<u64> {
        let (start, end) = self.entry(name)?.info.data_offsets;
        Ok((end - start) as u64)
    }

    /// Gives the bytes of tensor `name`, of whatever type, to `take`, piece by piece.
    ///
    /// # Errors
    /// As [`Checkpoint::read_byte_range`].
    pub fn read_bytes<E: From<Error>>(
        &self,
        name: &str,
        take: impl FnMut(&[u8]) -> std::result::Result<(), E>,
    ) -> std::result::Result<(), E> {
        self.read_byte_range(name, 0..self.nbytes(name)?, take)
    }

    /// Gives some of the bytes of tensor `name`, of whatever type, to `take`, piece by piece; a piece holds whole elements if `bytes` does.
    ///
    /// # Errors
    /// What `take` returns; as [`Checkpoint::dtype`]; [`Error::UnreadableTensor`] if the file cannot be read or has changed.
    ///
    /// # Panics
    /// If the tensor has no such bytes.
    pub fn read_byte_range<E: From<Error>>(
        &self,
        name: &str,
        bytes: Range<u64>,
        mut take: impl FnMut(&[u8]) -> std::result::Result<(), E>,
    ) -> std::result::Result<(), E> {
        let entry = self.entry(name)?;
        let (start, end) = (bytes.start as usize, bytes.end as usize);
        let (first, last) = entry.info.data_offsets;
        assert!(
            start <= end && end <= last - first,
            "{name} has no bytes {bytes:?}"
        );
        let mut piece: Vec<u8> = Vec::new();
        for first in (start..end).step_by(PIECE) {
            piece = self.read_plain(name, entry, first, PIECE.min(end - first), piece)?;
            take(&piece)?;
        }
        Ok(())
    }

    fn entry(&self, name: &str) -> Result<&Entry> {
        match self.duplicates.get(name) {
            Some(problem) => bail!(Checkpoint, "source"; "{problem}"),
            None => self
                .entries
                .get(name)
                .ok_or_else(|| Error::Checkpoint(problem!("source"; "{name} is missing"))),
        }
    }

    fn read_elements(
        &self,
        name: &str,
        entry: &Entry,
        first: usize,
        count: usize,
        spare: Option<Elements>,
    ) -> Result<Elements> {
        match entry.info.dtype {
            Dtype::F32 => {
                let spare = match spare {
                    Some(Elements::F32(values)) => values,
                    _ => Vec::new(),
                };
                let mut values: Vec<f32> = self.read_plain(name, entry, first, count, spare)?;
                from_little_endian(&mut values, |value| f32::from_bits(u32::from_le(value.to_bits())));
                Ok(Elements::F32(values))
            }
            Dtype::BF16 => {
                let spare = match spare {
                    Some(Elements::Bf16(values)) => values,
                    _ => Vec::new(),
                };
                let mut values: Vec<bf16> = self.read_plain(name, entry, first, count, spare)?;
                from_little_endian(&mut values, |value| {
                    bf16::from_bits(u16::from_le(value.to_bits()))
                });
                Ok(Elements::Bf16(values))
            }
            Dtype::F16 => {
                let halves: Vec<u16> = self.read_plain(name, entry, first, count, Vec::new())?;
                let mut widened = Vec::new();
                reserve("source", &mut widened, halves.len())?;
                let values = halves.into_iter().map(u16::from_le);
                widened.extend(values.map(|bits| f16::from_bits(bits).to_f32()));
                Ok(Elements::F32(widened))
            }
            other => bail!(Checkpoint, "source"; "{name} is {other:?}, expected F32, BF16 or F16"),
        }
    }

    fn read_quantized(&self, name: &str, entry: &Entry) -> Result<Elements> {
        let scale = format!("{name}{SCALE_SUFFIX}");
        let rows = entry.info.shape.first().copied().unwrap_or(1);
        let dtype = entry.info.dtype;
        if let Some(problem) = spec::scale_problem(|name| self.describe(name), name, dtype, &scale, rows) {
            return Err(Error::Checkpoint(Problem::new("source", problem.text())));
        }
        let count = entry.info.shape.iter().product();
        let scales = self
            .read_elements(&scale, self.entry(&scale)?, 0, rows, None)?
            .into_f32()?;
        let check = |bytes: &[u8], is_int4| {
            check_quantized(name, bytes, is_int4, &scale, &scales)
                .map_err(|problem| Error::Checkpoint(Problem::new("source", problem)))
        };
        if dtype == Dtype::U8 {
            let values: Vec<u8> = self.read_plain(name, entry, 0, count, Vec::new())?;
            check(&values, true)?;
            return Ok(Elements::Int4 { values, scales });
        }
        let values: Vec<i8> = self.read_plain(name, entry, 0, count, Vec::new())?;
        check(bytemuck::cast_slice(&values), false)?;
        Ok(Elements::Int8 { values, scales })
    }

    /// `count` elements from number `first` on, as their bytes are in the file, in the memory of `values`.
    fn read_plain<T: Pod>(
        &self,
        name: &str,
        entry: &Entry,
        first: usize,
        count: usize,
        mut values: Vec<T>,
    ) -> Result<Vec<T>> {
        let file = &self.files[entry.file];
        reserve("source", &mut values, count)?;
        values.resize(count, T::zeroed());
        let start = entry.start + (first * size_of::<T>()) as u64;
        file.read_at(bytemuck::cast_slice_mut(&mut values), start)
            .map_err(|source| Error::UnreadableTensor {
                name: name.to_owned(),
                path: file.path.clone(),
                source,
            })?;
        Ok(values)
    }

    fn add_file(&mut self, path: &Path, rename: impl Fn(String) -> String) -> Result<()> {
        let bad = |problem: String| Error::Checkpoint(problem!("source"; "{}: {problem}", path.display()));
        let file = SourceFile::open(path).map_err(|error| Error::reading("source", path, error))?;
        let header = Header::read(&file).map_err(bad)?;
        for (key, value) in header.metadata {
            self.metadata.entry(key).or_insert(value);
        }
        let index = self.files.len();
        for (written, info) in header.tensors {
            let start = header.data_start + info.data_offsets.0 as u64;
            let name = rename(written.clone());
            let wrapped = (written != name).then_some(written);
            if let Some(other) = self.entries.get(&name) {
                if other.wrapped != wrapped {
                    let (one, two) = (other.wrapped.as_ref(), wrapped.as_ref());
                    return Err(bad(format!(
                        "{} and {} are the same tensor, {name}, without what torch.compile and DistributedDataParallel add",
                        one.unwrap_or(&name),
                        two.unwrap_or(&name)
                    )));
                }
                let other = self.files[other.file].path.display();
                let problem = format!("{name} is in two files, {other} and {}", path.display());
                self.duplicates.insert(name, problem);
                continue;
            }
            self.entries.insert(
                name,
                Entry {
                    file: index,
                    info,
                    start,
                    wrapped,
                },
            );
        }
        self.files.push(file);
        Ok(())
    }

    fn check_index(&self, weights: &WeightFiles) -> Result<()> {
        let mut problems = Vec::new();
        for (name, shard) in &weights.weight_map {
            match self.entries.get(name) {
                Some(entry) if weights.files[entry.file] == *shard => {}
                _ => problems.push(format!("{name} is not in {}", shard.display())),
            }
        }
        if problems.is_empty() {
            Ok(())
        } else {
            Err(Error::Checkpoint(problem!(
                "source"; "the index and its shards disagree:\n  {}", problems.join("\n  ")
            )))
        }
    }
}

/// Puts the bytes of each value in this machine's order; on most machines there is nothing to do, and no code.
fn from_little_endian<T: Copy>(values: &mut [T], convert: impl Fn(T) -> T) {
    if cfg!(target_endian = "big") {
        values.iter_mut().for_each(|value| *value = convert(*value));
    }
}
