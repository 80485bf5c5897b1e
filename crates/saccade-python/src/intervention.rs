//! Interventions as the Python package gives them, and what a run recorded.

use std::collections::BTreeMap;

use numpy::PyReadonlyArrayDyn;
use pyo3::prelude::*;
use pyo3::types::PyDict;
use saccade_vla::{Group, OwnedArray, Patch, Recorded, Tokens};

use crate::arrays::{owned, owned_to_numpy};
use crate::error::raise;

/// A group's name and indices.
type PyTokens = (String, Option<Vec<usize>>);

/// The fields of a `saccade.Intervention` by name, as its constructor normalised them; mappings are lists of their items.
#[derive(FromPyObject)]
#[pyo3(from_item_all)]
pub(crate) struct PyIntervention<'py> {
    cut: Vec<(PyTokens, PyTokens)>,
    key_bias: Vec<(PyTokens, PyReadonlyArrayDyn<'py, f32>)>,
    patch: Vec<((usize, usize), PyTokens, PyReadonlyArrayDyn<'py, f32>)>,
    future_tokens: Option<PyReadonlyArrayDyn<'py, f32>>,
    blocks: Option<Vec<usize>>,
    steps: Option<Vec<usize>>,
    heads: Option<Vec<usize>>,
}

fn tokens((name, indices): PyTokens) -> PyResult<Tokens> {
    let group = Group::from_name(&name).map_err(raise)?;
    Ok(Tokens { group, indices })
}

fn intervention(given: PyIntervention<'_>) -> PyResult<saccade_vla::Intervention> {
    let cut = |(reader, source)| Ok((tokens(reader)?, tokens(source)?));
    let key_bias = |(keys, bias)| Ok((tokens(keys)?, owned(&bias)?));
    let patch = |((step, block), patched, rows)| {
        Ok(Patch {
            step,
            block,
            tokens: tokens(patched)?,
            rows: owned(&rows)?,
        })
    };
    Ok(saccade_vla::Intervention {
        cut: collected(given.cut, cut)?,
        key_bias: collected(given.key_bias, key_bias)?,
        patch: collected(given.patch, patch)?,
        future_tokens: given.future_tokens.as_ref().map(owned).transpose()?,
        blocks: given.blocks,
        steps: given.steps,
        heads: given.heads,
    })
}

pub(crate) fn interventions(given: Vec<PyIntervention<'_>>) -> PyResult<Vec<saccade_vla::Intervention>> {
    collected(given, intervention)
}

fn collected<T, R>(given: Vec<T>, made: impl FnMut(T) -> PyResult<R>) -> PyResult<Vec<R>> {
    given.into_iter().map(made).collect()
}

/// Attention and hidden rows, each by block, or by step and block.
pub(crate) type PyRecorded<'py> = (Bound<'py, PyDict>, Bound<'py, PyDict>);

pub(crate) fn recorded<'py, Key: IntoPyObject<'py>>(
    py: Python<'py>,
    recorded: Recorded<Key>,
) -> PyResult<PyRecorded<'py>> {
    let to_dict = |arrays: BTreeMap<Key, OwnedArray>| {
        let dict = PyDict::new(py);
        for (key, array) in arrays {
            dict.set_item(key, owned_to_numpy(py, array)?)?;
        }
        Ok::<_, PyErr>(dict)
    };
    Ok((to_dict(recorded.attention)?, to_dict(recorded.hidden)?))
}
