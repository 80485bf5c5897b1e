#!/usr/bin/env bash
# Builds with the oldest Rust that Cargo.toml declares, by `cargo +1.95.0`; where cargo is of this version, everything else does.
# Downloads nothing. Where neither is installed, this fails and says what to install.
set -euo pipefail
cd "$(dirname "$0")/.."
export RUSTUP_AUTO_INSTALL=0

oldest=$(sed -n 's/^rust-version = "\([0-9]*\.[0-9]*\)"$/\1/p' Cargo.toml)
[ -n "$oldest" ] || { echo "Cargo.toml: expected a rust-version of two numbers, such as \"1.95\"" >&2; exit 1; }

# Whether a cargo is there and of that version: a toolchain may have any name.
is_oldest() {
    [[ $("$@" --version 2>/dev/null) == "cargo $oldest."* ]]
}

if is_oldest cargo; then
    # Everything else is built with it.
    echo ".ci/oldest_rust.sh: cargo is the oldest, $(cargo --version)"
    exit
fi
is_oldest cargo "+$oldest.0" || {
    echo "the declared Rust $oldest is not installed, so nothing shows that it compiles the code:" \
        "rustup toolchain install $oldest.0 --profile minimal" >&2
    exit 1
}
echo ".ci/oldest_rust.sh: cargo +$oldest.0 build, $(cargo "+$oldest.0" --version)"
# All four crates, linked as in a wheel: without this feature the binding needs a library of Python.
exec cargo "+$oldest.0" build --locked --quiet -p saccade-python --features pyo3/extension-module
