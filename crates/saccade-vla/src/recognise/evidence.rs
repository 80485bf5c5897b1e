//! Which version a checkpoint is of: what its config and its tensors say.

use serde_json::Value;

use super::layout::{Contents, Evidence};
use super::lerobot;
use super::sizes::{DECODERS, FUTURE_TOKENS};
use crate::error::{Error, Result, bail, problem};
use crate::release::{Feature, Version};

/// The one version that all evidence fits, and the evidence, a sentence each.
///
/// # Errors
/// [`Error::Checkpoint`] for evidence that contradicts itself, and for names of GR00T models that are
/// unknown.
pub(super) fn recognise_version(contents: &Contents<'_>) -> Result<(Version, Vec<String>)> {
    let found = evidence(contents)?;
    let fits = |version: &Version| found.iter().all(|one| one.versions.contains(version));
    let possible: Vec<Version> = Version::all().filter(fits).collect();
    let sentences = found.iter().map(|one| {
        let versions: Vec<String> = one.versions.iter().map(Version::to_string).collect();
        format!("{}: {}", one.what, versions.join(" or "))
    });
    let version = match possible[..] {
        [one] => one,
        [] => {
            let sentences: Vec<String> = sentences.collect();
            bail!(
                Checkpoint, "source";
                "what is found belongs to different versions of GR00T:\n  {}", sentences.join("\n  ")
            );
        }
        // Nothing says which: a head alone, whose config names no model.
        _ => *possible
            .iter()
            .find(|version| **version == usual_version(contents))
            .unwrap_or(&possible[0]),
    };
    Ok((version, sentences.collect()))
}

/// The version that a head of these keys and tensors usually has, if nothing names it.
fn usual_version(contents: &Contents<'_>) -> Version {
    let (config, tensors) = (contents.config, &contents.tensors);
    let is_flat = config.get("max_action_dim").is_some() && config.get("action_dim").is_none();
    match (
        is_flat || config.is_true("use_alternate_vl_dit"),
        tensors.any("vl_self_attention."),
    ) {
        (true, true) => Version::N17,
        (true, false) => Version::N16,
        // lerobot's: every N1.5 that it can read has future tokens, which say so.
        (false, _) if !contents.has_head_config => Version::N17,
        (false, _) if config.get("use_vlln").is_none() && !tensors.any("vlln.") => Version::N1,
        (false, _) => Version::N15,
    }
}

/// Everything that says something about the version.
fn evidence(contents: &Contents<'_>) -> Result<Vec<Evidence>> {
    let (config, tensors) = (contents.config, &contents.tensors);
    let mut found = names_of_models(contents)?;
    if !contents.has_head_config {
        found.extend(lerobot::evidence(config.top()));
    }
    let mut add = |feature, what| {
        found.push(Evidence {
            versions: Version::with(feature),
            what,
        });
    };
    for (key, feature) in [
        ("use_alternate_vl_dit", Feature::AlternatingBlocks),
        ("use_multi_action_heads", Feature::SeveralDecoders),
        ("split_arm_heads", Feature::SeveralDecoders),
    ] {
        if config.is_true(key) {
            add(feature, format!("{key} is true"));
        }
    }
    if let Some(count) = config.get("num_target_vision_tokens").and_then(Value::as_u64)
        && count > 0
    {
        add(
            Feature::FutureTokens,
            format!("num_target_vision_tokens is {count}"),
        );
    }
    if tensors.any("future_tokens.") {
        add(Feature::FutureTokens, tensors.show(FUTURE_TOKENS));
    }
    for (name, _) in DECODERS {
        if tensors.any(&format!("{name}.")) {
            add(
                Feature::SeveralDecoders,
                tensors.show(&format!("{name}.layer2.W")),
            );
        }
    }
    if tensors.any("vlln.") {
        add(Feature::VlNorm, tensors.show("vlln.weight"));
    }
    if tensors.any("vl_self_attention.") {
        let blocks = tensors.blocks("vl_self_attention.transformer_blocks");
        add(
            Feature::VlSelfAttention,
            format!("vl_self_attention has {blocks} blocks"),
        );
    }
    if tensors.any("mask_token") {
        add(Feature::MaskToken, tensors.show("mask_token"));
    }
    Ok(found)
}

/// The versions that the config names: as the type of a model, or as its class.
fn names_of_models(contents: &Contents<'_>) -> Result<Vec<Evidence>> {
    let unknown = |what: &str| {
        let names = Version::model_types();
        Err(Error::Checkpoint(problem!(
            "config"; "{what}, expected one of {names}"
        )))
    };
    let mut found = Vec::new();
    for declared in contents.config.declared() {
        match declared.version {
            Some(version) => found.push(Evidence {
                versions: vec![version],
                what: declared.text,
            }),
            None => return unknown(&declared.text),
        }
    }
    if let Some(Value::Array(classes)) = contents.config.top().get("architectures") {
        for class in classes {
            let what = format!("architectures names {class}");
            match class.as_str().map(Version::of_model) {
                Some(Ok(Some(version))) => found.push(Evidence {
                    versions: vec![version],
                    what,
                }),
                Some(Err(())) => return unknown(&what),
                _ => {}
            }
        }
    }
    Ok(found)
}
