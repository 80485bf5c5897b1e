//! The weights of one layer of a checkpoint, rounded for what the layer is given. A directory holds them until
//! [`quantize`](crate::quantize) takes those of all layers.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use saccade_vla_checkpoint::spec::SCALE_SUFFIX;
use saccade_vla_checkpoint::{Checkpoint, CheckpointWriter, Companions, Elements};

use super::factor::WHAT;
use super::gptq::{RoundingErrors, gptq};
use crate::alloc::{product, reserved};
use crate::array::Array;
use crate::error::{Error, Result, bail, ensure, show_shape};
use crate::gram::Gram;
use crate::ops::check_interrupted;
use crate::rewrite::quantized::{check_not_quantized, plain_int4, planned_int4, write_with_scales};

/// What the metadata of a layer's file say of its errors.
const ERRORS: &str = "rounding_errors";

/// Rounds the weights of a layer to four bits for inputs as in `gram`, by [`gptq`], and writes them to the directory
/// `out`, as [`quantize`](crate::quantize) stores them. They share the layer's inputs, as those of queries, keys and values do. Scales
/// are those of plain rounding.
///
/// # Errors
/// [`Error::Checkpoint`] for weights that are quantised or not finite, [`Error::Shape`] for those of another width,
/// [`Error::Input`] if `out` is there, and those of [`gptq`] and of writing a checkpoint.
pub fn round_layer(
    checkpoint: &Checkpoint,
    names: &[String],
    gram: &Gram,
    out: &Path,
    threads: usize,
) -> Result<RoundingErrors> {
    let in_features = gram.width();
    let mut outputs = Vec::with_capacity(names.len());
    for name in names {
        check_not_quantized(checkpoint, name)?;
        match checkpoint.shape(name) {
            Some(&[out_features, width]) if width == in_features => outputs.push(out_features),
            shape => bail!(
                Shape, name; expected "(out_features, {in_features})"; got "{}", show_shape(shape.unwrap_or_default())
            ),
        }
    }
    let rows = outputs.iter().sum();
    let mut weights = reserved(WHAT, product(WHAT, &[rows, in_features])?)?;
    let mut scales = reserved(WHAT, rows)?;
    for (name, &out_features) in names.iter().zip(&outputs) {
        check_interrupted()?;
        let weight = checkpoint.read(name)?;
        // Of plain rounding the scales are kept.
        let (_, own) = plain_int4(&weight, out_features, in_features)?;
        scales.extend(own);
        weights.extend(weight.into_f32()?);
    }
    let rounded = gptq(
        Array::new(&weights, &[rows, in_features])?,
        &scales,
        gram,
        threads,
    )?;
    drop(weights);

    let planned = names.iter().zip(&outputs);
    let planned = planned.flat_map(|(name, &out_features)| planned_int4(name, out_features, in_features));
    let RoundingErrors {
        plain,
        rounded: kept,
        outputs: squares,
    } = rounded.errors;
    let metadata = [(ERRORS.to_owned(), format!("{plain} {kept} {squares}"))].into();
    let (planned, nothing) = (planned.collect(), Companions::default());
    let mut writer = CheckpointWriter::create(out, planned, &metadata, &nothing, u64::MAX, false)?;
    let (mut values, mut scales) = (rounded.values.as_slice(), scales.as_slice());
    for (name, &out_features) in names.iter().zip(&outputs) {
        let (own, others) = values.split_at(out_features * in_features);
        let (own_scales, other_scales) = scales.split_at(out_features);
        write_with_scales(name, &packed(own, in_features), own_scales, &mut writer)?;
        (values, scales) = (others, other_scales);
    }
    writer.finish()?;
    Ok(rounded.errors)
}

/// Two values in a byte, the first in its low half, rows of whole bytes.
fn packed(values: &[i8], in_features: usize) -> Vec<u8> {
    let nibble = |value: i8| value.cast_unsigned() & 15;
    let byte = |pair: &[i8]| nibble(pair[0]) | pair.get(1).map_or(0, |&value| nibble(value) << 4);
    let rows = values.chunks_exact(in_features);
    rows.flat_map(|row| row.chunks(2).map(byte)).collect()
}

/// A layer that [`round_layer`] wrote.
pub struct RoundedLayer {
    checkpoint: Checkpoint,
    /// What rounding changed.
    pub errors: RoundingErrors,
}

impl RoundedLayer {
    /// Opens its directory.
    ///
    /// # Errors
    /// [`Error::File`] if it cannot be read; [`Error::Checkpoint`] for one that [`round_layer`] did not write.
    pub fn open(directory: &Path) -> Result<Self> {
        let checkpoint = Checkpoint::open(directory)?;
        let Some(errors) = checkpoint.metadata().get(ERRORS).and_then(|text| parse(text)) else {
            let directory = directory.display();
            bail!(Checkpoint, directory; "its metadata have no {ERRORS}, expected a layer that was rounded");
        };
        Ok(Self { checkpoint, errors })
    }

    /// The names of its weights.
    pub fn weights(&self) -> impl Iterator<Item = &str> {
        self.checkpoint
            .names()
            .filter(|name| !name.ends_with(SCALE_SUFFIX))
    }
}

/// Layers that were rounded, by the names of their weights.
#[derive(Default)]
pub(crate) struct RoundedWeights {
    layers: Vec<RoundedLayer>,
    places: BTreeMap<String, usize>,
}

impl RoundedWeights {
    /// Opens the directories of layers.
    ///
    /// # Errors
    /// As [`RoundedLayer::open`]; [`Error::Input`] for a weight that is in two of them.
    pub(crate) fn open(directories: &[PathBuf]) -> Result<Self> {
        let mut found = Self::default();
        for directory in directories {
            let layer = RoundedLayer::open(directory)?;
            for name in layer.weights() {
                let before = found.places.insert(name.to_owned(), found.layers.len());
                ensure!(before.is_none(), Input, "rounded"; expected "each weight once"; got "{name} twice");
            }
            found.layers.push(layer);
        }
        Ok(found)
    }

    /// The names of all weights.
    pub(crate) fn names(&self) -> impl Iterator<Item = &str> {
        self.places.keys().map(String::as_str)
    }

    /// The values and scales of a weight, whose values are planned as bytes of `shape`; none if it is in no layer.
    ///
    /// # Errors
    /// [`Error::Checkpoint`] for one of another shape, [`Error::File`] if it cannot be read.
    pub(crate) fn read(&self, name: &str, shape: &[usize]) -> Result<Option<(Vec<u8>, Vec<f32>)>> {
        let Some(&place) = self.places.get(name) else {
            return Ok(None);
        };
        let checkpoint = &self.layers[place].checkpoint;
        let stored = checkpoint.shape(name).unwrap_or_default();
        match checkpoint.read(name)? {
            Elements::Int4 { values, scales } if stored == shape => Ok(Some((values, scales))),
            _ => {
                let (shape, stored) = (show_shape(shape), show_shape(stored));
                bail!(Checkpoint, "rounded"; expected "{name} in four bits, shape {shape}"; got "shape {stored}");
            }
        }
    }
}

/// The errors in the metadata of a file.
fn parse(text: &str) -> Option<RoundingErrors> {
    let numbers: Vec<f64> = text
        .split(' ')
        .map(|word| word.parse().ok())
        .collect::<Option<_>>()?;
    let [plain, rounded, outputs] = numbers[..] else {
        return None;
    };
    Some(RoundingErrors {
        plain,
        rounded,
        outputs,
    })
}
