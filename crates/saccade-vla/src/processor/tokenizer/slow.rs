//! `vocab.json`, `merges.txt`, `added_tokens.json` and `tokenizer_config.json`: what repositories have that hold no `tokenizer.json`.

use std::collections::BTreeMap;

use serde::Deserialize;
use tokenizers::models::bpe::Merges;

use super::parts::{Added, Ids, Parts, Problems, pair};
use crate::error::{Error, Result};

/// What is read of `tokenizer_config.json`.
#[derive(Default, Deserialize)]
struct Config {
    #[serde(default)]
    added_tokens_decoder: BTreeMap<String, Added>,
    #[serde(default)]
    add_prefix_space: Option<bool>,
    #[serde(default)]
    add_bos_token: Option<bool>,
    #[serde(default)]
    add_eos_token: Option<bool>,
}

/// The parts of these files, given as text.
///
/// # Errors
/// [`Error::Json`] for text that is not JSON or has other types; [`Error::Checkpoint`] for everything that the files disagree on.
pub(super) fn parse(
    vocab: &str,
    merges: &str,
    added_tokens: Option<&str>,
    tokenizer_config: Option<&str>,
) -> Result<Parts> {
    let mut problems = Problems::default();
    let Ids(vocab) = from_json("vocab.json", vocab)?;
    let merges = parse_merges(merges, &mut problems);
    let Ids(by_content) = match added_tokens {
        None => Ids::default(),
        Some(text) => from_json("added_tokens.json", text)?,
    };
    let config: Config = match tokenizer_config {
        None => Config::default(),
        Some(text) => from_json("tokenizer_config.json", text)?,
    };
    for (key, is_set) in [
        ("add_prefix_space", config.add_prefix_space),
        ("add_bos_token", config.add_bos_token),
        ("add_eos_token", config.add_eos_token),
    ] {
        if is_set == Some(true) {
            problems.add(|| format!("tokenizer_config.json: {key}: expected false, got true"));
        }
    }
    let mut added: BTreeMap<u32, Added> = by_content
        .into_iter()
        .map(|(content, id)| (id, Added::plain(content)))
        .collect();
    for (key, token) in config.added_tokens_decoder {
        let Ok(id) = key.parse() else {
            problems
                .add(|| format!("tokenizer_config.json: added_tokens_decoder: expected an id, got {key:?}"));
            continue;
        };
        if let Some(other) = added.get(&id).filter(|other| other.content != token.content) {
            problems.add(|| {
                format!(
                    "{id} is {:?} in added_tokens.json and {:?} in tokenizer_config.json",
                    other.content, token.content
                )
            });
        }
        added.insert(id, token);
    }
    problems.into_result()?;
    Ok(Parts {
        vocab,
        merges,
        added: added.into_iter().collect(),
    })
}

fn from_json<'a, T: Deserialize<'a>>(file: &str, text: &'a str) -> Result<T> {
    serde_json::from_str(text).map_err(|source| Error::json(format!("tokenizer: {file}"), source))
}

/// The lines of `merges.txt`: two tokens each, after a line that says which version of the format it is.
fn parse_merges(text: &str, problems: &mut Problems) -> Merges {
    let mut merges = Merges::new();
    for (index, line) in text.lines().enumerate() {
        let line = line.trim_matches([' ', '\r', '\t']);
        if line.is_empty() || (index == 0 && line.starts_with("#version")) {
            continue;
        }
        let number = index + 1;
        match pair(line) {
            Some(pair) => merges.push(pair),
            None => problems.add(|| format!("merges.txt: line {number}: expected two tokens, got {line:?}")),
        }
    }
    merges
}
