//! Layers: built from named weights, run by the kernels.

pub(crate) mod attention;
pub(crate) mod file;
#[cfg_attr(
    not(test),
    expect(dead_code, reason = "the layers of the vision-language backbone")
)]
pub(crate) mod gated_mlp;
#[cfg_attr(
    not(test),
    expect(dead_code, reason = "the layers of the vision-language backbone")
)]
pub(crate) mod grouped_attention;
pub(crate) mod linear;
pub(crate) mod mlp;
pub(crate) mod norm;
pub(crate) mod planner;
#[cfg_attr(
    not(test),
    expect(dead_code, reason = "the layers of the vision-language backbone")
)]
pub(crate) mod rms_norm;
#[cfg_attr(
    not(test),
    expect(dead_code, reason = "the layers of the vision-language backbone")
)]
pub(crate) mod rotary;
pub(crate) mod sizer;
#[cfg(test)]
mod tests;
pub(crate) mod weights;
