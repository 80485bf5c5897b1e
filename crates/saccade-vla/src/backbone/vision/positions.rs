//! Positions of patches: tables resized to a grid, and the axes that rotary positions turn with.
//!
//! Equation 20 of docs/equations.md.

use saccade_vla_kernels::Rows;

use crate::alloc::reserved;
use crate::backbone::config::VisionConfig;
use crate::error::Result;
use crate::nn::rope::{RopePair, frequencies};

/// The base of the frequencies of a vision tower's rotary positions.
const VISION_THETA: f64 = 10_000.0;

/// A row or column of a resized table: rows or columns of the table, and how much each of them counts.
pub(super) type Taps = Vec<(usize, f64)>;

/// For each of `count` places the taps over `side` rows of a table: linear interpolation, widened where the
/// table shrinks so that every row counts. With as many places as rows, each is its row.
pub(super) fn antialiased(side: usize, count: usize) -> Vec<Taps> {
    let scale = side as f64 / count as f64;
    let support = scale.max(1.0);
    (0..count)
        .map(|place| {
            let centre = scale * (place as f64 + 0.5);
            let first = (centre - support + 0.5).max(0.0) as usize;
            let end = side.min((centre + support + 0.5) as usize);
            let weight = |row: usize| (1.0 - ((row as f64 + 0.5 - centre) / support).abs()).max(0.0);
            let total: f64 = (first..end).map(weight).sum();
            let taps = (first..end).map(|row| (row, weight(row) / total));
            taps.filter(|(_, weight)| *weight > 0.0).collect()
        })
        .collect()
}

/// For each of `count` places, evenly spaced from the first to the last of `side` rows of a table, the two
/// rows around it.
pub(super) fn evenly_spaced(side: usize, count: usize) -> Vec<Taps> {
    (0..count)
        .map(|place| {
            let at = match count {
                1 => 0.0,
                _ => (side - 1) as f64 * place as f64 / (count - 1) as f64,
            };
            let (below, fraction) = (at.floor() as usize, at.fract());
            vec![(below, 1.0 - fraction), ((below + 1).min(side - 1), fraction)]
        })
        .collect()
}

/// Adds up the rows of `table (side * side, width)` that the taps of a patch's row and column name, to
/// `out (width)`.
pub(super) fn interpolate(table: Rows<'_>, side: usize, [rows, columns]: [&Taps; 2], out: &mut [f32]) {
    if let ([(row, _)], [(column, _)]) = (&rows[..], &columns[..]) {
        out.copy_from_slice(table.row(row * side + column));
        return;
    }
    out.fill(0.0);
    for (row, by_row) in rows {
        for (column, by_column) in columns {
            let weight = (by_row * by_column) as f32;
            for (out, from) in out.iter_mut().zip(table.row(row * side + column)) {
                *out += weight * from;
            }
        }
    }
}

/// The rotation of the pairs of a vision tower's heads: the first half by the row of a patch, the second by
/// its column.
pub(super) fn vision_rope_pairs(config: &VisionConfig) -> Vec<RopePair> {
    let pairs = config.head_dim / 4;
    let of_axis = |axis| frequencies(VISION_THETA, pairs).map(move |frequency| RopePair { axis, frequency });
    of_axis(0).chain(of_axis(1)).collect()
}

/// The row and column of each patch of a view whose patches come in squares of `merge` on each side, square
/// by square.
pub(super) fn patch_places(merge: usize, [rows, columns]: [usize; 2]) -> Result<Vec<[usize; 2]>> {
    let mut places = reserved("positions", rows * columns)?;
    for row in (0..rows).step_by(merge) {
        for column in (0..columns).step_by(merge) {
            for inside in 0..merge * merge {
                places.push([row + inside / merge, column + inside % merge]);
            }
        }
    }
    Ok(places)
}
