#!/usr/bin/env bash
# Tests the kernels on 32-bit x86, where products of sizes wrap that 64 bits hold. Vectors are the portable ones. On a
# Debian x86-64 machine, which runs the tests itself, with Debian's packages only.
#
#   .ci/i686/run.sh setup   compiler and sources of its standard library in target/aarch64, a linker for 32 bits
#   .ci/i686/run.sh check   that the crate and its tests compile
#   .ci/i686/run.sh test    the tests
#   .ci/i686/run.sh all     setup, check and test
#
# The first check and the first test compile the standard library, because Debian's Rust has none for 32 bits.
set -euo pipefail
cd "$(dirname "$0")/../.."
RUST=$PWD/target/aarch64/bin
TARGET=i686-unknown-linux-gnu
LIBRARIES=/usr/i686-linux-gnu/lib

fail() {
    echo "i686: $1" >&2
    exit 1
}

setup() {
    .ci/aarch64/run.sh compiler
    command -v i686-linux-gnu-gcc >/dev/null && [ -e $LIBRARIES/ld-linux.so.2 ] && return
    [ "$(id -u)" = 0 ] || fail "only root can install packages: apt-get install gcc-i686-linux-gnu libc6-dev-i386-cross"
    apt-get update -qq
    DEBIAN_FRONTEND=noninteractive apt-get install -qq --no-install-recommends gcc-i686-linux-gnu libc6-dev-i386-cross >/dev/null
}

# With Debian's compiler, by a cargo that is told to build the standard library.
kernels() (
    [ -x "$RUST/rustc" ] || fail "nothing is set up: .ci/i686/run.sh setup"
    export RUSTC="$RUST/rustc" RUSTDOC="$RUST/rustdoc" RUSTC_BOOTSTRAP=1 CARGO_TARGET_DIR="$PWD/target/i686"
    export CARGO_INCREMENTAL=0 CARGO_PROFILE_DEV_DEBUG=0
    export CARGO_TARGET_I686_UNKNOWN_LINUX_GNU_LINKER=i686-linux-gnu-gcc
    export RUSTFLAGS="--deny warnings -Clink-arg=-Wl,--dynamic-linker=$LIBRARIES/ld-linux.so.2 -Clink-arg=-Wl,-rpath,$LIBRARIES"
    # The longest tests then compute fewer cases.
    export SACCADE_TEST_EMULATED=1
    cargo "$@" --locked --quiet --config 'profile.dev.package."*".opt-level=1' -Zbuild-std --target $TARGET \
        -p saccade-vla-kernels --lib --tests
)

case ${1:-} in
setup) setup ;;
check) kernels check ;;
test) kernels test --no-fail-fast ;;
all) setup && kernels check && kernels test --no-fail-fast ;;
*)
    sed -n '2,/^[^#]/s/^# \{0,1\}//p' "$0"
    exit 2
    ;;
esac
