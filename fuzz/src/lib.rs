//! What the fuzz targets share: using what an input holds as the engine does, and folders in memory.

use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use saccade_vla::{
    Array, Frame, HeadCheckpoint, HeadConfig, Observation, Preprocessing, Processor, ProcessorOptions,
    ProcessorSource, ResizeOptions, RewriteOptions, Tokenizer, TokenizerFiles, resize, resized_config,
    tensor_shapes,
};
use saccade_vla_checkpoint::spec::TensorSpec;
use saccade_vla_checkpoint::{Checkpoint, Companions};

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
            Ok(read) => {
                let values = read.into_f32().expect("twice the file fits in memory");
                assert_eq!(values.len(), elements, "{name}");
            }
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
            Ok::<(), saccade_vla_checkpoint::Error>(())
        });
        match read {
            Ok(()) => assert_eq!(nbytes, checkpoint.nbytes(name).expect("it was read")),
            Err(error) => check_message(&error),
        }
    }
    let expected = [TensorSpec::plain("weight", &[2, 3]), TensorSpec::plain("a", &[])];
    for prefix in ["", "action_head."] {
        for problem in checkpoint.problems(prefix, &expected, |_, shape| shape.is_empty()) {
            assert!(!problem.text().is_empty());
        }
    }
    if let Err(error) = Companions::of(path, checkpoint.files()) {
        check_message(&error);
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
    for (name, shape) in tensor_shapes(config).expect("nothing stops it") {
        let size = shape
            .iter()
            .try_fold(4usize, |product, &size| product.checked_mul(size));
        assert!(size.is_some(), "{name} overflows");
    }
}

/// Says what the checkpoint of this `config.json` and this header is, as every command does. The file has all the bytes that the header
/// promises, up to some gigabytes, which take no memory as long as nobody reads them.
pub fn use_published(folder: &Path, config: &str, header: &[u8]) {
    write_checkpoint(folder, config, header, b"", 1 << 33);
    let published = match HeadCheckpoint::open(folder, None) {
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
    if let Err(error) = published.kept_embodiments() {
        check_message(&error);
    }
}

/// Resizes the checkpoint of this `config.json`, this header and these bytes, repeated; it may be refused.
pub fn use_resize(folder: &Path, count: usize, config: &str, header: &[u8], bytes: &[u8]) {
    if let Ok(before) = HeadConfig::from_json(config) {
        match resized_config(config, count) {
            Ok(text) => check_resized_config(&text, &before, count),
            Err(error) => check_message(&error),
        }
    }
    let (source, out) = (folder.join("source"), folder.join("out"));
    let _ = fs::create_dir(&source);
    write_checkpoint(&source, config, header, bytes, 1 << 20);
    let mut options = ResizeOptions::new(RewriteOptions::default(), count);
    // Some inputs with what is added to copies, some without.
    options.perturbation = f64::from(u8::from(count % 2 == 1));
    match resize(&source, &out, &options, |_, _| true) {
        Ok(report) => {
            assert_eq!((report.num_after, report.sources.len()), (count, count));
            let published = HeadCheckpoint::open(&out, None).expect("what was written can be read");
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

/// The new config says the new number and no biases, and otherwise what the old one said.
fn check_resized_config(text: &str, before: &HeadConfig, count: usize) {
    let mut expected = before.clone();
    (expected.num_future_tokens, expected.future_key_bias) = (count, None);
    let after = HeadConfig::from_json(text).expect("a config stays a config");
    assert_eq!(after, expected);
}

/// A small tokenizer that works.
const TOKENIZER: &str = concat!(
    env!("CARGO_MANIFEST_DIR"),
    "/../tests/data/backbone/tiny_tokenizer.json"
);

/// Makes a tokenizer of one file or of several, and tokens of some text.
pub fn use_tokenizer(files: &[&str]) {
    let read = match files {
        [vocab, merges, others @ ..] => {
            Tokenizer::from_slow(vocab, merges, others.first().copied(), others.get(1).copied())
        }
        _ => Tokenizer::from_json(files[0]),
    };
    let tokenizer = match read {
        Ok(tokenizer) => tokenizer,
        Err(error) => return check_message(&error),
    };
    for text in [
        "",
        "open the drawer",
        "<|im_end|> e\u{301} \u{3000}\r\n 12",
        files[0],
    ] {
        match tokenizer.encode(text) {
            Ok(ids) => assert!(ids.len() <= 4 * text.len(), "more tokens than bytes"),
            Err(error) => check_message(&error),
        }
    }
    for version in ["n1.5", "n1.7"] {
        let tokenizer = match files {
            [json] => Tokenizer::from_json(json),
            _ => return,
        };
        let tokenizer = tokenizer.expect("it was read before");
        if let Err(error) = Processor::new(version, tokenizer, &ProcessorOptions::default()) {
            check_message(&error);
        }
    }
}

/// Makes processors with these options, and with them inputs of a small frame and of the instruction.
pub fn use_processor(options: &str, instruction: Option<&str>) {
    let pixels: Vec<u8> = (0..5 * 7 * 3).collect();
    let frame = Frame::U8(Array::new(&pixels, &[5, 7, 3]).expect("the sizes fit"));
    for version in ["n1.5", "n1.6", "n1.7"] {
        for preprocessing in [Preprocessing::Lerobot, Preprocessing::Isaac] {
            let given = ProcessorOptions {
                preprocessing: Some(preprocessing),
                options: Some(options),
                ..ProcessorOptions::default()
            };
            let processor = match Processor::new(version, tokenizer(), &given) {
                Ok(processor) => processor,
                Err(error) => {
                    check_message(&error);
                    continue;
                }
            };
            let observation = Observation {
                views: vec![(Some("front"), frame), (Some("wrist"), frame)],
                instruction,
                ..Observation::default()
            };
            match processor.process(&[observation]) {
                Ok(inputs) => {
                    assert_eq!(inputs.input_ids.len(), inputs.length);
                    let image = i64::from(processor.image_token_id());
                    let found = inputs.input_ids.iter().filter(|id| **id == image).count();
                    let expected = 2 * processor.view(frame).expect("it was one before").tokens;
                    assert_eq!(found, expected, "image tokens");
                }
                Err(error) => check_message(&error),
            }
        }
    }
}

/// Reads the text as every file that a checkpoint may keep options in.
pub fn use_processor_files(folder: &Path, text: &str) {
    const HEADER: &[u8] =
        br#"{"backbone.model.model.visual.x":{"dtype":"F32","shape":[],"data_offsets":[0,4]}}"#;
    for name in [
        "processor_config.json",
        "preprocessor_config.json",
        "policy_preprocessor.json",
    ] {
        write_checkpoint(folder, r#"{"type":"groot"}"#, HEADER, b"", 4);
        fs::write(folder.join(name), text).expect("memory is not full");
        let files = TokenizerFiles::at(Path::new(TOKENIZER)).expect("it is in the repository");
        match ProcessorSource::open(folder).and_then(|source| source.processor(Some(&files), None, None)) {
            Ok(processor) => assert_eq!(processor.version(), "n1.7"),
            Err(error) => check_message(&error),
        }
        fs::remove_file(folder.join(name)).expect("it was just written");
    }
}

fn tokenizer() -> Tokenizer {
    static TEXT: LazyLock<String> =
        LazyLock::new(|| fs::read_to_string(TOKENIZER).expect("it is in the repository"));
    Tokenizer::from_json(&TEXT).expect("it works")
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
pub fn check_message(error: &dyn std::error::Error) {
    let message = error.to_string();
    assert!(!message.is_empty());
    assert!(
        message.chars().all(|c| c == '\n' || !c.is_control()),
        "control characters: {message:?}"
    );
    assert!(message.len() < 1_000_000, "a message of {} bytes", message.len());
}
