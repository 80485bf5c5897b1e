//! Noise on the copies of future tokens, so that training can tell them apart.

use crate::error::{Error, Result, bail, ensure};

/// Adds noise to `resized`, rows that begin with the `before` rows of `tokens`, from row `before` on; returns the noise's root mean square,
/// which is `amount` times that of `tokens`.
///
/// # Errors
/// [`Error::Input`] for an amount that is negative or not finite, where there are no copies, and where the result is too large: a block's
/// layer norm sums the squares of a row's distances from its mean, at most `width * (2 * largest)^2`, which float32 must hold.
pub(super) fn perturb(
    resized: &mut [f32],
    tokens: &[f32],
    before: usize,
    amount: f64,
    seed: u64,
) -> Result<f64> {
    ensure!(
        amount.is_finite() && amount >= 0.0, Input, "perturbation";
        expected "a finite number of at least 0"; got "{amount}"
    );
    if amount == 0.0 {
        return Ok(0.0);
    }
    let width = tokens.len() / before;
    let count = resized.len() / width;
    ensure!(
        count > before, Input, "perturbation";
        "copies are perturbed, and of {before} future tokens {count} have none"
    );
    let squares: f64 = tokens.iter().map(|&value| f64::from(value).powi(2)).sum();
    let scale = amount * (squares / tokens.len() as f64).sqrt();
    let mut state = seed;
    let mut added = 0.0;
    for value in &mut resized[before * width..] {
        // Uniform, since that is the same on every machine; of variance 1 between these ends.
        let noise = (2.0 * uniform(&mut state) - 1.0) * 3.0_f64.sqrt();
        added += (scale * noise).powi(2);
        *value = (f64::from(*value) + scale * noise) as f32;
    }
    let bound = (f64::from(f32::MAX) / width as f64).sqrt() / 2.0;
    if let Some(large) = resized
        .iter()
        .find(|value| value.is_nan() || f64::from(value.abs()) > bound)
    {
        bail!(
            Input, "perturbation";
            "{amount:?} gives a token with an element of {large:e}; a layer norm of {width} float32 elements overflows above {bound:.1e}"
        );
    }
    Ok((added / ((count - before) * width) as f64).sqrt())
}

/// SplitMix64: the next number from 0 to 1.
pub(super) fn uniform(state: &mut u64) -> f64 {
    *state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let mut bits = *state;
    bits = (bits ^ (bits >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    bits = (bits ^ (bits >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    ((bits ^ (bits >> 31)) >> 11) as f64 / (1u64 << 53) as f64
}
