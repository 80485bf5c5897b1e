//! Temporary files and directories, and small safetensors files.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};

/// A path in the temporary folder that no other test uses; what is there is removed at the end.
pub struct Temporary(PathBuf);

impl Temporary {
    pub fn new() -> Self {
        static COUNTER: AtomicUsize = AtomicUsize::new(0);
        let number = COUNTER.fetch_add(1, Ordering::Relaxed);
        Self(std::env::temp_dir().join(format!("saccade-checkpoint-{}-{number}", std::process::id())))
    }

    pub fn path(&self) -> &Path {
        &self.0
    }
}

impl Drop for Temporary {
    fn drop(&mut self) {
        let _ = match self.0.is_dir() {
            true => std::fs::remove_dir_all(&self.0),
            false => std::fs::remove_file(&self.0),
        };
    }
}

/// A safetensors file of vectors of float32.
#[allow(dead_code, reason = "the writer's tests need none")]
pub fn vectors(tensors: &[(&str, &[f32])]) -> Temporary {
    let (mut header, mut data) = (serde_json::Map::new(), Vec::new());
    for (name, values) in tensors {
        let start = data.len();
        data.extend(values.iter().flat_map(|value| value.to_le_bytes()));
        let info = serde_json::json!({
            "dtype": "F32", "shape": [values.len()], "data_offsets": [start, data.len()]
        });
        header.insert((*name).to_owned(), info);
    }
    let header = serde_json::Value::Object(header).to_string();
    let file = Temporary::new();
    let length = (header.len() as u64).to_le_bytes();
    std::fs::write(file.path(), [&length[..], header.as_bytes(), &data].concat()).unwrap();
    file
}
