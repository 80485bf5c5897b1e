//! The prompt of an observation, as text.

use std::sync::LazyLock;

use regex::Regex;

use super::python_text::{formalized, list_of};
use super::settings::Settings;
use super::tokenizer::Tokenizer;
use crate::error::{Error, Result, bail, problem};
use crate::release::{Preprocessing, PromptRules, Version, Wording};

/// The placeholder of a frame, where a release has it.
static PLACEHOLDER: LazyLock<Regex> =
    LazyLock::new(|| Regex::new(r"<(image|video)-\p{Nd}+>").expect("the pattern is written here"));

/// Ids that a prompt needs, by what they are for.
#[derive(Clone, Copy, Debug)]
pub(super) struct SpecialIds {
    /// Stands for a token of an image.
    pub image: u32,
    /// Whether a run of its string is a run of this id in every text.
    pub image_stands_alone: bool,
    /// Fills up a batch.
    pub padding: u32,
}

impl SpecialIds {
    /// Those of `tokenizer` for a version.
    ///
    /// # Errors
    /// [`Error::Checkpoint`] that lists the special tokens which it lacks.
    pub(super) fn find(tokenizer: &Tokenizer, version: Version, rules: &PromptRules) -> Result<Self> {
        const PADDING: &str = "<|endoftext|>";
        let view = &rules.view;
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
            (Some(image), Some(padding)) if missing.is_empty() => Ok(Self {
                image,
                image_stands_alone: tokenizer.stands_alone(view.image),
                padding,
            }),
            _ => Err(Error::Checkpoint(problem!(
                "tokenizer"; "the special tokens of {version} are missing: {}", missing.join(", ")
            ))),
        }
    }
}

/// The prompt of an observation whose views have these numbers of image tokens.
///
/// # Errors
/// [`Error::Input`] for an instruction that is missing where the released code has no default, and for one
/// that holds a placeholder of a frame.
pub(super) fn prompt(
    settings: &Settings,
    instruction: Option<&str>,
    plain_text: bool,
    views: &[usize],
) -> Result<String> {
    let text = text(settings, instruction, plain_text)?;
    let rules = &settings.rules.prompt;
    let images = views.iter().enumerate().map(|(index, tokens)| {
        let label = match rules.view.is_numbered {
            true => format!("<image {}>", index + 1),
            false => String::new(),
        };
        let image = rules.view.image.repeat(*tokens);
        format!("{label}{}{image}{}", rules.view.start, rules.view.end)
    });
    let images: String = images.collect();
    // The instruction last: it may hold anything.
    Ok(rules
        .template
        .replace("{views}", &images)
        .replace("{text}", &text))
}

/// The instruction as it stands in the prompt.
fn text(settings: &Settings, instruction: Option<&str>, plain_text: bool) -> Result<String> {
    let rules = &settings.rules.prompt;
    let instruction = match (settings.preprocessing, instruction, rules.default_instruction) {
        (Preprocessing::Lerobot, None | Some(""), _) => "Perform the task.",
        (_, Some(text), _) | (Preprocessing::Isaac, None, Some(text)) => text,
        (Preprocessing::Isaac, None, None) => {
            bail!(Input, "instruction"; "expected text: Isaac-GR00T {} has no default", settings.version);
        }
    };
    let text = match (settings.formalize_language, rules.wording, settings.preprocessing) {
        (true, Wording::Formalized, _) => formalized(instruction),
        (true, Wording::List, Preprocessing::Lerobot) => formalized(instruction).replace('_', ""),
        _ => instruction.to_owned(),
    };
    let text = match rules.wording == Wording::List && !settings.plain_text && !plain_text {
        true => list_of(&text),
        false => text,
    };
    if rules.has_placeholders
        && let Some(found) = PLACEHOLDER.find(&text)
    {
        bail!(
            Input, "instruction";
            expected "none of the placeholders that stand for a frame"; got "{}", found.as_str()
        );
    }
    Ok(text)
}
