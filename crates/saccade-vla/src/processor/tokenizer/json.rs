//! `tokenizer.json`, the format of the crate `tokenizers`: those of Qwen2's kind.

use std::fmt;

use serde_json::{Value, json};

use super::parts::{Added, Ids, PATTERN, Parts, Problems, pair};
use crate::error::{Error, Result};

#[derive(serde::Deserialize)]
struct File {
    truncation: Option<Value>,
    padding: Option<Value>,
    #[serde(default)]
    added_tokens: Vec<FileAdded>,
    normalizer: Option<Value>,
    pre_tokenizer: Option<Value>,
    post_processor: Option<Value>,
    model: Model,
}

#[derive(serde::Deserialize)]
struct FileAdded {
    id: u32,
    #[serde(flatten)]
    token: Added,
}

#[derive(serde::Deserialize)]
struct Model {
    #[serde(rename = "type")]
    kind: Option<String>,
    dropout: Option<f64>,
    unk_token: Option<String>,
    continuing_subword_prefix: Option<String>,
    end_of_word_suffix: Option<String>,
    #[serde(default)]
    byte_fallback: bool,
    #[serde(default)]
    ignore_merges: bool,
    vocab: Ids,
    merges: Vec<Merge>,
}

/// A merge: two strings, or, in older files, one with a space between them.
#[derive(serde::Deserialize)]
#[serde(untagged, expecting = "expected two tokens")]
enum Merge {
    Pair(String, String),
    Line(String),
}

/// The parts of a `tokenizer.json`.
///
/// # Errors
/// [`Error::Json`] for text that is not JSON or has other types; [`Error::Checkpoint`] that lists everything in which it differs from Qwen2's.
pub(super) fn parse(text: &str) -> Result<Parts> {
    let file: File = serde_json::from_str(text).map_err(|source| Error::json("tokenizer", source))?;
    let mut problems = Problems::default();
    check_kind(&file, &mut problems);
    let added = file.added_tokens.into_iter();
    let merges = file.model.merges.into_iter().enumerate();
    let merges = merges.map(|(rank, merge)| match merge {
        Merge::Pair(left, right) => (left, right),
        Merge::Line(line) => pair(&line).unwrap_or_else(|| {
            problems.add(|| format!("merges: {rank}: expected two tokens, got {line:?}"));
            Default::default()
        }),
    });
    let merges = merges.collect();
    problems.into_result()?;
    Ok(Parts {
        vocab: file.model.vocab.0,
        merges,
        added: added.map(|added| (added.id, added.token)).collect(),
    })
}

/// That the file asks for nothing but what [`Tokenizer`](super::Tokenizer) does.
fn check_kind(file: &File, problems: &mut Problems) {
    let mut differs = |key: &str, expected: &str, got: &dyn fmt::Display| {
        problems.add(|| format!("{key}: expected {expected}, got {got}"));
    };
    let model = &file.model;
    // Old files do not name the only kind that has merges.
    let kind = model.kind.as_deref().unwrap_or("BPE");
    if kind != "BPE" {
        differs("model.type", "BPE", &kind);
    }
    if let Some(dropout) = model.dropout.filter(|dropout| *dropout != 0.0) {
        differs("model.dropout", "none", &dropout);
    }
    for (key, text) in [
        ("model.unk_token", &model.unk_token),
        (
            "model.continuing_subword_prefix",
            &model.continuing_subword_prefix,
        ),
        ("model.end_of_word_suffix", &model.end_of_word_suffix),
    ] {
        if let Some(text) = text.as_ref().filter(|text| !text.is_empty()) {
            differs(key, "none", text);
        }
    }
    for (key, is_set) in [
        ("model.byte_fallback", model.byte_fallback),
        ("model.ignore_merges", model.ignore_merges),
    ] {
        if is_set {
            differs(key, "false", &is_set);
        }
    }
    for (key, part) in [("truncation", &file.truncation), ("padding", &file.padding)] {
        if let Some(part) = part {
            differs(key, "null", part);
        }
    }
    let normalizer = json!({"type": "NFC"});
    let given = file.normalizer.as_ref().unwrap_or(&Value::Null);
    if *given != normalizer {
        differs("normalizer", &normalizer.to_string(), given);
    }
    let given = file.pre_tokenizer.as_ref().unwrap_or(&Value::Null);
    if !is_pre_tokenizer(given) {
        differs("pre_tokenizer", "Qwen2's (a Split and a ByteLevel)", given);
    }
    let post_processor = file.post_processor.as_ref();
    if let Some(given) = post_processor.filter(|given| given["type"] != "ByteLevel") {
        differs("post_processor", "ByteLevel or none", given);
    }
}

/// Whether it splits by Qwen2's pattern and then makes bytes of the parts.
fn is_pre_tokenizer(given: &Value) -> bool {
    let Some([split, bytes]) = given["pretokenizers"].as_array().map(Vec::as_slice) else {
        return false;
    };
    given["type"] == "Sequence"
        && split["type"] == "Split"
        && split["pattern"] == json!({"Regex": PATTERN})
        && split["behavior"] == "Isolated"
        && split["invert"] == false
        && bytes["type"] == "ByteLevel"
        && bytes["add_prefix_space"] == false
        && bytes["use_regex"] == false
}
