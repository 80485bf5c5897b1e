//! The packed linear layer: `out = epilogue(x W^T + bias)` with weights packed once.
//!
//! Weights lie in panels of [`panel_columns`] output columns, `k`-major, so that one step over `k` reads a few whole vectors; activations are
//! read where they lie, one broadcast for each row and step. A tile of rows by panel columns stays in registers while a part
//! of the summed dimension is walked from front to back; parts are cut at fixed places and added in order. So an output's bits depend on its row, its weights and the instruction set only: never on how many
//! rows there are, nor on how the work is split.

mod pack;
mod product;
mod rows;
mod tile;

use std::ops::Range;

use half::bf16;

use crate::aligned::{AlignedBuffer, AllocError};
use crate::isa::Isa;
use crate::pool::{Interrupted, parallel_for};
use crate::rows::{Matrix, Rows, RowsMut};
use crate::simd::{dispatch, dispatch_dots};
use pack::pack_panels;
pub use pack::quantize_rows;
use product::{Bf16Pairs, F32, Int8Quads, WidenedBf16};
pub use rows::LinearScratch;
use tile::{Block, Job, Panel, PanelRun, ROW_BLOCK, Tiles, shape};

/// Weights to pack, `(out_features, in_features)`, of any strides.
#[derive(Clone, Copy, Debug)]
pub enum WeightRef<'a> {
    /// float32.
    F32(Matrix<'a, f32>),
    /// bfloat16.
    Bf16(Matrix<'a, bf16>),
    /// int8 as [`quantize_rows`] makes it: an element stands for itself times its row's scale.
    Int8 {
        /// -127 to 127.
        values: Matrix<'a, i8>,
        /// One for each row.
        scales: &'a [f32],
    },
}

impl WeightRef<'_> {
    /// `(out_features, in_features)`.
    #[must_use]
    pub fn shape(&self) -> (usize, usize) {
        match self {
            Self::F32(view) => (view.num_rows(), view.num_columns()),
            Self::Bf16(view) => (view.num_rows(), view.num_columns()),
            Self::Int8 { values, .. } => (values.num_rows(), values.num_columns()),
        }
    }

    /// The rows in `rows`.
    fn rows(&self, rows: Range<usize>) -> Self {
        match self {
            Self::F32(view) => Self::F32(view.rows(rows)),
            Self::Bf16(view) => Self::Bf16(view.rows(rows)),
            Self::Int8 { values, scales } => Self::Int8 {
                values: values.rows(rows.clone()),
                scales: &scales[rows],
            },
        }
    }
}

/// How a [`PackedLinear`] multiplies.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Arithmetic {
    /// float32 throughout. Weights that are bf16 stay so in memory, and are widened in registers.
    Float32,
    /// Weights and activations rounded to bf16, products and sums in float32.
    Bfloat16,
    /// Weights quantised to int8, one scale for each output; activations to 8 bits (7 where the CPU has no int8 dot product), one scale for
    /// each row; sums in int32.
    Int8,
}

/// How weights are stored in a [`PackedLinear`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Element {
    /// float32.
    F32,
    /// bfloat16.
    Bf16,
    /// int8 with a float32 scale for each output.
    Int8,
}

/// What is done with `x W^T + bias` while it is in registers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Epilogue {
    /// Stored as it is.
    Store,
    /// `0.5 x (1 + tanh(sqrt(2 / pi) (x + 0.044715 x^3)))`.
    GeluTanh,
    /// `max(x, 0)`.
    Relu,
    /// `x / (1 + exp(-x))`.
    Silu,
    /// Added to what `out` holds: the residual stream.
    Add,
}

/// Why a layer was not packed.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum KernelError {
    /// There is nothing to pack.
    #[error("a packed linear layer needs at least one part")]
    NoParts,
    /// Parts differ in their inputs.
    #[error("parts of one linear layer must have equal in_features: {expected} and {given}")]
    InFeatures {
        /// Of the first part.
        expected: usize,
        /// Of another.
        given: usize,
    },
    /// A bias does not have one element for each output.
    #[error("a bias of {given} elements does not fit {expected} out_features")]
    Bias {
        /// Outputs of the part.
        expected: usize,
        /// Elements of its bias.
        given: usize,
    },
    /// int8 weights do not have one scale for each output.
    #[error("int8 weights of {expected} out_features need as many scales, got {given}")]
    Scales {
        /// Outputs of the part.
        expected: usize,
        /// Its scales.
        given: usize,
    },
    /// A sum of so many products could overflow.
    #[error("int8 arithmetic takes at most {MAX_INT8_INPUTS} in_features, got {given}")]
    TooManyInputs {
        /// Of the parts.
        given: usize,
    },
    /// There is not enough memory.
    #[error(transparent)]
    Alloc(#[from] AllocError),
    /// Packing was interrupted; see [`interruptible`](crate::interruptible).
    #[error(transparent)]
    Interrupted(#[from] Interrupted),
}

/// 255 * 127 times this is less than 2^31.
const MAX_INT8_INPUTS: usize = 1 << 16;

/// A linear layer whose weights were packed for one instruction set.
///
/// ```
/// use saccade_kernels::{Arithmetic, Epilogue, Isa, LinearScratch, Matrix, PackedLinear, Rows, RowsMut, WeightRef};
///
/// let weight = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]; // (out_features 3, in_features 2)
/// let weight = WeightRef::F32(Matrix::new(&weight, 2));
/// let parts = [(weight, Some(&[0.0, 0.0, 10.0][..]))];
/// let layer = PackedLinear::pack(Isa::best(), Arithmetic::Float32, 1, &parts).unwrap();
///
/// let mut out = [0.0; 3];
/// let x = Rows::new(&[1.0, 1.0], 2);
/// layer.apply(1, x, Epilogue::Store, RowsMut::new(&mut out, 3), &mut LinearScratch::new()).unwrap();
/// assert_eq!(out, [3.0, 7.0, 21.0]);
/// ```
pub struct PackedLinear {
    isa: Isa,
    arithmetic: Arithmetic,
    element: Element,
    in_features: usize,
    out_features: usize,
    /// `[panel][k / step][column]`, words of `step` consecutive `k`, the first one lowest: one float32, two bf16 (what native products read,
    /// and the cheapest to widen) or four int8. The last word is padded with zeros.
    panels: AlignedBuffer<u32>,
    /// One for each column of the panels, zero in the padding.
    bias: AlignedBuffer<f32>,
    /// The columns' scales and the sums of their weights, for int8; otherwise empty.
    scales: AlignedBuffer<f32>,
    sums: AlignedBuffer<i32>,
}

/// Below this many multiply-accumulates a second thread costs more than it saves: waking one takes about 5 us, in which a core does
/// about 250 k of them.
const MACS_FOR_THREADS: usize = 1 << 19;

/// Tasks that each thread should have, if they are not smaller than that: one that begins its last task late keeps the others waiting for a
/// quarter of the work at most.
const TASKS_PER_THREAD: usize = 4;

impl PackedLinear {
    /// Packs `parts`, stacked along `out_features`, on `threads` threads; a missing bias is zero.
    ///
    /// For [`Arithmetic::Float32`] stored as bf16 only if every part is bf16; otherwise widened to f32, which is exact but for int8.
    ///
    /// # Errors
    /// [`KernelError`] if there is no part, the parts do not fit together, there are more than 65536 `in_features` for int8, there is not
    /// enough memory, or packing was interrupted.
    ///
    /// # Panics
    /// If this CPU lacks `isa`.
    pub fn pack(
        isa: Isa,
        arithmetic: Arithmetic,
        threads: usize,
        parts: &[(WeightRef<'_>, Option<&[f32]>)],
    ) -> Result<Self, KernelError> {
        assert!(isa.is_available(), "this CPU lacks {isa}");
        let in_features = parts.first().ok_or(KernelError::NoParts)?.0.shape().1;
        let mut out_features = 0;
        for (weight, bias) in parts {
            let (outputs, inputs) = weight.shape();
            if inputs != in_features {
                return Err(KernelError::InFeatures {
                    expected: in_features,
                    given: inputs,
                });
            }
            if let Some(bias) = bias
                && bias.len() != outputs
            {
                return Err(KernelError::Bias {
                    expected: outputs,
                    given: bias.len(),
                });
            }
            if let WeightRef::Int8 { scales, .. } = weight
                && scales.len() != outputs
            {
                return Err(KernelError::Scales {
                    expected: outputs,
                    given: scales.len(),
                });
            }
            out_features += outputs;
        }
        if arithmetic == Arithmetic::Int8 && in_features > MAX_INT8_INPUTS {
            return Err(KernelError::TooManyInputs { given: in_features });
        }
        let (columns, _) = shape(isa, false);
        let num_panels = out_features.div_ceil(columns);
        let mut bias = AlignedBuffer::zeroed(num_panels * columns)?;
        let mut column = 0;
        for (weight, part) in parts {
            if let Some(part) = part {
                bias[column..column + part.len()].copy_from_slice(part);
            }
            column += weight.shape().0;
        }
        let element = match arithmetic {
            Arithmetic::Float32
                if parts
                    .iter()
                    .all(|(weight, _)| matches!(weight, WeightRef::Bf16(_))) =>
            {
                Element::Bf16
            }
            Arithmetic::Float32 => Element::F32,
            Arithmetic::Bfloat16 => Element::Bf16,
            Arithmetic::Int8 => Element::Int8,
        };
        let (panels, scales, sums) = pack_panels(threads, element, columns, parts)?;
        Ok(Self {
            isa,
            arithmetic,
            element,
            in_features,
            out_features,
            panels,
            bias,
            scales,
            sums,
        })
    }

    /// Width of the input rows.
    #[must_use]
    pub fn in_features(&self) -> usize {
        self.in_features
    }

    /// Width of the output rows.
    #[must_use]
    pub fn out_features(&self) -> usize {
        self.out_features
    }

    /// How the weights are stored.
    #[must_use]
    pub fn element(&self) -> Element {
        self.element
    }

    /// How it multiplies.
    #[must_use]
    pub fn arithmetic(&self) -> Arithmetic {
        self.arithmetic
    }

    /// The instruction set that it was packed for.
    #[must_use]
    pub fn isa(&self) -> Isa {
        self.isa
    }

    /// Bytes held.
    #[must_use]
    pub fn nbytes(&self) -> usize {
        4 * (self.panels.len() + self.bias.len() + self.scales.len() + self.sums.len())
    }

    /// `out = epilogue(x W^T + bias)` for rows `x (rows, in_features)` and `out (rows, out_features)`, both row-major with any row stride.
    ///
    /// For [`Arithmetic::Bfloat16`] and [`Arithmetic::Int8`] the rows are converted first, into `scratch`. A row with NaN or infinity gives NaN
    /// for int8.
    ///
    /// # Errors
    /// [`AllocError`] if `scratch` has to grow and there is not enough memory.
    ///
    /// # Panics
    /// If a shape does not fit.
    pub fn apply(
        &self,
        threads: usize,
        x: Rows<'_>,
        epilogue: Epilogue,
        mut out: RowsMut<'_>,
        scratch: &mut LinearScratch,
    ) -> Result<(), AllocError> {
        let rows = x.num_rows();
        assert_eq!(
            x.num_columns(),
            self.in_features,
            "x: expected in_features columns"
        );
        assert_eq!(
            (out.num_rows(), out.num_columns()),
            (rows, self.out_features),
            "out: expected (rows, out_features)"
        );
        if rows == 0 || self.out_features == 0 {
            return Ok(());
        }
        let macs = rows * self.in_features * self.out_features;
        let threads = if macs < MACS_FOR_THREADS { 1 } else { threads };
        let (columns, tile_rows) = shape(self.isa, self.element == Element::Bf16 && !self.has_bf16_dot());
        let num_panels = self.out_features.div_ceil(columns);
        let tiles = Tiles {
            rows,
            count: rows.div_ceil(tile_rows),
        };
        // More blocks than the rows need where panels are few, so that no thread waits long for the last task of another.
        let wanted = (TASKS_PER_THREAD * threads)
            .div_ceil(num_panels)
            .min(macs / (num_panels * MACS_FOR_THREADS));
        let most = tiles.count.min(if threads == 1 { 1 } else { wanted.max(1) });
        let blocks = rows.div_ceil(ROW_BLOCK).max(most);
        let out_stride = out.row_stride() as isize;
        let mut job = Job {
            x: x.as_ptr().cast(),
            x_stride: x.row_stride() as isize,
            tiles,
            in_features: self.in_features,
            quantized: &[],
            out: out.as_mut_ptr(),
            out_stride,
            epilogue,
        };
        if self.arithmetic != Arithmetic::Float32 {
            let converted = scratch.convert(self.isa, self.arithmetic, threads, x)?;
            (job.x, job.x_stride) = (converted.words, converted.stride as isize);
            job.quantized = converted.quantized;
        }
        // Row blocks outside, panels inside: threads then share a block of activations and walk the weights side by side.
        parallel_for(threads, blocks * num_panels, &|task| {
            let (block, panel) = (task / num_panels, task % num_panels);
            let block = Block {
                first: tiles.count * block / blocks,
                end: tiles.count * (block + 1) / blocks,
            };
            self.run_panel(&job, block, columns, panel, threads);
        });
        Ok(())
    }

    /// Whether its products are those of an instruction for bf16.
    fn has_bf16_dot(&self) -> bool {
        self.arithmetic == Arithmetic::Bfloat16 && self.isa.has_bf16_dot()
    }

    /// Runs a block of rows through panel number `panel`; this thread will probably take the one `ahead` of it next.
    fn run_panel(&self, job: &Job<'_>, block: Block, columns: usize, panel: usize, ahead: usize) {
        let size = self.in_features.div_ceil(self.element.per_word()) * columns;
        let first = panel * columns;
        let panel = Panel {
            weights: &self.panels[panel * size..][..size],
            bias: &self.bias[first..first + columns],
            scales: self.scales.get(first..first + columns).unwrap_or_default(),
            sums: self.sums.get(first..first + columns).unwrap_or_default(),
            first,
            width: columns.min(self.out_features - first),
            ahead,
        };
        match self.element {
            Element::F32 => dispatch(self.isa, PanelRun::<F32>::new(job, block, panel)),
            Element::Bf16 if self.has_bf16_dot() => {
                dispatch_dots(self.isa, PanelRun::<Bf16Pairs>::new(job, block, panel));
            }
            Element::Bf16 => dispatch(self.isa, PanelRun::<WidenedBf16>::new(job, block, panel)),
            Element::Int8 => dispatch_dots(self.isa, PanelRun::<Int8Quads>::new(job, block, panel)),
        }
    }
}

impl Element {
    /// Elements in four bytes.
    fn per_word(self) -> usize {
        match self {
            Self::F32 => 1,
            Self::Bf16 => 2,
            Self::Int8 => 4,
        }
    }
}
