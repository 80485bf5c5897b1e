//! Groups of tokens: state, future and action rows, and the vision-language tokens.

use std::ops::Range;

use crate::error::{Error, Problem, Result, problem};

/// A group of tokens.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Group {
    /// The state rows: one, or one for each state of an observation.
    State,
    /// The future rows.
    Future,
    /// The action rows.
    Action,
    /// The vision-language tokens, which cross-attention blocks read.
    Vl,
}

impl Group {
    /// From its name: `state`, `future`, `action` or `vl`.
    ///
    /// # Errors
    /// [`Error::Input`] for any other name.
    pub fn from_name(name: &str) -> Result<Self> {
        [Self::State, Self::Future, Self::Action, Self::Vl]
            .into_iter()
            .find(|group| group.name() == name)
            .ok_or_else(|| Error::Input(Problem::expected("group", "state, future, action or vl", name)))
    }

    /// Its name.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::State => "state",
            Self::Future => "future",
            Self::Action => "action",
            Self::Vl => "vl",
        }
    }
}

/// A group, or some of its tokens.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Tokens {
    /// The group.
    pub group: Group,
    /// Indices within the group; `None` means the whole group.
    pub indices: Option<Vec<usize>>,
}

/// How many tokens each group has. Rows are in the order state, future, action.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Groups {
    /// State rows.
    pub state: usize,
    /// Future rows.
    pub future: usize,
    /// Action rows.
    pub action: usize,
    /// Vision-language tokens.
    pub vl: usize,
}

impl Groups {
    /// Rows of a sequence.
    #[must_use]
    pub fn num_rows(&self) -> usize {
        self.state + self.future + self.action
    }

    /// A group's tokens: their range among the rows, or among the vision-language tokens.
    #[must_use]
    pub fn range(&self, group: Group) -> Range<usize> {
        match group {
            Group::State => 0..self.state,
            Group::Future => self.state..self.state + self.future,
            Group::Action => self.state + self.future..self.num_rows(),
            Group::Vl => 0..self.vl,
        }
    }

    /// The positions of `tokens`, in the order given.
    pub(crate) fn positions(&self, tokens: &Tokens) -> Vec<usize> {
        let range = self.range(tokens.group);
        match &tokens.indices {
            None => range.collect(),
            Some(indices) => indices.iter().map(|index| range.start + index).collect(),
        }
    }

    /// How many `tokens` are.
    ///
    /// # Errors
    /// [`Error::Input`] for an index that is not in the group.
    pub(crate) fn check(&self, name: &str, tokens: &Tokens) -> Result<usize> {
        let count = self.range(tokens.group).len();
        let Some(indices) = &tokens.indices else {
            return Ok(count);
        };
        match indices.iter().find(|index| **index >= count) {
            None => Ok(indices.len()),
            Some(index) => Err(Error::Input(problem!(
                name; "{} token {index}, expected {}", tokens.group.name(), span(count)
            ))),
        }
    }
}

/// That all indices are below `count`.
pub(crate) fn check_indices(name: &str, indices: &[usize], count: usize) -> Result<()> {
    match indices.iter().find(|index| **index >= count) {
        None => Ok(()),
        Some(index) => Err(Error::Input(Problem::expected(name, span(count), index))),
    }
}

fn span(count: usize) -> String {
    match count {
        0 => "none, since the group has no token".to_owned(),
        _ => format!("0 to {}", count - 1),
    }
}
