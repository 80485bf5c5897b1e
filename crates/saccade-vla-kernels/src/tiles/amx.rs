//! Tiles of AMX. Stable Rust has no intrinsics for them; `asm!` takes the instructions as they are.
//!
//! No sum is in a tile between two `asm!` blocks: only the sizes outlive a block, and the compiler uses no
//! tiles.

use std::mem::offset_of;

use super::{Config, Job, MAX_COLUMN_TILES, Operation, Shape, TileUnit};
use crate::cpu::tiles::permission;
use crate::simd::Simd;
use crate::simd::x86_64::avx512::Avx512Amx;

/// The unit of this CPU.
#[derive(Clone, Copy)]
pub(crate) struct Amx(Avx512Amx);

/// An `asm!` block that may change every tile.
macro_rules! tiles {
    ($($part:tt)*) => {
        std::arch::asm!(
            $($part)*,
            out("tmm0") _, out("tmm1") _, out("tmm2") _, out("tmm3") _,
            out("tmm4") _, out("tmm5") _, out("tmm6") _, out("tmm7") _,
            options(nostack)
        )
    };
}

/// Prefetches a few cache lines after a product: the CPU's own prefetching follows each of their streams. All
/// at once they would stall it.
macro_rules! prefetch_ahead {
    () => {
        concat!(
            "mov {i}, [{job} + {lines}]\n",
            "test {i}, {i}\n",
            "jz 5f\n",
            "4: prefetcht1 [{p}]\n",
            "add {p}, {pitch}\n",
            "dec {i}\n",
            "jnz 4b\n",
            "5:"
        )
    };
}

/// The tile of sums number `$sum` plus rows (tile 6) times the weights that are `$column` bytes from the
/// first (into tile 7).
macro_rules! product {
    ($operation:literal, $sum:literal, $column:literal) => {
        concat!(
            "tileloadd tmm7, [{w} + {w_stride}*1 + ",
            $column,
            "]\n",
            $operation,
            " tmm",
            $sum,
            ", tmm6, tmm7\n",
            prefetch_ahead!()
        )
    };
}

/// The same for columns that are anywhere: the first, and those that follow each other by the job's stride.
macro_rules! products_apart {
    ($operation:literal, $($sum:literal),+) => {
        concat!(
            "mov {c}, {w}\n",
            $(
                "tileloadd tmm7, [{c} + {w_stride}*1]\n",
                $operation, " tmm", $sum, ", tmm6, tmm7\n",
                "add {c}, [{job} + {w_column}]\n",
                prefetch_ahead!(), "\n"
            ),+
        )
    };
}

/// Tiles of sums to zero, or from memory, and back to it: each `tile, bytes from the first of its rows`. The
/// first row is at `$rows` of the job.
macro_rules! each_sum {
    (zero: $($tile:literal),+) => {
        concat!($("tilezero tmm", $tile, "\n"),+)
    };
    (load $rows:literal: $($tile:literal, $column:literal);+) => {
        concat!(
            "mov {p}, [{job} + {", $rows, "}]\n",
            $("tileloadd tmm", $tile, ", [{p} + {i}*1 + ", $column, "]\n"),+
        )
    };
    (store $rows:literal: $($tile:literal, $column:literal);+) => {
        concat!(
            "mov {p}, [{job} + {", $rows, "}]\n",
            $("tilestored [{p} + {i}*1 + ", $column, "], tmm", $tile, "\n"),+
        )
    };
}

/// Tiles of rows by tiles of columns, as a function of the job: sums from zero or memory, the steps, sums to
/// memory.
macro_rules! kernel {
    ($name:ident, zero $zero:expr, load $load:expr, step [$($step:expr),+], store $store:expr $(, apart: $apart:ident)? $(, two: $second:ident)?) => {
        /// # Safety
        /// AMX is permitted and its tiles have the sizes of the job, whose pointers are valid for them.
        unsafe fn $name(job: &Job) {
            // SAFETY: the contract of this function; prefetching is allowed at any address.
            unsafe {
                tiles!(
                    "cmp qword ptr [{job} + {add}], 0",
                    "jne 2f",
                    $zero,
                    "jmp 3f",
                    "2:",
                    "mov {i}, [{job} + {sums_stride}]",
                    $load,
                    "3:",
                    "mov {p}, {ahead}",
                    $($step,)+
                    "add {x}, 64",
                    "add {w}, [{job} + {w_step}]",
                    "add {ahead}, [{job} + {advance}]",
                    "dec {steps}",
                    "jnz 3b",
                    "mov {i}, [{job} + {sums_stride}]",
                    $store,
                    job = in(reg) job,
                    x = inout(reg) job.x[0] => _,
                    x_stride = in(reg) job.x_stride,
                    w = inout(reg) job.w => _,
                    w_stride = in(reg) job.w_stride,
                    steps = inout(reg) job.steps => _,
                    ahead = inout(reg) job.ahead => _,
                    pitch = in(reg) job.ahead_pitch,
                    p = out(reg) _,
                    i = out(reg) _,
                    add = const offset_of!(Job, add),
                    w_step = const offset_of!(Job, w_step),
                    advance = const offset_of!(Job, ahead_advance),
                    lines = const offset_of!(Job, ahead_lines),
                    sums_stride = const offset_of!(Job, sums_stride),
                    sums = const offset_of!(Job, sums)
                    $(, $apart = const offset_of!(Job, w_column), c = out(reg) _)?
                    $(, $second = inout(reg) job.x[1] => _,
                    second_sums = const offset_of!(Job, sums) + size_of::<*mut u32>())?
                );
            }
        }
    };
}

/// A tile of rows by as many of columns as are listed: each `tile, bytes from the first of its rows in the
/// sums`.
macro_rules! row_kernel {
    ($operation:literal, $name:ident, $($tile:literal, $column:literal);+) => {
        kernel!(
            $name,
            zero each_sum!(zero: $($tile),+),
            load each_sum!(load "sums": $($tile, $column);+),
            step ["tileloadd tmm6, [{x} + {x_stride}*1]", products_apart!($operation, $($tile),+)],
            store each_sum!(store "sums": $($tile, $column);+),
            apart: w_column
        );
    };
}

/// Two tiles of rows (tiles 6 and 5) by a tile of columns, the job's stride after the one before it.
macro_rules! products_of_two {
    ($operation:literal, $first:literal, $second:literal) => {
        concat!(
            "tileloadd tmm7, [{c} + {w_stride}*1]\n",
            $operation,
            " tmm",
            $first,
            ", tmm6, tmm7\n",
            prefetch_ahead!(),
            "\n",
            $operation,
            " tmm",
            $second,
            ", tmm5, tmm7\n",
            prefetch_ahead!(),
            "\n",
            "add {c}, [{job} + {w_column}]"
        )
    };
}

/// Two tiles of rows by as many of columns as are listed: each `tile of the first rows, of the second, bytes
/// in the sums`.
macro_rules! two_rows_kernel {
    ($operation:literal, $name:ident, $($first:literal, $second:literal, $column:literal);+) => {
        kernel!(
            $name,
            zero concat!(each_sum!(zero: $($first),+), each_sum!(zero: $($second),+)),
            load concat!(
                each_sum!(load "sums": $($first, $column);+),
                each_sum!(load "second_sums": $($second, $column);+)
            ),
            step [
                "tileloadd tmm6, [{x} + {x_stride}*1]",
                "tileloadd tmm5, [{second} + {x_stride}*1]",
                "mov {c}, {w}",
                $(products_of_two!($operation, $first, $second),)+
                "add {second}, 64"
            ],
            store concat!(
                each_sum!(store "sums": $($first, $column);+),
                each_sum!(store "second_sums": $($second, $column);+)
            ),
            apart: w_column,
            two: second
        );
    };
}

/// Two tiles of rows by three of columns, next to each other. Six tiles of sums, one of rows and one of
/// weights. The second rows meet the columns in the opposite order, so that tile 7 still holds the last column
/// and is not loaded again: five loads of weights a step, not six.
macro_rules! block_kernel {
    ($operation:literal, $name:ident) => {
        kernel!(
            $name,
            zero each_sum!(zero: "0", "1", "2", "3", "4", "5"),
            load concat!(
                each_sum!(load "sums": "0", "0"; "1", "64"; "2", "128"),
                each_sum!(load "second_sums": "3", "0"; "4", "64"; "5", "128")
            ),
            step [
                "tileloadd tmm6, [{x} + {x_stride}*1]",
                product!($operation, "0", "0"),
                product!($operation, "1", "64"),
                product!($operation, "2", "128"),
                "tileloadd tmm6, [{second} + {x_stride}*1]",
                // Tile 7 still holds the third column.
                concat!($operation, " tmm5, tmm6, tmm7\n", prefetch_ahead!()),
                product!($operation, "4", "64"),
                product!($operation, "3", "0"),
                "add {second}, 64"
            ],
            store concat!(
                each_sum!(store "sums": "0", "0"; "1", "64"; "2", "128"),
                each_sum!(store "second_sums": "3", "0"; "4", "64"; "5", "128")
            ),
            two: second
        );
    };
}

row_kernel!("tdpbf16ps", bf16_row1, "0", "0");
row_kernel!("tdpbf16ps", bf16_row2, "0", "0"; "1", "64");
row_kernel!("tdpbf16ps", bf16_row3, "0", "0"; "1", "64"; "2", "128");
row_kernel!("tdpbf16ps", bf16_row4, "0", "0"; "1", "64"; "2", "128"; "3", "192");
row_kernel!("tdpbf16ps", bf16_row5, "0", "0"; "1", "64"; "2", "128"; "3", "192"; "4", "256");
row_kernel!("tdpbf16ps", bf16_row6, "0", "0"; "1", "64"; "2", "128"; "3", "192"; "4", "256"; "5", "320");
two_rows_kernel!("tdpbf16ps", bf16_two1, "0", "1", "0");
two_rows_kernel!("tdpbf16ps", bf16_two2, "0", "1", "0"; "2", "3", "64");
block_kernel!("tdpbf16ps", bf16_block);
row_kernel!("tdpbusd", int8_row3, "0", "0"; "1", "64"; "2", "128");
block_kernel!("tdpbusd", int8_block);

/// Those of bfloat16 with a tile of rows, by the number of columns.
const BF16_ROWS: [unsafe fn(&Job); MAX_COLUMN_TILES] =
    [bf16_row1, bf16_row2, bf16_row3, bf16_row4, bf16_row5, bf16_row6];

/// Those with two tiles of rows.
const BF16_TWO_ROWS: [unsafe fn(&Job); 2] = [bf16_two1, bf16_two2];

/// Independent products, from tiles that stay what they are: of zeros, whose speed is that of any numbers.
#[cfg(feature = "peak")]
macro_rules! peak_loop {
    ($name:ident, $operation:literal) => {
        /// # Safety
        /// AMX is permitted and its tiles have sizes.
        unsafe fn $name(iterations: usize) {
            // SAFETY: the contract of this function; no memory is involved.
            unsafe {
                tiles!(
                    each_sum!(zero: "0", "1", "2", "3", "4", "5", "6", "7"),
                    "2:",
                    concat!($operation, " tmm0, tmm6, tmm7"),
                    concat!($operation, " tmm1, tmm6, tmm7"),
                    concat!($operation, " tmm2, tmm6, tmm7"),
                    concat!($operation, " tmm3, tmm6, tmm7"),
                    concat!($operation, " tmm4, tmm6, tmm7"),
                    concat!($operation, " tmm5, tmm6, tmm7"),
                    "dec {n}",
                    "jnz 2b",
                    n = inout(reg) iterations => _
                );
            }
        }
    };
}

#[cfg(feature = "peak")]
peak_loop!(bf16_peak, "tdpbf16ps");
#[cfg(feature = "peak")]
peak_loop!(int8_peak, "tdpbusd");

// SAFETY: a value exists only where the vectors do and AMX is permitted; the kernels keep to the job.
unsafe impl TileUnit for Amx {
    type Simd = Avx512Amx;
    type Registers = ();
    const NAME: &'static str = "amx";

    #[inline]
    fn new() -> Option<Self> {
        let simd = Avx512Amx::new()?;
        permission().is_ok().then_some(Self(simd))
    }

    #[inline]
    fn simd(self) -> Avx512Amx {
        self.0
    }

    #[inline]
    fn registers(self) {}

    #[inline]
    unsafe fn configure(self, (): &mut (), config: &Config) {
        // SAFETY: there is a unit, so AMX is permitted; the sizes are those of palette 1.
        unsafe { tiles!("ldtilecfg [{config}]", config = in(reg) config) }
    }

    #[inline]
    unsafe fn release(self, (): &mut ()) {
        // SAFETY: there is a unit, so AMX is permitted.
        unsafe { tiles!("tilerelease") }
    }

    #[inline]
    unsafe fn run(self, (): &mut (), operation: Operation, shape: Shape, job: &Job) {
        let kernel = match (operation, shape) {
            (Operation::Bf16, Shape::Row(columns)) => BF16_ROWS[columns - 1],
            (Operation::Bf16, Shape::TwoRows(columns)) => BF16_TWO_ROWS[columns - 1],
            (Operation::Bf16, Shape::Block) => bf16_block,
            (Operation::Int8, Shape::Row(3)) => int8_row3,
            (Operation::Int8, Shape::Block) => int8_block,
            (Operation::Int8, shape) => unreachable!("a product of int8 in {shape:?}"),
        };
        // SAFETY: the contract of the trait is that of the kernels.
        unsafe { kernel(job) }
    }

    #[cfg(feature = "peak")]
    fn multiply_for_peak(self, operation: Operation) -> usize {
        const ITERATIONS: usize = 1 << 17;
        // SAFETY: there is a unit; the tiles have sizes until they are released.
        unsafe {
            self.configure(&mut (), &Config::of_rows(super::TILE));
            match operation {
                Operation::Bf16 => bf16_peak(ITERATIONS),
                Operation::Int8 => int8_peak(ITERATIONS),
            }
            self.release(&mut ());
        }
        ITERATIONS * 6 * super::TILE.pow(3) * operation.per_word()
    }
}
