//! The view that a frame becomes, by the sizes of its release.

use saccade_vla_kernels::{Isa, WeightRounding, resize_cubic_u8, resize_linear_f32};

use super::flexible::flexible_view;
use super::frames::{CHANNELS, Frame, View, crop_half_to_even, kernel, planes, read};
use super::settings::{Settings, Sizes};
use crate::error::Result;
use crate::ops::check_interrupted;
use crate::release::Preprocessing;

/// The view that a frame becomes, which errors call `name`.
///
/// # Errors
/// [`Error::Shape`] and [`Error::Input`] for a frame that is none; [`Error::Memory`].
pub(super) fn view(settings: &Settings, isa: Isa, name: &str, frame: Frame<'_>) -> Result<View> {
    let bytes = read(settings, name, frame)?;
    match &settings.sizes {
        Sizes::Square { size, tokens, crop } => {
            let pixels = match settings.preprocessing {
                Preprocessing::Lerobot => kernel(resize_cubic_u8(
                    isa,
                    bytes.image(),
                    *size,
                    *size,
                    WeightRounding::Torch,
                ))?,
                Preprocessing::Isaac => {
                    let centre = crop_half_to_even(bytes.image(), *crop);
                    let resized = kernel(resize_linear_f32(isa, centre, *size, *size))?;
                    kernel(resized.truncated())?
                }
            };
            check_interrupted()?;
            Ok(View {
                pixels: planes(&pixels, &[CHANNELS, *size, *size])?,
                tokens: *tokens,
                grid: None,
            })
        }
        Sizes::Flexible(sizes) => flexible_view(sizes, isa, name, bytes),
    }
}
