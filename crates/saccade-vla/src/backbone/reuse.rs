//! What a call may take from features of earlier calls: views of the same pixels, and prompts that begin in
//! the same way.

use std::sync::Arc;

use super::features::{BackboneFeatures, EncodedPrompt, View};
use super::inputs::{Prompt, ViewPixels};

/// A view of `previous` with the same pixels: the one at the same place of the same prompt if that has them,
/// or else any.
pub(super) fn same_view(
    previous: &[&BackboneFeatures],
    (prompt, place): (usize, usize),
    view: &ViewPixels<'_>,
) -> Option<Arc<View>> {
    let is_same = |held: &&Arc<View>| held.grid == view.grid && same_bytes(&held.pixels, view.pixels);
    let prompts = || previous.iter().flat_map(|features| &features.prompts);
    let own = prompts().nth(prompt).and_then(|prompt| prompt.views.get(place));
    let found = own.filter(is_same).or_else(|| {
        let mut views = prompts().flat_map(|prompt| &prompt.views);
        views.find(is_same)
    });
    found.map(Arc::clone)
}

fn same_bytes(a: &[f32], b: &[f32]) -> bool {
    bytemuck::cast_slice::<f32, u8>(a) == bytemuck::cast_slice::<f32, u8>(b)
}

/// The prompt of `previous` with which `prompt`, whose views are `views`, has the longest beginning in
/// common, and how long that is.
pub(super) fn longest_prefix<'a>(
    previous: &[&'a BackboneFeatures],
    prompt: &Prompt<'_>,
    views: &[Arc<View>],
) -> Option<(&'a Arc<EncodedPrompt>, usize)> {
    let prompts = previous.iter().flat_map(|features| &features.prompts);
    let prefixes = prompts.map(|held| (held, common(held, prompt, views)));
    // The first of equally long ones.
    let longest = prefixes.reduce(|best, other| if other.1 > best.1 { other } else { best });
    longest.filter(|(_, len)| *len > 0)
}

/// Tokens at the beginning that are the same in both: ids, padding, and the views that they are of.
fn common(held: &EncodedPrompt, prompt: &Prompt<'_>, views: &[Arc<View>]) -> usize {
    let held_tokens = held.ids.iter().zip(&held.attended);
    let tokens = prompt.ids.iter().zip(&prompt.attended);
    let same_words = held_tokens.zip(tokens).take_while(|(a, b)| a == b).count();
    let same_views = held
        .views
        .iter()
        .zip(views)
        .take_while(|(a, b)| Arc::ptr_eq(a, b));
    let same_image_tokens = same_views.map(|(view, _)| view.num_tokens).sum::<usize>();
    let first_other = prompt.image_tokens.get(same_image_tokens);
    first_other.map_or(same_words, |&place| same_words.min(place))
}
