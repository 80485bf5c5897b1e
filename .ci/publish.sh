#!/usr/bin/env bash
# Uploads the library crates, each after those that it needs. Leaves out those whose version the index has: after a release that
# stopped half-way it uploads the others.
#
#   .ci/publish.sh [OPTIONS OF cargo publish]
set -euo pipefail
cd "$(dirname "$0")/.."

version=$(python3 .ci/version.py)
empty=$(mktemp -d)
trap 'rmdir "$empty"' EXIT
missing=()
for crate in saccade-vla-kernels saccade-vla-checkpoint saccade-vla; do
    # In an empty folder: here, cargo would describe the crate of this workspace. If the index cannot be asked, cargo publish
    # fails, too, and says why.
    if (cd "$empty" && cargo info --quiet --registry crates-io "$crate@$version" >/dev/null 2>&1); then
        echo "publish: $crate $version is there"
    else
        missing+=(--package "$crate")
    fi
done
[ ${#missing[@]} -eq 0 ] || cargo publish --locked "${missing[@]}" "$@"
