# make rollout   run the bundled policy in simulation; table and videos in out/rollout
# make test      run all tests, Rust and Python             (PYTEST_ARGS="-k NAME")
# make lint      formatting, clippy, rustdoc, ruff, mypy, stubs
# make format    format all Rust and Python files
# make docs      the documentation site, in out/site/html
# make bench     measure kernels and head beside other implementations, with cargo bench
# make help      the other tasks
#
# Each is a session of nox in noxfile.py. The first one installs nox in .venv; nothing else needs to be there but Python
# and Rust. Options of a task: make bench-peers ARGS="--only policy", or the variables below.

PYTHON ?= python3
VENV := .venv
ROLLOUT_OUT ?= out/rollout
ROLLOUT_ARGS ?= --episodes 3 --video

SESSIONS := rollout test lint format docs workflows bench package setup core test-rust test-python test-compat test-clients test-ray test-libero \
	test-aarch64 test-i686 bench-peers rounding sanitize portable loom fuzz wheel metadata test-wheel demo-policy pictures lock

.DEFAULT_GOAL := help
MAKEFLAGS += --no-print-directory
.PHONY: help clean test-aarch64-all $(SESSIONS)

rollout: ARGS = $(ROLLOUT_ARGS) --out $(ROLLOUT_OUT)
test test-python core: ARGS = $(PYTEST_ARGS)
bench-peers: ARGS = $(PEERS_ARGS)
test-compat: ARGS = $(COMPAT_ARGS)
test-clients: ARGS = $(CLIENTS_ARGS)
test-ray: ARGS = $(RAY_ARGS)
test-libero: ARGS = $(LIBERO_ARGS)
wheel: ARGS = $(WHEEL_ARGS)
fuzz: ARGS = $(FUZZ_SECONDS)
demo-policy: ARGS = $(DEMO_OUT)
pictures: ARGS = $(PICTURES_OUT)
export VLA_SOURCE WHEEL_TARGETS

$(SESSIONS): $(VENV)/.nox
	@$(VENV)/bin/python -m nox --session $@ -- $(ARGS)

# On CPUs that differ in what they have. docs/cpus.md says more.
test-aarch64-all: $(VENV)/.nox
	@$(VENV)/bin/python -m nox --session test-aarch64 -- max,sve=off neoverse-n1 cortex-a72 max

help:
	@sed -n '/^$$/q;s/^# \{0,1\}//p' Makefile
	@test ! -e $(VENV)/.nox || $(VENV)/bin/python -m nox --list

# An environment that was copied or moved points to its old place, so it is created again.
PREFIX := $(shell $(VENV)/bin/python -c 'import sys; print(sys.prefix)' 2>/dev/null)
ifneq ($(PREFIX),$(CURDIR)/$(VENV))
.PHONY: $(VENV)/.nox
endif

$(VENV)/.nox: requirements/nox.txt
	@$(PYTHON) .ci/needs.py python
	@echo "setup: nox in $(VENV)"
	@test "$(PREFIX)" = "$(CURDIR)/$(VENV)" || $(PYTHON) -m venv --clear $(VENV)
	@$(VENV)/bin/python -m pip --disable-pip-version-check --no-input install --quiet --no-deps --requirement $<
	@touch $@

clean:
	rm -rf $(VENV) .nox .venv-compat-* target out dist
	find python -name '*.so' -delete
