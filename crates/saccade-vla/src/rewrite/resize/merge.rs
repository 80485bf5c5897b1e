//! Future tokens of another number: which tokens are copied or merged, the new rows, and the bias of their keys.
//!
//! All weights are logarithms, and sums of them are taken relative to the largest (log-sum-exp), so that no finite bias over- or underflows.

use saccade_vla_checkpoint::{probe_allocation, reserve};

use crate::alloc::filled;
use crate::error::{Error, Result, bail, ensure};
use crate::ops::check_interrupted;

/// A smaller bias is rounding error of the logarithms and is written as no bias.
const NO_BIAS: f64 = 1e-6;

/// Biases up to this size are exponentiated as they are: products and sums of 4096 such weights stay within float64.
const MAX_PLAIN_BIAS: f64 = 300.0;

/// Future tokens that represent a head's.
#[derive(Clone, Debug, PartialEq)]
pub struct MergedTokens {
    /// The rows, `(num_future_tokens, width)`.
    pub tokens: Vec<f32>,
    /// For each row, the indices of the given tokens that it represents.
    pub sources: Vec<Vec<usize>>,
    /// What is added to the logit of each row's key in self-attention, `(num_future_tokens)`; none if it is zero everywhere.
    pub key_bias: Option<Vec<f32>>,
    /// Whether every row represents equal tokens only, so that attention gives the same output but for rounding.
    pub is_exact: bool,
}

/// Merges `tokens`, rows of `width`, into `num_future_tokens`: the two groups of tokens with the most similar directions become one, again and
/// again. A row is the weighted mean of its tokens, and its key gets the logarithm of their total weight, where `key_bias`, one number per
/// token, holds the logarithms of the tokens' own weights (default zeros).
///
/// This is the rule by which [`resize`](crate::resize) merges.
///
/// # Errors
/// [`Error::Shape`] if `tokens` holds no whole rows or `key_bias` another number of them; [`Error::Input`] for values that are not finite and
/// for more rows than there are tokens.
pub fn merge_future_tokens(
    tokens: &[f32],
    width: usize,
    num_future_tokens: usize,
    key_bias: Option<&[f32]>,
) -> Result<MergedTokens> {
    ensure!(
        width > 0 && tokens.len().is_multiple_of(width), Shape, "tokens";
        expected "rows of {width} elements"; got "{} elements", tokens.len()
    );
    let count = tokens.len() / width;
    let zeros = filled("key_bias", count, 0.0)?;
    let key_bias = key_bias.unwrap_or(&zeros);
    ensure!(
        key_bias.len() == count, Shape, "key_bias";
        expected "{count} elements, one per token"; got "{}", key_bias.len()
    );
    for (what, values) in [("tokens", tokens), ("key_bias", key_bias)] {
        if let Some(bad) = values.iter().find(|value| !value.is_finite()) {
            bail!(Input, what; expected "finite numbers"; got "{bad}");
        }
    }
    ensure!(
        num_future_tokens <= count, Input, "num_future_tokens";
        expected "at most the {count} tokens that are given"; got "{num_future_tokens}"
    );
    resized(tokens, width, key_bias, num_future_tokens)
}

/// `count` tokens in place of `tokens`, rows of `width`, with `bias` on their keys: copied in turn, or merged.
///
/// # Errors
/// [`Error::File`] if there is no memory for them.
pub(super) fn resized(tokens: &[f32], width: usize, bias: &[f32], count: usize) -> Result<MergedTokens> {
    let before = bias.len();
    let mut rows = Vec::new();
    reserve("future tokens", &mut rows, count * width)?;
    let sources: Vec<Vec<usize>> = if count >= before {
        (0..count).map(|index| vec![index % before]).collect()
    } else {
        // As float64, while they are compared.
        probe_allocation("future tokens", tokens.len().saturating_mul(size_of::<f64>()))?;
        merged(tokens, width, bias, count)?
    };
    let row = |index: usize| &tokens[index * width..(index + 1) * width];
    let is_equal = |group: &Vec<usize>| group.iter().all(|&one| row(one) == row(group[0]));
    let is_exact = count > 0 && sources.iter().all(is_equal);
    let mut biases = Vec::with_capacity(count);
    for group in &sources {
        let copies = match count >= before {
            true => count / before + usize::from(group[0] < count % before),
            false => 1,
        };
        let shift = shift(group.iter().map(|&one| bias[one]));
        let weights: Vec<f64> = group
            .iter()
            .map(|&one| (f64::from(bias[one]) - shift).exp())
            .collect();
        let total: f64 = weights.iter().sum();
        biases.push((total / copies as f64).ln() + shift);
        if is_equal(group) {
            rows.extend(row(group[0]));
            continue;
        }
        rows.extend((0..width).map(|column| {
            let terms = group.iter().zip(&weights);
            let sum: f64 = terms
                .map(|(&one, weight)| weight * f64::from(row(one)[column]))
                .sum();
            (sum / total) as f32
        }));
    }
    let has_bias = biases.iter().any(|bias| bias.abs() > NO_BIAS);
    Ok(MergedTokens {
        tokens: rows,
        key_bias: has_bias.then(|| biases.into_iter().map(|bias| bias as f32).collect()),
        sources,
        is_exact,
    })
}

/// What is subtracted from biases before they are exponentiated: 0, or the largest of them where one is too large for that.
fn shift(biases: impl Iterator<Item = f32>) -> f64 {
    let (mut largest, mut is_plain) = (f64::NEG_INFINITY, true);
    for bias in biases.map(f64::from) {
        largest = largest.max(bias);
        is_plain &= bias.abs() <= MAX_PLAIN_BIAS;
    }
    if is_plain { 0.0 } else { largest }
}

/// Tokens that are merged.
struct Cluster {
    members: Vec<usize>,
    weight: f64,
    /// The weighted sum of the members' directions.
    sum: Vec<f64>,
}

impl Cluster {
    /// What merging with `other` adds to the weighted squared distances of directions from their group's mean.
    fn cost(&self, other: &Self) -> f64 {
        let both = self.sum.iter().zip(&other.sum);
        let squared: f64 = both
            .map(|(x, y)| (x / self.weight - y / other.weight).powi(2))
            .sum();
        squared * self.weight * other.weight / (self.weight + other.weight)
    }

    fn take(&mut self, other: Self) {
        self.members.extend(other.members);
        self.members.sort_unstable();
        self.weight += other.weight;
        for (sum, more) in self.sum.iter_mut().zip(other.sum) {
            *sum += more;
        }
    }
}

/// Which tokens are merged so that `count` are left: always the two groups whose merging costs least, ties in the order of their first
/// tokens. Directions count and lengths do not, since each block normalises its rows.
///
/// # Errors
/// [`Error::Interrupted`] if the call is to stop.
fn merged(tokens: &[f32], width: usize, bias: &[f32], count: usize) -> Result<Vec<Vec<usize>>> {
    if count == 0 {
        return Ok(Vec::new());
    }
    let mut groups = single_tokens(tokens, width, bias);
    let mut best: Vec<Option<(f64, usize)>> = Vec::with_capacity(groups.len());
    for index in 0..groups.len() {
        check_interrupted()?;
        best.push(cheapest(&groups, index));
    }
    for _ in count..groups.len() {
        check_interrupted()?;
        let found = best
            .iter()
            .enumerate()
            .filter_map(|(index, one)| one.map(|(cost, other)| (cost, index, other)));
        let (_, first, second) = found
            .min_by(|a, b| a.0.total_cmp(&b.0))
            .expect("there are more groups than are wanted");
        let taken = groups[second].take().expect("it was there to be found");
        groups[first]
            .as_mut()
            .expect("it was there to be found")
            .take(taken);
        best[second] = None;
        for index in 0..groups.len() {
            let is_stale = best[index].is_some_and(|(_, other)| other == first || other == second);
            if is_stale || index == first {
                check_interrupted()?;
                best[index] = cheapest(&groups, index);
            } else if index < first
                && let (Some(one), Some(changed)) = (&groups[index], &groups[first])
            {
                let cost = one.cost(changed);
                if best[index].is_none_or(|(least, other)| (cost, first) < (least, other)) {
                    best[index] = Some((cost, first));
                }
            }
        }
    }
    Ok(groups.into_iter().flatten().map(|group| group.members).collect())
}

/// A group for each token.
fn single_tokens(tokens: &[f32], width: usize, bias: &[f32]) -> Vec<Option<Cluster>> {
    let shift = shift(bias.iter().copied());
    let group = |(index, (row, &bias)): (usize, (&[f32], &f32))| {
        let row = row.iter().map(|&value| f64::from(value));
        let norm = row.clone().map(|value| value * value).sum::<f64>().sqrt();
        let norm = if norm > 0.0 { norm } else { 1.0 };
        // Lighter tokens than this all cost nothing to merge.
        let weight = (f64::from(bias) - shift).max(-MAX_PLAIN_BIAS).exp();
        Some(Cluster {
            members: vec![index],
            weight,
            sum: row.map(|value| weight * (value / norm)).collect(),
        })
    };
    let rows = tokens.chunks_exact(width).zip(bias);
    rows.enumerate().map(group).collect()
}

/// The cheapest group after number `index` to merge it with, and its cost.
fn cheapest(groups: &[Option<Cluster>], index: usize) -> Option<(f64, usize)> {
    let group = groups[index].as_ref()?;
    let mut best: Option<(f64, usize)> = None;
    for (other, candidate) in groups.iter().enumerate().skip(index + 1) {
        let Some(candidate) = candidate else { continue };
        let cost = group.cost(candidate);
        if best.is_none_or(|(least, _)| cost < least) {
            best = Some((cost, other));
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;
    use crate::rewrite::resize::perturb::uniform;

    /// The weight of each distinct token in a softmax, by the bits of its row.
    fn mass(tokens: &[f32], width: usize, bias: Option<&[f32]>) -> Vec<(Vec<u32>, f64)> {
        let mut found: BTreeMap<Vec<u32>, f64> = BTreeMap::new();
        for (index, row) in tokens.chunks_exact(width).enumerate() {
            let weight = bias.map_or(1.0, |bias| f64::from(bias[index]).exp());
            *found
                .entry(row.iter().map(|value| value.to_bits()).collect())
                .or_default() += weight;
        }
        found.into_iter().collect()
    }

    proptest::proptest! {
        #[test]
        fn copies_weigh_what_the_token_did_and_merge_again(
            before in 1usize..9,
            more in 0usize..30,
            width in 1usize..7,
            seed: u64,
        ) {
            let mut state = seed;
            let mut number = || uniform(&mut state) as f32 - 0.5;
            let tokens: Vec<f32> = (0..before * width).map(|_| number()).collect();
            let bias: Vec<f32> = (0..before).map(|_| number()).collect();
            let grown = resized(&tokens, width, &bias, before + more).unwrap();
            proptest::prop_assert!(grown.is_exact);
            proptest::prop_assert_eq!(&grown.tokens[..before * width], &tokens[..]);
            let was = mass(&tokens, width, Some(&bias));
            let is = mass(&grown.tokens, width, grown.key_bias.as_deref());
            for ((row, was), (other, is)) in was.iter().zip(&is) {
                proptest::prop_assert_eq!(row, other);
                proptest::prop_assert!((was - is).abs() < 1e-6 * was, "{} {}", was, is);
            }
            let all_zero = vec![0.0; before + more];
            let shrunk = resized(&grown.tokens, width, grown.key_bias.as_deref().unwrap_or(&all_zero), before).unwrap();
            // Rows of one element have one of two directions: merging those of different lengths is as good.
            if width > 1 {
                proptest::prop_assert!(shrunk.is_exact);
                proptest::prop_assert_eq!(&shrunk.tokens, &tokens);
                for (was, is) in bias.iter().zip(shrunk.key_bias.unwrap_or(vec![0.0; before])) {
                    proptest::prop_assert!((was - is).abs() < 2e-6, "{} {}", was, is);
                }
            }
        }

        #[test]
        fn any_finite_bias_gives_finite_numbers(
            before in 1usize..9,
            count in 0usize..12,
            bias in proptest::collection::vec(-f32::MAX..f32::MAX, 9),
            small in proptest::collection::vec(-1000f32..1000.0, 9),
            is_small: bool,
            seed: u64,
        ) {
            let mut state = seed;
            let tokens: Vec<f32> = (0..before * 3).map(|_| uniform(&mut state) as f32 - 0.5).collect();
            let bias = if is_small { &small[..before] } else { &bias[..before] };
            let resized = resized(&tokens, 3, bias, count).unwrap();
            proptest::prop_assert!(resized.tokens.iter().all(|value| value.is_finite() && value.abs() <= 0.5));
            proptest::prop_assert!(resized.key_bias.iter().flatten().all(|value| value.is_finite()));
            let mut all: Vec<usize> = resized.sources.concat();
            all.sort_unstable();
            if (1..=before).contains(&count) {
                proptest::prop_assert_eq!(all, (0..before).collect::<Vec<_>>());
            }
        }
    }
}
