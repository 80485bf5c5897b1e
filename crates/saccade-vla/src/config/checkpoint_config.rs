//! A config as it is given: the whole object, the head's in it, and the version that it declares.

use serde_json::Value;

use super::values::{Object, config_object};
use crate::error::{Error, Problem, Result};
use crate::release::Version;

/// The key of the head's config in a whole checkpoint's.
pub(crate) const HEAD_KEY: &str = "action_head_cfg";

/// The key of saccade's own part of the head's config.
pub(crate) const OWN_KEY: &str = "saccade";

/// The text of a config, read.
pub(crate) struct CheckpointConfig {
    top: Object,
    /// The head's, where the whole one has it under a key of its own.
    nested: Option<Object>,
}

/// A version that a config declares.
pub(crate) struct Declared {
    /// Where, and the value: `model_type is "gr00t_n1_5"`.
    pub text: String,
    /// None if there is no such version.
    pub version: Option<Version>,
}

impl CheckpointConfig {
    /// # Errors
    /// [`Error::Json`] for text that is not JSON; [`Error::Checkpoint`] if it is no object, and if the head's
    /// config in it is none or has saccade's key next to it.
    pub(crate) fn parse(text: &str) -> Result<Self> {
        Self::of(config_object(text)?)
    }

    /// # Errors
    /// [`Error::Checkpoint`] as for [`CheckpointConfig::parse`].
    pub(crate) fn of(mut top: Object) -> Result<Self> {
        let bad = |problem: String| Err(Error::Checkpoint(Problem::new("config", problem)));
        let nested = match top.remove(HEAD_KEY) {
            None => None,
            Some(Value::Object(head)) => Some(head),
            Some(_) => return bad(format!("{HEAD_KEY}: expected an object")),
        };
        if nested.is_some() && top.contains_key(OWN_KEY) {
            return bad(format!("{OWN_KEY} is next to {HEAD_KEY}, expected inside it"));
        }
        Ok(Self { top, nested })
    }

    /// The whole object, without the head's where that is nested in it.
    pub(crate) fn top(&self) -> &Object {
        &self.top
    }

    /// The head's config: the nested one, or else the whole object.
    pub(crate) fn head(&self) -> &Object {
        self.nested.as_ref().unwrap_or(&self.top)
    }

    /// Whether the head's config is nested in the whole one.
    pub(crate) fn is_nested(&self) -> bool {
        self.nested.is_some()
    }

    /// A value of the head's config, or of what surrounds it.
    pub(crate) fn get(&self, key: &str) -> Option<&Value> {
        self.head().get(key).or_else(|| self.top.get(key))
    }

    pub(crate) fn is_true(&self, key: &str) -> bool {
        self.get(key) == Some(&Value::Bool(true))
    }

    /// The versions that `model_type` names, here and in the head's own config.
    pub(crate) fn declared(&self) -> Vec<Declared> {
        let nested = self.nested.as_ref().map(|head| (format!("{HEAD_KEY}."), head));
        let maps = std::iter::once((String::new(), &self.top)).chain(nested);
        let declared = maps.filter_map(|(path, map)| {
            // A head's own config that a program wrote whole has an empty one.
            let given = map
                .get("model_type")
                .filter(|given| !given.is_null() && **given != "")?;
            Some(Declared {
                text: format!("{path}model_type is {given}"),
                version: given.as_str().and_then(|name| Version::of_model(name).ok()?),
            })
        });
        declared.collect()
    }
}
