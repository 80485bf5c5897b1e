//! The tokenizer of Qwen2 and its descendants: byte-level BPE, run by the crate `tokenizers`.
//!
//! Files are read strictly: a tokenizer of another kind, or one with anything in it that would change ids silently, is an error.

mod find;
mod json;
mod parts;
mod slow;

use tokenizers::models::bpe::BPE;
use tokenizers::normalizers::NFC;
use tokenizers::pre_tokenizers::PreTokenizerWrapper;
use tokenizers::pre_tokenizers::byte_level::ByteLevel;
use tokenizers::pre_tokenizers::sequence::Sequence;
use tokenizers::pre_tokenizers::split::{Split, SplitPattern};
use tokenizers::{
    AddedToken, Decoder, DecoderWrapper, PostProcessorWrapper, SplitDelimiterBehavior, TokenizerImpl,
};

use crate::cache::Cache;
use crate::error::{Error, Problem, Result, bail, problem};
use find::FilesText;
use parts::{PATTERN, Parts};

pub use find::TokenizerFiles;

/// Longer text is refused before it is looked at: no model takes as many tokens, and the pattern gives up on a million spaces.
const MAX_TEXT_BYTES: usize = 1 << 18;

/// Texts whose ids are kept: a server has several tasks at a time, and guidance two prompts for each.
const RECENT_TEXTS: usize = 16;

/// Bytes of the longest of them.
const LONGEST_RECENT: usize = 1 << 14;

/// That text which errors call `name` is not too long to be split.
///
/// # Errors
/// [`Error::Input`] for more than 256 kB.
pub(super) fn check_length(name: &str, text: &str) -> Result<()> {
    match text.len() {
        ..=MAX_TEXT_BYTES => Ok(()),
        len => bail!(Input, name; expected "at most {MAX_TEXT_BYTES} bytes of text"; got "{len}"),
    }
}

type Inner = TokenizerImpl<BPE, NFC, Sequence, PostProcessorWrapper, DecoderWrapper>;

/// Text to token ids.
pub struct Tokenizer {
    inner: Inner,
    /// Ids of the texts that were asked for last: a control loop asks for the same prompt in every step.
    recent: Cache<String, Vec<u32>>,
    /// Number of tokens.
    len: usize,
}

impl Tokenizer {
    /// The tokenizer of a `tokenizer.json`, given as text.
    ///
    /// # Errors
    /// [`Error::Json`] for text that is not JSON; [`Error::Checkpoint`] for a tokenizer of another kind, and for everything that is wrong with
    /// this one, in one list.
    pub fn from_json(text: &str) -> Result<Self> {
        Self::build(json::parse(text)?)
    }

    /// The tokenizer of `vocab.json` and `merges.txt`, with the added tokens of `added_tokens.json` and `tokenizer_config.json`, given as text.
    ///
    /// # Errors
    /// As [`from_json`](Self::from_json).
    pub fn from_slow(
        vocab: &str,
        merges: &str,
        added_tokens: Option<&str>,
        tokenizer_config: Option<&str>,
    ) -> Result<Self> {
        Self::build(slow::parse(vocab, merges, added_tokens, tokenizer_config)?)
    }

    /// The tokenizer in these files.
    ///
    /// # Errors
    /// [`Error::File`] for a file that cannot be read, and those of [`from_json`](Self::from_json).
    pub fn read(files: &TokenizerFiles) -> Result<Self> {
        let tokenizer = match files.text()? {
            FilesText::Json(text) => Self::from_json(&text),
            FilesText::Slow {
                vocab,
                merges,
                added,
                config,
            } => Self::from_slow(&vocab, &merges, added.as_deref(), config.as_deref()),
        };
        tokenizer.map_err(|error| error.in_file(files.path()))
    }

    fn build(parts: Parts) -> Result<Self> {
        parts.check()?;
        let len = parts.len();
        let Parts {
            mut vocab,
            merges,
            added,
        } = parts;
        // Added tokens are in the vocabulary too, so that they keep the ids of the file: the crate numbers others in their order.
        vocab.extend(added.iter().map(|(id, token)| (token.content.clone(), *id)));
        let bpe = BPE::builder().vocab_and_merges(vocab, merges).build();
        let bpe = bpe.map_err(|problem| Error::Checkpoint(problem!("tokenizer"; "merges: {problem}")))?;
        let split = Split::new(
            SplitPattern::Regex(PATTERN.to_owned()),
            SplitDelimiterBehavior::Isolated,
            false,
        );
        let split = split.map_err(|problem| Error::Checkpoint(Problem::new("tokenizer", problem)))?;
        let mut inner = Inner::new(bpe);
        inner.with_normalizer(Some(NFC));
        inner.with_pre_tokenizer(Some(Sequence::new(vec![
            PreTokenizerWrapper::Split(split),
            PreTokenizerWrapper::ByteLevel(ByteLevel::new(false, true, false)),
        ])));
        let added: Vec<AddedToken> = added
            .into_iter()
            .map(|(_, token)| {
                AddedToken::from(token.content, token.special)
                    .single_word(token.single_word)
                    .lstrip(token.lstrip)
                    .rstrip(token.rstrip)
                    .normalized(token.normalized)
            })
            .collect();
        inner.add_tokens(&added);
        let recent = Cache::new(RECENT_TEXTS);
        Ok(Self { inner, recent, len })
    }

    /// The ids of `text`. Nothing is added at either end, and a special token's own string becomes that token.
    ///
    /// # Errors
    /// [`Error::Input`] for more than 256 kB of text.
    pub fn encode(&self, text: &str) -> Result<Vec<u32>> {
        check_length("text", text)?;
        self.ids("text", text)
    }

    /// The ids of `text`, which errors call `name`, however long it is.
    ///
    /// # Errors
    /// [`Error::Input`] for text that the crate refuses.
    pub(super) fn ids(&self, name: &str, text: &str) -> Result<Vec<u32>> {
        let ids = || {
            let encoding = self.inner.encode_fast(text, false);
            let encoding = encoding.map_err(|problem| Error::Input(Problem::new(name, problem)))?;
            Ok(encoding.get_ids().to_vec())
        };
        if text.len() > LONGEST_RECENT {
            return ids();
        }
        Ok(self.recent.get_or_insert(text.to_owned(), ids)?.to_vec())
    }

    /// The text of a token; none for an id that is no token's. Bytes that are no whole characters become U+FFFD.
    #[must_use]
    pub fn text_of(&self, id: u32) -> Option<String> {
        let token = self.inner.id_to_token(id)?;
        if self.inner.get_added_vocabulary().get_vocab().contains_key(&token) {
            return Some(token);
        }
        // Without others to join it with, a token is one string, and decoding bytes has no errors.
        ByteLevel::default()
            .decode_chain(vec![token])
            .ok()
            .map(|text| text.concat())
    }

    /// The id of a special token, found by its string.
    pub(super) fn id_of(&self, token: &str) -> Option<u32> {
        let added = self.inner.get_added_vocabulary();
        added.get_vocab().get(token).copied()
    }

    /// Whether no other special token's string contains this one. Since they are found from left to right, the
    /// longest first, a run of it is then always a run of its id.
    pub(super) fn stands_alone(&self, token: &str) -> bool {
        let added = self.inner.get_added_vocabulary().get_vocab();
        added.keys().all(|other| other == token || !other.contains(token))
    }

    /// Number of tokens, added ones included.
    #[must_use]
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there are no tokens; never, since such files are refused.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }
}
