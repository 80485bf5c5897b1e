//! Reading safetensors: one file, or a directory of shards with or without an index.
//!
//! Headers are read and checked at [`Checkpoint::open`]; tensors are read one at a time when asked for, from files that stay open.
//! Nothing is mapped: a file that changes later cannot reach a running head.

use std::collections::{BTreeMap, BTreeSet};
use std::ffi::OsString;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::time::SystemTime;

use bytemuck::Pod;
use half::{bf16, f16};
use safetensors::Dtype;
use safetensors::tensor::{Metadata, TensorInfo};
use serde::de::{Deserialize, Deserializer, IgnoredAny, MapAccess, Visitor};

use crate::companions::is_processor;
use crate::config::HeadConfig;
use crate::error::{Error, Result, show_shape};
use crate::fit::{self, Problem};
use crate::head::plan::{is_unused, tensor_specs};

/// A longer header, index or config is hostile: the released head has 314 tensors in 40 kB.
const MAX_HEADER_BYTES: u64 = 100_000_000;

/// What a safetensors header calls its notes.
const METADATA: &str = "__metadata__";

/// The note of the embodiments that were kept.
pub(crate) const KEPT_EMBODIMENTS: &str = "saccade_embodiment_ids";

/// Bytes that are copied together.
const PIECE: usize = 1 << 24;

/// Where a head's tensors may stand in a checkpoint, longest first.
const HEAD_PREFIXES: [&str; 2] = ["_groot_model.action_head.", "action_head."];

/// What the name of a tensor's scales adds to its own: `X.weight` of int8 has `X.weight_scale`.
pub(crate) const SCALE_SUFFIX: &str = "_scale";

/// The elements of one tensor, in the type they are stored in; float16 is widened to float32, which is exact.
#[derive(Clone, Debug, PartialEq)]
pub enum Elements {
    /// float32.
    F32(Vec<f32>),
    /// bfloat16, kept as it is.
    Bf16(Vec<bf16>),
    /// int8 from -127 to 127, and what each row, an index of the first axis, is multiplied by.
    Int8 {
        /// The whole numbers.
        values: Vec<i8>,
        /// One for each row: not negative, zero only for a row of zeros, 127 times it finite.
        scales: Vec<f32>,
    },
}

impl Elements {
    /// The elements as float32: exactly, except that int8 times its scale is rounded.
    #[must_use]
    pub fn into_f32(self) -> Vec<f32> {
        match self {
            Self::F32(values) => values,
            Self::Bf16(values) => values.into_iter().map(bf16::to_f32).collect(),
            Self::Int8 { values, scales } => {
                let row = values.len() / scales.len().max(1);
                let scale = |index: usize| scales[index / row];
                let values = values.iter().enumerate();
                values
                    .map(|(index, &value)| f32::from(value) * scale(index))
                    .collect()
            }
        }
    }
}

struct Entry {
    file: usize,
    info: TensorInfo,
    /// Where the tensor's first byte lies in the file.
    start: u64,
}

/// A file that tensors are read from.
struct Source {
    path: PathBuf,
    file: File,
    /// What it was when its header was read.
    stamp: Stamp,
}

/// What changes when a file is written to.
#[derive(PartialEq)]
struct Stamp {
    length: u64,
    /// None where the system does not tell.
    modified: Option<SystemTime>,
}

impl Stamp {
    fn of(file: &File) -> std::io::Result<Self> {
        let metadata = file.metadata()?;
        Ok(Self {
            length: metadata.len(),
            modified: metadata.modified().ok(),
        })
    }
}

/// The tensors of one checkpoint, by name.
pub struct Checkpoint {
    files: Vec<Source>,
    entries: BTreeMap<String, Entry>,
    /// Names that stand in more than one file, with what to say of them: fatal only where the tensor is wanted.
    duplicates: BTreeMap<String, String>,
    /// What the files say of themselves.
    notes: BTreeMap<String, String>,
}

impl Checkpoint {
    /// Opens `path`: one `.safetensors` file, or a directory with one or more of them.
    ///
    /// A directory with an index (`*.safetensors.index.json`) is read as the index says; otherwise every `.safetensors` file in it counts.
    ///
    /// # Errors
    /// [`Error::NotFound`] for a path that is not there; [`Error::Checkpoint`] for a file that is not safetensors, is truncated,
    /// or names a tensor twice. A name in two files is an error only where that tensor is wanted.
    pub fn open(path: &Path) -> Result<Self> {
        let metadata = std::fs::metadata(path).map_err(|error| Error::from_io("source", path, &error))?;
        let mut checkpoint = Self {
            files: Vec::new(),
            entries: BTreeMap::new(),
            duplicates: BTreeMap::new(),
            notes: BTreeMap::new(),
        };
        if metadata.is_dir() {
            let listing = Listing::of(path)?;
            for file in &listing.files {
                checkpoint.add_file(file)?;
            }
            checkpoint.check_index(&listing)?;
        } else {
            checkpoint.add_file(path)?;
        }
        Ok(checkpoint)
    }

    /// What the files say of themselves; where they differ, what the first one says.
    pub(crate) fn notes(&self) -> &BTreeMap<String, String> {
        &self.notes
    }

    /// The embodiments whose layers were kept when others were taken out; none if nobody did.
    ///
    /// # Errors
    /// [`Error::Checkpoint`] if the files' note of it is not a list of numbers.
    pub fn kept_embodiments(&self) -> Result<Option<Vec<i64>>> {
        let Some(note) = self.notes.get(KEPT_EMBODIMENTS) else {
            return Ok(None);
        };
        let ids: std::result::Result<_, _> = note.split(',').map(str::parse).collect();
        ids.map(Some).map_err(|_| {
            Error::Checkpoint(format!(
                "source: {KEPT_EMBODIMENTS} in the metadata is `{note}`, expected numbers with commas between them"
            ))
        })
    }

    /// The files that tensors are read from.
    pub(crate) fn files(&self) -> impl Iterator<Item = &Path> {
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

    /// The prefix under which a head's tensors stand, empty if none of the known ones is used.
    ///
    /// # Errors
    /// [`Error::Checkpoint`] if two heads are in one checkpoint.
    pub fn head_prefix(&self) -> Result<&'static str> {
        let mut used = HEAD_PREFIXES
            .iter()
            .filter(|prefix| self.names().any(|name| name.starts_with(**prefix)));
        match (used.next(), used.next()) {
            (None, _) => Ok(""),
            (Some(prefix), None) => Ok(prefix),
            (Some(first), Some(second)) => Err(Error::Checkpoint(format!(
                "source: two heads in one checkpoint, under `{first}` and `{second}`"
            ))),
        }
    }

    /// That exactly the tensors of a head of this config stand under `prefix`, each of the right shape and a readable type; what only
    /// training uses may be there too.
    ///
    /// # Errors
    /// [`Error::Checkpoint`] that lists every tensor that is missing, unknown, misshaped or of another type.
    pub(crate) fn check(&self, prefix: &str, config: &HeadConfig) -> Result<()> {
        let expected = tensor_specs(config);
        let is_known = |name: &str, shape: &[usize]| is_unused(config, name, shape);
        let mut problems = fit::problems(
            self.names(),
            |name| self.describe(name),
            prefix,
            &expected,
            is_known,
        );
        let twice = self
            .duplicates
            .iter()
            .filter(|(name, _)| name.starts_with(prefix));
        problems.extend(twice.map(|(_, problem)| Problem::Other(problem.clone())));
        if problems.is_empty() {
            return Ok(());
        }
        Err(Error::Checkpoint(format!(
            "source: {}",
            fit::list(&problems, "the config")
        )))
    }

    fn describe(&self, name: &str) -> Option<(Dtype, &[usize])> {
        let entry = self.entries.get(name)?;
        Some((entry.info.dtype, &entry.info.shape))
    }

    /// Reads tensor `name` whole; int8 with its scales.
    ///
    /// # Errors
    /// [`Error::Checkpoint`] if there is no such tensor, its type is not F32, BF16, F16 or I8 with scales, or the file cannot be read.
    pub fn read(&self, name: &str) -> Result<Elements> {
        self.read_into(name, None, None)
    }

    /// Reads tensor `name` whole as float32, as [`Elements::into_f32`] has it.
    ///
    /// # Errors
    /// As [`Checkpoint::read`], and for more than there is memory for.
    pub fn read_f32(&self, name: &str) -> Result<Vec<f32>> {
        let elements = self.entry(name)?.info.shape.iter().product::<usize>();
        grant(elements.saturating_mul(size_of::<f32>()))?;
        Ok(self.read(name)?.into_f32())
    }

    /// Reads the slices `wanted` of the first axis of tensor `name`.
    ///
    /// # Errors
    /// As [`Checkpoint::read`], and if there are no such slices. int8 is read whole only.
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
            if entry.info.dtype == Dtype::I8 {
                return self.read_int8(name, entry);
            }
            let elements = entry.info.shape.iter().product();
            return self.read_elements(name, entry, 0, elements, spare);
        };
        match entry.info.shape.split_first() {
            Some((&size, rest)) if wanted.start <= wanted.end && wanted.end <= size => {
                let elements: usize = rest.iter().product();
                let (first, count) = (wanted.start * elements, wanted.len() * elements);
                self.read_elements(name, entry, first, count, spare)
            }
            _ => Err(Error::Checkpoint(format!(
                "source: {name} has shape {} and no slices {wanted:?}",
                show_shape(&entry.info.shape)
            ))),
        }
    }

    /// The type of tensor `name`.
    pub(crate) fn dtype(&self, name: &str) -> Result<Dtype> {
        Ok(self.entry(name)?.info.dtype)
    }

    /// Bytes of tensor `name` in its file.
    pub(crate) fn nbytes(&self, name: &str) -> Result<u64> {
        let (start, end) = self.entry(name)?.info.data_offsets;
        Ok((end - start) as u64)
    }

    /// Gives the bytes of tensor `name`, of whatever type, to `take`, piece by piece.
    pub(crate) fn read_bytes(&self, name: &str, take: impl FnMut(&[u8]) -> Result<()>) -> Result<()> {
        self.read_byte_range(name, 0..self.nbytes(name)?, take)
    }

    /// Gives some of the bytes of tensor `name`, of whatever type, to `take`, piece by piece; a piece holds whole elements if `bytes` does.
    pub(crate) fn read_byte_range(
        &self,
        name: &str,
        bytes: Range<u64>,
        mut take: impl FnMut(&[u8]) -> Result<()>,
    ) -> Result<()> {
        let entry = self.entry(name)?;
        let (start, end) = (bytes.start as usize, bytes.end as usize);
        let mut piece: Vec<u8> = Vec::new();
        for first in (start..end).step_by(PIECE) {
            piece = self.read_plain(name, entry, first, PIECE.min(end - first), piece)?;
            take(&piece)?;
        }
        Ok(())
    }

    fn entry(&self, name: &str) -> Result<&Entry> {
        match self.duplicates.get(name) {
            Some(problem) => Err(Error::Checkpoint(format!("source: {problem}"))),
            None => self
                .entries
                .get(name)
                .ok_or_else(|| Error::Checkpoint(format!("source: {name} is missing"))),
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
                let widened = halves
                    .into_iter()
                    .map(|bits| f16::from_bits(u16::from_le(bits)).to_f32());
                Ok(Elements::F32(widened.collect()))
            }
            other => Err(Error::Checkpoint(format!(
                "source: {name} is {other:?}, expected F32, BF16 or F16"
            ))),
        }
    }

    fn read_int8(&self, name: &str, entry: &Entry) -> Result<Elements> {
        let scale = format!("{name}{SCALE_SUFFIX}");
        let rows = entry.info.shape.first().copied().unwrap_or(1);
        if let Some(problem) = fit::scale_problem(|name| self.describe(name), name, &scale, rows) {
            return Err(Error::Checkpoint(format!("source: {}", problem.text())));
        }
        let values: Vec<i8> =
            self.read_plain(name, entry, 0, entry.info.shape.iter().product(), Vec::new())?;
        let scales = self
            .read_elements(&scale, self.entry(&scale)?, 0, rows, None)?
            .into_f32();
        let bad = |problem: String| Err(Error::Checkpoint(format!("source: {problem}")));
        if let Some(row) = scales
            .iter()
            .position(|scale| !((127.0 * scale).is_finite() && *scale >= 0.0))
        {
            return bad(format!(
                "{scale} is {} at index {row}, expected finite scales that are not negative, and 127 times them finite",
                scales[row]
            ));
        }
        if values.contains(&i8::MIN) {
            return bad(format!("{name} holds -128, expected -127 to 127"));
        }
        let width = values.len() / rows.max(1);
        let unscaled = |row: usize| {
            values[row * width..(row + 1) * width]
                .iter()
                .any(|&value| value != 0)
        };
        if let Some(row) = (0..rows).find(|&row| scales[row] == 0.0 && unscaled(row)) {
            return bad(format!(
                "{scale} is 0 at index {row}, whose row of {name} is not zero"
            ));
        }
        Ok(Elements::Int8 { values, scales })
    }

    /// `count` elements from number `first` on, as their bytes stand in the file, in the memory of `values`.
    fn read_plain<T: Pod>(
        &self,
        name: &str,
        entry: &Entry,
        first: usize,
        count: usize,
        mut values: Vec<T>,
    ) -> Result<Vec<T>> {
        let source = &self.files[entry.file];
        let mut file = &source.file;
        let mut read = || {
            // A file with holes is as long as it likes: more than there is memory for is an error, not the end of the process.
            values.try_reserve_exact(count.saturating_sub(values.len()))?;
            values.resize(count, T::zeroed());
            file.seek(SeekFrom::Start(entry.start + (first * size_of::<T>()) as u64))?;
            file.read_exact(bytemuck::cast_slice_mut(&mut values))?;
            // Half of one file and half of another must not become a head.
            if Stamp::of(file)? != source.stamp {
                return Err(std::io::Error::other("it changed while it was read"));
            }
            Ok(())
        };
        read().map_err(|error: std::io::Error| {
            Error::Checkpoint(format!(
                "source: {name} cannot be read from {}: {error}",
                source.path.display()
            ))
        })?;
        Ok(values)
    }

    fn add_file(&mut self, path: &Path) -> Result<()> {
        let bad = |problem: String| Error::Checkpoint(format!("source: {}: {problem}", path.display()));
        let mut file = open_regular(path).map_err(|error| Error::from_io("source", path, &error))?;
        let stamp = Stamp::of(&file).map_err(|error| Error::from_io("source", path, &error))?;
        let Header {
            tensors: header,
            data_start,
            notes,
        } = read_header(&mut file, stamp.length).map_err(bad)?;
        for (key, note) in notes {
            self.notes.entry(key).or_insert(note);
        }
        let index = self.files.len();
        for (name, info) in header {
            let start = data_start + info.data_offsets.0 as u64;
            if let Some(other) = self.entries.get(&name) {
                let other = self.files[other.file].path.display();
                let problem = format!("{name} is also in {other}, beside {}", path.display());
                self.duplicates.insert(name, problem);
                continue;
            }
            self.entries.insert(
                name,
                Entry {
                    file: index,
                    info,
                    start,
                },
            );
        }
        self.files.push(Source {
            path: path.to_owned(),
            file,
            stamp,
        });
        Ok(())
    }

    fn check_index(&self, listing: &Listing) -> Result<()> {
        let mut problems = Vec::new();
        for (name, shard) in &listing.weight_map {
            match self.entries.get(name) {
                Some(entry) if listing.files[entry.file] == *shard => {}
                _ => problems.push(format!("{name} is not in {}", shard.display())),
            }
        }
        if problems.is_empty() {
            Ok(())
        } else {
            Err(Error::Checkpoint(format!(
                "source: the index and its shards disagree:\n  {}",
                problems.join("\n  ")
            )))
        }
    }
}

/// Opens a file that may be read to its end: opening a pipe would wait for somebody to write to it, and a device has no end.
pub(crate) fn open_regular(path: &Path) -> std::io::Result<File> {
    let is_file = |metadata: std::io::Result<std::fs::Metadata>| match metadata?.is_file() {
        true => Ok(()),
        false => Err(std::io::Error::other("not a regular file")),
    };
    is_file(std::fs::metadata(path))?;
    let file = File::open(path)?;
    is_file(file.metadata())?;
    Ok(file)
}

/// The text of the file `path`, an index or a config, which `what` names in errors.
pub(crate) fn read_text(what: &'static str, path: &Path) -> Result<String> {
    let read = || {
        let mut text = String::new();
        // One byte more than is allowed shows that there are more.
        open_regular(path)?
            .take(MAX_HEADER_BYTES + 1)
            .read_to_string(&mut text)?;
        if text.len() as u64 > MAX_HEADER_BYTES {
            let problem = format!("more than {MAX_HEADER_BYTES} bytes");
            return Err(std::io::Error::other(problem));
        }
        Ok(text)
    };
    read().map_err(|error| Error::from_io(what, path, &error))
}

/// That the system has so many bytes at all, which it says before they are used: an allocation that fails later ends the process, and a file
/// with holes is as long as it likes.
///
/// # Errors
/// [`Error::Checkpoint`] with the number of bytes.
pub(crate) fn grant(bytes: usize) -> Result<()> {
    Vec::<u8>::new().try_reserve_exact(bytes).map_err(|_| {
        let gigabytes = bytes as f64 / 1e9;
        Error::Checkpoint(format!(
            "source: it takes {gigabytes:.1} GB of memory, more than there is"
        ))
    })
}

/// Puts the bytes of each value in this machine's order; on most machines there is nothing to do, and no code.
fn from_little_endian<T: Copy>(values: &mut [T], convert: impl Fn(T) -> T) {
    if cfg!(target_endian = "big") {
        values.iter_mut().for_each(|value| *value = convert(*value));
    }
}

/// The `.safetensors` files of a directory, and what its index promises of them.
struct Listing {
    files: Vec<PathBuf>,
    weight_map: Vec<(String, PathBuf)>,
}

impl Listing {
    fn of(directory: &Path) -> Result<Self> {
        let bad = |problem: String| Error::Checkpoint(format!("source: {}: {problem}", directory.display()));
        let all: Vec<OsString> = std::fs::read_dir(directory)
            .and_then(|entries| entries.map(|entry| Ok(entry?.file_name())).collect())
            .map_err(|error| Error::from_io("source", directory, &error))?;
        let mut names = Vec::new();
        for name in all {
            match name.into_string() {
                Ok(name) => names.push(name),
                // Left out in silence, its tensors would be missing for no reason that anybody sees.
                Err(name) if name.to_string_lossy().contains(".safetensors") => {
                    return Err(bad(format!("the name {} is not UTF-8", name.to_string_lossy())));
                }
                Err(_) => {}
            }
        }
        names.sort();
        let mut indexes = names
            .iter()
            .filter(|name| name.ends_with(".safetensors.index.json"));
        let files: Vec<PathBuf> = names
            .iter()
            .filter(|name| name.ends_with(".safetensors") && !is_processor(name))
            .map(|name| directory.join(name))
            .collect();
        match (indexes.next(), indexes.next()) {
            (None, _) if files.is_empty() => Err(bad("expected at least one .safetensors file".to_owned())),
            (None, _) => Ok(Self {
                files,
                weight_map: Vec::new(),
            }),
            (Some(index), None) => Self::from_index(directory, &directory.join(index)),
            (Some(first), Some(second)) => Err(bad(format!("expected one index, got {first} and {second}"))),
        }
    }

    fn from_index(directory: &Path, path: &Path) -> Result<Self> {
        #[derive(serde::Deserialize)]
        struct Index {
            weight_map: UniqueMap<String>,
        }
        let bad = |problem: String| Error::Checkpoint(format!("source: {}: {problem}", path.display()));
        let text = read_text("source", path)?;
        let index: Index = serde_json::from_str(&text).map_err(|error| bad(error.to_string()))?;
        let mut files = BTreeSet::new();
        let mut weight_map = Vec::new();
        for (name, shard) in index.weight_map.0 {
            // A name with a folder in it could point anywhere on the disk.
            if Path::new(&shard).file_name() != Some(shard.as_ref()) {
                return Err(bad(format!(
                    "{name} is said to be in `{shard}`, expected a file name in the same directory"
                )));
            }
            files.insert(directory.join(&shard));
            weight_map.push((name, directory.join(shard)));
        }
        if files.is_empty() {
            return Err(bad("weight_map names no tensor".to_owned()));
        }
        Ok(Self {
            files: files.into_iter().collect(),
            weight_map,
        })
    }
}

/// What a file's header says.
struct Header {
    tensors: Vec<(String, TensorInfo)>,
    /// Where the data begins.
    data_start: u64,
    notes: BTreeMap<String, String>,
}

/// A file's header, checked against the file's length.
fn read_header(file: &mut File, length: u64) -> std::result::Result<Header, String> {
    let mut size = [0; 8];
    file.read_exact(&mut size)
        .map_err(|_| format!("not safetensors: {length} bytes, expected at least 8"))?;
    let size = u64::from_le_bytes(size);
    if size > MAX_HEADER_BYTES || size > length - 8 {
        return Err(format!(
            "not safetensors or truncated: header of {size} bytes in a file of {length}"
        ));
    }
    // At most `MAX_HEADER_BYTES`.
    let mut header = vec![0; size as usize];
    file.read_exact(&mut header)
        .map_err(|error| format!("header cannot be read: {error}"))?;
    let UniqueMap::<TensorInfo>(mut tensors) =
        serde_json::from_slice(&header).map_err(|error| format!("header: {error}"))?;
    // The library's own rules: offsets in order, without gaps or overlaps, each of the size that shape and type give.
    tensors.sort_by_key(|(_, info)| info.data_offsets);
    let metadata = Metadata::new(None, tensors.clone()).map_err(|error| format!("header: {error}"))?;
    // The sizes of all tensors together may be more than a number holds.
    let promised = metadata.data_len() as u64;
    if promised != length - 8 - size {
        return Err(format!(
            "truncated or with trailing bytes: {} bytes of data, the header promises {promised}",
            length - 8 - size
        ));
    }
    Ok(Header {
        tensors,
        data_start: 8 + size,
        notes: notes(&header),
    })
}

/// What a header says of its file, as far as it is text.
fn notes(header: &[u8]) -> BTreeMap<String, String> {
    #[derive(serde::Deserialize)]
    struct Notes {
        #[serde(rename = "__metadata__", default)]
        notes: BTreeMap<String, serde_json::Value>,
    }
    let found = serde_json::from_slice::<Notes>(header).map_or_else(|_| BTreeMap::new(), |found| found.notes);
    let text = |(key, note): (String, serde_json::Value)| Some((key, note.as_str()?.to_owned()));
    found.into_iter().filter_map(text).collect()
}

/// A JSON object from names of tensors, all different (the usual map types keep the last of two equal keys in silence) and printable, to
/// values. What a file says of itself, `__metadata__`, is left out.
pub(crate) struct UniqueMap<T>(pub Vec<(String, T)>);

impl<'de, T: Deserialize<'de>> Deserialize<'de> for UniqueMap<T> {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> std::result::Result<Self, D::Error> {
        struct Entries<T>(std::marker::PhantomData<T>);
        impl<'de, T: Deserialize<'de>> Visitor<'de> for Entries<T> {
            type Value = UniqueMap<T>;

            fn expecting(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                formatter.write_str("a JSON object")
            }

            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> std::result::Result<Self::Value, A::Error> {
                let mut seen = BTreeSet::new();
                let mut entries = Vec::new();
                while let Some(key) = map.next_key::<String>()? {
                    let bad = |problem: String| Err(serde::de::Error::custom(problem));
                    if !seen.insert(key.clone()) {
                        return bad(format!("{key} stands there twice"));
                    }
                    if key.chars().any(char::is_control) {
                        return bad(format!("the name {key:?} holds control characters"));
                    }
                    if key == METADATA {
                        map.next_value::<IgnoredAny>()?;
                        continue;
                    }
                    match map.next_value() {
                        Ok(value) => entries.push((key, value)),
                        Err(error) => return bad(format!("{key}: {error}")),
                    }
                }
                Ok(UniqueMap(entries))
            }
        }
        deserializer.deserialize_map(Entries(std::marker::PhantomData))
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write;

    use super::*;

    /// Two float32, `a`, in the file `name` of the temporary folder.
    fn two_numbers(name: &str) -> PathBuf {
        let path = std::env::temp_dir().join(format!("saccade-{}-{name}", std::process::id()));
        let header = r#"{"a":{"dtype":"F32","shape":[2],"data_offsets":[0,8]}}"#;
        let mut bytes = (header.len() as u64).to_le_bytes().to_vec();
        bytes.extend(header.as_bytes());
        bytes.extend([1.0f32, 2.0].iter().flat_map(|value| value.to_le_bytes()));
        std::fs::write(&path, bytes).unwrap();
        path
    }

    #[test]
    fn a_file_that_changes_after_it_was_opened_is_an_error() {
        type Change = fn(&Path) -> std::io::Result<()>;
        let changes: [(&str, &str, Change); 4] = [
            ("shrinks", "fill whole buffer", |path| {
                File::options().write(true).open(path)?.set_len(10)
            }),
            ("grows", "changed while it was read", |path| {
                File::options().append(true).open(path)?.write_all(b"more")
            }),
            ("rewritten", "changed while it was read", |path| {
                // The clock of a file moves in steps of some milliseconds.
                std::thread::sleep(std::time::Duration::from_millis(30));
                let length = std::fs::metadata(path)?.len();
                std::fs::write(path, vec![0; length as usize])
            }),
            ("emptied", "fill whole buffer", |path| {
                File::create(path).map(|_| ())
            }),
        ];
        for (name, expected, change) in changes {
            let path = two_numbers(name);
            let checkpoint = Checkpoint::open(&path).unwrap();
            assert!(checkpoint.read("a").is_ok());
            change(&path).unwrap();
            let error = checkpoint.read("a").unwrap_err().to_string();
            assert!(error.contains(expected), "{name}: {error}");
            std::fs::remove_file(&path).unwrap();
        }
    }

    #[test]
    fn a_file_that_is_removed_or_replaced_stays_what_it_was() {
        let path = two_numbers("removed");
        let checkpoint = Checkpoint::open(&path).unwrap();
        let other = two_numbers("other");
        std::fs::write(&other, b"something else").unwrap();
        std::fs::rename(&other, &path).unwrap();
        assert_eq!(checkpoint.read("a").unwrap(), Elements::F32(vec![1.0, 2.0]));
        std::fs::remove_file(&path).unwrap();
        assert_eq!(checkpoint.read("a").unwrap(), Elements::F32(vec![1.0, 2.0]));
    }

    #[test]
    fn slices_are_those_that_are_there() {
        let path = two_numbers("slices");
        let checkpoint = Checkpoint::open(&path).unwrap();
        assert_eq!(
            checkpoint.read_slices("a", 1..2).unwrap(),
            Elements::F32(vec![2.0])
        );
        #[allow(clippy::reversed_empty_ranges)]
        for wanted in [0..3, 3..3, 2..1, 0..usize::MAX] {
            assert!(checkpoint.read_slices("a", wanted).is_err());
        }
        std::fs::remove_file(&path).unwrap();
    }
}
