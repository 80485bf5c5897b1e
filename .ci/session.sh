#!/usr/bin/env bash
# Runs sessions of nox on any system: `make NAME` without make, which Windows has not.
#
#   .ci/session.sh NAME...
set -euo pipefail
cd "$(dirname "$0")/.."

python=$(command -v python3 || command -v python)
[ "${OS:-}" = Windows_NT ] && bin=Scripts || bin=bin
[ -x ".venv/$bin/python" ] || [ -x ".venv/$bin/python.exe" ] || "$python" -m venv .venv
".venv/$bin/python" -m pip --disable-pip-version-check --no-input install --quiet --no-deps --requirement requirements/nox.txt
exec ".venv/$bin/python" -m nox --session "$@"
