//! The packed linear layer: `out = epilogue(x W^T + bias)` with weights packed once.
//!
//! A [`Gemm`] packs the weights in panels of output columns, converts rows where it has to, and makes the sums of a block of
//! rows and a panel. This module splits the work over blocks and panels, never over the summed dimension, and finishes the
//! sums. So an output's bits depend on its row, its weights and the instruction set only: neither on the number of rows nor
//! on how the work is split.

mod epilogue;
mod error;
mod pack;
mod rows;
mod schedule;

use std::mem::MaybeUninit;
use std::ops::Range;

use crate::aligned::{AlignedBuffer, AllocError};
use crate::cpu::Cpu;
use crate::gemm::outliers::{MultiplyOutliers, Outliers};
use crate::gemm::{Block, Gemm, MAX_SUMS, Quantized, RowSplit};
use crate::isa::Isa;
use crate::parts::part;
use crate::pool::{parallel_for, usable};
use crate::rows::{Rows, RowsMut, SharedRows};
use crate::weights::{Arithmetic, Element, WeightRef};
pub use epilogue::Epilogue;
use epilogue::{Dequantization, Finish};
pub use error::KernelError;
use pack::{Panels, check_int4, check_panel, pack_panels, packed_element};
pub use rows::LinearScratch;
use rows::RowConversion;
use schedule::Schedule;

/// A linear layer whose weights were packed for one instruction set.
///
/// ```
/// use saccade_vla_kernels::{Arithmetic, Epilogue, Isa, LinearScratch, Matrix, PackedLinear, Rows, RowsMut, WeightRef};
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
    gemm: Box<dyn Gemm>,
    arithmetic: Arithmetic,
    element: Element,
    in_features: usize,
    out_features: usize,
    panels: Panels,
    /// One for each column of the panels, zero in the padding.
    bias: AlignedBuffer<f32>,
    /// Whether they are prefetched as many streams.
    streams: bool,
    /// Whether the largest elements of a row are kept out of its quantisation.
    keeps_outliers: bool,
}

/// Below this many multiply-accumulates a second thread costs more than it saves: waking one takes about 5 us, in which a core does
/// about 250 k of them.
const MACS_FOR_THREADS: usize = 1 << 19;

/// As many multiply-accumulates should each thread have, for the same reason.
const MACS_OF_THREAD: usize = MACS_FOR_THREADS / 2;

/// A task has at least so many: a microsecond of work, against a tenth of one to deal it.
const MACS_OF_TASK: usize = 1 << 16;

/// Tasks that each thread should have, if they are not smaller than that: one that begins its last task late keeps the others waiting for a
/// quarter of the work at most.
const TASKS_PER_THREAD: usize = 4;

impl PackedLinear {
    /// Packs `parts`, stacked along `out_features`, on `threads` threads; a missing bias is zero.
    ///
    /// For [`Arithmetic::Float32`] stored as bf16 only if every part is bf16; otherwise widened to f32, which is exact but for int8 and int4.
    ///
    /// # Errors
    /// [`KernelError`] if there is no part, the parts do not fit together, there are more than 65536 `in_features` for int8 or int4, there is not
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
        isa.check();
        let in_features = parts.first().ok_or(KernelError::NoParts)?.0.shape().1;
        let mut out_features = 0_usize;
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
            if let Some(scales) = weight.scales()
                && scales.len() != outputs
            {
                return Err(KernelError::Scales {
                    expected: outputs,
                    given: scales.len(),
                });
            }
            check_int4(weight)?;
            out_features = out_features
                .checked_add(outputs)
                .filter(|&sum| sum <= isize::MAX as usize)
                .ok_or(AllocError { bytes: usize::MAX })?;
        }
        let are_bf16 = parts
            .iter()
            .all(|(weight, _)| matches!(weight, WeightRef::Bf16(_)));
        let element = packed_element(arithmetic, are_bf16, in_features)?;
        let gemm = isa.gemm(arithmetic, element);
        check_panel(in_features)?;
        let columns = gemm.shape().nr;
        let mut bias = AlignedBuffer::zeroed(out_features.next_multiple_of(columns))?;
        let mut column = 0;
        for (weight, part) in parts {
            if let Some(part) = part {
                bias[column..column + part.len()].copy_from_slice(part);
            }
            column += weight.shape().0;
        }
        let panels = pack_panels(threads, &*gemm, element, parts)?;
        Ok(Self {
            isa,
            gemm,
            arithmetic,
            element,
            in_features,
            out_features,
            panels,
            bias,
            streams: Cpu::current().wants_streams(),
            keeps_outliers: false,
        })
    }

    /// Overrides the prefetch pattern of this CPU's family: as many streams, or in order. For programs that measure it:
    /// results have the same bits. Panels whose steps are one cache line (AVX2, narrow portable vectors) are prefetched in
    /// their order either way, and so are those of NEON.
    #[cfg(feature = "peak")]
    #[must_use]
    pub fn with_streams(self, streams: bool) -> Self {
        Self { streams, ..self }
    }

    /// The layer, keeping up to 8 elements of a row out of its quantisation if they are far larger than the others: they are
    /// multiplied in float32 by the same weights. For int8 and int4; no other arithmetic needs it.
    ///
    /// Costs a pass over the rows, and for rows that have such elements some percent of the products.
    #[must_use]
    pub fn keeping_outliers(self) -> Self {
        Self {
            keeps_outliers: self.element.is_quantized(),
            ..self
        }
    }

    /// The bytes that a layer of `(out_features, in_features)` holds when it is packed; `usize::MAX` for more than that.
    /// `weights` is [`Element::Bf16`] if all its parts are bf16; every other element is packed as [`Element::F32`] is.
    ///
    /// # Errors
    /// [`KernelError::TooManyInputs`] as [`Self::pack`].
    ///
    /// # Panics
    /// If this CPU lacks `isa`.
    pub fn packed_nbytes(
        isa: Isa,
        arithmetic: Arithmetic,
        weights: Element,
        (out_features, in_features): (usize, usize),
    ) -> Result<usize, KernelError> {
        let element = packed_element(arithmetic, weights == Element::Bf16, in_features)?;
        if check_panel(in_features).is_err() {
            return Ok(usize::MAX);
        }
        let gemm = isa.gemm(arithmetic, element);
        let columns = gemm.shape().nr;
        // A bias for each column; for int8 and int4 also a scale and a sum.
        let words_of_column = if element.is_quantized() { 3 } else { 1 };
        let panel = gemm
            .panel_words(in_features)
            .saturating_add(columns * words_of_column);
        let words = out_features.div_ceil(columns).saturating_mul(panel);
        Ok(words.saturating_mul(size_of::<u32>()))
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

    /// The name of the kernel that multiplies: the instruction set and the elements, as in `avx512-vnni-int8`.
    #[must_use]
    pub fn kernel_name(&self) -> &'static str {
        self.gemm.name()
    }

    /// The instruction set that it was packed for.
    #[must_use]
    pub fn isa(&self) -> Isa {
        self.isa
    }

    /// Bytes held.
    #[must_use]
    pub fn nbytes(&self) -> usize {
        let Panels { words, scales, sums } = &self.panels;
        4 * (words.len() + self.bias.len() + scales.len() + sums.len())
    }

    /// `out = epilogue(x W^T + bias)` for rows `x (rows, in_features)` and `out (rows, out_features)`, both row-major with any row stride.
    ///
    /// For all but [`Arithmetic::Float32`] the rows are converted first, into `scratch`. A row with NaN or infinity gives NaN for int8 and int4.
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
        out: RowsMut<'_>,
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
        let macs = rows
            .saturating_mul(self.in_features)
            .saturating_mul(self.out_features);
        let threads = if macs < MACS_FOR_THREADS {
            1
        } else {
            usable(threads).min(macs / MACS_OF_THREAD)
        };
        let num_panels = self.out_features.div_ceil(self.gemm.shape().nr);
        let split = RowSplit::new(rows, self.gemm.shape());
        // More blocks than the rows need where panels are few, so that no thread waits long for the last task of another:
        // 49 x 128 x 128 has three panels of 48 columns, which two threads would take in the time of two.
        let wanted = (TASKS_PER_THREAD * threads)
            .div_ceil(num_panels)
            .min(macs / num_panels / MACS_OF_TASK);
        let most = split.count.min(if threads == 1 { 1 } else { wanted.max(1) });
        let blocks = rows.div_ceil(self.gemm.row_block(self.in_features)).max(most);
        let mut call = Call {
            x: x.bits(),
            split,
            quantized: &[],
            outliers: &[],
            out: SharedRows::new(out),
            epilogue,
        };
        if let Some(stride) = self.gemm.converted_stride(self.in_features) {
            let conversion = match (self.element.is_quantized(), self.keeps_outliers) {
                (true, true) => RowConversion::QuantizedWithoutOutliers,
                (true, false) => RowConversion::Quantized,
                (false, _) => RowConversion::Rounded,
            };
            let converted = scratch.convert(&*self.gemm, stride, conversion, threads, x)?;
            call.x = converted.words;
            (call.quantized, call.outliers) = (converted.quantized, converted.outliers);
        }
        let panel_bytes = size_of::<u32>() * self.gemm.panel_words(self.in_features);
        let schedule = Schedule::new(blocks, num_panels, panel_bytes, threads, TASKS_PER_THREAD);
        parallel_for(threads, schedule.tasks(), &|task| {
            let (block, panel) = schedule.at(task);
            let calls = part(split.count, block, blocks);
            self.run_panel(&call, calls, panel, schedule.ahead(task));
        });
        Ok(())
    }

    /// Runs a block of rows, by `calls` of the micro-kernel, through panel number `panel`; this thread will probably take the
    /// one `ahead` of it next.
    fn run_panel(&self, call: &Call<'_>, calls: Range<usize>, panel: usize, ahead: usize) {
        #[repr(align(64))]
        struct SumBuffer([MaybeUninit<u32>; MAX_SUMS]);

        let (size, columns) = (self.gemm.panel_words(self.in_features), self.gemm.shape().nr);
        let first_row = call.split.rows(&calls).start;
        let weights = &self.panels.words[panel * size..][..size];
        let block = Block {
            x: call.x,
            in_features: self.in_features,
            split: call.split,
            calls,
            weights,
            needed: self.needed_columns(panel),
            ahead,
            streams: self.streams,
            out: call.out.as_ptr().wrapping_add(panel * columns),
            out_stride: call.out.row_stride(),
        };
        let mut sums = SumBuffer([const { MaybeUninit::uninit() }; MAX_SUMS]);
        self.gemm.multiply_and_finish(&block, &mut sums.0, &|rows, sums| {
            let sums = &sums[(rows.start - first_row) * columns..];
            self.finish(call, rows, panel, weights, sums);
        });
    }

    /// Columns of panel number `panel` that the layer has.
    fn panel_width(&self, panel: usize) -> usize {
        let columns = self.gemm.shape().nr;
        columns.min(self.out_features - panel * columns)
    }

    /// Columns of panel number `panel` whose sums are needed: results are made in whole vectors.
    fn needed_columns(&self, panel: usize) -> usize {
        let width = self.panel_width(panel);
        width
            .next_multiple_of(self.isa.vectors().lanes)
            .min(self.gemm.shape().nr)
    }

    /// Makes results of the complete sums of some rows and panel number `panel`, whose words are `weights`.
    fn finish(
        &self,
        call: &Call<'_>,
        rows: Range<usize>,
        panel: usize,
        weights: &[u32],
        sums: &[MaybeUninit<u32>],
    ) {
        let columns = self.gemm.shape().nr;
        let first = panel * columns;
        let outliers = call.outliers.get(rows.clone()).unwrap_or_default();
        let has_outliers = outliers.iter().any(|outliers| !outliers.is_empty());
        let mut apart = [const { MaybeUninit::uninit() }; MAX_SUMS];
        let apart = &mut apart[..if has_outliers { rows.len() * columns } else { 0 }];
        apart.fill(MaybeUninit::new(0.0));
        // SAFETY: all elements have just been written.
        let apart = unsafe { apart.assume_init_mut() };
        if has_outliers {
            self.gemm.multiply_outliers(MultiplyOutliers {
                outliers,
                panel: weights,
                columns,
                run: 1,
                has_nibbles: false,
                sums: apart,
            });
        }
        let of_panel = first..first + columns;
        let quantized = self.element.is_quantized().then(|| Dequantization {
            scales: &self.panels.scales[of_panel.clone()],
            weight_sums: &self.panels.sums[of_panel.clone()],
            quantized: &call.quantized[rows.clone()],
            outliers: if has_outliers { outliers } else { &[] },
            apart: Rows::new(apart, columns),
        });
        // SAFETY: the product has written the sums of the needed columns of these rows.
        let sums = unsafe { Rows::initialised(sums, rows.len(), self.needed_columns(panel), columns) };
        // SAFETY: no two tasks have a row and a panel in common, and rows are finished once.
        let out = unsafe { call.out.block(rows, first..first + self.panel_width(panel)) };
        self.isa.run(&mut Finish {
            epilogue: call.epilogue,
            sums,
            bias: &self.bias[of_panel],
            quantized,
            out,
        });
    }
}

/// The activations and results of one call.
struct Call<'a> {
    /// As [`Block::x`].
    x: Rows<'a, u32>,
    split: RowSplit,
    quantized: &'a [Quantized],
    /// Of each row, if they are kept apart.
    outliers: &'a [Outliers],
    out: SharedRows<'a>,
    epilogue: Epilogue,
}
