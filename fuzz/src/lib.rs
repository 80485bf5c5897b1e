//! What the fuzz targets share: the files of `crates/saccade` that read checkpoints, and folders in memory.
//!
//! The files are compiled by path. So the targets reach what is private, and `saccade-kernels`, which takes minutes to build and reads no
//! file, stays out.

#![allow(dead_code)]

#[path = "../../crates/saccade/src/checkpoint.rs"]
pub mod checkpoint;
#[path = "../../crates/saccade/src/companions.rs"]
pub mod companions;
#[path = "../../crates/saccade/src/config.rs"]
pub mod config;
#[path = "../../crates/saccade/src/convert.rs"]
pub mod convert;
#[path = "../../crates/saccade/src/error.rs"]
pub mod error;
#[path = "../../crates/saccade/src/fit.rs"]
pub mod fit;
#[path = "../../crates/saccade/src/layout.rs"]
pub mod layout;
#[path = "../../crates/saccade/src/recognise.rs"]
pub mod recognise;
#[path = "../../crates/saccade/src/resize.rs"]
pub mod resize;
#[path = "../../crates/saccade/src/rewrite.rs"]
pub mod rewrite;
#[path = "../../crates/saccade/src/writer.rs"]
pub mod writer;

/// What the files above want of `head.rs`, which needs the kernels.
mod head {
    use crate::error::Result;

    pub(crate) fn chosen_embodiments(_: Option<&[i64]>, _: Option<&[i64]>, _: usize) -> Result<Vec<usize>> {
        unreachable!("no target converts")
    }
}

use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};

use checkpoint::Checkpoint;
use config::HeadConfig;
use layout::tensor_specs;
use recognise::Published;
use resize::ResizeOptions;

/// More than any tensor of an input: reading may not take more memory than the file has bytes, twice for widened halves.
const MAX_BYTES_READ: usize = 1 << 26;

/// An empty folder of this process in memory.
#[must_use]
pub fn folder(name: &str) -> PathBuf {
    let memory = Path::new("/dev/shm");
    let parent = if memory.is_dir() {
        memory.to_owned()
    } else {
        std::env::temp_dir()
    };
    let folder = parent.join(format!("saccade-fuzz-{name}-{}", std::process::id()));
    let _ = fs::remove_dir_all(&folder);
    fs::create_dir(&folder).expect("a folder can be made");
    folder
}

/// Opens `path` and uses the checkpoint as the engine does; only errors may come of it.
pub fn use_checkpoint(path: &Path) {
    let checkpoint = match Checkpoint::open(path) {
        Ok(checkpoint) => checkpoint,
        Err(error) => return check_message(&error),
    };
    let names: Vec<String> = checkpoint.names().map(str::to_owned).collect();
    for name in &names {
        let elements: usize = checkpoint.shape(name).expect("it has a shape").iter().product();
        assert!(elements <= MAX_BYTES_READ, "{name} is larger than the file");
        match checkpoint.read(name) {
            Ok(read) => assert_eq!(read.into_f32().len(), elements, "{name}"),
            Err(error) => check_message(&error),
        }
        for wanted in [0..0, 0..1, 1..3, 2..1, 0..usize::MAX] {
            if let Err(error) = checkpoint.read_slices(name, wanted) {
                check_message(&error);
            }
        }
        let mut nbytes = 0;
        let read = checkpoint.read_bytes(name, |bytes| {
            nbytes += bytes.len() as u64;
            Ok(())
        });
        match read {
            Ok(()) => assert_eq!(nbytes, checkpoint.nbytes(name).expect("it was read")),
            Err(error) => check_message(&error),
        }
    }
    if let Err(error) = checkpoint.kept_embodiments() {
        check_message(&error);
    }
    match checkpoint.head_prefix() {
        Ok(prefix) => {
            let config = HeadConfig::from_json(include_str!("../config.json")).expect("config.json is valid");
            if let Err(error) = checkpoint.check(prefix, &config) {
                check_message(&error);
            }
        }
        Err(error) => check_message(&error),
    }
}

/// Reads the text of a `config.json` and makes the names and shapes of the head that it describes.
pub fn use_config(text: &str) {
    match HeadConfig::from_json(text) {
        Ok(config) => use_head_config(&config),
        Err(error) => check_message(&error),
    }
}

fn use_head_config(config: &HeadConfig) {
    assert!(config.num_rows() > config.action_horizon);
    let names = HeadNames::new(config);
    for tensor in names.tensors() {
        let size = tensor
            .shape
            .iter()
            .try_fold(4usize, |product, &size| product.checked_mul(size));
        assert!(size.is_some(), "{} overflows", tensor.name);
    }
    let ids: Vec<usize> = (0..config.num_embodiments.min(3)).collect();
    assert!(!names.reading_order(config, &ids).is_empty());
}

/// Says what the checkpoint of this `config.json` and this header is, as every command does. The file has all the bytes that the header
/// promises, up to some gigabytes, which take no memory as long as nobody reads them.
pub fn use_published(folder: &Path, config: &str, header: &[u8]) {
    write_checkpoint(folder, config, header, b"", 1 << 33);
    let published = match Published::open(folder, None) {
        Ok(published) => published,
        Err(error) => return check_message(&error),
    };
    use_head_config(&published.config);
    let again = HeadConfig::from_json(&published.config_json).expect("its own config can be read");
    assert_eq!(again, published.config);
    assert_eq!(published.tensors().count(), published.checkpoint.names().count());
    if let Err(error) = published.check() {
        check_message(&error);
    }
}

/// Resizes the checkpoint of this `config.json`, this header and these bytes, repeated; it may be refused.
pub fn use_resize(folder: &Path, count: usize, config: &str, header: &[u8], bytes: &[u8]) {
    if let Ok(parsed) = HeadConfig::from_json(config) {
        match resize::plan(&parsed, config, count) {
            Ok(plan) => check_plan(&plan, &parsed, count),
            Err(error) => check_message(&error),
        }
    }
    let (source, out) = (folder.join("source"), folder.join("out"));
    let _ = fs::create_dir(&source);
    write_checkpoint(&source, config, header, bytes, 1 << 20);
    let options = ResizeOptions {
        num_future_tokens: count,
        // Some inputs with what is added to copies, some without.
        perturbation: f64::from(u8::from(count % 2 == 1)),
        ..ResizeOptions::default()
    };
    match resize::resize(&source, &out, &options, |_, _| true) {
        Ok(report) => {
            assert_eq!((report.num_after, report.sources.len()), (count, count));
            let published = Published::open(&out, None).expect("what was written can be read");
            published.check().expect("what was written fits");
            assert_eq!(published.config.num_future_tokens, count);
            assert_eq!(published.config.future_key_bias, report.future_key_bias);
            fs::remove_dir_all(&out).expect("what was written can be removed");
        }
        Err(error) => {
            check_message(&error);
            assert!(!out.exists(), "half a checkpoint: {error}");
        }
    }
    assert_eq!(
        fs::read_dir(folder).expect("the folder is there").count(),
        1,
        "something was left behind"
    );
}

/// The planned config says the new number, and is the old one else.
fn check_plan(plan: &resize::Plan, before: &HeadConfig, count: usize) {
    let (text, own) = plan.config(None);
    if own.is_none()
        && let Ok(after) = HeadConfig::from_json(&text)
    {
        let expected = HeadConfig {
            num_future_tokens: count,
            future_key_bias: None,
            ..before.clone()
        };
        assert_eq!(after, expected);
    }
}

/// `config.json` and a file of this header, `bytes` behind it, repeated up to the length that the header promises, but not longer than `most`.
fn write_checkpoint(folder: &Path, config: &str, header: &[u8], bytes: &[u8], most: u64) {
    fs::write(folder.join("config.json"), config).expect("memory is not full");
    let mut file = File::create(folder.join("model.safetensors")).expect("memory is not full");
    let mut start = (header.len() as u64).to_le_bytes().to_vec();
    start.extend(header);
    let promised = promised(header).min(most);
    let length = start.len() as u64 + promised;
    if !bytes.is_empty() {
        start.extend(bytes.iter().cycle().take(promised as usize));
    }
    file.write_all(&start).expect("memory is not full");
    file.set_len(length).expect("holes take no memory");
}

/// The end of the last tensor by this header, whatever else is wrong with it.
fn promised(header: &[u8]) -> u64 {
    let ends = |header: serde_json::Value| {
        let tensors = header.as_object()?.values();
        tensors
            .filter_map(|tensor| tensor.get("data_offsets")?.get(1)?.as_u64())
            .max()
    };
    serde_json::from_slice(header).ok().and_then(ends).unwrap_or(0)
}

/// The pieces of an input between lines of `====`, at most `count`.
#[must_use]
pub fn split(mut bytes: &[u8], count: usize) -> Vec<&[u8]> {
    const BETWEEN: &[u8] = b"\n====\n";
    let mut pieces = Vec::new();
    while pieces.len() + 1 < count {
        let Some(at) = bytes.windows(BETWEEN.len()).position(|window| window == BETWEEN) else {
            break;
        };
        pieces.push(&bytes[..at]);
        bytes = &bytes[at + BETWEEN.len()..];
    }
    pieces.push(bytes);
    pieces
}

/// A message is not empty, short enough to read and does nothing to a terminal.
pub fn check_message(error: &error::Error) {
    let message = error.to_string();
    assert!(!message.is_empty());
    assert!(
        message.chars().all(|c| c == '\n' || !c.is_control()),
        "control characters: {message:?}"
    );
    assert!(message.len() < 1_000_000, "a message of {} bytes", message.len());
}
