#!/usr/bin/env bash
# Tests of the kernels, the only crate with unsafe code, under tools that see what tests do not.
#
#   .ci/sanitize.sh            address and valgrind
#   .ci/sanitize.sh address    AddressSanitizer, on every instruction set of this CPU; needs a nightly Rust
#   .ci/sanitize.sh valgrind   valgrind, which emulates a CPU without AVX-512: the portable and AVX2 paths, and tiles in software
#   .ci/sanitize.sh portable   no tool: without intrinsics and system calls (--cfg saccade_portable), as Miri runs them
#   .ci/sanitize.sh miri       the same tests of the library under Miri; needs a nightly Rust with Miri
set -euo pipefail
cd "$(dirname "$0")/.."

# Tests that take too long in valgrind's emulation are left out; `narrow` takes a minute and a half.
VALGRIND_TESTS="attention key_values layer_norm linear linear_shapes masks narrow narrow_weights outliers rms_norm rotary_embedding"
# AddressSanitizer reports running out of memory as an error. Under it a test may run for more than a minute; the test
# runner then prints a warning, which allocates, so the test that counts allocations is skipped too.
ASAN_SKIPPED="allocates_nothing without_memory cannot_be_had cannot_be_started"

fail() {
    echo "sanitize: $1" >&2
    exit 1
}

# In a target folder of its own, because dependencies are instrumented too.
address() (
    cargo +nightly --version >/dev/null 2>&1 || fail "needs a nightly Rust: rustup toolchain install nightly"
    export RUSTFLAGS="-Zsanitizer=address"
    cargo +nightly test --locked --quiet --package saccade-vla-kernels --lib --tests --target x86_64-unknown-linux-gnu \
        --target-dir target/sanitize -- $(printf -- '--skip %s ' $ASAN_SKIPPED)
)

# It is slow, so the tests that compare many sizes with float64 are skipped.
valgrind() (
    type -P valgrind >/dev/null || fail "valgrind is not installed; install the package valgrind"
    export CARGO_TARGET_X86_64_UNKNOWN_LINUX_GNU_RUNNER="valgrind --quiet --error-exitcode=1"
    cargo test --locked --quiet --package saccade-vla-kernels $(printf -- '--test %s ' $VALGRIND_TESTS) -- \
        --test-threads 1 --skip float64
)

# In a target folder of its own, because the flag concerns every crate. The longest tests compute fewer cases.
portable() (
    export RUSTFLAGS="--cfg saccade_portable --deny warnings" SACCADE_TEST_EMULATED=1
    cargo test --locked --quiet --package saccade-vla-kernels --lib --tests --target-dir target/portable
)

# Without isolation, because tests read environment variables and clocks. The threads of the pool never end, which Miri takes
# for a leak.
miri() (
    cargo +nightly miri --version >/dev/null 2>&1 || fail "needs Miri: rustup toolchain install nightly --component miri"
    export RUSTFLAGS="--cfg saccade_portable" MIRIFLAGS="-Zmiri-disable-isolation -Zmiri-ignore-leaks"
    cargo +nightly miri test --locked --package saccade-vla-kernels --lib --target-dir target/miri
)

case ${1:-} in
'')
    address
    valgrind
    ;;
address | valgrind | portable | miri) "$1" ;;
*)
    sed -n '2,/^[^#]/s/^# \{0,1\}//p' "$0"
    exit 2
    ;;
esac
