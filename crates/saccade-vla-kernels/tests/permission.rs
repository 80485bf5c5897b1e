//! AMX in processes that may not use it, and in threads and children of those that may: the next best instruction set, and never an illegal
//! instruction. Without AMX the same runs show that asking for it harms nothing.
#![cfg(all(target_os = "linux", not(saccade_portable)))]

mod common;

use std::io::Write;
use std::ptr;
use std::sync::mpsc;

use common::{bits, numbers, rows, rows_mut};
use saccade_vla_kernels::{
    Arithmetic, CpuReport, Epilogue, Isa, LinearScratch, Matrix, PackedLinear, WeightRef,
};

/// A layer of int8: the same bits with AMX as in software.
fn layer(isa: Isa) -> Vec<f32> {
    let weight = numbers(1, 70 * 100, 0.5);
    let weight = WeightRef::F32(Matrix::new(&weight, 100));
    let layer = PackedLinear::pack(isa, Arithmetic::Int8, 1, &[(weight, None)]).unwrap();
    let (x, mut out) = (numbers(2, 9 * 100, 1.0), vec![0.0; 9 * 70]);
    let scratch = &mut LinearScratch::new();
    let (x, to) = (rows(&x, 100), rows_mut(&mut out, 70));
    layer.apply(1, x, Epilogue::Store, to, scratch).unwrap();
    out
}

/// That the best instruction set of this process computes: the bits of software, or nearly its numbers where inputs have 7 bits.
fn best_computes() -> bool {
    let (found, expected) = (layer(Isa::best()), layer(Isa::SoftwareTiles));
    match Isa::best() {
        Isa::Avx2 | Isa::Avx512f => found.iter().zip(&expected).all(|(a, b)| (a - b).abs() < 0.1),
        _ => bits(&found) == bits(&expected),
    }
}

/// Runs `body` in a child of this process, which has asked for nothing yet. Returns what it says of tiles.
fn child(body: impl FnOnce() -> Result<String, String>) -> String {
    let mut ends = [0; 2];
    // SAFETY: the child does not return to the test runner; it uses memory and one thread, as Linux and glibc allow after a fork of a thread
    // that holds no lock of theirs.
    unsafe {
        assert_eq!(libc::pipe(ends.as_mut_ptr()), 0);
        match libc::fork() {
            0 => {
                let said = body();
                let (text, status) = match &said {
                    Ok(text) => (text, 0),
                    Err(text) => (text, 1),
                };
                libc::write(ends[1], text.as_ptr().cast(), text.len());
                libc::_exit(status);
            }
            pid => {
                libc::close(ends[1]);
                let (mut said, mut status) = (vec![0; 4096], 0);
                let len = libc::read(ends[0], said.as_mut_ptr().cast(), said.len());
                libc::close(ends[0]);
                libc::waitpid(pid, &raw mut status, 0);
                said.truncate(usize::try_from(len).unwrap_or(0));
                let said = String::from_utf8(said).unwrap();
                assert!(
                    libc::WIFEXITED(status) && libc::WEXITSTATUS(status) == 0,
                    "status {status:#x}: {said}"
                );
                said
            }
        }
    }
}

/// What tiles are said to be, once the best instruction set has computed something.
fn tiles() -> Result<String, String> {
    let said = CpuReport::current().tiles;
    let is_chosen = Isa::best() == Isa::Amx;
    match (best_computes(), (said == "yes") == is_chosen) {
        (true, true) => Ok(said),
        (false, _) => Err(format!("{} computes something else", Isa::best())),
        (_, false) => Err(format!("tiles: {said}, but {} is the best", Isa::best())),
    }
}

fn with_small_signal_stack() -> Result<String, String> {
    let mut memory = vec![0_u8; 8192];
    let stack = libc::stack_t {
        ss_sp: memory.as_mut_ptr().cast(),
        ss_flags: 0,
        ss_size: memory.len(),
    };
    // SAFETY: the memory outlives this thread, on which no signal is handled meanwhile.
    if unsafe { libc::sigaltstack(&raw const stack, ptr::null_mut()) } != 0 {
        return Err("the small signal stack was refused".to_owned());
    }
    let said = tiles();
    std::mem::forget(memory);
    said
}

/// Forbids `arch_prctl` with this error number; 0 lets it seem to succeed.
fn with_seccomp(error: u32) -> Result<String, String> {
    const LOAD: u16 = (libc::BPF_LD | libc::BPF_W | libc::BPF_ABS) as u16;
    const EQUAL: u16 = (libc::BPF_JMP | libc::BPF_JEQ | libc::BPF_K) as u16;
    const RETURN: u16 = (libc::BPF_RET | libc::BPF_K) as u16;
    let step = |code, jt, jf, k| libc::sock_filter { code, jt, jf, k };
    let mut filter = [
        step(LOAD, 0, 0, 0),    // the number of the system call
        step(EQUAL, 0, 1, 158), // arch_prctl
        step(RETURN, 0, 0, libc::SECCOMP_RET_ERRNO | error),
        step(RETURN, 0, 0, libc::SECCOMP_RET_ALLOW),
    ];
    let program = libc::sock_fprog {
        len: filter.len() as u16,
        filter: filter.as_mut_ptr(),
    };
    // SAFETY: the program is read by the kernel during the call.
    let failed = unsafe {
        libc::prctl(libc::PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0) != 0
            || libc::prctl(
                libc::PR_SET_SECCOMP,
                libc::SECCOMP_MODE_FILTER,
                &raw const program,
            ) != 0
    };
    if failed {
        // Where a sandbox forbids it there is nothing to see.
        let _ = writeln!(std::io::stderr(), "SKIPPED: no seccomp here");
    }
    tiles()
}

/// A thread that was there before, one that comes after, and a child: all may do what the process may.
fn with_threads_and_children() -> Result<String, String> {
    let (ask, asked) = mpsc::channel::<()>();
    std::thread::scope(move |scope| {
        let early = scope.spawn(move || asked.recv().is_ok() && best_computes());
        let said = tiles()?;
        ask.send(()).expect("the thread is there");
        let late = scope.spawn(best_computes);
        if !early.join().expect("it ends") || !late.join().expect("it ends") {
            return Err("a thread computes something else".to_owned());
        }
        let inherited = child(tiles);
        if inherited == said {
            Ok(said)
        } else {
            Err(format!("{said} here, {inherited} in a child"))
        }
    })
}

/// One test in this file, so that nothing else asks for AMX in this process.
#[test]
fn the_best_instruction_set_computes_whatever_the_system_permits() {
    let permitted = child(tiles);
    assert_eq!(child(with_threads_and_children), permitted);
    let small = child(with_small_signal_stack);
    let forbidden = child(|| with_seccomp(libc::EPERM as u32));
    let faked = child(|| with_seccomp(0));
    if permitted == "yes" {
        assert!(small.contains("signal stack"), "{small}");
        assert!(forbidden.contains("error 1") || forbidden == "yes", "{forbidden}");
        assert!(faked.contains("does not list") || faked == "yes", "{faked}");
    } else {
        let _ = writeln!(
            std::io::stderr(),
            "SKIPPED: what AMX does under seccomp: {permitted}"
        );
        assert_eq!([&small, &forbidden, &faked], [&permitted; 3]);
    }
}
