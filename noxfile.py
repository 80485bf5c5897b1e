"""The tasks of this repository: `make NAME`, or `.venv/bin/nox --session NAME -- OPTIONS`.

`.venv` is the environment to work in: `make rollout` installs saccade and the simulation there, other tasks
add what tests and linters need. Both packages are editable in it. Tasks that need other packages have
environments in `.nox`. All are kept, and a step is repeated only when what it was made from has changed.
"""

from __future__ import annotations

import logging
import os
import shutil
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path

import nox

sys.path.insert(0, str(Path(__file__).resolve().parent / ".ci"))
import peers
from environments import ENVIRONMENTS, ROOT, Environment, digest, needs, working

nox.needs_version = ">=2025.2"
nox.options.sessions = ["test"]
nox.options.default_venv_backend = "none"  # `Environment` makes them, because several tasks share one
# The summary of a test runner stays the last line of a run. uv is not needed.
logging.getLogger("nox").addFilter(
    lambda record: record.levelname != "SUCCESS" and not record.getMessage().startswith("uv binary")
)


def cargo(session: nox.Session, *arguments: str, **variables: str) -> None:
    """Runs cargo."""
    session.run("cargo", *arguments, env=variables, external=True)


@nox.session
def setup(session: nox.Session) -> None:
    """Install everything that tests and linters need in .venv."""
    working(session)


@nox.session
def rollout(session: nox.Session) -> None:
    """Run the bundled policy in simulation; table and videos in out/rollout."""
    environment = working(session, "rollout")
    options = session.posargs or ["--episodes", "3", "--video", "--out", "out/rollout"]
    session.run(environment.program("saccade"), "rollout", *options, external=True)


@nox.session
def test(session: nox.Session) -> None:
    """Run all tests, Rust and Python."""
    environment = working(session)
    run_rust_tests(session)
    run_python_tests(environment)


@nox.session(name="test-rust")
def test_rust(session: nox.Session) -> None:
    """Run the Rust tests."""
    needs(session, "rust")
    run_rust_tests(session)


@nox.session(name="test-python")
def test_python(session: nox.Session) -> None:
    """Run the Python tests."""
    run_python_tests(working(session))


def run_rust_tests(session: nox.Session) -> None:
    """Those of the default members, and their examples, which a test run only builds.

    Benches have no tests, and their dependencies are slow to build.
    """
    cargo(session, "test", "--locked", "--quiet")
    for example in ("sample", "look_inside", "act"):
        # Of the default members, as above: with one package the features differ, and all is built again.
        command = ("run", "--locked", "--quiet", "--example", example)
        session.run("cargo", *command, silent=True, external=True)


def run_python_tests(environment: Environment) -> None:
    """One worker per core, each with a contiguous part of the tests: few module fixtures are built twice.

    The workers fill the cores; more OpenMP threads in torch and NumPy would only compete for them.
    """
    needs(environment.session, "browser", required=False)
    options = ("--numprocesses", "auto", "--dist", "worksteal", *environment.session.posargs)
    environment.run("-m", "pytest", *options, OMP_NUM_THREADS="1")


@nox.session
def core(session: nox.Session) -> None:
    """Run the tests that need the wheel of saccade, NumPy and pytest only.

    NUMPY is another version of NumPy than that of requirements/core.txt, or `newest`.
    """
    needs(session, "python", "rust")
    numpy = os.environ.get("NUMPY", "")
    environment = Environment(session, ENVIRONMENTS / f"core{numpy}").install("core")
    if numpy:
        environment.pip("--upgrade", "numpy" if numpy == "newest" else f"numpy=={numpy}")
    environment.install_saccade(editable=False)
    options = ("--numprocesses", "auto", "--dist", "worksteal", *session.posargs)
    environment.run("-m", "pytest", "tests", "-m", "core", *options, OMP_NUM_THREADS="1")


@nox.session
def lint(session: nox.Session) -> None:
    """Run the other checks of .ci/run: formatting, clippy, rustdoc, features, ruff, mypy, stubs, licences."""
    environment = working(session)
    cargo(session, "fmt", "--all", "--check")
    quiet = ("--workspace", "--locked", "--quiet")
    cargo(session, "clippy", *quiet, "--all-targets", "--", "--deny", "warnings")
    cargo(session, "doc", *quiet, "--no-deps", RUSTDOCFLAGS="--deny warnings")
    for feature in ("", "processor", "rewrite"):  # each alone; the workspace above has all of them
        options = ("--package", "saccade-vla", "--lib", "--examples", "--no-default-features")
        options += ("--features", feature)
        cargo(session, "clippy", "--locked", "--quiet", *options, "--", "--deny", "warnings")
    deny = "cargo-deny --offline check licenses bans sources"
    for command in ("ruff check .", "ruff format --check .", "mypy", "stubtest saccade._saccade", deny):
        program, *options = command.split()
        session.run(environment.program(program), *options, external=True)


@nox.session
def docs(session: nox.Session) -> None:
    """Build the documentation site in out/site/html; a warning or a link that leads nowhere is an error."""
    if sys.version_info < (3, 11):
        session.error("needs Python 3.11 or newer: make PYTHON=/path/to/python3 docs, after make clean")
    below = working(session)
    environment = Environment(session, ENVIRONMENTS / "docs").install("docs").lies_on(below)
    variables = {"OMP_NUM_THREADS": "1", "MUJOCO_GL": "egl"}
    environment.run("docs/site/build.py", *session.posargs, **variables)


@nox.session
def workflows(session: nox.Session) -> None:
    """Check the workflows of GitHub, the issue forms and the citation, without the network."""
    environment = Environment(session, ENVIRONMENTS / "workflows").install("workflows")
    folder = ROOT / ".github"
    config = folder / "ISSUE_TEMPLATE" / "config.yml"
    schemas = {
        "vendor.github-workflows": sorted((folder / "workflows").glob("*.yml")),
        "vendor.github-issue-forms": sorted({*config.parent.glob("*.yml")} - {config}),
        "vendor.github-issue-config": [config],
        "vendor.dependabot": [folder / "dependabot.yml"],
        "vendor.citation-file-format": [ROOT / "CITATION.cff"],
    }
    for schema, files in schemas.items():
        command = (environment.program("check-jsonschema"), "--builtin-schema", schema, *map(str, files))
        session.run(*command, external=True)
    session.run(environment.program("zizmor"), "--offline", "--no-progress", str(folder), external=True)


@nox.session
def format(session: nox.Session) -> None:
    """Format all Rust and Python files."""
    environment = working(session)
    cargo(session, "fmt", "--all")
    session.run(environment.program("ruff"), "check", "--fix", ".", external=True)
    session.run(environment.program("ruff"), "format", ".", external=True)


@nox.session
def package(session: nox.Session) -> None:
    """Pack the library crates as for publication, and build what they pack."""
    needs(session, "rust")
    others = ("--exclude", "saccade-python", "--exclude", "saccade-benches")
    cargo(session, "package", "--workspace", *others, "--locked", *session.posargs)


@nox.session
def bench(session: nox.Session) -> None:
    """Measure the kernels and the head beside other implementations, with cargo bench."""
    needs(session, "rust")
    cargo(session, "bench", "--locked", "--package", "saccade-benches", *session.posargs)


@nox.session(name="bench-peers")
def bench_peers(session: nox.Session) -> None:
    """Compare with other engines that run the same head, or with `--only policy` the whole policy.

    The whole policy is measured for N1.5 with lerobot 0.4.4 and for N1.7 with lerobot 0.6.1, unless
    `--release` names one. The latter needs Python 3.12: `python3.12` on PATH, or SACCADE_PYTHON312.
    """
    needs(session, "python", "rust")
    releases = peers.releases(session.posargs)
    # What one of them lacks is said before the other is measured.
    environments = [peers.environment_of(session, release) for release in releases]
    for release, (environment, variables) in zip(releases, environments, strict=True):
        environment.run("-m", "benches.peers", *session.posargs, "--release", release, **variables)


@nox.session
def rounding(session: nox.Session) -> None:
    """Round a trained model to four bits, layer by layer; `report --write` writes the page of docs."""
    needs(session, "python", "rust")
    environment = (
        Environment(session, ENVIRONMENTS / "rounding").install("rounding").install_saccade().install_lab()
    )
    environment.run("-m", "benches.rounding", *session.posargs)


@nox.session(name="test-compat")
def test_compat(session: nox.Session) -> None:
    """Test accelerate() and the plugin on lerobot releases; writes docs/results/compatibility.md.

    lerobot 0.5 and later need Python 3.12. If python3.12 is not on PATH: `--python312 PATH`.
    """
    working(session).run("tests/compat/run.py", *session.posargs)


@nox.session(name="test-clients")
def test_clients(session: nox.Session) -> None:
    """Test with Isaac-GR00T's clients and open loop, from a clone of its repository: `--clone PATH`."""
    working(session).run("tests/compat/groot.py", *session.posargs)


@nox.session(name="test-ray")
def test_ray(session: nox.Session) -> None:
    """Test the commands that take `--backend ray` on a cluster of two nodes on this machine; one node dies.

    Ray is in no other environment, since it does not support every Python.
    """
    needs(session, "python", "rust", "opengl")
    environment = Environment(session, ENVIRONMENTS / "ray").install("ray").install_saccade().install_lab()
    (file,) = (ROOT / "tests").rglob("test_ray.py")
    environment.run("-m", "pytest", file, *session.posargs, SACCADE_RAY="1", OMP_NUM_THREADS="1")


@nox.session(name="test-libero")
def test_libero(session: nox.Session) -> None:
    """Test the tasks of LIBERO in the simulator, against lerobot and what Isaac-GR00T's clients call.

    Downloads 550 MB. LIBERO is in no other environment.
    """
    below = working(session)  # has torch and lerobot
    recording = record_libero_clients(session, below)
    environment = with_setuptools(Environment(session, ENVIRONMENTS / "libero"))
    environment.install("libero").install_saccade().install_lab()
    variables = {"SACCADE_LIBERO": "1", "SACCADE_LIBERO_CLIENTS": str(recording), "OMP_NUM_THREADS": "1"}
    environment.run("-m", "pytest", "tests/libero", *session.posargs, **variables)


def with_setuptools(environment: Environment) -> Environment:
    """Installs setuptools, which builds bddl: it is on the index as source only."""
    lines = (ROOT / "requirements" / "dev.txt").read_text().splitlines()
    (setuptools,) = (line for line in lines if line.startswith("setuptools=="))
    if not environment.is_done("setuptools", setuptools):
        environment.pip(setuptools)
        environment.done("setuptools", setuptools)
    return environment


def record_libero_clients(session: nox.Session, below: Environment) -> Path:
    """Records what released clients observe, in an environment on top of another; returns the file."""
    folder = ENVIRONMENTS / "libero-clients"
    environment = with_setuptools(Environment(session, folder))
    lists = [ROOT / "tests" / name for name in ("compat/lerobot-0.4.4.txt", "libero/hf-libero.txt")]
    program = ROOT / "tests" / "libero" / "released_clients.py"
    made_from = digest(lists)
    if not environment.is_done("packages", made_from):
        print("setup: hf-libero and lerobot (takes minutes the first time)", flush=True)
        environment.lies_on(below)
        environment.pip(*(part for file in lists for part in ("--requirement", file)))
        environment.done("packages", made_from)
    made_from = digest([*lists, program])
    if not environment.is_done("recording", made_from):
        environment.run(
            program, folder / "recording", OMP_NUM_THREADS="1", LP_NUM_THREADS="0", MUJOCO_GL="egl"
        )
        environment.done("recording", made_from)
    return folder / "recording" / "clients.npz"


@nox.session(name="test-aarch64")
def test_aarch64(session: nox.Session) -> None:
    """Run the Rust tests and some of Python's on emulated 64-bit ARM CPUs, `max` or those given (Debian)."""
    cpus = " ".join(session.posargs) or "max"
    session.run(str(ROOT / ".ci/aarch64/run.sh"), "test", env={"CPUS": cpus}, external=True)


@nox.session(name="test-i686")
def test_i686(session: nox.Session) -> None:
    """Check and run the kernel tests on 32-bit x86 (Debian)."""
    session.run(str(ROOT / ".ci/i686/run.sh"), *(session.posargs or ["all"]), external=True)


@nox.session
def fuzz(session: nox.Session) -> None:
    """Fuzz parsers, processors, linear layers and attention, 1800 seconds each or those given.

    Needs a nightly Rust and cargo-fuzz. fuzz/README.md describes the targets.
    """
    environment = working(session)
    if not succeeds("cargo", "+nightly", "fuzz", "--version"):
        session.error("needs a nightly Rust (rustup toolchain install nightly) and cargo install cargo-fuzz")
    environment.run("fuzz/seeds.py")
    seconds = session.posargs[0] if session.posargs else "1800"
    limits = (f"-max_total_time={seconds}", "-timeout=10", "-rss_limit_mb=2048")
    for target in ("header", "index", "config", "resize", "tokenizer", "processor"):
        words = (target, "--", "-dict=fuzz/words.dict")
        cargo(session, "+nightly", "fuzz", "run", "--sanitizer", "none", *words, *limits)
    for target in ("linear", "attention"):
        cargo(session, "+nightly", "fuzz", "run", target, "--", *limits)


def succeeds(*command: str) -> bool:
    """Whether a program is there and ends with status 0."""
    found = shutil.which(command[0]) is not None
    return found and subprocess.run(command, capture_output=True, check=False).returncode == 0


@nox.session
def sanitize(session: nox.Session) -> None:
    """Run the kernel tests under AddressSanitizer (nightly Rust) and valgrind."""
    session.run(str(ROOT / ".ci/sanitize.sh"), *session.posargs, external=True)


@nox.session
def portable(session: nox.Session) -> None:
    """Run the kernel tests without intrinsics and system calls, as Miri does in a workflow."""
    session.run(str(ROOT / ".ci/sanitize.sh"), "portable", external=True)


@nox.session
def loom(session: nox.Session) -> None:
    """Run the models of the thread pool in every order of threads, up to some preemptions."""
    cargo(session, "test", "--locked", "--quiet", "--manifest-path", "loom/Cargo.toml")


@nox.session
def wheel(session: nox.Session) -> None:
    """Build the wheels of the last commit in dist: saccade for x86-64 and ARM, the lab, the lerobot plugin.

    WHEEL_TARGETS names other targets of Rust; options go to .ci/wheels/build.py.
    """
    build_wheels(session, session.posargs)


def build_wheels(session: nox.Session, options: Iterable[str]) -> Environment:
    """Builds all wheels; returns the environment that did."""
    needs(session, "python", "rust")
    environment = Environment(session, ENVIRONMENTS / "wheels").install("wheels")
    targets = os.environ.get("WHEEL_TARGETS", "x86_64-unknown-linux-gnu aarch64-unknown-linux-gnu").split()
    if any(target.startswith("aarch64") for target in targets):
        session.run(str(ROOT / ".ci/aarch64/run.sh"), "setup", external=True)
    shutil.rmtree(ROOT / "dist", ignore_errors=True)
    for target in targets:
        environment.run(".ci/wheels/build.py", "--out", "dist", "--target", target, *options)
    return environment


@nox.session
def metadata(session: nox.Session) -> None:
    """Write source archives of the last commit, and check what an index will show: `twine check --strict`."""
    needs(session, "python", "rust")
    environment = Environment(session, ENVIRONMENTS / "metadata").install("metadata")
    folder = ROOT / "out" / "metadata"
    shutil.rmtree(folder, ignore_errors=True)
    environment.run(".ci/wheels/sources.py", "--out", folder, "--no-build")
    environment.run("-m", "twine", "check", "--strict", *sorted(folder.glob("*.tar.gz")))


@nox.session(name="test-wheel")
def test_wheel(session: nox.Session) -> None:
    """Build the wheels and test them on CPythons, NumPys and emulated CPUs; writes docs/results/wheels.md."""
    needs(session, "opengl", "qemu")
    build_wheels(session, []).run(
        ".ci/wheels/test.py", "dist", "--page", "docs/results/wheels.md", *session.posargs
    )


@nox.session(name="demo-policy")
def demo_policy(session: nox.Session) -> None:
    """Record demonstrations and train the bundled policy anew, in out/demo-policy or the given folder.

    Takes an hour and a half of one core. Each part resumes where it was stopped. The second training has more
    demonstrations of the tasks that the first one did worst.
    """
    environment = working(session)
    out = Path(session.posargs[0] if session.posargs else "out/demo-policy")
    demos, first, policy = (str(out / name) for name in ("demos", "first", "policy"))

    def saccade(*command: str) -> None:
        session.run(environment.program("saccade"), *command, external=True)

    # The demonstrations that follow would make the finished training look like another one.
    finished = out / "first.done"
    if not finished.exists():
        saccade("demos", "--out", demos)
        saccade("train", "--demos", demos, "--out", first)
        finished.touch()
    saccade("demos", "--out", demos, "--tasks", "push", "--episodes", "300")
    saccade("demos", "--out", demos, "--tasks", "window-open", "--episodes", "200")
    again = ("--start-from", first, "--training-steps", "4000", "--learning-rate", "3e-4", "--seed", "1")
    saccade("train", "--demos", demos, *again, "--out", policy)
    check = ("--episodes", "20", "--seed", "1000", "--out", str(out / "check"))
    saccade("rollout", "--checkpoint", policy, *check)


@nox.session
def pictures(session: nox.Session) -> None:
    """Draw the pictures of README and docs anew, from the bundled policy and from one of LIBERO."""
    environment = working(session, "rollout")
    out = Path(session.posargs[0] if session.posargs else "out/pictures")
    saccade = environment.program("saccade")
    shown = ("--episodes", "1", "--seed", "2", "--video", "--out", str(out / "gif"))
    session.run(saccade, "rollout", *shown, external=True)
    tasks = ("reach", "push", "drawer-open", "button-press-topdown", "window-open")
    videos = (out / "gif" / "videos" / f"{task}-2.mp4" for task in tasks)
    environment.run("-m", "benches.pages.pictures", "gif", *videos)
    session.run(
        saccade, "attention", "--task", "push", "--seed", "3", "--out", str(out / "look"), external=True
    )
    environment.run("-m", "benches.pages.pictures", "step")
    shutil.copyfile(out / "look" / "sheet.png", ROOT / "docs" / "images" / "attention.png")
    policy, frames = ROOT / "studies" / "libero" / "n17", ROOT / "studies" / "libero" / "milk"
    said = ("--instruction", "pick up the milk and place it in the basket")
    seen = ("--checkpoint", str(policy), "--frames", str(frames), *said, "--out", str(out / "libero"))
    session.run(saccade, "attention", *seen, external=True)
    shutil.copyfile(out / "libero" / "sheet.png", ROOT / "docs" / "images" / "libero-attention.png")


@nox.session
def lock(session: nox.Session) -> None:
    """Write requirements/, one exact version of every Python package; `--upgrade` takes the newest ones."""
    environment = Environment(session, ENVIRONMENTS / "lock").install("lock")
    environment.run(".ci/lock.py", *session.posargs)
