# Two commands: `make rollout` (the shipped policy drives the simulated robot) and `make test` (every test).
# They share one virtual environment. Each step of setting it up leaves a stamp in it and is redone when what it was made from changes.

PYTHON ?= python3
VENV ?= .venv
ROLLOUT_OUT ?= out/rollout
ROLLOUT_ARGS ?= --episodes 3 --video

PEERS_VENV ?= .venv-peers
PEERS_ARGS ?=
COMPAT_ARGS ?=
FUZZ_SECONDS ?= 1800
WHEEL_VENV ?= .venv-wheel
WHEEL_ARGS ?=

BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --no-input install --quiet --constraint constraints.txt
# The build tool is in the environment, so a build neither downloads anything nor uses another version of it.
INSTALL := MATURIN_PEP517_ARGS=--locked $(PIP) --no-build-isolation --editable
RUST_SOURCES := Cargo.toml Cargo.lock $(shell find crates -name '*.rs' -o -name Cargo.toml)

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
MAKEFLAGS += --no-print-directory
.PHONY: help bench-peers setup-peers rollout test test-rust test-python lint format sanitize wheel test-wheel test-compat fuzz setup-rollout setup-test clean

help:
	@echo "make rollout   the shipped policy drives a simulated robot; table and videos in $(ROLLOUT_OUT)"
	@echo "make test      every test, Rust and Python"
	@echo "make bench-peers   saccade beside every engine that runs the same head; report in out/peers"
	@echo "make lint      what .ci/run checks besides the tests"
	@echo "make sanitize  kernel tests under AddressSanitizer (nightly Rust) and valgrind"
	@echo "make fuzz      hostile headers, indexes, configs and resizes, FUZZ_SECONDS each (nightly Rust, cargo-fuzz)"
	@echo "make test-compat  lerobot's own policies, accelerated, in an environment of each release; writes docs/compatibility.md"
	@echo "make wheel     a manylinux wheel in dist, from the last commit"
	@echo "make test-wheel   the wheel under every CPython, old and new NumPy, emulated old CPUs; writes docs/wheels.md"
	@echo "make format    formats all Rust and Python files"
	@echo "make clean     removes the virtual environment and what was built"

rollout: setup-rollout
	$(BIN)/saccade rollout $(ROLLOUT_ARGS) --out $(ROLLOUT_OUT)

test: setup-test
	@$(PYTHON) .ci/needs.py browser || true
	$(MAKE) test-rust
	$(MAKE) test-python

# The default members: benches hold no tests, and their peers take long to build.
test-rust:
	cargo test --locked --quiet

test-python:
	$(BIN)/python -m pytest

lint: setup-test
	cargo fmt --all --check
	cargo clippy --workspace --all-targets --locked --quiet -- --deny warnings
	RUSTDOCFLAGS="--deny warnings" cargo doc --workspace --no-deps --locked --quiet
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/stubtest saccade._saccade

# Other engines, in an environment of their own. PEERS_ARGS=--help lists what can be asked for.
bench-peers: setup-peers
	SACCADE_PEERS_GGML=$(PEERS_VENV)/ggml/build/bin $(PEERS_VENV)/bin/python -m benches.peers $(PEERS_ARGS)

format: setup-test
	cargo fmt --all
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Memory errors of the only crate with unsafe code. AddressSanitizer runs its tests on every instruction set of this CPU; a toolchain's own
# target directory, since everything is built with it. Slowed down so, a test runs for longer than a minute; the test runner then says so, and that
# allocates: the test that counts allocations is left out. So are those that run out of memory, which AddressSanitizer reports as an error.
# Valgrind shows programs a CPU without AVX-512, so that it runs the portable and the AVX2 paths; it is slow, and leaves out the tests that try
# many sizes.
ASAN_TARGET := x86_64-unknown-linux-gnu
VALGRIND_TESTS := attention layer_norm linear masks rms_norm rope
ASAN_SKIPPED := allocates_nothing without_memory cannot_be_had cannot_be_started

sanitize:
	@cargo +nightly --version >/dev/null 2>&1 || { echo "make sanitize: AddressSanitizer needs a nightly Rust: rustup toolchain install nightly"; exit 1; }
	@command -v valgrind >/dev/null || { echo "make sanitize: valgrind is missing: install the package of that name"; exit 1; }
	RUSTFLAGS=-Zsanitizer=address cargo +nightly test --locked --quiet -p saccade-kernels --lib --tests \
		--target $(ASAN_TARGET) --target-dir target/sanitize -- $(ASAN_SKIPPED:%=--skip %)
	CARGO_TARGET_X86_64_UNKNOWN_LINUX_GNU_RUNNER="valgrind --quiet --error-exitcode=1" \
		cargo test --locked --quiet -p saccade-kernels $(VALGRIND_TESTS:%=--test %) -- --test-threads 1 --skip float64

# One after the other, in this order, also under `make -j`.
setup-rollout:
	@$(PYTHON) .ci/needs.py python rust opengl
	@$(MAKE) -s $(VENV)/.rollout
	@$(MAKE) -s $(VENV)/.extension

setup-test:
	@$(PYTHON) .ci/needs.py python rust opengl
	@$(MAKE) -s $(VENV)/.test
	@$(MAKE) -s $(VENV)/.extension

setup-peers:
	@$(PYTHON) .ci/needs.py python rust
	@$(MAKE) -s $(PEERS_VENV)/.engines
	@$(MAKE) -s $(PEERS_VENV)/.extension
	@$(MAKE) -s $(PEERS_VENV)/.ggml

# A copied or moved checkout has an environment that points elsewhere: it is made anew.
$(VENV)/.tools: constraints.txt
	@test "$$($(BIN)/python -c 'import sys; print(sys.prefix)' 2>/dev/null)" = "$(abspath $(VENV))" || $(PYTHON) -m venv --clear $(VENV)
	@echo "setting up: build tool"
	@$(PIP) maturin
	@touch $@

$(VENV)/.rollout: pyproject.toml constraints.txt $(VENV)/.tools
	@echo "setting up: saccade and the simulation (builds the Rust head; minutes on the first run)"
	@$(INSTALL) ".[sim]"
	@touch $@ $(VENV)/.extension

$(VENV)/.test: pyproject.toml constraints.txt $(VENV)/.tools
	@echo "setting up: saccade and all that the tests need (torch is large; minutes on the first run)"
	@$(INSTALL) ".[all]"
	@$(PIP) --no-deps lerobot
	@touch $@ $(VENV)/.rollout $(VENV)/.extension

$(VENV)/.extension: pyproject.toml $(RUST_SOURCES)
	@echo "setting up: the Rust head has changed, building it"
	@$(INSTALL) . --no-deps
	@touch $@

PEERS_PIP := $(PEERS_VENV)/bin/python -m pip --disable-pip-version-check --no-input install --quiet --constraint benches/peers/constraints.txt
ENGINES := torch diffusers transformers onnx onnxscript onnxruntime openvino matplotlib cmake ninja maturin safetensors numpy

$(PEERS_VENV)/.engines: benches/peers/constraints.txt
	@test "$$($(PEERS_VENV)/bin/python -c 'import sys; print(sys.prefix)' 2>/dev/null)" = "$(abspath $(PEERS_VENV))" || $(PYTHON) -m venv --clear $(PEERS_VENV)
	@echo "setting up: torch, ONNX Runtime, OpenVINO (large; minutes on the first run)"
	@$(PEERS_PIP) $(ENGINES)
	@$(PEERS_PIP) --no-deps lerobot
	@touch $@

$(PEERS_VENV)/.extension: pyproject.toml $(RUST_SOURCES) $(PEERS_VENV)/.engines
	@echo "setting up: the Rust head, in release"
	@MATURIN_PEP517_ARGS=--locked $(PEERS_PIP) --no-build-isolation --no-deps --editable .
	@touch $@

# ggml as llama-cpp-python ships it, built for this CPU. Without it the report lacks ggml and says so; nothing else needs it.
$(PEERS_VENV)/.ggml: benches/peers/constraints.txt $(PEERS_VENV)/.engines
	@echo "setting up: ggml (builds it; minutes)"
	@sh benches/peers/build_ggml.sh $(PEERS_VENV) || echo "ggml could not be built; the report goes without it"
	@touch $@

# fuzz/README.md says what is done with which input, and why without AddressSanitizer.
fuzz: setup-test
	@cargo +nightly fuzz --version >/dev/null 2>&1 || { echo "make fuzz: needs a nightly Rust (rustup toolchain install nightly) and cargo-fuzz (cargo install cargo-fuzz)"; exit 1; }
	$(BIN)/python fuzz/seeds.py
	@for target in header index config resize; do \
		cargo +nightly fuzz run --sanitizer none $$target -- -dict=fuzz/words.dict -max_total_time=$(FUZZ_SECONDS) -timeout=10 -rss_limit_mb=2048 || exit 1; \
	done

# lerobot 0.5 and later need Python 3.12: COMPAT_ARGS="--python312 PATH" where python3.12 is not on PATH.
test-compat: setup-test
	$(BIN)/python tests/compat/run.py $(COMPAT_ARGS)

wheel:
	@$(PYTHON) .ci/needs.py python rust
	@$(MAKE) -s $(WHEEL_VENV)/.tools
	$(WHEEL_VENV)/bin/python .ci/wheels/build.py --out dist $(WHEEL_ARGS)

test-wheel: wheel
	@$(PYTHON) .ci/needs.py opengl qemu
	$(WHEEL_VENV)/bin/python .ci/wheels/test.py dist --page docs/wheels.md

$(WHEEL_VENV)/.tools: .ci/wheels/requirements.txt
	@test "$$($(WHEEL_VENV)/bin/python -c 'import sys; print(sys.prefix)' 2>/dev/null)" = "$(abspath $(WHEEL_VENV))" || $(PYTHON) -m venv --clear $(WHEEL_VENV)
	@echo "setting up: maturin and zig"
	@$(WHEEL_VENV)/bin/python -m pip --disable-pip-version-check --no-input install --quiet --requirement $<
	@touch $@

clean:
	rm -rf $(VENV) $(PEERS_VENV) $(WHEEL_VENV) .venv-compat-* target out dist
	find python -name '*.so' -delete
