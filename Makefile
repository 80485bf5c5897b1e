# Two commands: `make rollout` (the bundled policy drives a simulated robot) and `make test` (every test).
# Both use one virtual environment. Each setup step leaves a stamp file and is repeated only when its inputs change.

PYTHON ?= python3
VENV ?= .venv
ROLLOUT_OUT ?= out/rollout
ROLLOUT_ARGS ?= --episodes 3 --video
DEMO_OUT ?= out/demo-policy
PICTURES_OUT ?= out/pictures

PYTEST_ARGS ?=
PEERS_VENV ?= .venv-peers
PEERS_ARGS ?=
VLA_SOURCE ?=
COMPAT_ARGS ?=
CLIENTS_ARGS ?=
FUZZ_SECONDS ?= 1800
RAY_VENV ?= .venv-ray
RAY_ARGS ?=
WHEEL_VENV ?= .venv-wheel
WHEEL_ARGS ?=
WHEEL_TARGETS ?= x86_64-unknown-linux-gnu aarch64-unknown-linux-gnu

BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --no-input install --quiet --constraint constraints.txt
# The build tool is installed in the environment, so a build downloads nothing and uses that version.
INSTALL := MATURIN_PEP517_ARGS=--locked $(PIP) --no-build-isolation --editable
RUST_SOURCES := Cargo.toml Cargo.lock $(shell find crates -name '*.rs' -o -name Cargo.toml)

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
MAKEFLAGS += --no-print-directory
.PHONY: help demo-policy pictures bench-peers setup-peers rollout test test-rust test-python lint format sanitize wheel test-wheel test-compat test-clients test-ray test-aarch64 test-aarch64-all fuzz setup-rollout setup-test clean

help:
	@echo "make rollout      run the bundled policy in simulation; table and videos in $(ROLLOUT_OUT)"
	@echo "make test         run all tests, Rust and Python"
	@echo "make lint         run the other checks of .ci/run: formatting, clippy, ruff, mypy, stubs, rustdoc"
	@echo "make format       format all Rust and Python files"
	@echo "make bench-peers  compare with other engines that run the same head, or PEERS_ARGS=\"--only policy\" the whole policy"
	@echo "make sanitize     run the kernel tests under AddressSanitizer (nightly Rust) and valgrind"
	@echo "make fuzz         fuzz headers, indexes, configs, resizing, tokenizers and processors, FUZZ_SECONDS each (nightly Rust, cargo-fuzz)"
	@echo "make test-compat  test accelerate() and the plugin on lerobot releases; writes docs/compatibility.md"
	@echo "make test-clients test saccade serve with Isaac-GR00T's clients: CLIENTS_ARGS=\"--clone PATH\" of its repository"
	@echo "make test-ray     test rollout, study and demos on a Ray cluster of two nodes on this machine"
	@echo "make test-aarch64 run the Rust tests and some of Python's on an emulated 64-bit ARM CPU (Debian x86-64)"
	@echo "make wheel        build manylinux wheels of the last commit in dist, for x86-64 and 64-bit ARM (WHEEL_TARGETS), and the lerobot plugin"
	@echo "make test-wheel   test the wheels on CPythons, NumPys and emulated CPUs; writes docs/wheels.md"
	@echo "make demo-policy  record demonstrations and train the bundled policy anew, in $(DEMO_OUT)"
	@echo "make pictures     draw the pictures of the README anew"
	@echo "make clean        remove the virtual environments and build outputs"

rollout: setup-rollout
	$(BIN)/saccade rollout $(ROLLOUT_ARGS) --out $(ROLLOUT_OUT)

test: setup-test
	@$(PYTHON) .ci/needs.py browser || true
	$(MAKE) test-rust
	$(MAKE) test-python

# The default members; then their examples, which a test run only builds. Benches have no tests, and their dependencies are slow to build.
test-rust:
	cargo test --locked --quiet
	cargo run --locked --quiet -p saccade-groot --example sample >/dev/null
	cargo run --locked --quiet -p saccade-groot --example look_inside >/dev/null

# One worker per core. Each starts with a contiguous part of the tests, so few module fixtures are built twice. The
# workers fill the cores; more OpenMP threads in torch and NumPy would only compete for them.
test-python:
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest --numprocesses auto --dist worksteal $(PYTEST_ARGS)

lint: setup-test
	cargo fmt --all --check
	cargo clippy --workspace --all-targets --locked --quiet -- --deny warnings
	RUSTDOCFLAGS="--deny warnings" cargo doc --workspace --no-deps --locked --quiet
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/stubtest saccade._saccade

# The bundled policy anew: about an hour and a half of one core. Each part resumes where it was stopped. The second
# training has more demonstrations of the tasks that the first one did worst.
demo-policy: setup-test
	@$(MAKE) $(DEMO_OUT)/first.done
	$(BIN)/saccade demos --out $(DEMO_OUT)/demos --tasks push --episodes 300
	$(BIN)/saccade demos --out $(DEMO_OUT)/demos --tasks window-open --episodes 200
	$(BIN)/saccade train --demos $(DEMO_OUT)/demos --start-from $(DEMO_OUT)/first --training-steps 4000 \
		--learning-rate 3e-4 --seed 1 --out $(DEMO_OUT)/policy
	$(BIN)/saccade rollout --checkpoint $(DEMO_OUT)/policy --episodes 20 --seed 1000 --out $(DEMO_OUT)/check

# A stamp, because the demonstrations that follow would make the finished training look like another one.
$(DEMO_OUT)/first.done:
	$(BIN)/saccade demos --out $(DEMO_OUT)/demos
	$(BIN)/saccade train --demos $(DEMO_OUT)/demos --out $(DEMO_OUT)/first
	@touch $@

# The pictures of README and docs/attention.md, from the bundled policy.
pictures: setup-rollout
	$(BIN)/saccade rollout --episodes 1 --seed 2 --video --out $(PICTURES_OUT)/gif
	$(BIN)/python docs/make_pictures.py gif $(patsubst %,$(PICTURES_OUT)/gif/videos/%-2.mp4,reach push drawer-open button-press-topdown window-open)
	$(BIN)/saccade attention --task push --seed 3 --out $(PICTURES_OUT)/look
	$(BIN)/python docs/make_pictures.py map $(PICTURES_OUT)/look/sheet.png
	cp $(PICTURES_OUT)/look/sheet.png docs/images/attention.png

# Other engines, in a separate environment. PEERS_ARGS=--help lists the options.
bench-peers: setup-peers
	SACCADE_PEERS_GGML=$(PEERS_VENV)/ggml/build/bin SACCADE_PEERS_VLA=$(PEERS_VENV)/vla $(PEERS_VENV)/bin/python -m benches.peers $(PEERS_ARGS)

format: setup-test
	cargo fmt --all
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Memory errors in the only crate with unsafe code. AddressSanitizer runs its tests on every instruction set of this CPU.
# It needs a target directory of its own, because dependencies are instrumented too. Under it a test may run for more
# than a minute; the test runner then prints a warning, which allocates, so the test that counts allocations is skipped.
# So are the tests that run out of memory, which AddressSanitizer reports as errors.
# Valgrind emulates a CPU without AVX-512, so it covers the portable and AVX2 paths, and tiles in software where a test has
# them. It is slow, so the tests that compare many sizes with float64 are skipped. `narrow` takes a minute and a half.
ASAN_TARGET := x86_64-unknown-linux-gnu
VALGRIND_TESTS := attention layer_norm linear masks narrow narrow_weights outliers rms_norm rope
ASAN_SKIPPED := allocates_nothing without_memory cannot_be_had cannot_be_started

sanitize:
	@cargo +nightly --version >/dev/null 2>&1 || { echo "make sanitize needs a nightly Rust: rustup toolchain install nightly"; exit 1; }
	@command -v valgrind >/dev/null || { echo "make sanitize: valgrind is not installed; install the package valgrind"; exit 1; }
	RUSTFLAGS=-Zsanitizer=address cargo +nightly test --locked --quiet -p saccade-kernels --lib --tests \
		--target $(ASAN_TARGET) --target-dir target/sanitize -- $(ASAN_SKIPPED:%=--skip %)
	CARGO_TARGET_X86_64_UNKNOWN_LINUX_GNU_RUNNER="valgrind --quiet --error-exitcode=1" \
		cargo test --locked --quiet -p saccade-kernels $(VALGRIND_TESTS:%=--test %) -- --test-threads 1 --skip float64

# These steps run in this order, even with `make -j`.
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
	@test -z "$(VLA_SOURCE)" || $(MAKE) -s $(PEERS_VENV)/.vla

# The environment of a copied or moved checkout points to the old place, so it is recreated.
$(VENV)/.tools: constraints.txt
	@test "$$($(BIN)/python -c 'import sys; print(sys.prefix)' 2>/dev/null)" = "$(abspath $(VENV))" || $(PYTHON) -m venv --clear $(VENV)
	@echo "setup: build tool"
	@$(PIP) maturin
	@touch $@

$(VENV)/.rollout: pyproject.toml constraints.txt $(VENV)/.tools
	@echo "setup: saccade and the simulation (builds the Rust head; takes minutes the first time)"
	@$(INSTALL) ".[sim]"
	@touch $@ $(VENV)/.extension

$(VENV)/.test: pyproject.toml constraints.txt $(VENV)/.tools
	@echo "setup: saccade and everything the tests need (torch is large; takes minutes the first time)"
	@$(INSTALL) ".[all]"
	@$(PIP) --no-deps lerobot
	@touch $@ $(VENV)/.rollout $(VENV)/.extension

$(VENV)/.extension: pyproject.toml $(RUST_SOURCES)
	@echo "setup: the Rust sources have changed, rebuilding the head"
	@$(INSTALL) . --no-deps
	@touch $@

PEERS_PIP := $(PEERS_VENV)/bin/python -m pip --disable-pip-version-check --no-input install --quiet --constraint benches/peers/constraints.txt
ENGINES := torch diffusers transformers onnx onnxscript onnxruntime openvino matplotlib cmake ninja maturin safetensors numpy

$(PEERS_VENV)/.engines: benches/peers/constraints.txt
	@test "$$($(PEERS_VENV)/bin/python -c 'import sys; print(sys.prefix)' 2>/dev/null)" = "$(abspath $(PEERS_VENV))" || $(PYTHON) -m venv --clear $(PEERS_VENV)
	@echo "setup: torch, ONNX Runtime, OpenVINO (large; takes minutes the first time)"
	@$(PEERS_PIP) $(ENGINES)
	@$(PEERS_PIP) --no-deps lerobot
	@touch $@

$(PEERS_VENV)/.extension: pyproject.toml $(RUST_SOURCES) $(PEERS_VENV)/.engines
	@echo "setup: building the Rust head"
	@MATURIN_PEP517_ARGS=--locked $(PEERS_PIP) --no-build-isolation --no-deps --editable .
	@touch $@

# ggml as llama-cpp-python ships it, built for this CPU. It is optional: without it, the report has no ggml rows and says so.
$(PEERS_VENV)/.ggml: benches/peers/constraints.txt $(PEERS_VENV)/.engines
	@echo "setup: building ggml (takes minutes)"
	@sh benches/peers/build_ggml.sh $(PEERS_VENV) || echo "ggml could not be built; the report will not include it"
	@touch $@

# vla.cpp from a clone of github.com/VinRobotics/vla.cpp, VLA_SOURCE. It is optional likewise.
$(PEERS_VENV)/.vla: benches/peers/build_vla.sh $(PEERS_VENV)/.ggml
	@echo "setup: building vla.cpp (takes minutes)"
	@sh benches/peers/build_vla.sh $(PEERS_VENV) $(VLA_SOURCE) || { echo "vla.cpp could not be built"; exit 1; }
	@touch $@

# fuzz/README.md describes the targets and why they run without AddressSanitizer.
fuzz: setup-test
	@cargo +nightly fuzz --version >/dev/null 2>&1 || { echo "make fuzz needs a nightly Rust (rustup toolchain install nightly) and cargo-fuzz (cargo install cargo-fuzz)"; exit 1; }
	$(BIN)/python fuzz/seeds.py
	@for target in header index config resize tokenizer processor; do \
		cargo +nightly fuzz run --sanitizer none $$target -- -dict=fuzz/words.dict -max_total_time=$(FUZZ_SECONDS) -timeout=10 -rss_limit_mb=2048 || exit 1; \
	done

# lerobot 0.5 and later need Python 3.12. If python3.12 is not on PATH: COMPAT_ARGS="--python312 PATH".
test-compat: setup-test
	$(BIN)/python tests/compat/run.py $(COMPAT_ARGS)

# Nothing is fetched: the clients are read from a clone of Isaac-GR00T.
test-clients: setup-test
	$(BIN)/python tests/compat/groot.py $(CLIENTS_ARGS)

# Processes and a node are killed meanwhile. Ray is in no other environment, since it does not support every Python.
test-ray:
	@$(PYTHON) .ci/needs.py python rust opengl
	@$(MAKE) -s $(RAY_VENV)/.ray
	SACCADE_RAY=1 OMP_NUM_THREADS=1 $(RAY_VENV)/bin/python -m pytest tests/test_ray.py $(RAY_ARGS)

RAY_PIP := MATURIN_PEP517_ARGS=--locked $(RAY_VENV)/bin/python -m pip --disable-pip-version-check --no-input install --quiet --constraint constraints.txt --constraint .ci/ray-constraints.txt

$(RAY_VENV)/.ray: pyproject.toml constraints.txt .ci/ray-constraints.txt $(RUST_SOURCES)
	@test "$$($(RAY_VENV)/bin/python -c 'import sys; print(sys.prefix)' 2>/dev/null)" = "$(abspath $(RAY_VENV))" || $(PYTHON) -m venv --clear $(RAY_VENV)
	@echo "setup: saccade with the extra ray (torch is large; takes minutes the first time)"
	@$(RAY_PIP) maturin pytest hypothesis
	@$(RAY_PIP) --no-build-isolation --editable ".[ray]"
	@touch $@

# On one emulated CPU, and on those that differ in what they have. docs/aarch64.md says more.
test-aarch64:
	.ci/aarch64/run.sh test

test-aarch64-all:
	CPUS="max,sve=off neoverse-n1 cortex-a72 max" .ci/aarch64/run.sh test

# The plugin needs lerobot to run, but not to be packed.
wheel:
	@$(PYTHON) .ci/needs.py python rust
	@$(MAKE) -s $(WHEEL_VENV)/.tools
	$(if $(filter aarch64-%,$(WHEEL_TARGETS)),.ci/aarch64/run.sh setup)
	rm -rf dist
	for target in $(WHEEL_TARGETS); do $(WHEEL_VENV)/bin/python .ci/wheels/build.py --out dist --target $$target $(WHEEL_ARGS) || exit 1; done
	SOURCE_DATE_EPOCH=$$(git show --no-patch --format=%ct) $(WHEEL_VENV)/bin/python -m pip wheel --disable-pip-version-check --quiet \
		--no-deps --no-build-isolation --ignore-requires-python --wheel-dir dist plugins/lerobot

test-wheel:
	@$(PYTHON) .ci/needs.py opengl qemu
	@$(MAKE) wheel
	$(WHEEL_VENV)/bin/python .ci/wheels/test.py dist --page docs/wheels.md

$(WHEEL_VENV)/.tools: .ci/wheels/requirements.txt
	@test "$$($(WHEEL_VENV)/bin/python -c 'import sys; print(sys.prefix)' 2>/dev/null)" = "$(abspath $(WHEEL_VENV))" || $(PYTHON) -m venv --clear $(WHEEL_VENV)
	@echo "setup: maturin and zig"
	@$(WHEEL_VENV)/bin/python -m pip --disable-pip-version-check --no-input install --quiet --requirement $<
	@touch $@

clean:
	rm -rf $(VENV) $(PEERS_VENV) $(RAY_VENV) $(WHEEL_VENV) .venv-compat-* target out dist
	find python -name '*.so' -delete
