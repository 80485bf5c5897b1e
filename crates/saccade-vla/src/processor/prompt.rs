//! The prompt of each version, as text.

use std::sync::LazyLock;

use regex::Regex;

use super::python_text::{formalized, list_of};
use super::settings::{Preprocessing, Settings};
use super::tokenizer::Tokenizer;
use crate::config::Version;
use crate::error::{Error, Result, problem};

/// What the released processor of N1.5 and N1.6 replaces by a frame, wherever it stands in the prompt.
static PLACEHOLDER: LazyLock<Regex> =
    LazyLock::new(|| Regex::new(r"<(image|video)-\p{Nd}+>").expect("the pattern is written here"));

/// The tokens around and in place of a view.
struct ViewTokens {
    start: &'static str,
    image: &'static str,
    end: &'static str,
}

const EAGLE: ViewTokens = ViewTokens {
    start: "<img>",
    image: "<IMG_CONTEXT>",
    end: "</img>",
};

const QWEN: ViewTokens = ViewTokens {
    start: "<|vision_start|>",
    image: "<|image_pad|>",
    end: "<|vision_end|>",
};

const SYSTEM: &str = "<|im_start|>system\nYou are a helpful assistant.<|im_end|>\n";
const USER: &str = "<|im_start|>user\n";
const TURN_END: &str = "<|im_end|>\n";
const ASSISTANT: &str = "<|im_start|>assistant\n";

fn view_tokens(version: Version) -> &'static ViewTokens {
    match version {
        Version::N17 => &QWEN,
        _ => &EAGLE,
    }
}

/// Ids that a prompt needs, by what they are for.
#[derive(Clone, Copy, Debug)]
pub(super) struct SpecialIds {
    /// Stands for a token of an image.
    pub image: u32,
    /// Fills up a batch.
    pub padding: u32,
}

impl SpecialIds {
    /// Those of `tokenizer` for a version.
    ///
    /// # Errors
    /// [`Error::Checkpoint`] that lists the special tokens which it lacks.
    pub(super) fn find(tokenizer: &Tokenizer, version: Version) -> Result<Self> {
        const PADDING: &str = "<|endoftext|>";
        let view = view_tokens(version);
        let needed = [
            PADDING,
            "<|im_start|>",
            "<|im_end|>",
            view.start,
            view.image,
            view.end,
        ];
        let missing: Vec<&str> = needed
            .into_iter()
            .filter(|token| tokenizer.id_of(token).is_none())
            .collect();
        match (tokenizer.id_of(view.image), tokenizer.id_of(PADDING)) {
            (Some(image), Some(padding)) if missing.is_empty() => Ok(Self { image, padding }),
            _ => Err(Error::Checkpoint(problem!(
                "tokenizer"; "the special tokens of {} are missing: {}", version.title(), missing.join(", ")
            ))),
        }
    }
}

/// The prompt of an observation whose views have these numbers of image tokens.
///
/// # Errors
/// [`Error::Input`] for an instruction that is missing where the released code has no default, and for one that holds a placeholder of a frame.
pub(super) fn prompt(
    settings: &Settings,
    instruction: Option<&str>,
    plain_text: bool,
    views: &[usize],
) -> Result<String> {
    let text = text(settings, instruction, plain_text)?;
    let view = view_tokens(settings.version);
    let images = views.iter().enumerate().map(|(index, tokens)| {
        let label = match settings.version {
            Version::N17 => String::new(),
            _ => format!("<image {}>", index + 1),
        };
        format!("{label}{}{}{}", view.start, view.image.repeat(*tokens), view.end)
    });
    let images: String = images.collect();
    Ok(match settings.version {
        Version::N17 => format!("{USER}{images}{text}{TURN_END}"),
        Version::N16 => format!("{SYSTEM}{USER}{text}{images}{TURN_END}"),
        _ => format!("{SYSTEM}{USER}{images}{text}{TURN_END}{ASSISTANT}"),
    })
}

/// The instruction as it stands in the prompt.
fn text(settings: &Settings, instruction: Option<&str>, plain_text: bool) -> Result<String> {
    let instruction = match (settings.preprocessing, instruction) {
        (Preprocessing::Lerobot, None | Some("")) => "Perform the task.",
        (Preprocessing::Isaac, None) if settings.version == Version::N15 => "Perform the default behavior.",
        (Preprocessing::Isaac, None) => {
            return Err(Error::Input(problem!(
                "instruction"; "expected text: Isaac-GR00T {} has no default", settings.version.title()
            )));
        }
        (_, Some(text)) => text,
    };
    let is_n15 = settings.version == Version::N15;
    let text = match settings.formalize_language {
        false => instruction.to_owned(),
        // lerobot's N1.5 keeps no underscores; Isaac-GR00T's does not read the option.
        true if is_n15 && settings.preprocessing == Preprocessing::Isaac => instruction.to_owned(),
        true if is_n15 => formalized(instruction).replace('_', ""),
        true => formalized(instruction),
    };
    let text = match is_n15 && !settings.plain_text && !plain_text {
        true => list_of(&text),
        false => text,
    };
    if settings.version != Version::N17
        && let Some(found) = PLACEHOLDER.find(&text)
    {
        return Err(Error::Input(problem!(
            "instruction"; expected "none of the placeholders that stand for a frame";
            got "{}", found.as_str()
        )));
    }
    Ok(text)
}
