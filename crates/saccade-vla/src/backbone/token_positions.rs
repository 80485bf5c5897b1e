//! Positions of the tokens of a prompt, and the axes that rotary positions turn with.
//!
//! Equation 26 of docs/equations.md.

use super::config::BackboneConfig;
use super::inputs::{Prompt, ViewPixels};
use crate::alloc::{collected, filled};
use crate::error::{Error, Result, ensure};
use crate::nn::rope::{RopePair, one_axis};

/// The rotation of the pairs of the language model's heads: all by the place in the prompt, or interleaved by
/// time, height and width.
pub(super) fn rope_pairs(config: &BackboneConfig) -> Vec<RopePair> {
    let language = &config.language;
    let mut pairs = one_axis(language.rope_theta, language.head_dim);
    if let Some([_, height, width]) = language.mrope_section {
        for (index, pair) in pairs.iter_mut().enumerate() {
            pair.axis = match index % 3 {
                1 if index < 3 * height => 1,
                2 if index < 3 * width => 2,
                _ => 0,
            };
        }
    }
    pairs
}

/// The position of each token of a prompt: time, height and width.
///
/// Without `mrope_section` it is the place in the prompt, padding counted. With it padding does not count,
/// and a view counts as many steps as its longer side has tokens.
pub(super) fn token_positions(
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
        ensure!(
            tokens.end <= count && tokens.clone().all(is_whole), Input, "input_ids";
            expected "the {} tokens of a view one after the other and attended", tokens.len();
            got "others from token {place} on"
        );
        for (index, token) in tokens.clone().enumerate() {
            positions[token] = [next, next + index / columns, next + index % columns];
        }
        next += rows.max(columns);
        place = tokens.end;
    }
    Ok(positions)
}
