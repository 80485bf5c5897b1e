//! Positions of patches and of tokens: tables resized to a grid, and the axes that rotary positions turn with.

use crate::alloc::{collected, filled, reserve};
use crate::backbone::config::{BackboneConfig, VisionConfig};
use crate::backbone::inputs::{Prompt, ViewPixels};
use crate::error::{Error, Result, problem};
use crate::nn::rope::{Turn, frequencies, one_axis};

/// The base of the frequencies of a vision tower's rotary positions.
const VISION_THETA: f64 = 10_000.0;

/// A row or column of a resized table: rows or columns of the table, and how much each of them counts.
pub(crate) type Taps = Vec<(usize, f64)>;

/// For each of `count` places the taps over `side` rows of a table: linear interpolation, widened where the table shrinks so that every row
/// counts. With as many places as rows, each is its row.
pub(crate) fn antialiased(side: usize, count: usize) -> Vec<Taps> {
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

/// For each of `count` places, evenly spaced from the first to the last of `side` rows of a table, the two rows around it.
pub(crate) fn evenly_spaced(side: usize, count: usize) -> Vec<Taps> {
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

/// Adds up the rows of `table (side * side, width)` that the taps of a patch's row and column name, to `out (width)`.
pub(crate) fn interpolate(table: &[f32], side: usize, [rows, columns]: [&Taps; 2], out: &mut [f32]) {
    let width = out.len();
    if let ([(row, _)], [(column, _)]) = (&rows[..], &columns[..]) {
        out.copy_from_slice(&table[(row * side + column) * width..][..width]);
        return;
    }
    out.fill(0.0);
    for (row, by_row) in rows {
        for (column, by_column) in columns {
            let weight = (by_row * by_column) as f32;
            let from = &table[(row * side + column) * width..][..width];
            for (out, from) in out.iter_mut().zip(from) {
                *out += weight * from;
            }
        }
    }
}

/// How the pairs of a vision tower's heads turn: the first half with the row of a patch, the second with its column.
pub(crate) fn vision_turns(config: &VisionConfig) -> Vec<Turn> {
    let pairs = config.head_dim / 4;
    let of_axis = |axis| frequencies(VISION_THETA, pairs).map(move |frequency| Turn { axis, frequency });
    of_axis(0).chain(of_axis(1)).collect()
}

/// How the pairs of the language model's heads turn: all with the place in the prompt, or interleaved with time, height and width.
pub(crate) fn language_turns(config: &BackboneConfig) -> Vec<Turn> {
    let language = &config.language;
    let mut turns = one_axis(language.rope_theta, language.head_dim);
    if let Some([_, height, width]) = language.mrope_section {
        for (pair, turn) in turns.iter_mut().enumerate() {
            turn.axis = match pair % 3 {
                1 if pair < 3 * height => 1,
                2 if pair < 3 * width => 2,
                _ => 0,
            };
        }
    }
    turns
}

/// The position of each token of a prompt: time, height and width.
///
/// Without `mrope_section` it is the place in the prompt, padding counted. With it padding does not count, and a view counts as many steps
/// as its longer side has tokens.
pub(crate) fn token_positions(
    config: &BackboneConfig,
    prompt: &Prompt<'_>,
    views: &[ViewPixels<'_>],
) -> Result<Vec<[usize; 3]>> {
    let count = prompt.ids.len();
    if config.language.mrope_section.is_none() {
        return collected("positions", count, (0..count).map(|place| [place; 3]));
    }
    let mut positions = filled("positions", count, [1; 3])?;
    let mut next = 0;
    let mut views = views[prompt.views.clone()].iter();
    let mut place = 0;
    while place < count {
        let is_image = prompt.ids[place] == config.image_token_id as i64;
        if !is_image {
            if prompt.attended[place] {
                positions[place] = [next; 3];
                next += 1;
            }
            place += 1;
            continue;
        }
        let view = views.next().expect("every image token is one of a view");
        let [rows, columns] = view.grid.map(|side| side / config.vision.merge);
        let tokens = place..place + rows * columns;
        let is_whole = |token| prompt.attended[token] && prompt.ids[token] == config.image_token_id as i64;
        if tokens.end > count || !tokens.clone().all(is_whole) {
            return Err(Error::Input(problem!(
                "input_ids";
                expected "the {} tokens of a view one after the other and attended", tokens.len();
                got "others from token {place} on"
            )));
        }
        for (index, token) in tokens.clone().enumerate() {
            positions[token] = [next, next + index / columns, next + index % columns];
        }
        next += rows.max(columns);
        place = tokens.end;
    }
    Ok(positions)
}

/// The row and column of each patch of a view whose patches come in squares of `merge` on each side, square by square.
pub(crate) fn patch_places(merge: usize, [rows, columns]: [usize; 2]) -> Result<Vec<[usize; 2]>> {
    let mut places = Vec::new();
    reserve("positions", &mut places, rows * columns)?;
    for row in (0..rows).step_by(merge) {
        for column in (0..columns).step_by(merge) {
            for inside in 0..merge * merge {
                places.push([row + inside / merge, column + inside % merge]);
            }
        }
    }
    Ok(places)
}
