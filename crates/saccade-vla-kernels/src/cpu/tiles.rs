//! Whether this process may use tiles (AMX): asked once, and if the answer is no, why.

use once_cell::race::OnceBox;

/// Why tiles cannot be used.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub(crate) enum Refusal {
    /// CPUID names none, or a hypervisor hides them.
    #[error("this CPU lacks AMX")]
    NotThere,
    /// Some products are not there.
    #[error("this CPU has AMX without its products of bfloat16 and int8")]
    WithoutProducts,
    /// The vectors that work beside the tiles are not there.
    #[error("this CPU has AMX without AVX512-BF16 and AVX512-VNNI")]
    WithoutVectors,
    /// Tiles of other sizes than the kernels are written for.
    #[error("this CPU names no AMX palette of eight tiles of 16 rows of 64 bytes")]
    OtherTiles,
    /// The state of tiles is turned off in XCR0.
    #[error("the system keeps the AMX state turned off (XCR0 {0:#x})")]
    TurnedOff(u64),
    /// The system has no request for tiles, or saccade does not know it.
    #[error("this system lets no process use AMX")]
    NoRequest,
    /// A thread of this process has an alternate signal stack that would be too small.
    #[error("an alternate signal stack of this process is too small for AMX (ENOSPC)")]
    SignalStack,
    /// The request failed otherwise: forbidden, or unknown to the kernel.
    #[error("the kernel refused AMX (error {0})")]
    Refused(i32),
    /// The request seemed to succeed, and changed nothing: a sandbox answers in the kernel's place.
    #[error("the kernel granted AMX, but does not list it among the permissions of this process")]
    NotGranted,
}

/// What is asked of the CPU and of the system.
trait Machine {
    /// `[eax, ebx, ecx, edx]`; zeros for a leaf beyond the last one.
    fn cpuid(&self, leaf: u32, subleaf: u32) -> [u32; 4];

    /// XCR0. Asked only where OSXSAVE is set.
    fn xcr0(&self) -> u64;

    /// Asks the system to let this process use tile data, now and in later threads. `Err(None)` if there is
    /// no such request.
    fn request(&self) -> Result<(), Option<i32>>;

    /// The states that this process may use, as bits.
    fn permitted(&self) -> u64;
}

/// The state of tile data, as a bit of XCR0 and of the kernel's permissions; that of the configuration is the
/// bit before it.
const TILE_DATA: u32 = 18;

/// Whether tiles may be used. Nothing is asked of the system before the CPU is known to have all of it.
fn ask(machine: &impl Machine) -> Result<(), Refusal> {
    const OSXSAVE: u32 = 1 << 27;
    const TILES: u32 = 1 << 24;
    const PRODUCTS: u32 = 1 << 22 | 1 << 25; // bfloat16, int8
    const AVX512_VNNI: u32 = 1 << 11;
    const AVX512_BF16: u32 = 1 << 5;
    let [_, _, vectors, features] = machine.cpuid(7, 0);
    if features & TILES == 0 {
        return Err(Refusal::NotThere);
    }
    if features & PRODUCTS != PRODUCTS {
        return Err(Refusal::WithoutProducts);
    }
    if vectors & AVX512_VNNI == 0 || machine.cpuid(7, 1)[0] & AVX512_BF16 == 0 {
        return Err(Refusal::WithoutVectors);
    }
    // Palette 1: bytes in all tiles and in one, bytes in a row and tiles, rows.
    let [bytes, names, rows, _] = machine.cpuid(0x1d, 1);
    if (bytes, names, rows & 0xffff) != (1024 << 16 | 8192, 8 << 16 | 64, 16) {
        return Err(Refusal::OtherTiles);
    }
    if machine.cpuid(1, 0)[2] & OSXSAVE == 0 {
        return Err(Refusal::TurnedOff(0));
    }
    let (state, enabled) = (0b11 << (TILE_DATA - 1), machine.xcr0());
    if enabled & state != state {
        return Err(Refusal::TurnedOff(enabled));
    }
    machine.request().map_err(|error| match error {
        None => Refusal::NoRequest,
        Some(ENOSPC) => Refusal::SignalStack,
        Some(error) => Refusal::Refused(error),
    })?;
    if machine.permitted() & 1 << TILE_DATA == 0 {
        return Err(Refusal::NotGranted);
    }
    Ok(())
}

const ENOSPC: i32 = 28;

/// Whether this process may use tiles. Asked once: the answer holds for all threads, also for those that run
/// already, and for forked children. XCR0 shows the state without permission too, and the first instruction
/// on a tile would then be SIGILL.
pub(crate) fn permission() -> Result<(), Refusal> {
    static ANSWER: OnceBox<Result<(), Refusal>> = OnceBox::new();
    *ANSWER.get_or_init(|| {
        #[cfg(all(target_arch = "x86_64", not(saccade_portable)))]
        let answer = ask(&ThisMachine);
        #[cfg(not(all(target_arch = "x86_64", not(saccade_portable))))]
        let answer = Err(Refusal::NotThere);
        Box::new(answer)
    })
}

/// The CPU and the kernel below this process.
#[cfg(all(target_arch = "x86_64", not(saccade_portable)))]
struct ThisMachine;

#[cfg(all(target_arch = "x86_64", not(saccade_portable)))]
impl Machine for ThisMachine {
    fn cpuid(&self, leaf: u32, subleaf: u32) -> [u32; 4] {
        use std::arch::x86_64::{__cpuid, __cpuid_count};
        // Beyond the last leaf, some CPUs answer with that of another.
        if __cpuid(0).eax < leaf {
            return [0; 4];
        }
        let found = __cpuid_count(leaf, subleaf);
        [found.eax, found.ebx, found.ecx, found.edx]
    }

    fn xcr0(&self) -> u64 {
        let (low, high): (u32, u32);
        // SAFETY: XGETBV is there where OSXSAVE is set, after which alone this is called; it only reads.
        unsafe {
            std::arch::asm!(
                "xgetbv", in("ecx") 0, out("eax") low, out("edx") high, options(nomem, nostack, preserves_flags)
            );
        }
        u64::from(high) << 32 | u64::from(low)
    }

    #[cfg(target_os = "linux")]
    fn request(&self) -> Result<(), Option<i32>> {
        const ARCH_REQ_XCOMP_PERM: libc::c_long = 0x1023;
        // SAFETY: asks for a permission; nothing is passed by pointer.
        let failed = unsafe {
            libc::syscall(
                libc::SYS_arch_prctl,
                ARCH_REQ_XCOMP_PERM,
                libc::c_long::from(TILE_DATA),
            ) != 0
        };
        if failed {
            return Err(Some(std::io::Error::last_os_error().raw_os_error().unwrap_or(-1)));
        }
        Ok(())
    }

    #[cfg(not(target_os = "linux"))]
    fn request(&self) -> Result<(), Option<i32>> {
        Err(None)
    }

    #[cfg(target_os = "linux")]
    fn permitted(&self) -> u64 {
        const ARCH_GET_XCOMP_PERM: libc::c_long = 0x1022;
        let mut states = 0_u64;
        // SAFETY: the kernel writes one word, for which there is room.
        let failed =
            unsafe { libc::syscall(libc::SYS_arch_prctl, ARCH_GET_XCOMP_PERM, &raw mut states) != 0 };
        if failed { 0 } else { states }
    }

    #[cfg(not(target_os = "linux"))]
    fn permitted(&self) -> u64 {
        0
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use super::*;

    /// A machine that answers what it is told to.
    struct Told {
        osxsave: bool,
        features: u32,
        vnni: bool,
        bf16: bool,
        palette: [u32; 4],
        xcr0: u64,
        answer: Result<(), Option<i32>>,
        permitted: u64,
        asked: Cell<u32>,
    }

    impl Told {
        /// As a Sapphire Rapids under Linux 5.16 or later.
        fn sapphire_rapids() -> Self {
            Self {
                osxsave: true,
                features: 1 << 22 | 1 << 24 | 1 << 25,
                vnni: true,
                bf16: true,
                palette: [1024 << 16 | 8192, 8 << 16 | 64, 16, 0],
                xcr0: 0x602e7,
                answer: Ok(()),
                permitted: 0x602e7,
                asked: Cell::new(0),
            }
        }
    }

    impl Machine for Told {
        fn cpuid(&self, leaf: u32, subleaf: u32) -> [u32; 4] {
            match (leaf, subleaf) {
                (1, 0) => [0, 0, u32::from(self.osxsave) << 27, 0],
                (7, 0) => [1, 0, u32::from(self.vnni) << 11, self.features],
                (7, 1) => [u32::from(self.bf16) << 5, 0, 0, 0],
                (0x1d, 1) => self.palette,
                _ => [0; 4],
            }
        }

        fn xcr0(&self) -> u64 {
            assert!(self.osxsave, "XGETBV would be SIGILL");
            self.xcr0
        }

        fn request(&self) -> Result<(), Option<i32>> {
            self.asked.set(self.asked.get() + 1);
            self.answer
        }

        fn permitted(&self) -> u64 {
            self.permitted
        }
    }

    #[test]
    fn a_machine_with_everything_is_asked_once() {
        let machine = Told::sapphire_rapids();
        assert_eq!(ask(&machine), Ok(()));
        assert_eq!(machine.asked.get(), 1);
    }

    /// A request can fail a later `sigaltstack` of the program: where tiles cannot be used anyway there is
    /// none.
    #[test]
    fn nothing_is_asked_of_the_system_without_the_whole_of_amx() {
        type Change = fn(&mut Told);
        let lacking: [(Change, Refusal); 11] = [
            (|told| told.features = 0, Refusal::NotThere),
            // The products are named, the tiles are masked.
            (|told| told.features = 1 << 22 | 1 << 25, Refusal::NotThere),
            (|told| told.features = 1 << 24, Refusal::WithoutProducts),
            (|told| told.features = 1 << 24 | 1 << 22, Refusal::WithoutProducts),
            (|told| told.vnni = false, Refusal::WithoutVectors),
            (|told| told.bf16 = false, Refusal::WithoutVectors),
            (|told| told.palette = [0; 4], Refusal::OtherTiles),
            (|told| told.palette[2] = 32, Refusal::OtherTiles),
            (|told| told.osxsave = false, Refusal::TurnedOff(0)),
            // A hypervisor that passes the features through and not the state; half of the state.
            (|told| told.xcr0 = 0x2e7, Refusal::TurnedOff(0x2e7)),
            (|told| told.xcr0 = 0x202e7, Refusal::TurnedOff(0x202e7)),
        ];
        for (change, expected) in lacking {
            let mut machine = Told::sapphire_rapids();
            change(&mut machine);
            assert_eq!(ask(&machine), Err(expected));
            assert_eq!(machine.asked.get(), 0, "{expected}");
        }
    }

    #[test]
    fn what_the_kernel_says_is_believed_only_if_it_is_no() {
        let complete = Told::sapphire_rapids;
        let (einval, eperm) = (22, 1);
        for (answer, expected, words) in [
            (Err(None), Refusal::NoRequest, "lets no process"),
            (Err(Some(ENOSPC)), Refusal::SignalStack, "signal stack"),
            // Linux before 5.16; seccomp.
            (Err(Some(einval)), Refusal::Refused(einval), "error 22"),
            (Err(Some(eperm)), Refusal::Refused(eperm), "error 1"),
        ] {
            assert_eq!(ask(&Told { answer, ..complete() }), Err(expected));
            assert!(expected.to_string().contains(words), "{expected}");
        }
        // seccomp with an error number of 0: every call succeeds and none does anything.
        let machine = Told {
            permitted: 0,
            ..complete()
        };
        assert_eq!(ask(&machine), Err(Refusal::NotGranted));
    }

    #[test]
    fn this_machine_answers_the_same_again() {
        let first = permission();
        let again = std::thread::spawn(permission).join().unwrap();
        assert_eq!(first, again);
    }
}
