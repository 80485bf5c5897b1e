#!/usr/bin/env bash
# The tests of accelerate() and of the plugin on the newest lerobot that the package index has, which no requirements name. A
# failure says that lerobot changed, not that saccade is broken: `make test-compat` tests what is supported.
#
#   .ci/newest_lerobot.sh [PYTHON]     a Python that lerobot supports (default: python3.12)
set -euo pipefail
cd "$(dirname "$0")/.."

folder=out/newest-lerobot
known=$(ls tests/compat/lerobot-*.txt | sort --version-sort | tail -1)
"${1:-python3.12}" -m venv --clear "$folder"
pip=("$folder/bin/python" -m pip --disable-pip-version-check --no-input install --quiet)
# What the newest known release needs, then what the newest one says it needs instead.
"${pip[@]}" --no-deps --requirement "$known"
"${pip[@]}" --no-deps --requirement requirements/core.txt
"${pip[@]}" --upgrade lerobot
# Without build isolation maturin's hook calls the program `maturin`.
PATH="$PWD/$folder/bin:$PATH" "${pip[@]}" --no-deps --no-build-isolation . ./lab ./plugins/lerobot
"$folder/bin/python" -m pip list | grep -i '^lerobot '
exec env OMP_NUM_THREADS=1 "$folder/bin/python" -m pytest tests/compat/policies.py tests/compat/plugin.py
