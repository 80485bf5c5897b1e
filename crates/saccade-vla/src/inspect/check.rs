//! Whether an intervention fits a call, and acts in it at all.

use super::call_sizes::CallSizes;
use super::groups::{Group, Tokens, check_indices};
use super::intervention::Intervention;
use crate::array::first_not_bias;
use crate::config::HeadConfig;
use crate::error::{Error, Result, bail, ensure, problem, show_shape};

/// That cuts and biases fit the call, and that each of them acts somewhere.
///
/// # Errors
/// [`Error::Shape`] and [`Error::Input`] if not.
pub(super) fn check(intervention: &Intervention, sizes: &CallSizes<'_>) -> Result<()> {
    let CallSizes { config, groups, .. } = sizes;
    for (name, indices, count) in [
        ("intervention: blocks", &intervention.blocks, config.num_layers),
        ("intervention: steps", &intervention.steps, sizes.num_steps),
        ("intervention: heads", &intervention.heads, config.num_heads),
    ] {
        let Some(indices) = indices else {
            continue;
        };
        ensure!(!indices.is_empty(), Input, name; expected "at least one index"; got "an empty list");
        check_indices(name, indices, count)?;
    }
    let blocks = intervention.blocks.as_deref();
    for (reader, source) in &intervention.cut {
        ensure!(
            reader.group != Group::Vl, Input, "cut";
            "vl is read, it does not read; expected a reader among state, future, action"
        );
        for tokens in [reader, source] {
            check_not_empty("cut", tokens, groups.check("cut", tokens)?)?;
        }
        let edge = format!("{} reads {}", reader.group.name(), source.group.name());
        check_acts("cut", &edge, source.group, blocks, config)?;
    }
    for (tokens, bias) in &intervention.key_bias {
        let count = groups.check("key_bias", tokens)?;
        check_not_empty("key_bias", tokens, count)?;
        let keys = format!("{} is read", tokens.group.name());
        check_acts("key_bias", &keys, tokens.group, blocks, config)?;
        ensure!(
            bias.shape().is_empty() || bias.shape() == [count], Shape, "key_bias";
            expected "a number or ({count},) for {}", tokens.group.name(); got "{}", show_shape(bias.shape())
        );
        if let Some(bad) = first_not_bias(bias.data()) {
            bail!(Input, "key_bias"; expected "numbers below infinity"; got "{bad}");
        }
    }
    Ok(())
}

/// That there are tokens: `count` of them.
pub(super) fn check_not_empty(name: &str, tokens: &Tokens, count: usize) -> Result<()> {
    if count > 0 {
        return Ok(());
    }
    Err(Error::Input(match tokens.indices {
        None => problem!(name; "expected tokens, but this call has no {} tokens", tokens.group.name()),
        Some(_) => problem!(name; expected "at least one {} token", tokens.group.name(); got "an empty list"),
    }))
}

/// That keys of `group` are read in some of `blocks`. `edge` says what is changed.
fn check_acts(
    argument: &str,
    edge: &str,
    group: Group,
    blocks: Option<&[usize]>,
    config: &HeadConfig,
) -> Result<()> {
    let is_of_vl = group == Group::Vl;
    let has_edge = |block: &usize| config.is_cross(*block) == is_of_vl;
    let kind = if is_of_vl { "cross" } else { "self" };
    let existing: Vec<usize> = (0..config.num_layers).filter(has_edge).collect();
    ensure!(
        !existing.is_empty(), Input, argument;
        "{edge} in {kind}-attention blocks only, and this head has none"
    );
    match blocks {
        Some(blocks) if !blocks.iter().any(has_edge) => Err(Error::Input(problem!(
            argument;
            "{edge} in {kind}-attention blocks only, which are {existing:?}; expected blocks with at least one of them, got {blocks:?}"
        ))),
        _ => Ok(()),
    }
}

/// Whether blocks of this kind have these keys.
pub(super) fn is_read(tokens: &Tokens, is_cross: bool) -> bool {
    (tokens.group == Group::Vl) == is_cross
}
