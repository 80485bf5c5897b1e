//! Checkpoints with another number of future tokens.
//!
//! A token can be replaced by n copies if log(n) is subtracted from the logits of their keys in every
//! self-attention block, and n equal tokens by one if log(n) is added (equation 47 of docs/equations.md). No
//! published layout has a place for such a bias, so it is written under a key of saccade's own: the result is
//! exact in saccade, while other programs see plain copies.

mod config_edit;
mod merge;
mod perturb;

use std::path::Path;

use saccade_vla_checkpoint::{OWN_CONFIG, reserve};

use crate::error::{Error, Result, bail};
use crate::recognise::sizes::FUTURE_TOKENS;
use crate::rewrite::float::Float;
use crate::rewrite::{RewriteOptions, SourceCheckpoint, Written};
use config_edit::config_edit;
use merge::resized;
use perturb::perturb;

pub use config_edit::resized_config;
pub use merge::{MergedTokens, merge_future_tokens};

/// How a checkpoint is resized.
#[derive(Clone, Debug)]
pub struct ResizeOptions {
    /// Options that all rewriting shares.
    pub rewrite: RewriteOptions,
    /// Future tokens of the copy.
    pub num_future_tokens: usize,
    /// Root mean square of the noise added to copies of tokens, relative to that of all tokens; 0 adds nothing.
    pub perturbation: f64,
    /// Seed of the noise.
    pub seed: u64,
}

impl ResizeOptions {
    /// A copy with this number of future tokens and nothing added to them.
    #[must_use]
    pub fn new(rewrite: RewriteOptions, num_future_tokens: usize) -> Self {
        Self {
            rewrite,
            num_future_tokens,
            perturbation: 0.0,
            seed: 0,
        }
    }
}

/// What [`resize`] wrote.
#[derive(Clone, Debug)]
pub struct ResizeReport {
    /// The files.
    pub written: Written,
    /// Future tokens of the source.
    pub num_before: usize,
    /// Future tokens of the copy.
    pub num_after: usize,
    /// For each token of the copy, the indices of the source's tokens that it represents: one for a copy, several for merged ones.
    pub sources: Vec<Vec<usize>>,
    /// What saccade adds to the logits of the tokens' keys; none if it is zero everywhere.
    pub future_key_bias: Option<Vec<f32>>,
    /// Whether actions in saccade stay the same but for rounding.
    pub is_exact: bool,
    /// Whether the tokens are stored as float32 because their former type cannot hold the new ones exactly.
    pub is_widened: bool,
    /// Root mean square of the noise added to copies.
    pub perturbation_rms: f64,
}

/// Writes the checkpoint `source` to the directory `out` with another number of future tokens. Going up, tokens are copied in turn; going
/// down, the most similar are merged. All other tensors are copied bit for bit, and the number is changed wherever the config has it.
///
/// `progress(done, total)`, in bytes read, is called after each tensor; if it returns false, nothing is written.
///
/// ```
/// # let out = std::env::temp_dir().join(format!("saccade-resize-{}", std::process::id()));
/// use saccade_vla::{ResizeOptions, RewriteOptions, resize};
/// let options = ResizeOptions::new(RewriteOptions::default(), 4);
/// let report = resize("examples/tiny".as_ref(), &out, &options, |_, _| true)?;
/// assert_eq!((report.num_before, report.num_after), (8, 4));
/// # std::fs::remove_dir_all(&out).ok();
/// # Ok::<(), saccade_vla::Error>(())
/// ```
///
/// # Errors
/// Of kind [`Checkpoint`](crate::ErrorKind::Checkpoint) for a source that is broken or does not fit its config, a version without future
/// tokens, a source that has none, a config with different numbers of them, and tokens that are not finite; [`Input`](crate::ErrorKind::Input)
/// for a number or a perturbation out of range, and if `out` exists and `force` is not set, holds anything but such a checkpoint, or is the
/// source; [`Output`](crate::ErrorKind::Output) if it cannot be written.
pub fn resize(
    source: &Path,
    out: &Path,
    options: &ResizeOptions,
    mut progress: impl FnMut(u64, u64) -> bool,
) -> Result<ResizeReport> {
    let source = SourceCheckpoint::open(source, options.rewrite.config.as_deref())?;
    let config = &source.config;
    let edit = config_edit(config, &source.given_config, options.num_future_tokens)?;
    let name = format!("{}{FUTURE_TOKENS}", source.prefix);
    let tokens = source.checkpoint.read(&name)?.into_f32()?;
    if let Some(bad) = tokens.iter().find(|value| !value.is_finite()) {
        bail!(Checkpoint, "source"; "{name} holds {bad}, expected finite numbers");
    }
    let no_bias = || vec![0.0; config.num_future_tokens];
    let bias = config.future_key_bias.clone().unwrap_or_else(no_bias);
    let mut resized = resized(&tokens, config.width, &bias, options.num_future_tokens)?;
    let perturbation_rms = perturb(
        &mut resized.tokens,
        &tokens,
        config.num_future_tokens,
        options.perturbation,
        options.seed,
    )?;

    let mut stored = source.as_it_is(&name)?;
    let dtype = Float::of(stored.dtype).expect("the tokens are checked to be floating point");
    let is_widened = resized.tokens.iter().any(|&value| dtype.round(value) != value);
    let dtype = if is_widened { Float::F32 } else { dtype };
    (stored.dtype, stored.shape) = (dtype.dtype(), vec![options.num_future_tokens, config.width]);
    let mut bytes = Vec::new();
    reserve("source", &mut bytes, stored.nbytes())?;
    dtype.write(&resized.tokens, &mut bytes);

    let mut planned = Vec::new();
    for other in source.names(&options.rewrite) {
        if other != name {
            planned.push(source.as_it_is(other)?);
        }
    }
    planned.push(stored);
    let (config_text, own) = edit.config(resized.key_bias.as_deref());
    let small = [
        ("config.json", Some(config_text.as_str())),
        (OWN_CONFIG, own.as_deref()),
    ];
    let rewrite = &options.rewrite;
    let written = source.write(out, rewrite, &small, planned, &mut progress, |other, writer| {
        if other == name {
            Ok(writer.tensor(&name, &bytes)?)
        } else {
            source.copy(other, writer)
        }
    })?;
    Ok(ResizeReport {
        written,
        num_before: config.num_future_tokens,
        num_after: options.num_future_tokens,
        is_exact: resized.is_exact && perturbation_rms == 0.0,
        sources: resized.sources,
        future_key_bias: resized.key_bias,
        is_widened,
        perturbation_rms,
    })
}
