//! Tests of the tiles in software, and of AMX against them. That their sums are right is in `tests/software_tiles.rs`, of all layouts in
//! `tests/attention.rs`.

use std::panic::catch_unwind;

use half::bf16;

use super::software::{Registers, add_products, bf16_row, flushed};
use super::*;

/// Does products of operands that [`product`] was given, or parts of them.
fn multiply<U: TileUnit>(unit: U, products: &[Product]) {
    // SAFETY: the operands have the sizes of the products; no other session is open.
    unsafe {
        let mut session = Session::new(unit);
        for product in products {
            session.multiply(product);
        }
    }
}

fn words(seed: u32, count: usize) -> Vec<u32> {
    let mut state = u64::from(seed) << 17 | 0x9e37_79b9;
    let mut next = || {
        state = state
            .wrapping_mul(6364136223846793005)
            .wrapping_add(1442695040888963407);
        (state >> 33) as u32
    };
    (0..count).map(|_| next()).collect()
}

/// Numbers between -2 and 2, in pairs.
fn pairs(seed: u32, count: usize) -> Vec<u32> {
    let number = |word: u32| u32::from(bf16::from_f32((word & 0xffff) as f32 / 16384.0 - 2.0).to_bits());
    let words = words(seed, count);
    words
        .iter()
        .map(|&word| number(word) | number(word >> 16) << 16)
        .collect()
}

/// How many tiles of columns a product of so many rows may have, and whether they are apart in `w`.
fn layouts(operation: Operation, rows: usize) -> impl Iterator<Item = (usize, bool)> {
    let columns = match operation {
        Operation::Bf16 => 1..=MAX_COLUMN_TILES,
        Operation::Int8 => 3..=3,
    };
    let all = columns.flat_map(|columns| [(columns, false), (columns, true)]);
    all.filter(move |&(columns, apart)| match apart {
        false => columns <= 3,
        true => columns < 3 || rows <= TILE,
    })
}

/// By as many tiles, next to each other or one after the other.
fn product(
    operation: Operation,
    (columns, apart): (usize, bool),
    x: &[u32],
    w: &[u32],
    sums: &mut [u32],
) -> Product {
    assert_eq!((x.len() % TILE, w.len() % (columns * TILE * TILE)), (0, 0));
    let steps = w.len() / (columns * TILE * TILE);
    let (w_stride, w_column, w_step) = match apart {
        false => (columns * TILE, TILE, columns * TILE * TILE),
        true => (TILE, steps * TILE * TILE, TILE * TILE),
    };
    Product {
        operation,
        rows: x.len() / TILE / steps,
        x: x.as_ptr(),
        x_stride: TILE * steps,
        w: w.as_ptr(),
        w_stride,
        w_column,
        w_step,
        columns,
        steps,
        sums: sums.as_mut_ptr(),
        sums_stride: columns * TILE,
        add: false,
        ahead: Ahead::NOTHING,
    }
}

/// The order of the sum, by hand: the even elements first, then the odd ones, then both, then what was there.
#[test]
fn software_tiles_sum_in_the_order_of_the_hardware() {
    let one = |even: f32, odd: f32| {
        u32::from(bf16::from_f32(even).to_bits()) | u32::from(bf16::from_f32(odd).to_bits()) << 16
    };
    let sum = |x: &[u32], before: f32| {
        let mut w = [[0; TILE]; TILE];
        w.iter_mut().for_each(|w| w[0] = one(1.0, 1.0));
        let mut sums = [before.to_bits(); TILE];
        bf16_row(&mut sums, x, &w);
        f32::from_bits(sums[0])
    };
    let large = 33_554_432.0; // 2^25: adding 1 to it changes nothing
    assert_eq!(sum(&[one(large, 1.0), one(-large, 1.0)], 0.0), 2.0);
    assert_eq!(sum(&[one(large, -large), one(1.0, 1.0)], 0.0), 0.0);
    assert_eq!(sum(&[one(large, 1.0), one(0.0, 1.0)], -large), 0.0);
    // Denormals, and products that would be denormal.
    let tiny = f32::MIN_POSITIVE;
    assert_eq!(sum(&[one(tiny / 2.0, 0.0)], 0.0), 0.0);
    assert_eq!(sum(&[one(tiny, 0.0)], 0.0), tiny);
    assert_eq!(sum(&[one(tiny * 1.5, -tiny)], 0.0), 0.0);
    assert_eq!(sum(&[one(0.0, 0.0)], tiny / 2.0), 0.0);
    assert!(sum(&[one(f32::NAN, 0.0)], 1.0).is_nan());
    assert_eq!(sum(&[one(f32::INFINITY, 0.0)], 1.0), f32::INFINITY);
}

/// Where products are not exact in float32, the fused multiply-add decides.
#[test]
fn software_tiles_round_products_once() {
    let (tiny, huge) = (1.5 * 2.0_f32.powi(-70), 2.0_f32.powi(127));
    for (x, w, before) in [
        (tiny, tiny, f32::MIN_POSITIVE),
        (tiny, -tiny, f32::MIN_POSITIVE * 1.25),
        (huge, huge, -huge),
        (huge, 2.0, -huge),
        (3.0, 5.0, 0.25),
    ] {
        let mut sums = [before; TILE];
        add_products(&mut sums, x, &[w; TILE]);
        assert_eq!(sums, [flushed(x.mul_add(w, before)); TILE], "{x} {w} {before}");
    }
}

/// A row has the bits that it has alone, whatever tiles its product is dealt to.
#[test]
fn software_tiles_give_a_row_the_same_bits_in_any_product() {
    let steps = 3;
    let x = pairs(1, MAX_ROWS * TILE * steps);
    let cases = [Operation::Bf16, Operation::Int8]
        .into_iter()
        .flat_map(|operation| layouts(operation, 1).map(move |layout| (operation, layout)));
    for (operation, layout) in cases {
        let width = layout.0 * TILE;
        let w = pairs(2, width * TILE * steps);
        let of = |rows: std::ops::Range<usize>| {
            let mut sums = vec![0; rows.len() * width];
            let x = &x[rows.start * TILE * steps..rows.end * TILE * steps];
            let whole = product(operation, layout, x, &w, &mut sums);
            // The last step apart.
            let most = Product {
                steps: steps - 1,
                ..whole
            };
            let last = Product {
                x: whole.x.wrapping_add((steps - 1) * TILE),
                w: whole.w.wrapping_add((steps - 1) * whole.w_step),
                steps: 1,
                add: true,
                ..whole
            };
            multiply(Software, &[most, last]);
            sums
        };
        let alone: Vec<u32> = (0..MAX_ROWS).flat_map(|row| of(row..row + 1)).collect();
        for rows in [0..16, 3..10, 0..32, 0..17, 3..20, 5..30, 16..32, 31..32] {
            if layouts(operation, rows.len()).any(|of_rows| of_rows == layout) {
                let expected = &alone[rows.start * width..rows.end * width];
                assert_eq!(of(rows.clone()), expected, "{operation:?}, {layout:?}, {rows:?}");
            }
        }
    }
}

#[test]
fn software_tiles_refuse_sizes_that_do_not_fit() {
    let broken: [fn(&mut Config); 5] = [
        |config| config.rows[0] = 3,
        |config| config.row_bytes[X] = 32,
        |config| config.rows[W] = 8,
        |config| config.row_bytes[0] = 32,
        |config| config.rows[2] = 17,
    ];
    for change in broken {
        let mut config = Config::of_rows(5);
        change(&mut config);
        let refused = catch_unwind(|| {
            let mut registers = Registers::new();
            registers.configure(&config);
            (0..3).for_each(|sums| registers.multiply(Operation::Bf16, sums));
        });
        assert!(refused.is_err(), "{config:?}");
    }
    assert!(catch_unwind(|| Config::of_rows(17)).is_err());
    let mut palette = Config::of_rows(5);
    palette.palette = 2;
    assert!(catch_unwind(|| Registers::new().configure(&palette)).is_err());
}

/// Compares what both units make of a product with these operands.
#[cfg(all(target_arch = "x86_64", not(saccade_portable)))]
fn assert_equal(operation: Operation, rows: usize, steps: usize, x: &[u32], w: &[u32], before: &[u32]) {
    let amx = amx::Amx::new().expect("looked at before");
    let of = |columns: usize, apart: bool, add: bool| {
        let [mut hard, mut soft] = [before.to_vec(), before.to_vec()];
        let with = |sums| {
            let product = Product {
                columns,
                add,
                sums_stride: MAX_COLUMN_TILES * TILE,
                ..product(operation, (3, false), x, w, sums)
            };
            if !apart {
                return product;
            }
            Product {
                w_stride: TILE,
                w_step: TILE * TILE,
                // Columns overlap, so that all of them fit.
                w_column: (w.len() - steps * TILE * TILE) / (MAX_COLUMN_TILES - 1),
                ..product
            }
        };
        multiply(amx, &[with(&mut hard)]);
        multiply(Software, &[with(&mut soft)]);
        let is_nan = |bits: u32| operation == Operation::Bf16 && f32::from_bits(bits).is_nan();
        for (index, (&hard, &soft)) in hard.iter().zip(&soft).enumerate() {
            let same = hard == soft || (is_nan(hard) && is_nan(soft));
            let what =
                format!("{operation:?}, {rows} rows, {steps} steps, {columns} columns, number {index}");
            assert!(same, "{what}: {hard:#x} in hardware, {soft:#x} in software");
        }
    };
    for add in [false, true] {
        layouts(operation, rows).for_each(|(columns, apart)| of(columns, apart, add));
    }
}

#[cfg(all(target_arch = "x86_64", not(saccade_portable)))]
#[test]
fn hardware_and_software_tiles_agree_bit_for_bit() {
    use std::io::Write;

    if let Err(refusal) = crate::cpu::tiles::permission() {
        // Past the test runner, which keeps back what a test prints.
        let _ = writeln!(
            std::io::stderr(),
            "SKIPPED: the tiles of AMX are not compared with software: {refusal}"
        );
        return;
    }
    for rows in 1..=MAX_ROWS {
        let steps = 1 + rows % 4;
        let (x_size, w_size, sums) = (
            rows * TILE * steps,
            3 * TILE * TILE * steps,
            rows * MAX_COLUMN_TILES * TILE,
        );
        for seed in 0..8 {
            let (x, w, before) = (
                words(seed, x_size),
                words(seed + 50, w_size),
                words(seed + 90, sums),
            );
            assert_equal(Operation::Int8, rows, steps, &x, &w, &before);
            // Any bits; exponents far apart; denormals.
            assert_equal(Operation::Bf16, rows, steps, &x, &w, &before);
            for (keep, set) in [(0x83ff_83ff, 0x3000_3000), (0x81ff_81ff, 0)] {
                let masked = |words: &[u32]| words.iter().map(|word| word & keep | set).collect::<Vec<_>>();
                assert_equal(
                    Operation::Bf16,
                    rows,
                    steps,
                    &masked(&x),
                    &masked(&w),
                    &masked(&before),
                );
            }
            let numbers = [pairs(seed, x_size), pairs(seed + 50, w_size)];
            let before: Vec<_> = before
                .iter()
                .map(|word| (*word as f32 * 1e-9).to_bits())
                .collect();
            assert_equal(Operation::Bf16, rows, steps, &numbers[0], &numbers[1], &before);
        }
    }
}

#[cfg(all(target_arch = "x86_64", not(saccade_portable)))]
#[test]
fn peaks_of_tiles_are_counted() {
    if let Some(amx) = amx::Amx::new() {
        let [bf16, int8] =
            [Operation::Bf16, Operation::Int8].map(|operation| amx.multiply_for_peak(operation));
        assert_eq!(int8, 2 * bf16);
    }
}
