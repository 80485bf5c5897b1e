//! What a backbone is given: pixels and token ids, checked and dealt to the prompts.

use std::ops::Range;

use super::config::{BackboneConfig, CHANNELS, Tower, VisionConfig};
use crate::alloc::{collected, filled, reserve, reserved};
use crate::array::{Array, unravel};
use crate::error::{Error, Result, bail, ensure, problem, show_shape};

/// The inputs of [`Backbone::encode`](super::model::Backbone::encode), as the released processors prepare
/// them.
#[derive(Clone, Debug)]
pub struct BackboneInputs<'a> {
    /// The normalised pixels of all views, those of the first prompt first: arrays
    /// `(views, 3, height, width)`, whose sizes may differ, or for N1.7 one of patches, `(patches, values)`.
    pub pixel_values: Vec<Array<'a>>,
    /// The tokens of the prompts, `(batch, tokens)`.
    pub input_ids: Array<'a, i64>,
    /// `(batch, tokens)`, false = padding; none if there is none.
    pub attention_mask: Option<Array<'a, bool>>,
    /// For N1.7 the patches of each view, `(views, 3)`: time, rows, columns.
    pub image_grid_thw: Option<Array<'a, i64>>,
}

impl<'a> BackboneInputs<'a> {
    /// Inputs without padding.
    #[must_use]
    pub fn new(pixel_values: Vec<Array<'a>>, input_ids: Array<'a, i64>) -> Self {
        Self {
            pixel_values,
            input_ids,
            attention_mask: None,
            image_grid_thw: None,
        }
    }
}

/// The pixels of one view.
#[derive(Clone, Copy)]
pub(super) struct ViewPixels<'a> {
    /// An image `(3, height, width)`, or patches `(rows * columns, values)`.
    pub pixels: &'a [f32],
    /// Rows and columns of patches.
    pub grid: [usize; 2],
}

impl ViewPixels<'_> {
    pub(super) fn num_patches(&self) -> usize {
        self.grid[0] * self.grid[1]
    }
}

/// One prompt.
pub(super) struct Prompt<'a> {
    pub ids: &'a [i64],
    /// For each token whether it may be attended to.
    pub attended: Vec<bool>,
    /// Its views among those of all prompts.
    pub views: Range<usize>,
    /// The places of image tokens, ascending: those of its first view first.
    pub image_tokens: Vec<usize>,
}

/// Inputs that fit the backbone and each other.
pub(super) struct Checked<'a> {
    pub views: Vec<ViewPixels<'a>>,
    pub prompts: Vec<Prompt<'a>>,
    /// Tokens of each prompt.
    pub num_tokens: usize,
}

impl<'a> Checked<'a> {
    /// # Errors
    /// [`Error::Shape`] and [`Error::Input`] for what does not fit.
    pub(super) fn new(config: &BackboneConfig, inputs: &BackboneInputs<'a>) -> Result<Self> {
        let (batch, num_tokens) = match *inputs.input_ids.shape() {
            [batch, tokens] if batch > 0 && tokens > 0 => (batch, tokens),
            ref other => {
                bail!(
                    Shape, "input_ids";
                    expected "(batch, tokens) with at least one prompt and token"; got "{}", show_shape(other)
                );
            }
        };
        if let Some(mask) = inputs.attention_mask {
            mask.check_shape("attention_mask", "(batch, tokens)", &[batch, num_tokens])?;
        }
        check_ids(config, &inputs.input_ids)?;
        let views = views(config, inputs)?;
        let mut prompts = reserved("prompts", batch)?;
        let mut first = 0;
        for row in 0..batch {
            let tokens = row * num_tokens..(row + 1) * num_tokens;
            let ids = &inputs.input_ids.data()[tokens.clone()];
            let is_image = |id: &i64| *id == config.image_token_id as i64;
            let count = ids.iter().filter(|id| is_image(id)).count();
            let places = (0..num_tokens).filter(|&place| is_image(&ids[place]));
            let end = views_of_prompt(config, &views, first, count).ok_or_else(|| {
                Error::Input(problem!(
                    "input_ids";
                    "prompt {row} has {count} image tokens (id {}), which its views do not fill: from view {first} on they have {}",
                    config.image_token_id, show_counts(config, &views[first..])
                ))
            })?;
            prompts.push(Prompt {
                ids,
                attended: match inputs.attention_mask {
                    Some(mask) => {
                        collected("attention_mask", num_tokens, mask.data()[tokens].iter().copied())?
                    }
                    None => filled("attention_mask", num_tokens, true)?,
                },
                views: first..end,
                image_tokens: collected("image_mask", count, places)?,
            });
            first = end;
        }
        ensure!(
            first >= views.len(), Input, "pixel_values";
            "{} views were given, but the prompts have image tokens (id {}) for {first}",
            views.len(), config.image_token_id
        );
        Ok(Self {
            views,
            prompts,
            num_tokens,
        })
    }
}

/// Tokens of a view.
pub(super) fn num_tokens(config: &VisionConfig, view: &ViewPixels<'_>) -> usize {
    view.num_patches() / config.patches_of_token()
}

/// The end of the views from number `first` on that have `count` tokens together.
fn views_of_prompt(
    config: &BackboneConfig,
    views: &[ViewPixels<'_>],
    first: usize,
    count: usize,
) -> Option<usize> {
    let (mut left, mut end) = (count, first);
    while left > 0 {
        left = left.checked_sub(num_tokens(&config.vision, views.get(end)?))?;
        end += 1;
    }
    Some(end)
}

/// The tokens of views, to be shown.
fn show_counts(config: &BackboneConfig, views: &[ViewPixels<'_>]) -> String {
    const SHOWN: usize = 8;
    let counts = views
        .iter()
        .map(|view| num_tokens(&config.vision, view).to_string());
    let mut counts: Vec<String> = counts.take(SHOWN).collect();
    if views.len() > SHOWN {
        counts.push("...".to_owned());
    }
    match counts.is_empty() {
        true => "none, since there are no more views".to_owned(),
        false => format!("{} tokens", counts.join(", ")),
    }
}

fn check_ids(config: &BackboneConfig, ids: &Array<'_, i64>) -> Result<()> {
    let last = config.language.vocab_size - 1;
    let bad = ids.data().iter().position(|id| !(0..=last as i64).contains(id));
    match bad {
        None => Ok(()),
        Some(position) => Err(Error::Input(problem!(
            "input_ids"; expected "ids of 0 to {last}";
            got "{} at index {}", ids.data()[position], show_shape(&unravel(position, ids.shape()))
        ))),
    }
}

/// The views, in the order in which they are given.
fn views<'a>(config: &BackboneConfig, inputs: &BackboneInputs<'a>) -> Result<Vec<ViewPixels<'a>>> {
    let several = inputs.pixel_values.len() > 1;
    for (index, array) in inputs.pixel_values.iter().enumerate() {
        array.check_finite(&name(index, several))?;
    }
    match (config.vision.tower, inputs.image_grid_thw) {
        (Tower::Siglip { .. }, Some(_)) => Err(Error::Input(problem!(
            "image_grid_thw"; "expected none, since GR00T {} takes images, not patches",
            config.version
        ))),
        (Tower::Siglip { .. }, None) => images(&config.vision, inputs),
        (Tower::Qwen3Vl { .. }, None) => Err(Error::Input(problem!(
            "image_grid_thw";
            expected "(views, 3), the patches of each view, since GR00T {} takes patches",
            config.version;
            got "none"
        ))),
        (Tower::Qwen3Vl { patch_elements, .. }, Some(grid)) => {
            patches(&config.vision, patch_elements, &inputs.pixel_values, grid)
        }
    }
}

fn name(index: usize, several: bool) -> String {
    match several {
        true => format!("pixel_values[{index}]"),
        false => "pixel_values".to_owned(),
    }
}

/// The views of arrays `(views, 3, height, width)`.
fn images<'a>(config: &VisionConfig, inputs: &BackboneInputs<'a>) -> Result<Vec<ViewPixels<'a>>> {
    let unit = config.token_size();
    let several = inputs.pixel_values.len() > 1;
    let mut views = Vec::new();
    for (index, array) in inputs.pixel_values.iter().enumerate() {
        let fits = match *array.shape() {
            [_, CHANNELS, height, width] => match config.image_size {
                Some(size) => [height, width] == [size, size],
                None => [height, width]
                    .iter()
                    .all(|side| *side > 0 && side.is_multiple_of(unit)),
            },
            _ => false,
        };
        if !fits {
            let sides = match config.image_size {
                Some(size) => format!("(views, {CHANNELS}, {size}, {size})"),
                None => format!("(views, {CHANNELS}, height, width) with sides that are multiples of {unit}"),
            };
            bail!(Shape, name(index, several); expected "{sides}"; got "{}", show_shape(array.shape()));
        }
        let (height, width) = (array.shape()[2], array.shape()[3]);
        let of_array = array.data().chunks_exact(CHANNELS * height * width);
        let count = views.len() + of_array.len();
        reserve("views", &mut views, count)?;
        for pixels in of_array {
            views.push(ViewPixels {
                pixels,
                grid: [height / config.patch_size, width / config.patch_size],
            });
        }
    }
    Ok(views)
}

/// The views of patches `(patches, values)`.
fn patches<'a>(
    config: &VisionConfig,
    patch_elements: usize,
    pixel_values: &[Array<'a>],
    grid: Array<'a, i64>,
) -> Result<Vec<ViewPixels<'a>>> {
    let [array] = pixel_values else {
        bail!(Shape, "pixel_values"; expected "one array of patches"; got "{}", pixel_values.len());
    };
    let (&[num_patches, width], &[_, 3]) = (array.shape(), grid.shape()) else {
        bail!(
            Shape, "pixel_values, image_grid_thw";
            expected "(patches, {patch_elements}) and (views, 3)";
            got "{} and {}", show_shape(array.shape()), show_shape(grid.shape())
        );
    };
    ensure!(
        width == patch_elements, Shape, "pixel_values";
        expected "(patches, {patch_elements})"; got "{}", show_shape(array.shape())
    );
    let mut views = reserved("views", grid.shape()[0])?;
    let mut left = array.data();
    for (index, sizes) in grid.data().as_chunks::<3>().0.iter().enumerate() {
        let side = |side: i64| {
            let side = usize::try_from(side).ok()?;
            (side > 0 && side.is_multiple_of(config.merge)).then_some(side)
        };
        let (1, Some(rows), Some(columns)) = (sizes[0], side(sizes[1]), side(sizes[2])) else {
            bail!(
                Input, "image_grid_thw";
                expected "(1, rows, columns) with multiples of {}", config.merge;
                got "({}, {}, {}) for view {index}", sizes[0], sizes[1], sizes[2]
            );
        };
        let len = rows
            .checked_mul(columns)
            .and_then(|patches| patches.checked_mul(width));
        let Some((pixels, rest)) = len.and_then(|len| left.split_at_checked(len)) else {
            return Err(does_not_fit(num_patches, index));
        };
        views.push(ViewPixels {
            pixels,
            grid: [rows, columns],
        });
        left = rest;
    }
    match left {
        [] => Ok(views),
        _ => Err(does_not_fit(num_patches, views.len())),
    }
}

fn does_not_fit(num_patches: usize, view: usize) -> Error {
    Error::Shape(problem!(
        "image_grid_thw"; expected "grids of the {num_patches} patches in pixel_values together";
        got "others up to view {view}"
    ))
}
