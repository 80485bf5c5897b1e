//! What both kinds of files describe: a vocabulary, merges and added tokens; and everything that can be wrong with them.

use std::collections::{HashMap, HashSet};
use std::fmt;

use serde::de::{Deserialize, Deserializer, Error as _, MapAccess, Visitor};
use tokenizers::models::bpe::{Merges, Vocab};
use tokenizers::pre_tokenizers::byte_level::ByteLevel;

use crate::error::{Error, Result, bail};

/// No model has as many rows in its embedding table.
const MAX_ID: u32 = 1 << 24;

/// Problems that one error lists.
const MAX_PROBLEMS: usize = 20;

/// How Qwen2 splits text before BPE.
pub(super) const PATTERN: &str = r"(?i:'s|'t|'re|'ve|'m|'ll|'d)|[^\r\n\p{L}\p{N}]?\p{L}+|\p{N}| ?[^\s\p{L}\p{N}]+[\r\n]*|\s*[\r\n]+|\s+(?!\S)|\s+";

/// A token that is found in text before anything else.
#[derive(Clone, Debug, Default, PartialEq, Eq, serde::Deserialize)]
pub(super) struct Added {
    pub content: String,
    #[serde(default)]
    pub special: bool,
    #[serde(default)]
    pub single_word: bool,
    #[serde(default)]
    pub lstrip: bool,
    #[serde(default)]
    pub rstrip: bool,
    #[serde(default)]
    pub normalized: bool,
}

impl Added {
    /// A token that is matched as it stands.
    pub(super) fn plain(content: String) -> Self {
        Self {
            content,
            special: true,
            ..Self::default()
        }
    }
}

/// A tokenizer as its files describe it.
#[derive(Default)]
pub(super) struct Parts {
    pub vocab: Vocab,
    pub merges: Merges,
    /// By their ids.
    pub added: Vec<(u32, Added)>,
}

impl Parts {
    /// Number of different ids.
    pub(super) fn len(&self) -> usize {
        let added = self
            .added
            .iter()
            .filter(|(_, token)| !self.vocab.contains_key(&token.content));
        self.vocab.len() + added.count()
    }

    /// That the parts fit each other.
    ///
    /// # Errors
    /// [`Error::Checkpoint`] that lists what does not.
    pub(super) fn check(&self) -> Result<()> {
        let mut problems = Problems::default();
        self.check_ids(&mut problems);
        self.check_alphabet(&mut problems);
        self.check_merges(&mut problems);
        problems.into_result()
    }

    fn check_ids(&self, problems: &mut Problems) {
        let mut tokens: HashMap<u32, &str> = HashMap::with_capacity(self.vocab.len());
        let mut contents = HashSet::new();
        let added = self.added.iter().map(|(id, token)| (token.content.as_str(), *id));
        let vocab = self.vocab.iter().map(|(token, &id)| (token.as_str(), id));
        for (token, id) in vocab.chain(added) {
            if id >= MAX_ID {
                problems.add(|| format!("{token:?}: expected an id below {MAX_ID}, got {id}"));
            }
            if let Some(other) = tokens.insert(id, token)
                && other != token
            {
                problems.add(|| format!("{token:?} and {other:?} have the same id, {id}"));
            }
        }
        for (id, token) in &self.added {
            if token.content.is_empty() {
                problems.add(|| format!("the added token {id} is empty"));
            }
            if !contents.insert(&token.content) {
                problems.add(|| format!("{:?} is added twice", token.content));
            }
            if let Some(known) = self.vocab.get(&token.content).filter(|known| *known != id) {
                problems.add(|| {
                    format!(
                        "{:?}: expected the id of the vocabulary, {known}, got {id}",
                        token.content
                    )
                });
            }
        }
    }

    /// Text that no token stands for would be dropped without a word.
    fn check_alphabet(&self, problems: &mut Problems) {
        let alphabet = ByteLevel::alphabet();
        let missing = alphabet
            .iter()
            .filter(|byte| !self.vocab.contains_key(byte.encode_utf8(&mut [0; 4]) as &str));
        match missing.count() {
            0 => {}
            missing => problems.add(|| format!("vocab: {missing} of the 256 byte tokens are missing")),
        }
    }

    fn check_merges(&self, problems: &mut Problems) {
        let mut seen = HashSet::with_capacity(self.merges.len());
        let mut merged = String::new();
        for (rank, pair) in self.merges.iter().enumerate() {
            let (left, right) = pair;
            if left.is_empty() || right.is_empty() {
                problems.add(|| format!("merges: {rank}: expected two tokens, got {pair:?}"));
                continue;
            }
            merged.clear();
            merged.extend([left.as_str(), right]);
            let ids = [left.as_str(), right, &merged].map(|token| {
                let id = self.vocab.get(token).copied();
                if id.is_none() {
                    problems.add(|| format!("merges: {rank}: {token:?} is not in the vocabulary"));
                }
                id
            });
            if !seen.insert((ids[0], ids[1])) && ids.iter().all(Option::is_some) {
                problems.add(|| format!("merges: {rank}: {pair:?} appears twice"));
            }
        }
    }
}

/// The two tokens of a line, with one space between them.
pub(super) fn pair(line: &str) -> Option<(String, String)> {
    let (left, right) = line.split_once(' ')?;
    (!right.contains(' ')).then(|| (left.to_owned(), right.to_owned()))
}

/// What is wrong with a tokenizer.
#[derive(Default)]
pub(super) struct Problems {
    listed: Vec<String>,
    more: usize,
}

impl Problems {
    pub(super) fn add(&mut self, problem: impl FnOnce() -> String) {
        match self.listed.len() < MAX_PROBLEMS {
            true => self.listed.push(problem()),
            false => self.more += 1,
        }
    }

    /// # Errors
    /// [`Error::Checkpoint`] if there is a problem.
    pub(super) fn into_result(mut self) -> Result<()> {
        // Maps have no order of their own.
        self.listed.sort();
        if self.more > 0 {
            self.listed.push(format!("and {} more", self.more));
        }
        match &self.listed[..] {
            [] => Ok(()),
            [problem] => bail!(Checkpoint, "tokenizer"; "{problem}"),
            problems => bail!(Checkpoint, "tokenizer"; "it is broken:\n  {}", problems.join("\n  ")),
        }
    }
}

/// Ids by token, each token once.
#[derive(Default)]
pub(super) struct Ids(pub Vocab);

impl<'de> Deserialize<'de> for Ids {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> std::result::Result<Self, D::Error> {
        struct Entries;
        impl<'de> Visitor<'de> for Entries {
            type Value = Ids;

            fn expecting(&self, formatter: &mut fmt::Formatter) -> fmt::Result {
                formatter.write_str("an object of tokens and their ids")
            }

            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> std::result::Result<Ids, A::Error> {
                let mut ids = Vocab::new();
                while let Some((token, id)) = map.next_entry::<String, u32>()? {
                    if ids.contains_key(&token) {
                        return Err(A::Error::custom(format!("{token:?} appears twice")));
                    }
                    ids.insert(token, id);
                }
                Ok(Ids(ids))
            }
        }
        deserializer.deserialize_map(Entries)
    }
}
