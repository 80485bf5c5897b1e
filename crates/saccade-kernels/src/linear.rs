//! The packed linear layer: `out = epilogue(x W^T + bias)` with weights packed once.
//!
//! Weights lie in panels of [`panel_columns`] output columns, `k`-major, so that one step over `k` reads a few whole vectors; activations are
//! read where they lie, one broadcast for each row and step. A tile of rows by panel columns stays in registers while a part
//! of the summed dimension is walked from front to back; parts are cut at fixed places and added in order. So an output's bits depend on its row, its weights and the instruction set only: never on how many
//! rows there are, nor on how the work is split.

mod tile;

use faer::{MatMut, MatRef};
use half::bf16;

use crate::aligned::AlignedBuffer;
use crate::isa::Isa;
use crate::pool::parallel_for;
use crate::simd::dispatch;
use tile::{Job, Panel, PanelRun, Rows, Stored};

/// Weights to pack, `(out_features, in_features)`, of any strides.
#[derive(Clone, Copy, Debug)]
pub enum WeightRef<'a> {
    /// float32.
    F32(MatRef<'a, f32>),
    /// bfloat16.
    Bf16(MatRef<'a, bf16>),
}

impl WeightRef<'_> {
    fn shape(&self) -> (usize, usize) {
        match self {
            Self::F32(view) => (view.nrows(), view.ncols()),
            Self::Bf16(view) => (view.nrows(), view.ncols()),
        }
    }
}

/// How weights are stored in a [`PackedLinear`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[non_exhaustive]
pub enum Element {
    /// float32.
    F32,
    /// bfloat16, widened in registers: the same bits as float32 storage of the same values.
    Bf16,
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

/// Parts that cannot be packed together.
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
}

/// A linear layer whose weights were packed for one instruction set.
///
/// ```
/// use faer::{MatMut, MatRef};
/// use saccade_kernels::{Epilogue, Isa, PackedLinear, WeightRef};
///
/// let weight = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]; // (out_features 3, in_features 2)
/// let weight = WeightRef::F32(MatRef::from_row_major_slice(&weight, 3, 2));
/// let layer = PackedLinear::pack(Isa::best(), &[(weight, Some(&[0.0, 0.0, 10.0]))]).unwrap();
///
/// let x = MatRef::from_row_major_slice(&[1.0, 1.0], 1, 2);
/// let mut out = [0.0; 3];
/// layer.apply(1, x, Epilogue::Store, MatMut::from_row_major_slice_mut(&mut out, 1, 3));
/// assert_eq!(out, [3.0, 7.0, 21.0]);
/// ```
pub struct PackedLinear {
    isa: Isa,
    in_features: usize,
    out_features: usize,
    panels: Panels,
    /// One for each column of the panels, zero in the padding.
    bias: AlignedBuffer<f32>,
}

/// `[panel][k][column]`.
enum Panels {
    F32(AlignedBuffer<f32>),
    /// `[panel][k / 2][column]`, each element an even `k` in its low half and the following odd one in its high half: what native bf16
    /// products read, and the cheapest to widen. An odd `in_features` is padded with zero.
    Bf16(AlignedBuffer<u32>),
}

/// Rows that go through a panel together: their activations should stay in the second-level cache while the panel streams past. 96 rows
/// of 2048 are 768 kB, three quarters of a 1 MB cache.
const ROW_BLOCK: usize = 96;

/// Below this many multiply-accumulates a second thread costs more than it saves: waking one takes about 5 us, in which a core does
/// about 250 k of them.
const MACS_FOR_THREADS: usize = 1 << 19;

impl PackedLinear {
    /// Packs `parts`, stacked along `out_features`; a missing bias is zero.
    ///
    /// Stored as bf16 only if every part is bf16; otherwise widened to f32, which is exact.
    ///
    /// # Errors
    /// [`KernelError`] if there is no part, or the parts do not fit together.
    ///
    /// # Panics
    /// If this CPU lacks `isa`.
    pub fn pack(isa: Isa, parts: &[(WeightRef<'_>, Option<&[f32]>)]) -> Result<Self, KernelError> {
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
            out_features += outputs;
        }
        let columns = panel_columns(isa);
        let num_panels = out_features.div_ceil(columns);
        let mut bias = AlignedBuffer::zeroed(num_panels * columns);
        let mut column = 0;
        for (weight, part) in parts {
            if let Some(part) = part {
                bias[column..column + part.len()].copy_from_slice(part);
            }
            column += weight.shape().0;
        }
        let bf16 = parts
            .iter()
            .all(|(weight, _)| matches!(weight, WeightRef::Bf16(_)));
        let panels = if bf16 {
            Panels::Bf16(pack_bf16(parts, in_features, columns, num_panels))
        } else {
            Panels::F32(pack_f32(parts, in_features, columns, num_panels))
        };
        Ok(Self {
            isa,
            in_features,
            out_features,
            panels,
            bias,
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
        match self.panels {
            Panels::F32(_) => Element::F32,
            Panels::Bf16(_) => Element::Bf16,
        }
    }

    /// The instruction set that it was packed for.
    #[must_use]
    pub fn isa(&self) -> Isa {
        self.isa
    }

    /// Bytes held.
    #[must_use]
    pub fn nbytes(&self) -> usize {
        let panels = match &self.panels {
            Panels::F32(panels) => panels.len(),
            Panels::Bf16(panels) => panels.len(),
        };
        4 * (panels + self.bias.len())
    }

    /// `out = epilogue(x W^T + bias)` for rows `x (rows, in_features)` and `out (rows, out_features)`, both row-major with any row stride.
    ///
    /// # Panics
    /// If a shape does not fit, or columns are not contiguous.
    pub fn apply(&self, threads: usize, x: MatRef<'_, f32>, epilogue: Epilogue, out: MatMut<'_, f32>) {
        let rows = x.nrows();
        assert_eq!(x.ncols(), self.in_features, "x: expected in_features columns");
        assert_eq!(
            (out.nrows(), out.ncols()),
            (rows, self.out_features),
            "out: expected (rows, out_features)"
        );
        if rows == 0 || self.out_features == 0 {
            return;
        }
        assert!(
            x.col_stride() == 1 || x.ncols() <= 1,
            "x: expected contiguous rows"
        );
        assert!(
            out.col_stride() == 1 || out.ncols() <= 1,
            "out: expected contiguous rows"
        );
        let columns = panel_columns(self.isa);
        let num_panels = self.out_features.div_ceil(columns);
        let job = Job::new(x, out, epilogue);
        let blocks = rows.div_ceil(ROW_BLOCK);
        let threads = if rows * self.in_features * self.out_features < MACS_FOR_THREADS {
            1
        } else {
            threads
        };
        // The panel that this thread will probably take next.
        let ahead = threads;
        // Row blocks outside, panels inside: threads then share a block of activations and walk the weights side by side.
        parallel_for(threads, blocks * num_panels, &|task| {
            let (block, panel) = (task / num_panels, task % num_panels);
            let rows = Rows {
                first: rows * block / blocks,
                end: rows * (block + 1) / blocks,
            };
            match &self.panels {
                Panels::F32(panels) => self.run_panel(&job, rows, panels, panel, ahead),
                Panels::Bf16(panels) => self.run_panel(&job, rows, panels, panel, ahead),
            }
        });
    }

    /// Runs a block of rows through panel number `panel` of `panels`, all of this layer's.
    fn run_panel<E: Stored>(&self, job: &Job, rows: Rows, panels: &[E], panel: usize, ahead: usize) {
        let columns = panel_columns(self.isa);
        let size = self.in_features.div_ceil(E::STEP) * columns;
        let first = panel * columns;
        let panel = Panel {
            weights: &panels[panel * size..][..size],
            bias: &self.bias[first..first + columns],
            first,
            width: columns.min(self.out_features - first),
            ahead,
        };
        dispatch(self.isa, PanelRun { job, rows, panel });
    }
}

/// Output columns of a panel: as many vectors as leave registers for a tile that hides the latency of the multiply-adds.
fn panel_columns(isa: Isa) -> usize {
    match isa {
        Isa::Portable => tile::PORTABLE_COLUMNS,
        Isa::Avx2 => tile::AVX2_COLUMNS,
        Isa::Avx512 => tile::AVX512_COLUMNS,
    }
}

fn pack_f32(
    parts: &[(WeightRef<'_>, Option<&[f32]>)],
    in_features: usize,
    columns: usize,
    num_panels: usize,
) -> AlignedBuffer<f32> {
    let mut panels = AlignedBuffer::zeroed(num_panels * columns * in_features);
    let mut first = 0;
    for (weight, _) in parts {
        let start = |row: usize| (first + row) / columns * columns * in_features + (first + row) % columns;
        match weight {
            WeightRef::F32(view) => for_each(*view, start, |start, k, value| {
                panels[start + k * columns] = value
            }),
            WeightRef::Bf16(view) => {
                for_each(*view, start, |start, k, value| {
                    panels[start + k * columns] = value.to_f32()
                });
            }
        }
        first += weight.shape().0;
    }
    panels
}

fn pack_bf16(
    parts: &[(WeightRef<'_>, Option<&[f32]>)],
    in_features: usize,
    columns: usize,
    num_panels: usize,
) -> AlignedBuffer<u32> {
    let pairs = in_features.div_ceil(2);
    let mut panels = AlignedBuffer::zeroed(num_panels * columns * pairs);
    let mut first = 0;
    for (weight, _) in parts {
        let WeightRef::Bf16(view) = weight else {
            unreachable!("the caller has looked at all parts")
        };
        let start = |row: usize| (first + row) / columns * columns * pairs + (first + row) % columns;
        for_each(*view, start, |start, k, value| {
            panels[start + k / 2 * columns] |= u32::from(value.to_bits()) << (16 * (k % 2));
        });
        first += view.nrows();
    }
    panels
}

/// Visits all elements in blocks, so that neither the reading nor the writing side jumps through memory at every element;
/// `start` is computed once for each row of a block.
fn for_each<T: Copy>(
    view: MatRef<'_, T>,
    start: impl Fn(usize) -> usize,
    mut visit: impl FnMut(usize, usize, T),
) {
    const BLOCK: usize = 16;
    for row in (0..view.nrows()).step_by(BLOCK) {
        let count = BLOCK.min(view.nrows() - row);
        let starts: [usize; BLOCK] = std::array::from_fn(|index| start(row + index));
        for first in (0..view.ncols()).step_by(BLOCK) {
            let block = view.submatrix(row, first, count, BLOCK.min(view.ncols() - first));
            for k in 0..block.ncols() {
                for (index, &start) in starts[..count].iter().enumerate() {
                    visit(start, first + k, block[(index, k)]);
                }
            }
        }
    }
}
