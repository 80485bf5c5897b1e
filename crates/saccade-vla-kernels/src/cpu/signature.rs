//! Vendor, family and model, as CPUID gives them.

use std::fmt;

/// Who made a CPU.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Vendor {
    Intel,
    Amd,
    Other,
}

/// A CPU's vendor and its numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Signature {
    pub vendor: Vendor,
    pub family: u32,
    pub model: u32,
}

impl Signature {
    /// This CPU's; `None` where there is no CPUID.
    pub(super) fn current() -> Option<Self> {
        #[cfg(all(target_arch = "x86_64", not(saccade_portable)))]
        {
            let (vendor, version) = (std::arch::x86_64::__cpuid(0), std::arch::x86_64::__cpuid(1));
            Some(Self::decode([vendor.ebx, vendor.edx, vendor.ecx], version.eax))
        }
        #[cfg(not(all(target_arch = "x86_64", not(saccade_portable))))]
        None
    }

    /// From the vendor's name in leaf 0 (`ebx`, `edx`, `ecx`) and `eax` of leaf 1.
    #[cfg(any(all(target_arch = "x86_64", not(saccade_portable)), test))]
    fn decode(vendor: [u32; 3], version: u32) -> Self {
        let mut name = [0; 12];
        for (to, word) in name.as_chunks_mut().0.iter_mut().zip(vendor) {
            *to = word.to_le_bytes();
        }
        let field = |shift: u32, bits: u32| (version >> shift) & ((1 << bits) - 1);
        let (family, model) = (field(8, 4), field(4, 4));
        Self {
            vendor: match &name {
                b"GenuineIntel" => Vendor::Intel,
                b"AuthenticAMD" => Vendor::Amd,
                _ => Vendor::Other,
            },
            family: if family == 15 {
                family + field(20, 8)
            } else {
                family
            },
            model: if matches!(family, 6 | 15) {
                model | field(16, 4) << 4
            } else {
                model
            },
        }
    }
}

impl fmt::Display for Signature {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let vendor = match self.vendor {
            Vendor::Intel => "GenuineIntel",
            Vendor::Amd => "AuthenticAMD",
            Vendor::Other => "another vendor",
        };
        write!(
            formatter,
            "{vendor}, family {}, model {}",
            self.family, self.model
        )
    }
}

/// For tests.
#[cfg(test)]
pub(super) fn signature(vendor: Vendor, family: u32, model: u32) -> Signature {
    Signature {
        vendor,
        family,
        model,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `eax` of leaf 1, as published for these CPUs.
    #[test]
    fn known_versions_are_decoded() {
        let word = |bytes: &[u8; 4]| u32::from_le_bytes(*bytes);
        let intel = [word(b"Genu"), word(b"ineI"), word(b"ntel")];
        let amd = [word(b"Auth"), word(b"enti"), word(b"cAMD")];
        for (vendor, version, expected) in [
            (intel, 0x000806f8, signature(Vendor::Intel, 6, 0x8f)), // Xeon 8480
            (intel, 0x000c06f2, signature(Vendor::Intel, 6, 0xcf)), // Xeon 8592
            (intel, 0x000a06d1, signature(Vendor::Intel, 6, 0xad)), // Xeon 6980P
            (intel, 0x000606a6, signature(Vendor::Intel, 6, 0x6a)), // Xeon 8380
            (intel, 0x00050657, signature(Vendor::Intel, 6, 0x55)), // Xeon 8280
            (intel, 0x0005065b, signature(Vendor::Intel, 6, 0x55)), // Xeon 8380H
            (intel, 0x00090672, signature(Vendor::Intel, 6, 0x97)), // Core i9-12900K
            (amd, 0x00a00f11, signature(Vendor::Amd, 25, 1)),       // EPYC 7763
            (amd, 0x00a10f11, signature(Vendor::Amd, 25, 17)),      // EPYC 9654
            (amd, 0x00b00f21, signature(Vendor::Amd, 26, 2)),       // EPYC 9755
            ([0; 3], 0, signature(Vendor::Other, 0, 0)),
        ] {
            assert_eq!(Signature::decode(vendor, version), expected, "{version:#x}");
        }
    }
}
