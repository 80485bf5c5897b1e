//! The header of a safetensors file: which tensors it holds and where.

use std::collections::BTreeMap;

use safetensors::tensor::{Metadata, TensorInfo};

use crate::error::reserve;
use crate::lfs::{TELLING, pointer_problem};
use crate::source::{MAX_TEXT_BYTES, SourceFile};
use crate::unique_map::UniqueMap;

/// What a file's header says.
pub(crate) struct Header {
    pub tensors: Vec<(String, TensorInfo)>,
    /// Where the data begins.
    pub data_start: u64,
    /// What the file says of itself.
    pub metadata: BTreeMap<String, String>,
}

impl Header {
    /// The header of `file`, checked against the file's length. The error is what is wrong.
    pub(crate) fn read(file: &SourceFile) -> Result<Self, String> {
        let length = file.length();
        let mut size = [0; 8];
        file.read_at(&mut size, 0)
            .map_err(|_| format!("not safetensors: {length} bytes, expected at least 8"))?;
        let mut start = [0; TELLING];
        if file.read_at(&mut start, 0).is_ok()
            && let Some(problem) = pointer_problem(&file.path, &start)
        {
            return Err(problem);
        }
        let size = u64::from_le_bytes(size);
        if size > MAX_TEXT_BYTES || size > length - 8 {
            return Err(format!(
                "not safetensors or truncated: header of {size} bytes in a file of {length}"
            ));
        }
        let mut header = Vec::new();
        // At most `MAX_TEXT_BYTES`.
        reserve("source", &mut header, size as usize).map_err(|error| error.to_string())?;
        header.resize(size as usize, 0);
        file.read_at(&mut header, 8)
            .map_err(|error| format!("header cannot be read: {error}"))?;
        let UniqueMap::<TensorInfo>(mut tensors) =
            serde_json::from_slice(&header).map_err(|error| format!("header: {error}"))?;
        // The library's own rules: offsets in order, without gaps or overlaps, each of the size that shape and type give.
        tensors.sort_by_key(|(_, info)| info.data_offsets);
        let checked = Metadata::new(None, tensors.clone()).map_err(|error| format!("header: {error}"))?;
        // The sizes of all tensors together may be more than a number holds.
        let promised = checked.data_len() as u64;
        if promised != length - 8 - size {
            return Err(format!(
                "truncated or with trailing bytes: {} bytes of data, the header promises {promised}",
                length - 8 - size
            ));
        }
        Ok(Self {
            tensors,
            data_start: 8 + size,
            metadata: metadata(&header),
        })
    }
}

/// What a header says of its file, as far as it is text.
fn metadata(header: &[u8]) -> BTreeMap<String, String> {
    #[derive(serde::Deserialize)]
    struct OnlyMetadata {
        #[serde(rename = "__metadata__", default)]
        metadata: BTreeMap<String, serde_json::Value>,
    }
    let found = serde_json::from_slice::<OnlyMetadata>(header);
    let found = found.map_or_else(|_| BTreeMap::new(), |found| found.metadata);
    let text = |(key, value): (String, serde_json::Value)| Some((key, value.as_str()?.to_owned()));
    found.into_iter().filter_map(text).collect()
}
