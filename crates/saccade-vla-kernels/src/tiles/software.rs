//! Tiles in software: what AMX does, bit for bit, with its rules about sizes. A rule that is broken here
//! would be SIGILL there.

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
    /// Without sizes.
    pub(super) fn new() -> Self {
        Self {
            config: None,
            tiles: [[[0; TILE]; TILE]; 8],
        }
    }

    /// LDTILECFG.
    pub(super) fn configure(&mut self, config: &Config) {
        assert!(
            config.palette == 1 && config.start_row == 0 && config.reserved == [0; 14],
            "expected palette 1 from its first row on: {config:?}"
        );
        assert!(
            config.rows[8..] == [0; 8] && config.row_bytes[8..] == [0; 8],
            "palette 1 has eight tiles"
        );
        self.config = Some(*config);
        (0..8).for_each(|tile| self.zero(tile));
    }

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
                // SAFETY: the contract of this function.
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
                // SAFETY: the contract of this function.
                unsafe { to.byte_add(row * stride).add(word).write(*from) };
            }
        }
    }

    /// TDPBF16PS or TDPBUSD: `sums += X W`.
    pub(super) fn multiply(&mut self, operation: Operation, sums: usize) {
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
pub(super) fn flushed(x: f32) -> f32 {
    if x.abs() < f32::MIN_POSITIVE { x * 0.0 } else { x }
}

fn low_half(word: u32) -> f32 {
    flushed(f32::from_bits(word << 16))
}

fn high_half(word: u32) -> f32 {
    flushed(f32::from_bits(word & 0xffff_0000))
}

/// A row of TDPBF16PS: the first and the second elements of the pairs are summed apart, each from zero; then
/// both sums together, and then with what was there. So measured on a Sapphire Rapids, on two million sums of
/// normal numbers, wide exponents, denormals and any bits.
pub(super) fn bf16_row(sums: &mut [u32; TILE], x: &[u32], w: &Tile) {
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
pub(super) fn add_products(sums: &mut [f32; TILE], x: f32, w: &[f32; TILE]) {
    // A product of two bfloat16 has 16 digits: in float32 it is exact, unless it is too small or too large.
    // Then the sum is rounded once, as by a fused multiply-add, which many CPUs' baseline lacks.
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
    const NAME: &'static str = "software-tiles";

    fn new() -> Option<Self> {
        Some(Self)
    }

    fn simd(self) -> Loops<TILE> {
        Loops::new().expect("loops run everywhere")
    }

    fn registers(self) -> Registers {
        Registers::new()
    }

    unsafe fn configure(self, registers: &mut Registers, config: &Config) {
        registers.configure(config);
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
        // SAFETY: the pointers of the job are valid for the tiles of its shape.
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

    #[cfg(feature = "peak")]
    fn multiply_for_peak(self, operation: Operation) -> usize {
        const PRODUCTS: usize = 256;
        let mut registers = Registers::new();
        registers.configure(&Config::of_rows(TILE));
        for product in 0..PRODUCTS {
            registers.multiply(operation, product % X);
        }
        std::hint::black_box(&registers.tiles);
        PRODUCTS * TILE * TILE * TILE * operation.per_word()
    }
}
