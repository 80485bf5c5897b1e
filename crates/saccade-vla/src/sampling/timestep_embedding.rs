//! Sinusoidal embeddings of a timestep `t`: `sin(t f_i)` and `cos(t f_i)`, correctly rounded.
//!
//! The action encoder and the transformer embed it with different frequencies `f_i`. The released code evaluates
//! float32 `exp`, `sin` and `cos` of whatever vector library its torch was built with; one ulp of a frequency moves an
//! angle of 900 rad by 6e-5. Here exponents and angles are float32 as there, and the functions are evaluated in float64
//! and rounded once.
//!
//! Equations 3 and 7 of docs/equations.md.

/// ln 10000, rounded to float32 as the released code does.
const LN_10000: f32 = 9.210_340_5;

/// Width of the transformer's embedding.
pub(crate) const TIME_CHANNELS: usize = 256;

/// The action encoder's: sines, then cosines; `f_i = exp(-ln(10000) i / half)`.
pub(crate) fn action_encoder_embedding(timestep: usize, out: &mut [f32]) {
    let half = out.len() / 2;
    let step = LN_10000 / half as f32;
    for i in 0..half {
        let (sin, cos) = rounded_sin_cos(timestep, -(i as f32) * step);
        (out[i], out[half + i]) = (sin, cos);
    }
}

/// The transformer's: cosines, then sines; `f_i = exp(-ln(10000) i / (half - 1))`.
pub(crate) fn transformer_embedding(timestep: usize, out: &mut [f32; TIME_CHANNELS]) {
    let half = TIME_CHANNELS / 2;
    for i in 0..half {
        let (sin, cos) = rounded_sin_cos(timestep, -LN_10000 * i as f32 / (half - 1) as f32);
        (out[i], out[half + i]) = (cos, sin);
    }
}

fn rounded_sin_cos(timestep: usize, exponent: f32) -> (f32, f32) {
    let frequency = f64::from(exponent).exp() as f32;
    let angle = f64::from(timestep as f32 * frequency);
    (angle.sin() as f32, angle.cos() as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_constant_is_the_nearest_float() {
        assert_eq!(LN_10000, 10000f64.ln() as f32);
    }

    #[test]
    fn at_timestep_zero_sines_are_zero_and_cosines_one() {
        let mut table = [9.0; TIME_CHANNELS];
        transformer_embedding(0, &mut table);
        assert!(table[..128].iter().all(|&cos| cos == 1.0) && table[128..].iter().all(|&sin| sin == 0.0));
        action_encoder_embedding(0, &mut table);
        assert!(table[..128].iter().all(|&sin| sin == 0.0) && table[128..].iter().all(|&cos| cos == 1.0));
    }

    #[test]
    fn the_last_frequencies_differ_by_their_divisors() {
        let mut table = [0.0; TIME_CHANNELS];
        transformer_embedding(1000, &mut table);
        assert!(
            (table[255] - (0.1f32).sin()).abs() < 1e-6,
            "divisor half - 1 reaches 1 / 10000"
        );
        action_encoder_embedding(1000, &mut table);
        let last = (1000.0 * (-127.0 * 10000f64.ln() / 128.0).exp()).sin() as f32;
        assert!((table[127] - last).abs() < 1e-6, "divisor half stops short of it");
    }
}
