//! Instruction sets: the table of what each one uses, which ones this CPU has, and which one is chosen.

use std::fmt;
use std::str::FromStr;

#[cfg(all(target_arch = "x86_64", not(saccade_portable)))]
use crate::cpu::Cpu;
use crate::cpu::tiles::{Refusal, permission};
use crate::gemm::elements::{F32, Int8, RoundedBf16, WidenedBf16};
use crate::gemm::in_vectors::InVectors;
#[cfg(all(target_arch = "aarch64", not(saccade_portable)))]
use crate::gemm::neon::{DotprodInt8, I8mmInt8, Lanes, MatrixBf16, WideningInt8};
use crate::gemm::{Gemm, available};
#[allow(
    unused_imports,
    reason = "not every architecture and set of features has such products"
)]
use crate::gemm::{elements::Bf16, in_tiles::InTiles};
#[cfg(all(target_arch = "aarch64", not(saccade_portable)))]
use crate::simd::aarch64::neon::{Neon, NeonBf16, NeonDotprod, NeonI8mm};
use crate::simd::portable::Portable;
#[cfg(all(target_arch = "x86_64", not(saccade_portable)))]
use crate::simd::x86_64::{
    avx2::{Avx2, Avx2EvexVnni, Avx2VexVnni},
    avx512::{Avx512, Avx512Amx, Avx512Bf16, Avx512Vnni},
};
use crate::simd::{Kernel, MAX_LANES, MAX_TILE_ROWS, Simd};
use crate::tiles::TileKernel;
#[allow(
    unused_imports,
    reason = "not every architecture and set of features has tiles"
)]
use crate::tiles::TileUnit;
#[cfg(all(target_arch = "x86_64", not(saccade_portable)))]
use crate::tiles::amx::Amx;
use crate::weights::{Arithmetic, Element};
#[cfg(feature = "software-tiles")]
use crate::{
    simd::portable::Loops,
    tiles::{Software, TILE},
};

/// Environment variable that forces an instruction set, so that every path can be tested on one machine.
pub const ISA_VARIABLE: &str = "SACCADE_ISA";

/// A product that is made of vectors, unless the instruction set has its own ones.
macro_rules! of_vectors_unless {
    ([] $product:ty, $weights:ident) => {
        available::<$product>($weights)
    };
    ([$own:ty] $product:ty, $weights:ident) => {
        None
    };
}

/// An entry is an instruction set, slowest first, with the name that users give it and the condition under
/// which it is compiled: `Name = "name" if CONDITION { ... }`. With `of "feature"` before the condition, it
/// exists only where the crate has this feature. In the braces are
/// - `vectors`: what every kernel runs on;
/// - `bf16`, `int8`: instruction sets with the same vectors and an instruction for dot products of these
///   elements; a kernel for dot products of bfloat16 uses the first of `bf16` that the CPU has, and else
///   `vectors`; with `where` a condition, where it holds: on Intel's Sapphire Rapids products of float32 have
///   twice the rate of those of bfloat16;
/// - `gemm_bf16`, `gemm_int8`: products with packed weights of these elements, likewise; those after the last
///   one listed are made of `vectors` alone; int4 has those of int8;
/// - `needs`: of these types, the CPU must have at least one;
/// - `gemm_f32`, `gemm_widened`: float32 rows with float32 weights, and with bfloat16 ones, where these
///   products are not made of `vectors` either; then no product is.
/// - `tiles`: the unit that multiplies tiles, where there is one, and which must be there: attention over
///   bfloat16 uses it.
macro_rules! instruction_sets {
    ($(
        $(#[$doc:meta])*
        $isa:ident = $name:literal $(of $feature:literal)? if $condition:meta {
            vectors: $vectors:ty,
            bf16: [$($bf16:ty $(where $bf16_is_fast:expr)?),*],
            int8: [$($int8:ty),*],
            gemm_bf16: [$($gemm_bf16:ty $(where $gemm_is_fast:expr)?),*],
            gemm_int8: [$($gemm_int8:ty),*],
            needs: [$($needed:ty),+],
            $(gemm_f32: $gemm_f32:ty, gemm_widened: $gemm_widened:ty,)?
            $(tiles: $tiles:ty,)?
        }
    )+) => {
        /// An instruction set that the kernels are written for.
        ///
        /// ```
        /// use saccade_vla_kernels::Isa;
        /// assert!(Isa::available().contains(&Isa::best()));
        /// assert_eq!("portable".parse::<Isa>().unwrap(), Isa::Portable);
        /// ```
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
        #[non_exhaustive]
        pub enum Isa {
            $($(#[$doc])* $(#[cfg(feature = $feature)])? $isa,)+
        }

        const ALL: &[Isa] = &[$($(#[cfg(feature = $feature)])? Isa::$isa),+];

        $(#[cfg($condition)] const _: () = Vectors::of::<$vectors>().check();)+

        impl Isa {
            fn name(self) -> &'static str {
                match self {
                    $($(#[cfg(feature = $feature)])? Self::$isa => $name,)+
                }
            }

            /// Whether this CPU has it.
            #[must_use]
            #[inline]
            pub fn is_available(self) -> bool {
                match self {
                    $(#[cfg($condition)] Self::$isa => ($(<$needed as Simd>::new().is_some())||+) $(&& <$tiles as TileUnit>::new().is_some())?,)+
                    #[allow(unreachable_patterns, reason = "on some architectures all of them are there")]
                    _ => false,
                }
            }

            /// The instructions for dot products of bfloat16 and of int8 that it uses on this CPU.
            fn dots(self) -> [Option<&'static str>; 2] {
                match self {
                    $(#[cfg($condition)] Self::$isa if self.is_available() => [
                        None $(.or_else(|| (true $(&& $bf16_is_fast)?).then(name_of::<$bf16>).flatten()))*,
                        None $(.or_else(name_of::<$int8>))*,
                    ],)+
                    _ => [None; 2],
                }
            }

            /// Sizes of its vectors.
            ///
            /// # Panics
            /// If no CPU of this architecture has it.
            pub(crate) fn vectors(self) -> Vectors {
                match self {
                    $(#[cfg($condition)] Self::$isa => Vectors::of::<$vectors>(),)+
                    #[allow(unreachable_patterns, reason = "on some architectures all of them are there")]
                    _ => self.is_missing(),
                }
            }

            /// Runs a kernel on it, with dot products of bfloat16 if the kernel uses them and there are any.
            ///
            /// # Panics
            /// If this CPU lacks it: looking is a few loads, and makes every kernel sound.
            #[inline]
            pub(crate) fn run<K: Kernel>(self, kernel: &mut K) -> K::Output {
                match self {
                    $(#[cfg($condition)] Self::$isa if self.is_available() => {
                        $(if K::USES_DOT_BF16 $(&& $bf16_is_fast)? && let Some(simd) = <$bf16 as Simd>::new() {
                            return simd.run(kernel);
                        })*
                        match <$vectors as Simd>::new() {
                            Some(simd) => simd.run(kernel),
                            None => self.is_missing(),
                        }
                    })+
                    _ => self.is_missing(),
                }
            }

            /// Whether attention over bfloat16 runs in tiles.
            pub(crate) fn has_tiles(self) -> bool {
                match self {
                    $($(#[cfg($condition)] Self::$isa => <$tiles as TileUnit>::new().is_some(),)?)+
                    _ => false,
                }
            }

            /// Runs a kernel on its unit for tiles.
            ///
            /// # Panics
            /// If it has none, or this CPU lacks it.
            pub(crate) fn run_tiles<K: TileKernel>(self, kernel: &mut K) -> K::Output {
                match self {
                    $($(#[cfg($condition)] Self::$isa => match <$tiles as TileUnit>::new() {
                        Some(unit) => kernel.run(unit),
                        None => self.is_missing(),
                    },)?)+
                    _ => {
                        let _ = kernel;
                        self.is_missing()
                    }
                }
            }

            /// What multiplies rows by packed weights, which are given as `weights`.
            ///
            /// # Panics
            /// If this CPU lacks it.
            pub(crate) fn gemm(self, arithmetic: Arithmetic, weights: Element) -> Box<dyn Gemm> {
                let found: Option<Box<dyn Gemm>> = match self {
                    $(#[cfg($condition)] Self::$isa if self.is_available() => match (arithmetic, weights) {
                        (Arithmetic::Float32, Element::Bf16) => None $(.or_else(|| available::<$gemm_widened>(weights)))?
                            .or_else(|| of_vectors_unless!([$($gemm_f32)?] InVectors<$vectors, WidenedBf16>, weights)),
                        (Arithmetic::Float32, _) => None $(.or_else(|| available::<$gemm_f32>(weights)))?
                            .or_else(|| of_vectors_unless!([$($gemm_f32)?] InVectors<$vectors, F32>, weights)),
                        (Arithmetic::Bfloat16, _) => None
                            $(.or_else(|| (true $(&& $gemm_is_fast)?).then(|| available::<$gemm_bf16>(weights)).flatten()))*
                            .or_else(|| of_vectors_unless!([$($gemm_f32)?] InVectors<$vectors, RoundedBf16>, weights)),
                        (Arithmetic::Int8 | Arithmetic::Int4, _) => None $(.or_else(|| available::<$gemm_int8>(weights)))*
                            .or_else(|| of_vectors_unless!([$($gemm_f32)?] InVectors<$vectors, Int8>, weights)),
                    },)+
                    _ => None,
                };
                found.unwrap_or_else(|| self.is_missing())
            }
        }
    };
}

instruction_sets! {
    /// Plain loops that any compiler vectorises for its baseline; runs everywhere.
    Portable = "portable" if all() {
        vectors: Portable, bf16: [], int8: [], gemm_bf16: [], gemm_int8: [], needs: [Portable],
    }
    /// AVX2 with FMA.
    Avx2 = "avx2" if all(target_arch = "x86_64", not(saccade_portable)) {
        vectors: Avx2, bf16: [], int8: [], gemm_bf16: [], gemm_int8: [], needs: [Avx2],
    }
    /// AVX2 with 256-bit int8 dot products: AVX-VNNI, or AVX512-VNNI with VL.
    Avx2Vnni = "avx2vnni" if all(target_arch = "x86_64", not(saccade_portable)) {
        vectors: Avx2,
        bf16: [],
        int8: [Avx2VexVnni, Avx2EvexVnni],
        gemm_bf16: [],
        gemm_int8: [InVectors<Avx2VexVnni, Int8>, InVectors<Avx2EvexVnni, Int8>],
        needs: [Avx2VexVnni, Avx2EvexVnni],
    }
    /// AVX-512 F, VL, BW and DQ, without dot products.
    Avx512f = "avx512f" if all(target_arch = "x86_64", not(saccade_portable)) {
        vectors: Avx512, bf16: [], int8: [], gemm_bf16: [], gemm_int8: [], needs: [Avx512],
    }
    /// AVX-512 with whichever of the dot products AVX512-BF16 and AVX512-VNNI this CPU has; [`Isa::Avx512f`]
    /// where it has neither.
    Avx512 = "avx512" if all(target_arch = "x86_64", not(saccade_portable)) {
        vectors: Avx512,
        bf16: [Avx512Bf16 where Cpu::current().has_fast_bf16_dot()],
        int8: [Avx512Vnni],
        gemm_bf16: [InVectors<Avx512Bf16, Bf16> where Cpu::current().has_fast_bf16_dot()],
        gemm_int8: [InVectors<Avx512Vnni, Int8>],
        needs: [Avx512],
    }
    /// Tiles in software: what [`Isa::Amx`] computes, bit for bit but for the vectors beside the tiles, at
    /// the speed of an emulator. For tests; never chosen, and not among [`Isa::available`].
    #[doc(hidden)]
    SoftwareTiles = "software_tiles" of "software-tiles" if feature = "software-tiles" {
        vectors: Loops<TILE>,
        bf16: [],
        int8: [],
        gemm_bf16: [InTiles<Software, Bf16>],
        gemm_int8: [InTiles<Software, Int8>],
        needs: [Loops<TILE>],
        tiles: Software,
    }
    /// AVX-512, and products of bfloat16 and int8 in the tiles of AMX.
    Amx = "amx" if all(target_arch = "x86_64", not(saccade_portable)) {
        vectors: Avx512,
        bf16: [Avx512Amx],
        int8: [Avx512Vnni],
        gemm_bf16: [InTiles<Amx, Bf16>],
        gemm_int8: [InTiles<Amx, Int8>],
        needs: [Avx512Amx],
        tiles: Amx,
    }
    /// NEON, which every 64-bit ARM has.
    Neon = "neon" if all(target_arch = "aarch64", not(saccade_portable)) {
        vectors: Neon,
        bf16: [],
        int8: [],
        gemm_bf16: [InVectors<Neon, RoundedBf16, Lanes>],
        gemm_int8: [InVectors<Neon, WideningInt8, Lanes>],
        needs: [Neon],
        gemm_f32: InVectors<Neon, F32, Lanes>,
        gemm_widened: InVectors<Neon, WidenedBf16, Lanes>,
    }
    /// NEON with dot products of int8.
    Dotprod = "dotprod" if all(target_arch = "aarch64", not(saccade_portable)) {
        vectors: Neon,
        bf16: [],
        int8: [NeonDotprod],
        gemm_bf16: [InVectors<Neon, RoundedBf16, Lanes>],
        gemm_int8: [InVectors<NeonDotprod, DotprodInt8, Lanes>],
        needs: [NeonDotprod],
        gemm_f32: InVectors<Neon, F32, Lanes>,
        gemm_widened: InVectors<Neon, WidenedBf16, Lanes>,
    }
    /// NEON with products of matrices of int8.
    I8mm = "i8mm" if all(target_arch = "aarch64", not(saccade_portable)) {
        vectors: Neon,
        bf16: [],
        int8: [NeonI8mm],
        gemm_bf16: [InVectors<Neon, RoundedBf16, Lanes>],
        gemm_int8: [InVectors<NeonI8mm, I8mmInt8, Lanes>],
        needs: [NeonI8mm],
        gemm_f32: InVectors<Neon, F32, Lanes>,
        gemm_widened: InVectors<Neon, WidenedBf16, Lanes>,
    }
    /// NEON with products of bfloat16, and whichever of int8 this CPU has.
    Bf16 = "bf16" if all(target_arch = "aarch64", not(saccade_portable)) {
        vectors: Neon,
        bf16: [NeonBf16],
        int8: [NeonI8mm, NeonDotprod],
        gemm_bf16: [InVectors<NeonBf16, MatrixBf16, Lanes>],
        gemm_int8: [
            InVectors<NeonI8mm, I8mmInt8, Lanes>,
            InVectors<NeonDotprod, DotprodInt8, Lanes>,
            InVectors<Neon, WideningInt8, Lanes>
        ],
        needs: [NeonBf16],
        gemm_f32: InVectors<Neon, F32, Lanes>,
        gemm_widened: InVectors<Neon, WidenedBf16, Lanes>,
    }
}

/// What users call the instructions of `S`, where this CPU has them.
#[allow(dead_code, reason = "not every architecture has such an instruction")]
fn name_of<S: Simd>() -> Option<&'static str> {
    S::new().map(|_| S::DOT_NAME)
}

/// Sizes that data are laid out by.
#[derive(Clone, Copy)]
pub(crate) struct Vectors {
    /// f32 in a vector.
    pub lanes: usize,
    /// Rows of the largest tile of sums in registers.
    pub tile_rows: usize,
}

impl Vectors {
    const fn of<S: Simd>() -> Self {
        Self {
            lanes: S::LANES,
            tile_rows: S::TILE_ROWS,
        }
    }

    /// Checks that kernels have room for them.
    const fn check(&self) {
        assert!(self.lanes <= MAX_LANES && self.tile_rows >= 1 && self.tile_rows <= MAX_TILE_ROWS);
    }
}

/// `SACCADE_ISA` holds a name that is unknown, or of an instruction set that this CPU lacks or the system
/// keeps from this process.
#[derive(Debug, thiserror::Error)]
#[error("{ISA_VARIABLE}: expected one of {}, got `{given}`{why}", names(&Isa::available()))]
pub struct IsaError {
    given: String,
    /// The reason, with its punctuation (`, ...`); empty for an unknown name.
    why: String,
}

impl Isa {
    /// The fastest one that this CPU has.
    #[must_use]
    pub fn best() -> Self {
        *Self::available().last().expect("portable is always there")
    }

    /// All that this CPU has, slowest first.
    #[must_use]
    pub fn available() -> Vec<Self> {
        ALL.iter()
            .copied()
            .filter(|isa| !isa.is_emulated() && isa.is_available())
            .collect()
    }

    /// Whether it is for tests alone.
    fn is_emulated(self) -> bool {
        self.name() == "software_tiles"
    }

    /// The dot products that it uses on this CPU: `bf16` (of bfloat16); `vnni`, `dotprod` or `i8mm` (of
    /// int8); in tiles, for [`Isa::Amx`].
    ///
    /// ```
    /// assert!(saccade_vla_kernels::Isa::Portable.dot_products().is_empty());
    /// ```
    #[must_use]
    pub fn dot_products(self) -> Vec<&'static str> {
        self.dots().into_iter().flatten().collect()
    }

    /// The one that `SACCADE_ISA` names; the best where it is unset or empty.
    ///
    /// # Errors
    /// The name is unknown, or this CPU lacks the instruction set.
    pub fn from_env() -> Result<Self, IsaError> {
        match std::env::var_os(ISA_VARIABLE) {
            Some(given) if !given.is_empty() => {
                let given = given.to_string_lossy();
                let isa: Self = given.parse()?;
                if isa.is_available() {
                    return Ok(isa);
                }
                let (given, why) = (given.into_owned(), isa.why_not());
                Err(IsaError { given, why })
            }
            _ => Ok(Self::best()),
        }
    }

    /// Why it is not available.
    fn why_not(self) -> String {
        match (self, permission()) {
            (Self::Amx, Err(refusal)) if refusal != Refusal::NotThere => format!(": {refusal}"),
            _ => ", which this CPU lacks".to_owned(),
        }
    }

    /// Panics unless this CPU has it.
    pub(crate) fn check(self) {
        if !self.is_available() {
            self.is_missing();
        }
    }

    #[cold]
    fn is_missing(self) -> ! {
        panic!("this CPU lacks {self}")
    }
}

impl fmt::Display for Isa {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(self.name())
    }
}

impl FromStr for Isa {
    type Err = IsaError;

    fn from_str(name: &str) -> Result<Self, IsaError> {
        let known = ALL.iter().copied().find(|isa| isa.name() == name);
        let (given, why) = (name.to_owned(), String::new());
        known.ok_or(IsaError { given, why })
    }
}

fn names(isas: &[Isa]) -> String {
    isas.iter().map(Isa::to_string).collect::<Vec<_>>().join(", ")
}
