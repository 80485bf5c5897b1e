//! Linear algebra: identities that hold whatever the implementation. The Python tests compare with scikit-learn
//! and SciPy.

use proptest::prelude::*;

use saccade_vla::linalg::{Pca, Ridge, Standardizer, linear_cka, principal_angles};
use saccade_vla::{Array, Error, ErrorKind};

/// Numbers in -1 to 1 that look random.
fn numbers(seed: u64, len: usize) -> Vec<f64> {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    let mut next = || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 11) as f64 / (1_u64 << 52) as f64 - 1.0
    };
    (0..len).map(|_| next()).collect()
}

fn near(a: f64, b: f64, tolerance: f64) -> bool {
    (a - b).abs() <= tolerance
}

/// `a b` of `(n, k)` and `(k, m)`, element by element.
fn plain_product(a: &[f64], b: &[f64], k: usize, m: usize) -> Vec<f64> {
    let row = |row: &[f64]| -> Vec<f64> {
        (0..m)
            .map(|j| row.iter().enumerate().map(|(i, a)| a * b[i * m + j]).sum())
            .collect()
    };
    a.chunks_exact(k).flat_map(row).collect()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]

    /// `X^T (X W + b - Y) + alpha W = 0`, and the residuals have no mean: what the least value is found by.
    #[test]
    fn the_gradient_of_ridge_is_zero(
        rows in 1_usize..20, features in 1_usize..30, targets in 1_usize..4, seed: u64, alpha in 0.001..10.0,
    ) {
        let (x, y) = (numbers(seed, rows * features), numbers(seed ^ 1, rows * targets));
        let shape = [rows, features];
        let x_view = Array::new(&x, &shape).unwrap();
        let shape_y = [rows, targets];
        let ridge = Ridge::fit(x_view, Array::new(&y, &shape_y).unwrap(), &[alpha, 2.0 * alpha]).unwrap();
        let predicted = ridge.predict(x_view).unwrap();
        for (index, alpha) in [alpha, 2.0 * alpha].into_iter().enumerate() {
            let weights = &ridge.weights().data()[index * features * targets..];
            let predicted = &predicted.data()[index * rows * targets..];
            for target in 0..targets {
                let residual = |row: usize| predicted[row * targets + target] - y[row * targets + target];
                prop_assert!(near((0..rows).map(residual).sum(), 0.0, 1e-11));
                for feature in 0..features {
                    let pull: f64 = (0..rows).map(|row| x[row * features + feature] * residual(row)).sum();
                    prop_assert!(near(pull + alpha * weights[feature * targets + target], 0.0, 1e-11));
                }
            }
        }
    }

    /// The components are orthonormal, and all of them together lose nothing.
    #[test]
    fn components_are_orthonormal_and_complete(rows in 2_usize..20, features in 1_usize..20, seed: u64) {
        let x = numbers(seed, rows * features);
        let shape = [rows, features];
        let x_view = Array::new(&x, &shape).unwrap();
        let count = rows.min(features);
        let pca = Pca::fit(x_view, count).unwrap();
        let components = pca.components().data();
        for (i, a) in components.chunks_exact(features).enumerate() {
            for (j, b) in components.chunks_exact(features).enumerate() {
                let dot: f64 = a.iter().zip(b).map(|(a, b)| a * b).sum();
                prop_assert!(near(dot, f64::from(i == j), 1e-12));
            }
            let largest = a.iter().copied().max_by(|a, b| a.abs().total_cmp(&b.abs())).unwrap();
            prop_assert!(largest > 0.0);
        }
        let variance = pca.explained_variance();
        prop_assert!(variance.windows(2).all(|pair| pair[0] >= pair[1]));
        prop_assert!(near(variance.iter().sum(), pca.total_variance(), 1e-12));
        let back = plain_product(pca.transform(x_view).unwrap().data(), components, count, features);
        for (row, original) in back.chunks_exact(features).zip(x.chunks_exact(features)) {
            for ((value, mean), original) in row.iter().zip(pca.mean()).zip(original) {
                prop_assert!(near(value + mean, *original, 1e-12));
            }
        }
    }

    /// More columns than rows or fewer: both forms of the alignment are one number, and it is symmetric.
    #[test]
    fn alignment_does_not_depend_on_the_form(rows in 2_usize..8, features in 1_usize..8, seed: u64) {
        let (x, y) = (numbers(seed, rows * features), numbers(seed ^ 1, rows));
        let (shape, shape_y) = ([rows, features], [rows, 1]);
        let (x_view, y) = (Array::new(&x, &shape).unwrap(), Array::new(&y, &shape_y).unwrap());
        // Columns of zeros change nothing but the form.
        let wide: Vec<f64> = x.chunks_exact(features).flat_map(|row| [row, &[0.0; 20][..]].concat()).collect();
        let wide_shape = [rows, features + 20];
        let wide = Array::new(&wide, &wide_shape).unwrap();
        let cka = linear_cka(x_view, y).unwrap();
        prop_assert!(near(linear_cka(wide, y).unwrap(), cka, 1e-12));
        prop_assert!(near(linear_cka(y, x_view).unwrap(), cka, 1e-12));
        prop_assert!(near(linear_cka(x_view, wide).unwrap(), 1.0, 1e-12));
    }
}

#[test]
fn angles_are_exact_where_they_are_small_and_where_they_are_large() {
    for angle in [
        0.0,
        1e-12,
        1e-7,
        0.3,
        0.785,
        0.786,
        1.2,
        std::f64::consts::FRAC_PI_2 - 1e-9,
    ] {
        // Two planes of four dimensions, which share no direction but by `angle` and `angle / 2`.
        let a = [1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0];
        let half = angle / 2.0;
        let b = [
            angle.cos(),
            0.0,
            0.0,
            half.cos(),
            angle.sin(),
            0.0,
            0.0,
            half.sin(),
        ];
        let angles =
            principal_angles(Array::new(&a, &[4, 2]).unwrap(), Array::new(&b, &[4, 2]).unwrap()).unwrap();
        let expected = [half, angle];
        assert!(
            angles
                .iter()
                .zip(expected)
                .all(|(&found, angle)| near(found, angle, 4e-16)),
            "{angles:?}"
        );
    }
}

#[test]
fn dependent_columns_count_once() {
    let a = [1.0, 2.0, 0.0, 0.0, 0.0, 0.0];
    let b = [0.0, 1.0, 1.0, 0.0, 0.0, 1.0];
    let angles =
        principal_angles(Array::new(&a, &[3, 2]).unwrap(), Array::new(&b, &[3, 2]).unwrap()).unwrap();
    assert_eq!(angles.len(), 1);
}

#[test]
fn constant_columns_are_centred_to_zero() {
    let x: Vec<f64> = (0..7).flat_map(|row| [0.1, f64::from(row)]).collect();
    let x = Array::new(&x, &[7, 2]).unwrap();
    let scaler = Standardizer::fit(x).unwrap();
    assert_eq!((scaler.scale()[0], scaler.scale()[1]), (1.0, 2.0));
    let pca = Pca::fit(x, 2).unwrap();
    assert_eq!(pca.components().data(), [0.0, 1.0, 1.0, 0.0]);
    assert_eq!(pca.explained_variance()[1], 0.0);
    assert_eq!(Standardizer::centring(x).unwrap().scale(), [1.0, 1.0]);
}

#[test]
fn huge_and_tiny_values_neither_overflow_nor_vanish() {
    let x = numbers(3, 40);
    let y = numbers(4, 10);
    let y = Array::new(&y, &[10, 1]).unwrap();
    let plain = Array::new(&x, &[10, 4]).unwrap();
    let deviation = Standardizer::fit(plain).unwrap().scale()[0];
    for factor in [1e200, 1e-200] {
        let scaled: Vec<f64> = x.iter().map(|value| value * factor).collect();
        let scaled = Array::new(&scaled, &[10, 4]).unwrap();
        assert!(near(
            Standardizer::fit(scaled).unwrap().scale()[0] / factor,
            deviation,
            1e-12
        ));
        assert!(near(
            linear_cka(scaled, y).unwrap(),
            linear_cka(plain, y).unwrap(),
            1e-12
        ));
        let fit = |x| Ridge::fit(x, y, &[0.0]).unwrap().predict(x).unwrap();
        for (a, b) in fit(scaled).data().iter().zip(fit(plain).data()) {
            assert!(near(*a, *b, 1e-11), "{a} {b}");
        }
    }
    let beyond = [1e308, -1e308, 1e308, -1e308];
    let beyond = Array::new(&beyond, &[4, 1]).unwrap();
    assert_eq!(Pca::fit(beyond, 1).unwrap_err().kind(), ErrorKind::Input);
    let beyond = [f64::MAX, f64::MAX];
    let error = Standardizer::fit(Array::new(&beyond, &[2, 1]).unwrap()).unwrap_err();
    assert_eq!(
        error.to_string(),
        "x: the result is not finite: values are too large for float64"
    );
}

#[test]
fn every_run_on_every_thread_has_the_same_bits() {
    let (x, y) = (numbers(1, 60 * 200), numbers(2, 60));
    let run = || {
        let (x, y) = (
            Array::new(&x, &[60, 200]).unwrap(),
            Array::new(&y, &[60, 1]).unwrap(),
        );
        let mut all = Ridge::fit(x, y, &[0.1]).unwrap().weights().data().to_vec();
        all.extend(Pca::fit(x, 60).unwrap().components().data());
        all.push(linear_cka(x, y).unwrap());
        all.into_iter().map(f64::to_bits).collect::<Vec<_>>()
    };
    let first = run();
    assert_eq!(run(), first);
    let apart = std::thread::scope(|scope| {
        let threads = [0, 1].map(|_| scope.spawn(run));
        threads.map(|thread| thread.join().unwrap())
    });
    assert_eq!(apart, [first.clone(), first]);
}

fn refused<T>(outcome: saccade_vla::Result<T>) -> String {
    match outcome {
        Ok(_) => panic!("accepted"),
        Err(error) => error.to_string(),
    }
}

#[test]
fn errors_name_the_argument_and_what_was_given() {
    let data = [0.0, 1.0, 2.0, 3.0, 4.0, 5.0];
    let x = Array::new(&data, &[3, 2]).unwrap();
    let y = Array::new(&data[..3], &[3, 1]).unwrap();
    let flat = Array::new(&data, &[6]).unwrap();
    let empty = Array::new(&[], &[0, 2]).unwrap();
    let with_nan = [0.0, 1.0, f64::NAN, 3.0];
    let with_nan = Array::new(&with_nan, &[2, 2]).unwrap();
    let one = Array::new(&data[..2], &[1, 2]).unwrap();
    let zeros = Array::new(&[0.0; 6], &[3, 2]).unwrap();
    let scaler = Standardizer::fit(x).unwrap();
    let wrong: Vec<(String, &str)> = vec![
        (
            refused(Standardizer::fit(flat)),
            "x: expected two axes, (rows, features), got (6,)",
        ),
        (
            refused(Standardizer::fit(empty)),
            "x: expected (rows, features) of at least one element, got (0, 2)",
        ),
        (
            refused(Standardizer::centring(with_nan)),
            "x: expected finite values, got NaN at index (1, 0)",
        ),
        (
            refused(scaler.transform(y)),
            "x: expected (rows, features) = (3, 2), got (3, 1)",
        ),
        (
            refused(Pca::fit(x, 0)),
            "components: expected 1 to 2 for x of shape (3, 2), got 0",
        ),
        (
            refused(Pca::fit(x, 3)),
            "components: expected 1 to 2 for x of shape (3, 2), got 3",
        ),
        (refused(Pca::fit(one, 1)), "x: expected at least 2 rows, got 1"),
        (
            refused(Pca::fit(x, 1).unwrap().transform(y)),
            "x: expected (rows, features) = (3, 2), got (3, 1)",
        ),
        (
            refused(Ridge::fit(x, one, &[1.0])),
            "y: expected (rows, targets) = (3, 2), got (1, 2)",
        ),
        (
            refused(Ridge::fit(x, with_nan, &[1.0])),
            "y: expected finite values, got NaN at index (1, 0)",
        ),
        (
            refused(Ridge::fit(x, y, &[])),
            "alphas: expected at least one penalty, got none",
        ),
        (
            refused(Ridge::fit(x, y, &[1.0, -1.0])),
            "alphas: expected finite penalties of at least 0, got -1",
        ),
        (
            refused(Ridge::fit(x, y, &[f64::NAN])),
            "alphas: expected finite penalties of at least 0, got NaN",
        ),
        (
            refused(Ridge::fit(x, y, &[1.0]).unwrap().predict(y)),
            "x: expected (rows, features) = (3, 2), got (3, 1)",
        ),
        (
            refused(linear_cka(one, one)),
            "x: expected at least 2 rows, got 1",
        ),
        (
            refused(linear_cka(x, one)),
            "y: expected (rows, features) = (3, 2), got (1, 2)",
        ),
        (
            refused(linear_cka(x, zeros)),
            "y: expected a feature that varies between rows, got constant columns only",
        ),
        (
            refused(principal_angles(x, one)),
            "b: expected (dimensions, vectors) = (3, 2), got (1, 2)",
        ),
        (
            refused(principal_angles(zeros, x)),
            "a: expected a column that is not zero, got zeros only",
        ),
    ];
    for (message, expected) in wrong {
        assert_eq!(message, expected);
    }
}

#[test]
fn decompositions_stop_when_asked_to() {
    let x = numbers(1, 12);
    let x = Array::new(&x, &[4, 3]).unwrap();
    let stopped = saccade_vla::interruptible(&|| true, || {
        std::thread::sleep(std::time::Duration::from_millis(30));
        Pca::fit(x, 2)
    });
    assert!(matches!(stopped, Err(Error::Interrupted)));
}
