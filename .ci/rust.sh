#!/usr/bin/env bash
# Installs toolchains of Rust with rustup, for machines that are new at every run.
#
#   .ci/rust.sh newest         the newest stable one, the default from then on
#   .ci/rust.sh declared       also the one that Cargo.toml declares, for .ci/oldest_rust.sh
#   .ci/rust.sh nightly        also the newest nightly one, with Miri and the sources of the standard library
#   .ci/rust.sh TARGET         the standard library of a target, for the default toolchain
set -euo pipefail
cd "$(dirname "$0")/.."

[ $# -gt 0 ] || { sed -n '2,/^[^#]/s/^# \{0,1\}//p' "$0"; exit 2; }
for wanted in "$@"; do
    case $wanted in
    newest)
        rustup toolchain install stable --profile minimal --component rustfmt,clippy --no-self-update
        rustup default stable
        ;;
    declared)
        oldest=$(sed -n 's/^rust-version = "\([0-9]*\.[0-9]*\)"$/\1/p' Cargo.toml)
        rustup toolchain install "$oldest.0" --profile minimal --no-self-update
        ;;
    nightly) rustup toolchain install nightly --profile minimal --component miri,rust-src --no-self-update ;;
    *-*-*) rustup target add "$wanted" ;;
    *)
        echo ".ci/rust.sh: expected newest, declared, nightly or a target, got $wanted" >&2
        exit 2
        ;;
    esac
done
