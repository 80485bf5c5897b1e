//! Slices of one length, vector by vector.

use super::Simd;

/// Replaces each element of `to` by what `f` makes of it and of the elements of `from` at its place: in whole
/// vectors, then in what is left of one. `f` is short, so that it is inlined into both.
///
/// # Panics
/// If a slice of `from` is shorter than `to`.
#[inline(always)]
pub(crate) fn update<S: Simd, const N: usize>(
    simd: S,
    to: &mut [f32],
    from: [&[f32]; N],
    f: impl Fn(S::F32, [S::F32; N]) -> S::F32,
) {
    let len = to.len();
    // Of one length, so that one check of the place serves all of them.
    let from = from.map(|from| &from[..len]);
    let mut x = [simd.splat(0.0); N];
    for vector in 0..len / S::LANES {
        let at = vector * S::LANES..(vector + 1) * S::LANES;
        // Not by `map`, whose closure is a function without the target features unless it is inlined.
        for (x, from) in x.iter_mut().zip(from) {
            *x = simd.load(&from[at.clone()]);
        }
        let to = &mut to[at];
        simd.store(f(simd.load(to), x), to);
    }
    let rest = len - len % S::LANES..len;
    if !rest.is_empty() {
        for (x, from) in x.iter_mut().zip(from) {
            *x = simd.load_rest(&from[rest.clone()]);
        }
        let to = &mut to[rest];
        simd.store_rest(f(simd.load_rest(to), x), to);
    }
}
