//! Instruction sets: which ones this CPU has, and which one is used.

use std::fmt;
use std::str::FromStr;

/// Environment variable that forces an instruction set, so that every path can be tested on one machine.
pub const ISA_VARIABLE: &str = "SACCADE_ISA";

/// An instruction set that the kernels are written for.
///
/// ```
/// use saccade_kernels::Isa;
/// assert!(Isa::available().contains(&Isa::best()));
/// assert_eq!("portable".parse::<Isa>().unwrap(), Isa::Portable);
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Isa {
    /// Plain loops that any compiler vectorises for its baseline; runs everywhere.
    Portable,
    /// AVX2 with FMA.
    Avx2,
    /// AVX2 with 256-bit int8 dot products: AVX-VNNI, or AVX512-VNNI with VL.
    Avx2Vnni,
    /// AVX-512 F, VL, BW and DQ, without dot products.
    Avx512f,
    /// AVX-512 with whichever of the dot products AVX512-BF16 and AVX512-VNNI this CPU has; [`Isa::Avx512f`] where it has neither.
    Avx512,
}

/// `SACCADE_ISA` holds a name that is unknown, or of an instruction set that this CPU lacks.
#[derive(Debug, thiserror::Error)]
#[error("{ISA_VARIABLE}: expected one of {}, got `{given}`{}", names(&Isa::available()), if *known { ", which this CPU lacks" } else { "" })]
pub struct IsaError {
    given: String,
    known: bool,
}

const ALL: [Isa; 5] = [Isa::Portable, Isa::Avx2, Isa::Avx2Vnni, Isa::Avx512f, Isa::Avx512];

impl Isa {
    /// The fastest one that this CPU has.
    #[must_use]
    pub fn best() -> Self {
        *Self::available().last().expect("portable is always there")
    }

    /// All that this CPU has, slowest first.
    #[must_use]
    pub fn available() -> Vec<Self> {
        ALL.into_iter().filter(|isa| isa.is_available()).collect()
    }

    /// Whether this CPU has it.
    #[must_use]
    pub fn is_available(self) -> bool {
        match self {
            Self::Portable => true,
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma"),
            #[cfg(target_arch = "x86_64")]
            Self::Avx2Vnni => {
                Self::Avx2.is_available()
                    && (is_x86_feature_detected!("avxvnni")
                        || (is_x86_feature_detected!("avx512vnni") && is_x86_feature_detected!("avx512vl")))
            }
            #[cfg(target_arch = "x86_64")]
            Self::Avx512f | Self::Avx512 => {
                is_x86_feature_detected!("avx512f")
                    && is_x86_feature_detected!("avx512vl")
                    && is_x86_feature_detected!("avx512bw")
                    && is_x86_feature_detected!("avx512dq")
                    && Self::Avx2.is_available()
            }
            #[cfg(not(target_arch = "x86_64"))]
            _ => false,
        }
    }

    /// The dot products that it uses on this CPU: `bf16` (pairs of bfloat16), `vnni` (quads of int8).
    ///
    /// ```
    /// assert!(saccade_kernels::Isa::Portable.dot_products().is_empty());
    /// ```
    #[must_use]
    pub fn dot_products(self) -> Vec<&'static str> {
        [("bf16", self.has_bf16_dot()), ("vnni", self.has_vnni())]
            .into_iter()
            .filter_map(|(name, has)| has.then_some(name))
            .collect()
    }

    /// Whether pairs of bf16 are multiplied and summed in one instruction.
    pub(crate) fn has_bf16_dot(self) -> bool {
        #[cfg(target_arch = "x86_64")]
        return self == Self::Avx512 && self.is_available() && is_x86_feature_detected!("avx512bf16");
        #[cfg(not(target_arch = "x86_64"))]
        false
    }

    /// Whether quads of int8 are multiplied and summed in one instruction.
    pub(crate) fn has_vnni(self) -> bool {
        #[cfg(target_arch = "x86_64")]
        return match self {
            Self::Avx2Vnni => self.is_available(),
            Self::Avx512 => self.is_available() && is_x86_feature_detected!("avx512vnni"),
            _ => false,
        };
        #[cfg(not(target_arch = "x86_64"))]
        false
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
                    Ok(isa)
                } else {
                    Err(IsaError {
                        given: given.into_owned(),
                        known: true,
                    })
                }
            }
            _ => Ok(Self::best()),
        }
    }
}

impl fmt::Display for Isa {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(match self {
            Self::Portable => "portable",
            Self::Avx2 => "avx2",
            Self::Avx2Vnni => "avx2vnni",
            Self::Avx512f => "avx512f",
            Self::Avx512 => "avx512",
        })
    }
}

impl FromStr for Isa {
    type Err = IsaError;

    fn from_str(name: &str) -> Result<Self, IsaError> {
        let known = ALL.into_iter().find(|isa| isa.to_string() == name);
        known.ok_or_else(|| IsaError {
            given: name.to_owned(),
            known: false,
        })
    }
}

fn names(isas: &[Isa]) -> String {
    isas.iter().map(Isa::to_string).collect::<Vec<_>>().join(", ")
}
