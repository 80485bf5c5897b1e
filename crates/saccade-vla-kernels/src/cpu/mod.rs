//! Which CPU this is, what was measured on its family, and whether the system lets this process use tiles.

pub(crate) mod family;
mod signature;
pub(crate) mod tiles;

use std::fmt;

use family::{Family, Rates};
use once_cell::race::OnceBox;
use signature::Signature;

/// What is known of a CPU.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Cpu {
    signature: Option<Signature>,
    /// Its own family, if it is in the table.
    family: Option<&'static Family>,
    /// The family whose rates decide: its own, else the newest of its vendor.
    measured: Option<&'static Family>,
}

impl Cpu {
    fn new(signature: Option<Signature>) -> Self {
        let family = signature.and_then(family::of);
        Self {
            signature,
            family,
            measured: family.or_else(|| family::newest(signature?.vendor)),
        }
    }

    /// The CPU that this process runs on, detected once. No thread waits for another one that detects it:
    /// after a fork that one might not be there.
    pub(crate) fn current() -> &'static Self {
        static CURRENT: OnceBox<Cpu> = OnceBox::new();
        CURRENT.get_or_init(|| Box::new(Self::new(Signature::current())))
    }

    fn rates(&self) -> Option<&Rates> {
        self.measured.map(|family| &family.rates)
    }

    /// Whether AVX512-BF16 multiplies faster than float32 does: what is widened instead has the rate of
    /// float32.
    pub(crate) fn has_fast_bf16_dot(&self) -> bool {
        self.rates().is_none_or(|rates| rates.bf16_dot > rates.float32)
    }

    /// Whether weights are asked for as many streams of memory.
    pub(crate) fn wants_streams(&self) -> bool {
        self.rates().is_some_and(|rates| rates.streams)
    }
}

/// The name of its family and its numbers, where CPUID has them.
impl fmt::Display for Cpu {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = self.family.map_or("unknown family", |family| family.name);
        match self.signature {
            Some(signature) => write!(formatter, "{name} ({signature})"),
            None => formatter.write_str(std::env::consts::ARCH),
        }
    }
}

/// What decides which kernels this process uses, in words.
///
/// ```
/// let cpu = saccade_vla_kernels::CpuReport::current();
/// assert!(!cpu.family.is_empty() && !cpu.rates.is_empty() && !cpu.tiles.is_empty());
/// ```
#[derive(Clone, Debug)]
#[non_exhaustive]
pub struct CpuReport {
    /// The family, with its vendor and numbers: `Zen 4 (AuthenticAMD, family 25, model 17)`.
    pub family: String,
    /// The family whose measured rates choose between kernels, and whether it is this one.
    pub rates: String,
    /// Whether AMX can be used, and if not, why.
    pub tiles: String,
}

impl CpuReport {
    /// That of this process. The first call asks the system for AMX.
    #[must_use]
    pub fn current() -> Self {
        Self::of(Cpu::current(), tiles::permission())
    }

    fn of(cpu: &Cpu, tiles: Result<(), tiles::Refusal>) -> Self {
        let rates = match (cpu.family, cpu.measured) {
            (Some(own), _) => format!("{}, measured", own.name),
            (None, Some(Family { name, .. })) => {
                format!("{name}, the newest family of this vendor that was measured")
            }
            (None, None) => "none measured for this vendor".to_owned(),
        };
        Self {
            family: cpu.to_string(),
            rates,
            tiles: tiles.map_or_else(|refusal| format!("no: {refusal}"), |()| "yes".to_owned()),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::signature::{Vendor, signature};
    use super::tiles::Refusal;
    use super::*;

    fn cpu(vendor: Vendor, family: u32, model: u32) -> Cpu {
        Cpu::new(Some(signature(vendor, family, model)))
    }

    #[test]
    fn a_measured_family_gets_what_was_measured() {
        for (vendor, family, model, name) in [
            (Vendor::Intel, 6, 0x8f, "Sapphire Rapids"),
            (Vendor::Intel, 6, 0xcf, "Emerald Rapids"),
            (Vendor::Amd, 25, 0x11, "Zen 4"),
            (Vendor::Amd, 25, 0x61, "Zen 4"),
            (Vendor::Amd, 25, 0xa0, "Zen 4"),
            (Vendor::Amd, 26, 0x02, "Zen 5"),
            (Vendor::Amd, 26, 0x44, "Zen 5"),
        ] {
            let cpu = cpu(vendor, family, model);
            let is_amd = vendor == Vendor::Amd;
            assert_eq!(
                (cpu.has_fast_bf16_dot(), cpu.wants_streams()),
                (is_amd, !is_amd),
                "{cpu}"
            );
            let report = CpuReport::of(&cpu, Err(Refusal::NotThere));
            assert_eq!(report.rates, format!("{name}, measured"));
            assert_eq!(report.tiles, "no: this CPU lacks AMX");
            assert_eq!(
                report.family,
                format!("{name} ({})", signature(vendor, family, model))
            );
        }
        let genoa = cpu(Vendor::Amd, 25, 17);
        assert_eq!(genoa.to_string(), "Zen 4 (AuthenticAMD, family 25, model 17)");
    }

    #[test]
    fn another_family_gets_what_its_vendors_newest_gets() {
        for (vendor, family, model, newest) in [
            // Granite Rapids, Ice Lake, and models that nobody has named.
            (Vendor::Intel, 6, 0xad, "Emerald Rapids"),
            (Vendor::Intel, 6, 0x6a, "Emerald Rapids"),
            (Vendor::Intel, 6, 0xfe, "Emerald Rapids"),
            (Vendor::Intel, 19, 0x01, "Emerald Rapids"),
            (Vendor::Amd, 25, 0x01, "Zen 5"),
            (Vendor::Amd, 26, 0x50, "Zen 5"),
        ] {
            let cpu = cpu(vendor, family, model);
            let is_amd = vendor == Vendor::Amd;
            assert_eq!(
                (cpu.has_fast_bf16_dot(), cpu.wants_streams()),
                (is_amd, !is_amd),
                "{cpu}"
            );
            let report = CpuReport::of(&cpu, Ok(()));
            assert!(report.family.starts_with("unknown family ("), "{cpu}");
            assert_eq!(
                report.rates,
                format!("{newest}, the newest family of this vendor that was measured")
            );
            assert_eq!(report.tiles, "yes");
        }
    }

    /// Then what the CPU has is used, as before there was a table.
    #[test]
    fn a_vendor_that_nobody_measured_gets_what_its_cpu_has() {
        for cpu in [
            Cpu::new(None),
            cpu(Vendor::Other, 6, 0x8f),
            cpu(Vendor::Other, 25, 0x11),
        ] {
            assert!(cpu.has_fast_bf16_dot() && !cpu.wants_streams());
            let report = CpuReport::of(&cpu, Err(Refusal::NotThere));
            assert_eq!(report.rates, "none measured for this vendor");
        }
    }
}
