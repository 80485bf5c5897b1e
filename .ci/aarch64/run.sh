#!/usr/bin/env bash
# Tests saccade for 64-bit ARM on emulated CPUs, on a Debian x86-64 machine, with Debian's packages and PyPI only.
#
#   .ci/aarch64/run.sh setup      compiler, emulator and an ARM Python in target/aarch64 (about 500 MB)
#   .ci/aarch64/run.sh rust       the Rust tests on each of $CPUS
#   .ci/aarch64/run.sh python     the Python tests that need NumPy alone, on each of $CPUS
#   .ci/aarch64/run.sh loops      the inner loops of the kernels, judged by llvm-mca, as a table in Markdown
#   .ci/aarch64/run.sh instructions   instructions a multiply-add of whole linear layers, counted by the emulator
#   .ci/aarch64/run.sh lint       clippy of the Rust crates; a warning is an error
#   .ci/aarch64/run.sh check      that three crates compile for macOS (ARM) and Windows (x86-64), with sources of the standard library
#   .ci/aarch64/run.sh compiler   only the compiler, and sources of the standard library, for other targets
#   .ci/aarch64/run.sh test       setup, rust and python
#
# CPUS are names of qemu, separated by spaces (default: max). Nothing that is installed is replaced: the compiler is
# unpacked, not installed, and cargo is told to use it.
set -euo pipefail
cd "$(dirname "$0")/../.."
HERE=$PWD
WORK=$HERE/target/aarch64
TARGET=aarch64-unknown-linux-gnu
RUST=$WORK/rust/usr
ROOT=$WORK/root
CPUS=${CPUS:-max}
export DEBIAN_FRONTEND=noninteractive CARGO_INCREMENTAL=0
# The emulator passes no limits of memory on to the system, and more than a test may be started beside each other only
# where there are processors for it.
SKIPPED=(--skip without_memory --skip cannot_be_started --skip cannot_be_had)

fail() {
    echo "aarch64: $1" >&2
    exit 1
}

packages() {
    local missing=()
    for package in "$@"; do
        dpkg-query --show --showformat '${Status}\n' "$package" 2>/dev/null | grep -q '^install ok' || missing+=("$package")
    done
    [ ${#missing[@]} = 0 ] && return
    [ "$(id -u)" = 0 ] || fail "not installed: ${missing[*]}. Only root can install them: apt-get install ${missing[*]}"
    apt-get update -qq
    apt-get install -qq --no-install-recommends "${missing[@]}" >/dev/null
}

setup() {
    command -v apt-get >/dev/null && [ "$(dpkg --print-architecture)" = amd64 ] ||
        fail "needs Debian on x86-64: the compiler's ARM standard library and the ARM Python are its packages"
    command -v cargo >/dev/null || fail "needs cargo; no cargo was found on PATH"
    packages gcc-aarch64-linux-gnu libc6-dev-arm64-cross qemu-user-static mmdebstrap python3-venv
    compiler
    python
}

# Debian's own Rust, which it keeps up to date for browsers: the compiler and standard libraries of both architectures.
compiler() {
    if [ ! -e "$WORK/rust/done" ]; then
        local others std llvm
        rm -rf "$WORK/rust" "$WORK/debs"
        mkdir -p "$WORK/rust" "$WORK/debs"
        others=$(dpkg --print-foreign-architectures)
        if ! grep -qx arm64 <<<"$others"; then
            [ "$(id -u)" = 0 ] || fail "only root can add the architecture arm64: dpkg --add-architecture arm64"
            dpkg --add-architecture arm64
            trap 'dpkg --remove-architecture arm64' EXIT
        fi
        apt-get update -qq
        std=$(apt-cache depends libstd-rust-web-dev | sed -n 's/.*Depends: \(libstd-rust-web-[0-9.]*\)$/\1/p' | head -1)
        [ -n "$std" ] || fail "this Debian has no package libstd-rust-web-dev"
        llvm=$(apt-cache depends "$std" | sed -n 's/.*Depends: \(libllvm[0-9]*\)$/\1/p' | head -1)
        (cd "$WORK/debs" && apt-get download -qq rustc-web "$std" "$llvm" libstd-rust-web-dev libstd-rust-web-dev:arm64 2>/dev/null)
        for deb in "$WORK"/debs/*.deb; do dpkg-deb --extract "$deb" "$WORK/rust"; done
        rm -r "$WORK/debs"
        if ! grep -qx arm64 <<<"$others"; then
            trap - EXIT
            dpkg --remove-architecture arm64
            apt-get update -qq
        fi
        touch "$WORK/rust/done"
    fi
    local libraries=$RUST/lib/x86_64-linux-gnu
    mkdir -p "$WORK/bin"
    for tool in rustc rustdoc; do
        printf '#!/bin/sh\nLD_LIBRARY_PATH=%s${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH} exec %s "$@"\n' \
            "$libraries" "$RUST/bin/$tool" >"$WORK/bin/$tool"
        chmod +x "$WORK/bin/$tool"
    done
    "$WORK/bin/rustc" --version || fail "Debian's rustc does not run: $(LD_LIBRARY_PATH=$libraries ldd "$RUST/bin/rustc" | grep 'not found')"
}

# Debian's ARM Python is unpacked, not set up, so no ARM program has to run meanwhile. pip of this machine fetches the
# packages for it; NumPy's wheel loads the system's C++ library.
python() {
    [ -e "$WORK/python.done" ] && [ -e "$ROOT/usr/lib/aarch64-linux-gnu/libstdc++.so.6" ] && return
    rm -rf "$ROOT" "$WORK/venv" "$WORK/packages"
    # shellcheck source=/dev/null
    (. /etc/os-release && sources | mmdebstrap --quiet --variant=extract --arch=arm64 --include=python3,libstdc++6 "$VERSION_CODENAME" "$ROOT" -)
    python3 -m venv "$WORK/venv"
    # NumPy apart from what only tests need: a wheel is tested with it alone.
    arm_pip "$(arm_site)" "numpy>=2"
    arm_pip "$WORK/packages" pytest hypothesis safetensors rich
    touch "$WORK/python.done"
}

# Where this machine gets its packages from.
sources() {
    local keys=/usr/share/keyrings/debian-archive-keyring.gpg
    if [ -e /etc/apt/sources.list.d/debian.sources ]; then
        awk -v keys=$keys '/^URIs:/{u=$2} /^Suites:/{for(i=2;i<=NF;i++) print "deb [signed-by=" keys "]", u, $i, "main"}' \
            /etc/apt/sources.list.d/debian.sources
    else
        grep '^deb ' /etc/apt/sources.list
    fi
}

arm_python() {
    basename "$(ls "$ROOT"/usr/bin/python3.[0-9]* | grep -v config | head -1)"
}

# Where that Python looks for packages.
arm_site() {
    echo "$ROOT/usr/local/lib/$(arm_python)/dist-packages"
}

arm_pip() {
    local version tag
    version=$(arm_python)
    local platforms=()
    for tag in manylinux_2_17 manylinux2014 manylinux_2_28; do platforms+=(--platform "${tag}_aarch64"); done
    "$WORK/venv/bin/pip" install --quiet --disable-pip-version-check --upgrade --target "$1" --implementation cp \
        --python-version "${version#python}" --only-binary :all: "${platforms[@]}" "${@:2}"
}

# cargo stays what it is; only the compiler is another.
cross() {
    [ -x "$WORK/bin/rustc" ] || fail "nothing is set up: .ci/aarch64/run.sh setup"
    export RUSTC="$WORK/bin/rustc" RUSTDOC="$WORK/bin/rustdoc" CARGO_TARGET_DIR="$WORK/target"
    export CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_LINKER=aarch64-linux-gnu-gcc
    export CARGO_TARGET_AARCH64_UNKNOWN_LINUX_GNU_RUNNER="qemu-aarch64-static -cpu ${1:-max} -L /usr/aarch64-linux-gnu"
    # The longest tests then compute fewer cases.
    export SACCADE_TEST_EMULATED=1
    # No symbols for debuggers, and little optimisation of what tests only compare with: less to compile.
    export CARGO_PROFILE_DEV_DEBUG=0
    LEAST=(--config 'profile.dev.package."*".opt-level=1')
}

rust() (
    for cpu in $CPUS; do
        echo "aarch64: Rust tests on $cpu"
        cross "$cpu"
        cargo test --locked --quiet "${LEAST[@]}" --target $TARGET --no-fail-fast \
            -p saccade-vla-kernels -p saccade-vla-checkpoint -p saccade-vla --lib --tests -- "${SKIPPED[@]}"
    done
)

extension() (
    cross
    # An extension finds the symbols of Python in the program that loads it.
    PYO3_NO_PYTHON=1 cargo build --locked --quiet "${LEAST[@]}" --target $TARGET -p saccade-python --features pyo3/extension-module
    rm -rf "$WORK/site"
    mkdir -p "$WORK/site"
    git ls-files python/saccade | tar --create --files-from - | tar --extract --directory "$WORK/site" --strip-components 1
    cp "$WORK/target/$TARGET/debug/lib_saccade.so" "$WORK/site/saccade/_saccade.abi3.so"
)

arm() {
    local cpu=$1
    shift
    PYTHONPATH="$WORK/site:$WORK/packages:$HERE" PYTHONDONTWRITEBYTECODE=1 \
        qemu-aarch64-static -cpu "$cpu" -L "$ROOT" "$ROOT/usr/bin/$(arm_python)" "$@"
}

run_python() {
    extension
    for cpu in $CPUS; do
        echo "aarch64: Python tests on $cpu"
        arm "$cpu" -c 'import saccade; saccade.show_config()'
        # The emulator starts no other program, which one test of test_threads does.
        arm "$cpu" -m pytest -p no:cacheprovider -q tests/package/test_numpy_alone.py tests/package/test_binding.py tests/head/test_threads.py \
            --deselect tests/head/test_threads.py::test_the_default_counts_only_processors_that_may_be_used
    done
}

loops() (
    cross
    packages llvm-19
    CARGO_PROFILE_RELEASE_LTO=false cargo rustc --locked --quiet --release --target $TARGET -p saccade-vla-kernels --lib -- \
        --emit asm -C codegen-units=1
    python3 .ci/aarch64/loops.py "$(ls -t "$WORK/target/$TARGET"/release/deps/saccade_vla_kernels-*.s | head -1)"
)

# The emulator writes a line for every instruction. Two numbers of calls: packing and starting count in neither.
instructions() (
    cross
    CARGO_PROFILE_RELEASE_LTO=false cargo build --locked --quiet --release --target $TARGET -p saccade-vla-kernels --example linear_calls
    local program=$WORK/target/$TARGET/release/examples/linear_calls rows=49 inputs=512 outputs=96
    count() {
        SACCADE_ISA=$1 qemu-aarch64-static -cpu max -L /usr/aarch64-linux-gnu -singlestep -d nochain,exec -D /dev/stdout \
            "$program" "$2" $rows $inputs $outputs "$3" | grep -c '^Trace'
    }
    echo "| instructions a multiply-add, $rows x $inputs x $outputs | float32 | bfloat16 | int8 |"
    echo "|---|---|---|---|"
    for isa in portable neon dotprod i8mm bf16; do
        local row="| \`$isa\` |" few many
        for arithmetic in float32 bfloat16 int8; do
            few=$(count "$isa" "$arithmetic" 1)
            many=$(count "$isa" "$arithmetic" 2)
            row+=" $(python3 -c "print(f'{($many - $few) / ($rows * $inputs * $outputs):.3f}')") |"
        done
        echo "$row"
    done
)

# Unpacks a package of Debian's Rust beside the compiler, unless what it brings is there.
unpack() {
    [ -e "$RUST/$2" ] && return
    mkdir -p "$WORK/debs"
    (cd "$WORK/debs" && apt-get download -qq "$1" 2>/dev/null) || fail "this Debian has no package $1"
    dpkg-deb --extract "$WORK/debs/$1"*.deb "$WORK/rust"
    rm -r "$WORK/debs"
}

# Clippy of the same version as the compiler. It finds the standard library by SYSROOT.
lint() (
    cross
    unpack rust-web-clippy bin/cargo-clippy
    SYSROOT=$RUST LD_LIBRARY_PATH=$RUST/lib/x86_64-linux-gnu "$RUST/bin/cargo-clippy" clippy --locked --quiet "${LEAST[@]}" \
        --target $TARGET -p saccade-vla-kernels -p saccade-vla-checkpoint -p saccade-vla --all-targets -- --deny warnings
)

check() (
    cross
    # Debian has no standard library for them, but its sources, which are checked too.
    unpack rust-web-src lib/rustlib/src/rust/library
    export RUSTC_BOOTSTRAP=1
    for target in aarch64-apple-darwin x86_64-pc-windows-msvc; do
        echo "aarch64: checking for $target"
        RUSTFLAGS="--deny warnings" cargo check --locked --quiet -Zbuild-std=std,panic_abort --target $target \
            -p saccade-vla-kernels -p saccade-vla-checkpoint -p saccade-vla --lib
    done
)

case ${1:-} in
setup) setup ;;
rust) rust ;;
python) run_python ;;
loops) loops ;;
instructions) instructions ;;
lint) lint ;;
check) check ;;
compiler) compiler && unpack rust-web-src lib/rustlib/src/rust/library ;;
test) setup && rust && run_python ;;
*)
    sed -n '2,/^[^#]/s/^# \{0,1\}//p' "$0"
    exit 2
    ;;
esac
