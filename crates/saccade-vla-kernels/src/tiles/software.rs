//! Tiles in software: what AMX does, bit for bit, with its rules about sizes. A rule that is broken here would be SIGILL there.

use std::hint::black_box;

use super::{Config, Job, Operation, Shape, TILE, TileUnit, W, X};
use crate::simd::Simd;
use crate::simd::portable::Loops;

/// The unit in software.
#[derive(Clone, Copy)]
pub(crate) struct Software;

/// Sizes and contents of eight tiles.
pub(crate) struct Registers {
    config: Option<Config>,
    tiles: [Tile; 8],
}

type Tile = [[u32; TILE]; TILE];

impl Registers {
    /// Rows of a tile, and words of each.
    fn size(&self, tile: usize) -> (usize, usize) {
        let config = self.config.as_ref().expect("tiles have sizes");
        let (rows, bytes) = (
            usize::from(config.rows[tile]),
            usize::from(config.row_bytes[tile]),
        );
        assert!(
            (1..=TILE).contains(&rows) && (4..=4 * TILE).contains(&bytes) && bytes.is_multiple_of(4),
            "tile {tile}: {rows} rows of {bytes} bytes"
        );
        (rows, bytes / 4)
    }

    fn zero(&mut self, tile: usize) {
        self.size(tile);
        self.tiles[tile] = [[0; TILE]; TILE];
    }

    /// TILELOADD: what is beyond the size becomes zero.
    ///
    /// # Safety
    /// The tile's rows are at `from`, `stride` bytes apart.
    unsafe fn load(&mut self, tile: usize, from: *const u32, stride: usize) {
        let (rows, words) = self.size(tile);
        self.zero(tile);
        for (row, to) in self.tiles[tile].iter_mut().enumerate().take(rows) {
            for (word, to) in to.iter_mut().enumerate().take(words) {
                // SAFETY: the caller's promise.
                *to = unsafe { from.byte_add(row * stride).add(word).read() };
            }
        }
    }

    /// TILESTORED.
    ///
    /// # Safety
    /// There is room for the tile's rows at `to`, `stride` bytes apart.
    unsafe fn store(&self, tile: usize, to: *mut u32, stride: usize) {
        let (rows, words) = self.size(tile);
        for (row, from) in self.tiles[tile].iter().enumerate().take(rows) {
            for (word, from) in from.iter().enumerate().take(words) {
                // SAFETY: the caller's promise.
                unsafe { to.byte_add(row * stride).add(word).write(*from) };
            }
        }
    }

    /// TDPBF16PS or TDPBUSD: `sums += X W`.
    fn multiply(&mut self, operation: Operation, sums: usize) {
        let [(rows, words), (x_rows, x_words), (w_rows, w_words)] = [sums, X, W].map(|tile| self.size(tile));
        assert!(
            rows == x_rows && x_words == w_rows && words == w_words && sums != X && sums != W,
            "sizes that do not fit: {rows} x {words}, {x_rows} x {x_words}, {w_rows} x {w_words}"
        );
        let (x, w) = (self.tiles[X], self.tiles[W]);
        for (sums, x) in self.tiles[sums].iter_mut().zip(&x).take(rows) {
            let of_row = match operation {
                Operation::Bf16 => bf16_row,
                Operation::Int8 => int8_row,
            };
            of_row(sums, &x[..x_words], &w);
        }
    }
}

/// Denormals count as zero and become zero.
fn flushed(x: f32) -> f32 {
    if x.abs() < f32::MIN_POSITIVE { x * 0.0 } else { x }
}

fn low_half(word: u32) -> f32 {
    flushed(f32::from_bits(word << 16))
}

fn high_half(word: u32) -> f32 {
    flushed(f32::from_bits(word & 0xffff_0000))
}

/// A row of TDPBF16PS: the first and the second elements of the pairs are summed apart, each from zero; then both sums together, and then
/// with what was there. So measured on a Sapphire Rapids, on two million sums of normal numbers, wide exponents, denormals and any bits.
fn bf16_row(sums: &mut [u32; TILE], x: &[u32], w: &Tile) {
    let (mut first, mut second) = ([0.0; TILE], [0.0; TILE]);
    for (x, w) in x.iter().zip(w) {
        add_products(&mut first, low_half(*x), &w.map(low_half));
        add_products(&mut second, high_half(*x), &w.map(high_half));
    }
    for ((sum, first), second) in sums.iter_mut().zip(first).zip(second) {
        let before = flushed(f32::from_bits(*sum));
        *sum = flushed(before + flushed(first + second)).to_bits();
    }
}

/// `sums += x w`, rounded once.
fn add_products(sums: &mut [f32; TILE], x: f32, w: &[f32; TILE]) {
    // A product of two bfloat16 has 16 digits: in float32 it is exact, unless it is too small or too large. Then the sum is rounded once, as
    // by a fused multiply-add, which many CPUs' baseline lacks.
    let products = w.map(|w| x * w);
    let is_exact = |(product, w): (&f32, &f32)| {
        (product.abs() >= f32::MIN_POSITIVE && product.is_finite()) || x == 0.0 || *w == 0.0
    };
    let are_exact = products.iter().zip(w).fold(true, |all, of| all & is_exact(of));
    for ((sum, product), w) in sums.iter_mut().zip(products).zip(w) {
        *sum = flushed(if are_exact {
            product + *sum
        } else {
            x.mul_add(*w, *sum)
        });
    }
}

/// A row of TDPBUSD.
fn int8_row(sums: &mut [u32; TILE], x: &[u32], w: &Tile) {
    for (x, w) in x.iter().zip(w) {
        for shift in [0, 8, 16, 24] {
            let x = (x >> shift) & 0xff;
            for (sum, w) in sums.iter_mut().zip(w) {
                let w = (*w << (24 - shift)).cast_signed() >> 24;
                *sum = sum.wrapping_add(x.wrapping_mul(w.cast_unsigned()));
            }
        }
    }
}

// SAFETY: plain arithmetic on what the contracts name.
unsafe impl TileUnit for Software {
    type Simd = Loops<TILE>;
    type Registers = Registers;

    fn new() -> Option<Self> {
        Some(Self)
    }

    fn simd(self) -> Loops<TILE> {
        Loops::new().expect("loops run everywhere")
    }

    fn registers(self) -> Registers {
        Registers {
            config: None,
            tiles: [[[0; TILE]; TILE]; 8],
        }
    }

    unsafe fn configure(self, registers: &mut Registers, config: &Config) {
        assert!(
            config.palette == 1 && config.start_row == 0 && config.reserved == [0; 14],
            "expected palette 1 from its first row on: {config:?}"
        );
        assert!(
            config.rows[8..] == [0; 8] && config.row_bytes[8..] == [0; 8],
            "palette 1 has eight tiles"
        );
        registers.config = Some(*config);
        (0..8).for_each(|tile| registers.zero(tile));
    }

    unsafe fn release(self, registers: &mut Registers) {
        registers.config = None;
    }

    unsafe fn run(self, registers: &mut Registers, operation: Operation, shape: Shape, job: &Job) {
        let (row_tiles, columns) = match shape {
            Shape::Row(columns) => (1, columns),
            Shape::TwoRows(columns) => (2, columns),
            Shape::Block => (2, 3),
        };
        let sums =
            |row: usize, column: usize| (columns * row + column, job.sums[row].wrapping_add(column * TILE));
        let all = (0..row_tiles).flat_map(|row| (0..columns).map(move |column| (row, column)));
        // SAFETY: the caller's promise.
        unsafe {
            for (row, column) in all.clone() {
                let (tile, at) = sums(row, column);
                if job.add == 0 {
                    registers.zero(tile);
                } else {
                    registers.load(tile, at, job.sums_stride);
                }
            }
            for step in 0..job.steps {
                for (row, column) in all.clone() {
                    registers.load(X, job.x[row].add(step * TILE), job.x_stride);
                    let w = job.w.byte_add(step * job.w_step + column * job.w_column);
                    registers.load(W, w, job.w_stride);
                    registers.multiply(operation, sums(row, column).0);
                }
            }
            for (row, column) in all {
                let (tile, at) = sums(row, column);
                registers.store(tile, at, job.sums_stride);
            }
        }
    }

    fn chains(self, operation: Operation) -> usize {
        const PRODUCTS: usize = 256;
        let mut registers = self.registers();
        // SAFETY: no memory is involved.
        unsafe { self.configure(&mut registers, &Config::of_rows(TILE)) };
        for product in 0..PRODUCTS {
            registers.multiply(operation, product % X);
        }
        black_box(&registers.tiles);
        PRODUCTS * TILE * TILE * TILE * operation.per_word()
    }
}

#[cfg(test)]
pub(super) mod tests {
    use half::bf16;

    use super::super::{Ahead, MAX_COLUMN_TILES, MAX_ROWS, Product, Session};
    use super::*;

    pub(in super::super) fn words(seed: u32, count: usize) -> Vec<u32> {
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
    pub(in super::super) fn pairs(seed: u32, count: usize) -> Vec<u32> {
        let number = |word: u32| u32::from(bf16::from_f32((word & 0xffff) as f32 / 16384.0 - 2.0).to_bits());
        let words = words(seed, count);
        words
            .iter()
            .map(|&word| number(word) | number(word >> 16) << 16)
            .collect()
    }

    fn elements(word: u32) -> [f64; 2] {
        [word & 0xffff, word >> 16].map(|bits| bf16::from_bits(bits as u16).to_f64())
    }

    /// How many tiles of columns a product of so many rows may have, and whether they are apart in `w`.
    pub(in super::super) fn layouts(
        operation: Operation,
        rows: usize,
    ) -> impl Iterator<Item = (usize, bool)> {
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

    /// By three tiles next to each other.
    pub(in super::super) fn product(operation: Operation, x: &[u32], w: &[u32], sums: &mut [u32]) -> Product {
        product_in(operation, (3, false), x, w, sums)
    }

    /// By as many tiles, next to each other or one after the other.
    fn product_in(
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

    #[test]
    fn software_tiles_agree_with_float64() {
        let cases =
            (1..=MAX_ROWS).flat_map(|rows| layouts(Operation::Bf16, rows).map(move |layout| (rows, layout)));
        for (rows, layout) in cases {
            let (columns, steps) = (layout.0, 1 + rows % 3);
            let (x, w) = (
                pairs(rows as u32, rows * TILE * steps),
                pairs(77, columns * TILE * TILE * steps),
            );
            let mut sums = vec![7; rows * columns * TILE];
            let product = product_in(Operation::Bf16, layout, &x, &w, &mut sums);
            // SAFETY: the operands have these sizes.
            unsafe { Session::new(Software).multiply(&product) };
            for row in 0..rows {
                for column in 0..columns * TILE {
                    let products = (0..TILE * steps).flat_map(|k| {
                        let at = k / TILE * product.w_step
                            + k % TILE * product.w_stride
                            + column / TILE * product.w_column
                            + column % TILE;
                        let (x, w) = (elements(x[row * TILE * steps + k]), elements(w[at]));
                        [x[0] * w[0], x[1] * w[1]]
                    });
                    let (exact, size) = products.fold((0.0, 0.0), |(sum, size), product: f64| {
                        (sum + product, size + product.abs())
                    });
                    let given = f64::from(f32::from_bits(sums[row * columns * TILE + column]));
                    assert!(
                        (given - exact).abs() <= size * 1e-5,
                        "{layout:?}, ({row}, {column}): {given}, {exact}"
                    );
                }
            }
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

    #[test]
    fn software_tiles_of_int8_are_exact() {
        let (rows, steps) = (29, 2);
        let (x, w) = (words(3, rows * TILE * steps), words(4, 3 * TILE * TILE * steps));
        let mut sums = words(5, rows * 3 * TILE);
        let before = sums.clone();
        let product = Product {
            add: true,
            ..product(Operation::Int8, &x, &w, &mut sums)
        };
        // SAFETY: the operands have these sizes.
        unsafe { Session::new(Software).multiply(&product) };
        for row in 0..rows {
            for column in 0..3 * TILE {
                let at = row * 3 * TILE + column;
                let mut exact = i64::from(before[at].cast_signed());
                for k in 0..TILE * steps {
                    let (x, w) = (
                        x[row * TILE * steps + k].to_le_bytes(),
                        w[k * 3 * TILE + column].to_le_bytes(),
                    );
                    for (x, w) in x.into_iter().zip(w) {
                        exact += i64::from(x) * i64::from(w.cast_signed());
                    }
                }
                // As the hardware, which lets sums wrap.
                assert_eq!(sums[at].cast_signed(), exact as i32, "({row}, {column})");
            }
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
                let whole = product_in(operation, layout, x, &w, &mut sums);
                // SAFETY: the operands have these sizes.
                unsafe {
                    let mut session = Session::new(Software);
                    // The last step apart.
                    session.multiply(&Product {
                        steps: steps - 1,
                        ..whole
                    });
                    session.multiply(&Product {
                        x: whole.x.add((steps - 1) * TILE),
                        w: whole.w.add((steps - 1) * whole.w_step),
                        steps: 1,
                        add: true,
                        ..whole
                    });
                }
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
            let refused = std::panic::catch_unwind(|| {
                let mut registers = Software.registers();
                // SAFETY: no memory is involved.
                unsafe { Software.configure(&mut registers, &config) };
                (0..3).for_each(|sums| registers.multiply(Operation::Bf16, sums));
            });
            assert!(refused.is_err(), "{config:?}");
        }
        assert!(std::panic::catch_unwind(|| Config::of_rows(17)).is_err());
        let mut palette = Config::of_rows(5);
        palette.palette = 2;
        // SAFETY: no memory is involved.
        let configure = || unsafe { Software.configure(&mut Software.registers(), &palette) };
        assert!(std::panic::catch_unwind(configure).is_err());
    }
}
