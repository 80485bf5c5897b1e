//! Rounding to four bits for the inputs of a layer: against the formula of the paper, element by element, and what holds
//! whatever the implementation.

use proptest::prelude::*;

use saccade_vla::{Array, ErrorKind, Gram, Rounded, RoundingErrors, gptq, interruptible};

/// Numbers in -1 to 1 that look random.
fn numbers(seed: u64, len: usize) -> Vec<f32> {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    let mut next = || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        ((state >> 11) as f64 / (1_u64 << 52) as f64 - 1.0) as f32
    };
    (0..len).map(|_| next()).collect()
}

/// Rows whose inputs depend on each other, and are of different sizes.
fn inputs(seed: u64, rows: usize, width: usize) -> Vec<f32> {
    let (mut x, shared) = (numbers(seed, rows * width), numbers(seed ^ 5, rows));
    for (row, shared) in x.chunks_exact_mut(width).zip(shared) {
        for (input, value) in row.iter_mut().enumerate() {
            *value = (*value + 2.0 * shared) * (1.0 + (input * 7 % 5) as f32);
        }
    }
    x
}

fn gram(x: &[f32], width: usize) -> Gram {
    let mut gram = Gram::new(width).unwrap();
    let shape = [x.len() / width, width];
    gram.add(Array::new(x, &shape).unwrap(), 2).unwrap();
    gram
}

/// A seventh of the largest magnitude of each row.
fn scales(weight: &[f32], width: usize) -> Vec<f32> {
    let largest = |row: &[f32]| row.iter().fold(0.0, |most: f32, value| most.max(value.abs()));
    weight.chunks_exact(width).map(|row| largest(row) / 7.0).collect()
}

fn rounded(weight: &[f32], scales: &[f32], gram: &Gram, threads: usize) -> Rounded {
    let shape = [scales.len(), gram.width()];
    gptq(Array::new(weight, &shape).unwrap(), scales, gram, threads).unwrap()
}

fn plain(weight: &[f32], scales: &[f32], width: usize) -> Vec<i8> {
    let rows = weight.chunks_exact(width).zip(scales);
    rows.flat_map(|(row, scale)| {
        row.iter()
            .map(move |value| (value / scale).round_ties_even().clamp(-7.0, 7.0) as i8)
    })
    .collect()
}

/// The squared error of the outputs of rows `x`, in float64.
fn error(x: &[f32], weight: &[f32], values: &[i8], scale: f32) -> f64 {
    let width = weight.len();
    let of_row = |row: &[f32]| -> f64 {
        let weights = weight.iter().zip(values);
        row.iter()
            .zip(weights)
            .map(|(x, (w, v))| f64::from(*x) * (f64::from(*v) * f64::from(scale) - f64::from(*w)))
            .sum()
    };
    x.chunks_exact(width).map(|row| of_row(row).powi(2)).sum()
}

/// Algorithm 1 of the paper for one row of weights: by the inverse of the damped Gram matrix, updated after each input.
///
/// The matrix is the one that was summed in float32, which is compared with sums in float64 apart. With fewer rows than
/// inputs its condition number is above a thousand, so that the last digits of the sums can change a rounded value.
fn by_the_paper(weight: &[f32], scale: f32, sums: &Gram) -> Vec<i8> {
    let width = weight.len();
    let of_input = |i| (0..width).map(|j| f64::from(sums.get(i, j))).collect();
    let mut gram: Vec<Vec<f64>> = (0..width).map(of_input).collect();
    (0..width).for_each(|i| gram[i][i] *= 1.01);
    let mut left: Vec<usize> = (0..width).collect();
    let mut weight: Vec<f64> = weight.iter().map(|&w| f64::from(w)).collect();
    let mut values = vec![0; width];
    while !left.is_empty() {
        // The largest square of those that are left, the first one of several.
        let first = left
            .iter()
            .copied()
            .reduce(|a, b| if gram[b][b] > gram[a][a] { b } else { a })
            .unwrap();
        let place = left.iter().position(|&input| input == first).unwrap();
        let inverse = inverse(
            &left
                .iter()
                .map(|&i| left.iter().map(|&j| gram[i][j]).collect())
                .collect::<Vec<_>>(),
        );
        let value = (weight[first] / f64::from(scale))
            .round_ties_even()
            .clamp(-7.0, 7.0);
        values[first] = value as i8;
        let error = (weight[first] - value * f64::from(scale)) / inverse[place][place];
        for (other, &input) in left.iter().enumerate() {
            weight[input] -= error * inverse[place][other];
        }
        left.remove(place);
    }
    values
}

/// The inverse of a symmetric positive matrix, by Gauss and Jordan.
fn inverse(matrix: &[Vec<f64>]) -> Vec<Vec<f64>> {
    let size = matrix.len();
    let mut rows: Vec<Vec<f64>> = matrix.to_vec();
    for (i, row) in rows.iter_mut().enumerate() {
        row.extend((0..size).map(|j| f64::from(u8::from(i == j))));
    }
    for pivot in 0..size {
        let scale = rows[pivot][pivot];
        rows[pivot].iter_mut().for_each(|value| *value /= scale);
        let own = rows[pivot].clone();
        for (i, row) in rows.iter_mut().enumerate().filter(|(i, _)| *i != pivot) {
            let factor = row[pivot];
            row.iter_mut()
                .zip(&own)
                .for_each(|(value, own)| *value -= factor * own);
            debug_assert!(i < size);
        }
    }
    rows.into_iter().map(|row| row[size..].to_vec()).collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(24))]

    /// Every value, where the paper's are better than plain ones; what is kept otherwise is plain.
    #[test]
    fn values_are_those_of_the_paper(seed: u64, width in 1_usize..40, rows in 1_usize..60, outputs in 1_usize..4) {
        let (x, weight) = (inputs(seed, rows, width), numbers(seed ^ 2, outputs * width));
        let scales = scales(&weight, width);
        let gram = gram(&x, width);
        let found = rounded(&weight, &scales, &gram, 1);
        let plain = plain(&weight, &scales, width);
        for (i, j) in (0..width).flat_map(|i| (0..=i).map(move |j| (i, j))) {
            let products = x.chunks_exact(width).map(|row| f64::from(row[i]) * f64::from(row[j]));
            let (sum, size) = products.fold((0.0, 0.0), |(sum, size), one| (sum + one, size + one.abs()));
            prop_assert!((f64::from(gram.get(i, j)) - sum).abs() <= 1e-5 * size);
        }
        for (row, weight) in weight.chunks_exact(width).enumerate() {
            let of_row = row * width..(row + 1) * width;
            let values = &found.values[of_row.clone()];
            let expected = by_the_paper(weight, scales[row], &gram);
            prop_assert!(values == expected || values == &plain[of_row], "{values:?}, expected {expected:?}");
        }
    }

    /// Wider than the blocks of the factorisation: outputs of the rows that it was calibrated with are no further off.
    #[test]
    fn outputs_are_closer_than_with_plain_rounding(seed: u64, width in 200_usize..600, outputs in 30_usize..80) {
        let x = inputs(seed, 2 * width, width);
        let weight = numbers(seed ^ 2, outputs * width);
        let (scales, gram) = (scales(&weight, width), gram(&x, width));
        let found = rounded(&weight, &scales, &gram, 1);
        let plain = plain(&weight, &scales, width);
        let sum = |values: &[i8]| -> f64 {
            let rows = weight.chunks_exact(width).zip(values.chunks_exact(width)).zip(&scales);
            rows.map(|((weight, values), &scale)| error(&x, weight, values, scale)).sum()
        };
        let (before, after) = (sum(&plain), sum(&found.values));
        prop_assert!(after < 0.8 * before, "{after}, before {before}");
        // With the hundredth that is added, for the errors that are reported.
        prop_assert!(found.errors.plain > before && found.errors.plain < 1.5 * before);
        prop_assert!(found.errors.rounded > after && found.errors.rounded < 1.5 * after);
        let again = rounded(&weight, &scales, &gram, 3);
        prop_assert_eq!(found, again, "the same bits on three threads");
    }

    /// Inputs that have nothing to do with each other: nothing is passed on.
    #[test]
    fn independent_inputs_give_plain_rounding(seed: u64, width in 1_usize..300, outputs in 1_usize..70) {
        let mut x = vec![0.0; width * width];
        (0..width).for_each(|i| x[i * width + i] = 1.0 + (i % 3) as f32);
        let weight = numbers(seed, outputs * width);
        let scales: Vec<f32> = scales(&weight, width).iter().map(|scale| 0.6 * scale).collect();
        let found = rounded(&weight, &scales, &gram(&x, width), 2);
        prop_assert_eq!(found.values, plain(&weight, &scales, width));
        prop_assert_eq!(found.errors.rounded, found.errors.plain);
    }
}

#[test]
fn inputs_that_were_always_zero_are_rounded_for_themselves() {
    let (width, rows) = (50, 100);
    let mut x = inputs(3, rows, width);
    for row in x.chunks_exact_mut(width) {
        (0..width).step_by(3).for_each(|input| row[input] = 0.0);
    }
    let weight = numbers(4, 8 * width);
    let scales = scales(&weight, width);
    let (found, plain) = (
        rounded(&weight, &scales, &gram(&x, width), 1),
        plain(&weight, &scales, width),
    );
    for (place, (found, plain)) in found.values.iter().zip(&plain).enumerate() {
        assert!(found == plain || place % width % 3 != 0);
    }
    assert!(found.errors.rounded < 0.6 * found.errors.plain);
    let nothing = rounded(&weight, &scales, &Gram::new(width).unwrap(), 1);
    assert_eq!(nothing.values, plain, "no calibration at all");
    assert_eq!(
        nothing.errors,
        RoundingErrors::default(),
        "outputs of zero have no error"
    );
}

#[test]
fn inputs_whose_squares_are_no_normal_numbers_count_as_zero() {
    let (width, rows) = (50, 100);
    let mut x = inputs(3, rows, width);
    let mut with_zeros = x.clone();
    // Two of them, alike: the products of what is left of their digits would not be a sum of squares.
    for (row, zeros) in x.chunks_exact_mut(width).zip(with_zeros.chunks_exact_mut(width)) {
        (row[7], row[8]) = (1e-21 * row[7], 1e-21 * row[7]);
        (zeros[7], zeros[8]) = (0.0, 0.0);
    }
    let tiny = gram(&x, width);
    assert!(tiny.get(7, 7) > 0.0 && tiny.get(7, 7) < f32::MIN_POSITIVE);
    let weight = numbers(4, 8 * width);
    let scales = scales(&weight, width);
    assert_eq!(
        rounded(&weight, &scales, &tiny, 1),
        rounded(&weight, &scales, &gram(&with_zeros, width), 1)
    );
}

#[test]
fn a_gram_matrix_of_fewer_rows_than_inputs_is_regular_enough() {
    let width = 300;
    let (x, weight) = (inputs(1, 5, width), numbers(2, 30 * width));
    let scales = scales(&weight, width);
    let found = rounded(&weight, &scales, &gram(&x, width), 1);
    assert!(found.errors.rounded < 0.2 * found.errors.plain, "{found:?}");
}

#[test]
fn a_channel_far_larger_than_the_others_does_not_drown_them() {
    let width = 200;
    let mut x = inputs(1, 400, width);
    let mut weight = numbers(2, 30 * width);
    let scales = scales(&weight, width);
    // Its weights are whole steps, so that the others have nothing to make up for.
    x.iter_mut().step_by(width).for_each(|value| *value *= 1000.0);
    let own = weight.iter_mut().step_by(width).zip(&scales);
    own.for_each(|(weight, scale)| *weight = 3.0 * scale);
    let gram = gram(&x, width);
    let found = rounded(&weight, &scales, &gram, 1);
    let others = |values: &[i8]| -> f64 {
        let rows = weight
            .chunks_exact(width)
            .zip(values.chunks_exact(width))
            .zip(&scales);
        let mut x = x.clone();
        x.iter_mut().step_by(width).for_each(|value| *value = 0.0);
        rows.map(|((weight, values), &scale)| error(&x, weight, values, scale))
            .sum()
    };
    let (after, before) = (others(&found.values), others(&plain(&weight, &scales, width)));
    assert!(after < 0.6 * before, "{after}, before {before}");
}

#[test]
fn rows_are_added_in_any_pieces() {
    let (width, rows) = (300, 700);
    let x = inputs(1, rows, width);
    let whole = gram(&x, width);
    assert_eq!(
        (whole.num_rows(), whole.width(), Gram::nbytes_of(width)),
        (rows, width, 4 * width * width)
    );
    let mut pieces = Gram::new(width).unwrap();
    for piece in x.chunks(width * 90) {
        let shape = [piece.len() / width, width];
        pieces.add(Array::new(piece, &shape).unwrap(), 1).unwrap();
    }
    pieces.add(Array::new(&[], &[0, width]).unwrap(), 1).unwrap();
    assert_eq!(pieces.num_rows(), rows);
    for (first, second) in [(0, 0), (299, 0), (17, 280), (256, 255), (299, 299)] {
        let column = |input: usize| x.iter().skip(input).step_by(width).map(|&value| f64::from(value));
        let exact: f64 = column(first).zip(column(second)).map(|(a, b)| a * b).sum();
        let size: f64 = column(first)
            .zip(column(second))
            .map(|(a, b)| (a * b).abs())
            .sum();
        for gram in [&whole, &pieces] {
            assert!((f64::from(gram.get(first, second)) - exact).abs() < 1e-5 * size);
            assert_eq!(gram.get(first, second), gram.get(second, first));
        }
    }
}

#[test]
fn rows_of_zeros_and_tiny_scales() {
    let gram = gram(&inputs(1, 30, 4), 4);
    let zero = rounded(&[0.0, -0.0, 1e-38, 0.0], &[0.0], &gram, 1);
    assert_eq!(zero.values, [0; 4]);
    assert_eq!(
        gptq(Array::new(&[], &[0, 4]).unwrap(), &[], &gram, 1).unwrap(),
        Rounded::default()
    );
    let tiny = rounded(&[7e-30, 1.4e-30, -7e-30, 0.0], &[1e-30], &gram, 1);
    assert!(tiny.values.iter().any(|&value| value.abs() == 7), "{tiny:?}");
}

#[test]
fn what_is_wrong_is_named() {
    let gram = gram(&inputs(1, 30, 4), 4);
    let weight = [1.0, 2.0, 3.0, 4.0];
    let call = |weight: &[f32], shape: &[usize], scales: &[f32]| {
        let error = gptq(Array::new(weight, shape).unwrap(), scales, &gram, 1).unwrap_err();
        (error.kind(), error.to_string())
    };
    for (given, kind, message) in [
        (
            call(&weight, &[4], &[1.0]),
            ErrorKind::Shape,
            "weight: expected two axes, (out_features, in_features), got (4,)",
        ),
        (
            call(&weight, &[2, 2], &[1.0]),
            ErrorKind::Shape,
            "weight: expected (out_features, in_features) = (2, 4), got (2, 2)",
        ),
        (
            call(&weight, &[1, 4], &[1.0, 1.0]),
            ErrorKind::Shape,
            "scales: expected one for each of 1 rows, got 2",
        ),
        (
            call(&weight, &[1, 4], &[-1.0]),
            ErrorKind::Input,
            "scales: expected finite scales that are not negative, got -1 at index 0",
        ),
        (
            call(&weight, &[1, 4], &[f32::NAN]),
            ErrorKind::Input,
            "scales: expected finite scales that are not negative, got NaN at index 0",
        ),
        (
            call(&weight, &[1, 4], &[f32::MAX]),
            ErrorKind::Input,
            "scales: expected finite scales that are not negative, got 340282350000000000000000000000000000000 at index 0",
        ),
        (
            call(&weight, &[1, 4], &[0.0]),
            ErrorKind::Input,
            "scales: expected a scale above 0 for a row that is not zero, got 0 at index 0",
        ),
        (
            call(&[1.0, f32::INFINITY, 0.0, 0.0], &[1, 4], &[1.0]),
            ErrorKind::Input,
            "weight: expected finite values, got inf at index (0, 1)",
        ),
    ] {
        assert_eq!(given, (kind, message.to_owned()));
    }
    let mut gram = Gram::new(2).unwrap();
    let mut add = |x: &[f32], shape: &[usize]| {
        let error = gram.add(Array::new(x, shape).unwrap(), 1).unwrap_err();
        (error.kind(), error.to_string())
    };
    for (given, kind, message) in [
        (
            add(&[1.0, 2.0], &[2]),
            ErrorKind::Shape,
            "x: expected two axes, (rows, width), got (2,)",
        ),
        (
            add(&[1.0, 2.0, 3.0], &[1, 3]),
            ErrorKind::Shape,
            "x: expected (rows, width) = (1, 2), got (1, 3)",
        ),
        (
            add(&[1.0, f32::NAN], &[1, 2]),
            ErrorKind::Input,
            "x: expected finite values, got NaN at index (0, 1)",
        ),
        (
            add(&[0.0, 3e19], &[1, 2]),
            ErrorKind::Input,
            "x: expected inputs whose squares sum to finite float32, got inf at (1, 1)",
        ),
    ] {
        assert_eq!(given, (kind, message.to_owned()));
    }
    assert_eq!(
        Gram::new(0).unwrap_err().to_string(),
        "width: expected at least 1, got 0"
    );
    assert_eq!(Gram::new(usize::MAX / 2).unwrap_err().kind(), ErrorKind::Memory);
}

#[test]
fn it_stops_when_asked_to() {
    let width = 64;
    let (gram, weight) = (gram(&inputs(1, 80, width), width), numbers(2, 8 * width));
    let scales = scales(&weight, width);
    let stopped = interruptible(&|| true, || {
        std::thread::sleep(std::time::Duration::from_millis(30));
        gptq(Array::new(&weight, &[8, width])?, &scales, &gram, 1)
    });
    assert_eq!(stopped.unwrap_err().kind(), ErrorKind::Interrupted);
}
