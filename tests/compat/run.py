"""Runs what is tested against released lerobot packages, each in an environment of its own; writes the page.

    python tests/compat/run.py [--releases 0.6.1] [--python312 PATH] [--page docs/compatibility.md]

`make test-compat` runs all. Environments are `.venv-compat-lerobot-*` beside the Makefile; they are made anew
when their list of packages changes. lerobot and the others are installed without what they ask for besides:
the lists beside this file are complete. torch is large, so two environments look for it in another one.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
ROOT = HERE.parent.parent
PIP = ("-m", "pip", "--disable-pip-version-check", "--no-input", "install", "--quiet")


@dataclass(frozen=True)
class Release:
    """A release of lerobot and where it is tried."""

    lerobot: str
    on_top_of: str | None
    tests: tuple[str, ...]

    @property
    def folder(self) -> Path:
        return ROOT / f".venv-compat-lerobot-{self.lerobot}"

    @property
    def packages(self) -> Path:
        return HERE / f"lerobot-{self.lerobot}.txt"

    @property
    def result(self) -> Path:
        return ROOT / "out" / "compat" / f"lerobot-{self.lerobot}.json"


#: In the order in which their environments build on each other; "" is the one that runs this.
RELEASES = (
    Release("0.4.4", "", ("policies.py", "normalizers.py")),
    Release("0.6.1", None, ("policies.py", "normalizers.py", "n17_parity.py")),
    Release("0.5.1", "0.6.1", ("policies.py", "normalizers.py")),
)

INTRODUCTION = """\
# What `accelerate` was tested with

lerobot's own policy, model and head, small and with random weights, around a stub of the backbone, whose
constructor asks the Hub for assets. `make test-compat` sets up an environment for each release, runs the
tests in it and writes this page. Errors are of whole chunks against the original `get_action` with equal
seeds: root mean square of the difference beside that of the actions, the largest over the tests. float32
differs by the order of sums and by torch's own sine tables. Where the original rounds to bfloat16, the
difference is its rounding.
"""

ERRORS = {
    "float32": "float32 weights",
    "float32, autocast": "float32 weights, autocast to bfloat16 (`use_bf16`)",
    "bfloat16": "bfloat16 weights",
    "bfloat16, autocast": "bfloat16 weights, autocast",
    "precision bfloat16": 'float32 weights, `precision="bfloat16"`',
    "precision int8": 'float32 weights, `precision="int8"`',
    "real-time chunking": "real-time chunking through the policy",
    "chunking by options": "real-time chunking by the head's options",
    "published widths": "published widths, 6 blocks, 296 tokens",
}

CHECKED = """\
Batches of 1 and 3, with padding and images of other lengths in every row where the head reads masks. In each
environment also passed:

- `select_action` over more than a chunk; `save_pretrained`; an optimizer's step between evaluations.
- `restore` is bit for bit the original; twice accelerated is an error; copies and pickles hold the original.
- Weights that change are taken anew: optimizer step, `load_state_dict` (also with `assign`), `.data`, NumPy,
  a replaced parameter, a replaced layer, `.to(bfloat16)`. Steps set on the torch head are read live.
- Refused: training mode, hooks, gradients, a replaced `get_action` or `forward`, `torch.compile` inside,
  float64, changed code under the same names, other draws from the generator.
- Calls from several threads, at 1 and 2 threads, give the same bits.

## What is not in the table

- **lerobot 0.4.0 to 0.4.3, 0.5.0, 0.6.0**: their heads' files equal those of the releases above (in 0.4.0 to
  0.4.2 the policy around it differs).
- **N1, N1.6, the two-decoder fork and its split arms**: `tests/test_integrations.py` has classes of the same
  shape with saccade's own arithmetic. The fork's own head file was run once by hand, with errors as above.
- **Isaac-GR00T's classes** are in no package, so nothing here runs them. N1.5's head is lerobot's; N1.6's and
  N1.7's have the attributes, arguments and results that the classes of the same shape have.
- **A GPU**: a head there is copied, computed on the CPU and its results put back; that path has not been run.
- **Trained weights**: random ones have errors of another size at reduced precision:
  [precision](precision.md).
"""


def main() -> None:
    """Sets up, tests, writes the page if all passed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--releases", nargs="+", choices=[release.lerobot for release in RELEASES])
    parser.add_argument(
        "--python312", default=shutil.which("python3.12"), help="lerobot 0.5 and later need it"
    )
    parser.add_argument("--page", type=Path, default=ROOT / "docs" / "compatibility.md")
    options = parser.parse_args()
    chosen = [release for release in RELEASES if release.lerobot in (options.releases or [release.lerobot])]
    for release in chosen:
        set_up(release, options.python312)
        run_tests(release)
    if chosen == list(RELEASES):
        write(options.page, page([json.loads(release.result.read_text()) for release in RELEASES]))


def set_up(release: Release, python312: str | None) -> None:
    """An environment with exactly the listed packages, unless there is one."""
    stamp = release.folder / "packages.txt"
    if stamp.is_file() and stamp.read_text() == release.packages.read_text():
        return
    python = sys.executable if release.on_top_of == "" else python312
    if python is None:
        sys.exit(f"lerobot {release.lerobot} needs Python 3.12: --python312 PATH (make: COMPAT_ARGS=...)")
    print(f"setting up: lerobot {release.lerobot}", flush=True)
    subprocess.run([python, "-m", "venv", "--clear", release.folder], check=True)
    if release.on_top_of is not None:
        base = [other.folder for other in RELEASES if other.lerobot == release.on_top_of]
        below = site_packages(base[0] / "bin" / "python" if base else Path(sys.executable))
        (site_packages(release.folder / "bin" / "python") / "below.pth").write_text(f"{below}\n")
    install = [*PIP, "--no-deps", "--requirement", str(release.packages)]
    subprocess.run([str(release.folder / "bin" / "python"), *install], check=True)
    stamp.write_text(release.packages.read_text())


def site_packages(python: Path) -> Path:
    """Where an interpreter's packages are."""
    code = "import sysconfig; print(sysconfig.get_path('purelib'))"
    found = subprocess.run([python, "-c", code], check=True, capture_output=True, text=True)
    return Path(found.stdout.strip())


def run_tests(release: Release) -> None:
    """The release's tests, with the saccade of this tree."""
    print(f"testing: lerobot {release.lerobot}", flush=True)
    release.result.parent.mkdir(parents=True, exist_ok=True)
    paths = os.pathsep.join([str(ROOT / "python"), str(ROOT / "tests")])
    environment = os.environ | {"PYTHONPATH": paths, "SACCADE_COMPAT_OUT": str(release.result)}
    # The suite's own settings ask for plugins that are not here.
    command = [str(release.folder / "bin" / "python"), "-m", "pytest", "--noconftest", "--quiet"]
    tests = [str(HERE / test) for test in release.tests]
    done = subprocess.run([*command, *tests], cwd=ROOT, env=environment)
    if done.returncode:
        sys.exit(done.returncode)


def page(reports: list[dict[str, Any]]) -> str:
    """The page of what was run."""
    reports = sorted(reports, key=lambda report: report["versions"]["lerobot"])
    rows = [["", *(f"lerobot {report['versions']['lerobot']}" for report in reports)]]
    rows.append(["head", *(f"GR00T {report['kind'].upper()}" for report in reports)])
    rows.append(["Python", *(report["python"] for report in reports)])
    packages = [name for name in reports[0]["versions"] if name != "lerobot"]
    rows += [[name, *(report["versions"][name] for report in reports)] for name in packages]
    for key, text in ERRORS.items():
        cells = [report["results"].get(key) for report in reports]
        rows.append([text, *("" if cell is None else f"{cell:.0e}" for cell in cells)])
    lines = [f"| {' | '.join(row)} |" for row in rows]
    lines.insert(1, f"| {' | '.join(['---'] * len(rows[0]))} |")
    return "\n".join([INTRODUCTION, *lines, "", CHECKED])


def write(path: Path, text: str) -> None:
    """Writes a file under a temporary name first."""
    temporary = path.with_name(f"{path.name}.part")
    temporary.write_text(text)
    temporary.replace(path)
    print(f"wrote {path}")


if __name__ == "__main__":
    main()
