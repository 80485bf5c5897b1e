//! JSON objects and their values by type. What is missing or of another type is listed, and one error says all
//! of it.

use std::ops::RangeInclusive;
use std::path::Path;

use saccade_vla_checkpoint::read_text;
use serde_json::{Map, Value};

use crate::error::{Error, Problem, Result, bail};

/// A JSON object.
pub(crate) type Object = Map<String, Value>;

/// No size in a config is larger: products of three of them stay far below `u64::MAX`. Those of two may be
/// more than a `usize` of 32 bits, so they saturate, and are then refused as too large.
pub(crate) const MAX_SIZE: u64 = 1 << 20;

/// No model has more layers; the names of their tensors are written out.
pub(crate) const MAX_LAYERS: u64 = 1024;

/// The object that the text of a config is.
///
/// # Errors
/// [`Error::Json`] for text that is not JSON; [`Error::Checkpoint`] if it is no object.
pub(crate) fn config_object(text: &str) -> Result<Object> {
    match serde_json::from_str(text) {
        Ok(Value::Object(object)) => Ok(object),
        Ok(_) => bail!(Checkpoint, "config"; "expected a JSON object"),
        Err(source) => Err(Error::json("config", source)),
    }
}

/// The object in the JSON file `path`, which errors call `what`.
///
/// # Errors
/// [`Error::File`], [`Error::Json`] and [`Error::Checkpoint`] for a file that is no such thing.
pub(crate) fn object_in(what: &'static str, path: &Path) -> Result<Object> {
    match serde_json::from_str(&read_text(what, path)?) {
        Ok(Value::Object(object)) => Ok(object),
        Ok(_) => bail!(Checkpoint, what; "{}: expected a JSON object", path.display()),
        Err(source) => Err(Error::json(format!("{what}: {}", path.display()), source)),
    }
}

/// As [`object_in`], if the file is there.
pub(crate) fn object_in_any(what: &'static str, path: &Path) -> Result<Option<Object>> {
    path.exists().then(|| object_in(what, path)).transpose()
}

/// Whether a value asks for nothing: null, false, or empty.
#[cfg(any(feature = "processor", feature = "rewrite"))]
pub(crate) fn asks_for_nothing(value: &Value) -> bool {
    match value {
        Value::Null | Value::Bool(false) => true,
        Value::String(text) => text.is_empty(),
        Value::Array(values) => values.is_empty(),
        Value::Object(keys) => keys.is_empty(),
        _ => false,
    }
}

/// What is wrong with a config.
#[derive(Default)]
pub(crate) struct Problems(Vec<String>);

impl Problems {
    pub(crate) fn add(&mut self, problem: String) {
        self.0.push(problem);
    }

    /// `config`, unless something is wrong with it: with its values, or if these are good by what
    /// `contradictions` lists.
    ///
    /// # Errors
    /// [`Error::Checkpoint`] that lists everything.
    pub(crate) fn finish<T>(self, config: T, contradictions: impl FnOnce(&T) -> Vec<String>) -> Result<T> {
        let problems = match self.0.is_empty() {
            true => contradictions(&config),
            false => self.0,
        };
        match problems.is_empty() {
            true => Ok(config),
            false => Err(Error::Checkpoint(Problem::new("config", problems.join("; ")))),
        }
    }

    /// Adds that the value at `path` is not what is expected.
    pub(crate) fn differs(&mut self, path: &str, given: Option<&Value>, expected: &str) {
        self.add(match given {
            None => format!("{path} is missing, expected {expected}"),
            Some(given) => format!("{path} is {given}, expected {expected}"),
        });
    }

    pub(crate) fn whole(&mut self, path: &str, given: Option<&Value>, sizes: RangeInclusive<u64>) -> usize {
        match given.and_then(Value::as_u64) {
            Some(size) if sizes.contains(&size) => size as usize,
            _ => {
                let expected = format!("a whole number from {} to {}", sizes.start(), sizes.end());
                self.differs(path, given, &expected);
                1
            }
        }
    }

    pub(crate) fn flag(&mut self, path: &str, given: Option<&Value>) -> bool {
        given.and_then(Value::as_bool).unwrap_or_else(|| {
            self.differs(path, given, "true or false");
            false
        })
    }

    /// A positive number.
    pub(crate) fn positive(&mut self, path: &str, given: Option<&Value>) -> f64 {
        match given.and_then(Value::as_f64) {
            Some(number) if number > 0.0 && number.is_finite() => number,
            _ => {
                self.differs(path, given, "a positive number");
                1.0
            }
        }
    }
}

/// A list of whole numbers, none larger than any size.
pub(crate) fn whole_numbers(given: &Value) -> Option<Vec<usize>> {
    let size = |value: &Value| Some(value.as_u64().filter(|size| *size <= MAX_SIZE)? as usize);
    given.as_array()?.iter().map(size).collect()
}
