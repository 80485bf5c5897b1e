"""Runs the tests against released lerobot packages, each in a separate environment, and writes the page.

    python tests/compat/run.py [--releases 0.6.1] [--python312 PATH] [--page docs/results/compatibility.md]

`make test-compat` runs all releases. Environments are `.venv-compat-lerobot-*` next to the Makefile. They are
recreated when their list of packages changes. All packages are installed without their dependencies, because
the lists in this folder are complete. torch is large, so two environments use the torch of another one. The
plugin of plugins/lerobot is installed in all of them.
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

#: The package of plugins/lerobot, and its tests.
PLUGIN = ROOT / "plugins" / "lerobot"
PLUGIN_TESTS = (
    "plugin.py",
    "plugin_files.py",
    "plugin_lerobot.py",
    "plugin_async.py",
    "plugin_environments.py",
)
#: Tests of data sets. lerobot 0.3.3 is there for these alone: it writes version 2.1, later ones 3.0.
RECORDINGS = "recordings.py"
POLICIES = ("policies.py", "whole.py", "normalizers.py", RECORDINGS)


@dataclass(frozen=True)
class Release:
    """A release of lerobot and its environment."""

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


#: In the order in which the environments build on each other; "" is the environment that runs this program.
RELEASES = (
    Release("0.3.3", "", (RECORDINGS,)),
    Release("0.4.4", "", (*POLICIES, *PLUGIN_TESTS)),
    Release("0.6.1", None, (*POLICIES, "n17_parity.py", *PLUGIN_TESTS, "plugin_rtc.py")),
    Release("0.5.1", "0.6.1", (*POLICIES, *PLUGIN_TESTS)),
)

INTRODUCTION = """\
# What was tested with releases of lerobot

`make test-compat` creates an environment for each release, runs the tests of `accelerate`, of the plugin and
of data sets in it, and writes this page. The table is that of `accelerate`. Its tests use lerobot's own
policy, model, backbone and head, small and with random weights. Where only the head is accelerated, the
backbone is a stub. Errors compare whole chunks with the original `get_action` for equal
seeds: the root-mean-square difference divided by the root mean square of the actions, and of that the largest
over the tests. In float32 the differences come from the order of sums and from torch's own sine tables. Where
the original rounds to bfloat16, the difference is its rounding.
"""

ERRORS = {
    "float32": "float32 weights",
    "float32, autocast": "float32 weights, autocast to bfloat16 (`use_bf16`)",
    "bfloat16": "bfloat16 weights",
    "bfloat16, autocast": "bfloat16 weights, autocast",
    "precision bfloat16": 'float32 weights, `precision="bfloat16"`',
    "precision int8": 'float32 weights, `precision="int8"`',
    "whole, float32": "whole policy, float32 weights",
    "whole, float32, autocast": "whole policy, float32 weights, autocast",
    "whole, bfloat16": "whole policy, bfloat16 weights",
    "whole, bfloat16, autocast": "whole policy, bfloat16 weights, autocast",
    "whole, float32, precision bfloat16": 'whole policy, float32 weights, `precision="bfloat16"`',
    "whole, float32, autocast, precision bfloat16": 'whole policy, autocast, `precision="bfloat16"`',
    "whole, precision int8": 'whole policy, float32 weights, `precision="int8"`',
    "real-time chunking": "real-time chunking through the policy",
    "chunking by options": "real-time chunking by the head's options",
    "published widths": "published widths, 6 blocks, 296 tokens",
}

CHECKED = """\
Batches of 1 and 3, with padding and images of different lengths in every row if the head reads masks. In each
environment these tests passed too:

- `select_action` over more than one chunk; `save_pretrained`; an optimizer step between evaluations.
- `restore` gives the original bit for bit; accelerating twice is an error; copies and pickles hold the
  original.
- Changed weights are reloaded: optimizer step, `load_state_dict` (also with `assign`), `.data`, NumPy, a
  replaced parameter, a replaced layer, `.to(bfloat16)`. The number of steps set on the torch head is read at
  each call.
- These are refused: training mode, hooks, gradients, a replaced `get_action` or `forward`, `torch.compile`
  inside, float64, changed code under the same names, other draws from the generator.
- Calls from several threads, at 1 and 2 threads, give the same bits.
- With `backbone=True`: batches of 1 and 3 with one and two views and left padding; `select_action`,
  real-time chunking, `save_pretrained`, training in between, `restore`, copies, changed weights, refusals and
  threads. In training, and where a gradient is asked for, the original backbone runs. Padding under another
  attention than torch's `sdpa` is refused.

Those of the plugin `lerobot_policy_saccade` passed too. `lerobot-eval`, started as users start it, runs
episodes of saccade's tasks with `--policy.type` and with `--policy.path`; their rewards are those of
`saccade.Policy.act` in a loop. lerobot's async client gets the actions of `saccade.Policy.act` over gRPC. In
0.6.1 lerobot's rollout runs with real-time chunking, and every chunk is that of `saccade.Policy.act` with
`saccade.Chunking`.

Of data sets that lerobot wrote, version 2.1 by lerobot 0.3.3 and 3.0 by the others, `saccade.datasets` reads
every row and frame as lerobot's loader does. That loader reads every row and frame that was given to
`saccade.datasets.Writer`, and the statistics are those that lerobot computes.

## What is not in the table

- **lerobot 0.4.0 to 0.4.3, 0.5.0, 0.6.0**: the files of their heads equal those of the releases above (in
  0.4.0 to 0.4.2 the policy around the head differs).
- **N1, N1.6, the two-decoder fork and its split arms**: `tests/integrations` has classes of the same
  structure with saccade's own arithmetic. The fork's own head file was run once by hand, with errors as
  above.
- **Isaac-GR00T's classes** are in no package, so they are not run here. N1.5's head is lerobot's. N1.6's and
  N1.7's heads have the attributes, arguments and results of the test classes of the same structure.
- **Flash attention**: lerobot's backbones can use it on GPUs only. It was not run.
- **GPUs**: a head on a GPU is copied, computed on the CPU, and the results are copied back. This path has not
  been run.
- **Trained weights**: random weights have errors of another size at reduced precision: see
  [precision](../precision.md).
"""


def main() -> None:
    """Sets up, runs the tests, and writes the page if all passed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--releases", nargs="+", choices=[release.lerobot for release in RELEASES])
    parser.add_argument(
        "--python312", default=shutil.which("python3.12"), help="needed for lerobot 0.5 and later"
    )
    parser.add_argument("--page", type=Path, default=ROOT / "docs" / "results" / "compatibility.md")
    options = parser.parse_args()
    describe = ["git", "describe", "--always", "--dirty", "--exclude", "*"]
    commit = subprocess.run(describe, cwd=ROOT, capture_output=True, text=True, check=True).stdout.strip()
    chosen = [release for release in RELEASES if release.lerobot in (options.releases or [release.lerobot])]
    for release in chosen:
        set_up(release, options.python312)
        run_tests(release)
    if chosen == list(RELEASES):
        reports = [json.loads(one.result.read_text()) for one in RELEASES if "policies.py" in one.tests]
        if commit.endswith("-dirty"):
            sys.exit(f"compat: passed at {commit}, with uncommitted changes; no page is written of these")
        write(options.page, page(reports, commit))


def set_up(release: Release, python312: str | None) -> None:
    """Creates an environment with exactly the listed packages, unless it exists."""
    stamp = release.folder / "packages.txt"
    if stamp.is_file() and stamp.read_text() == release.packages.read_text():
        return
    python = sys.executable if release.on_top_of == "" else python312
    if python is None:
        sys.exit(f"lerobot {release.lerobot} needs Python 3.12: --python312 PATH (make: COMPAT_ARGS=...)")
    print(f"setup: lerobot {release.lerobot}", flush=True)
    subprocess.run([python, "-m", "venv", "--clear", release.folder], check=True)
    if release.on_top_of is not None:
        base = [other.folder for other in RELEASES if other.lerobot == release.on_top_of]
        below = site_packages(base[0] / "bin" / "python" if base else Path(sys.executable))
        (site_packages(release.folder / "bin" / "python") / "below.pth").write_text(f"{below}\n")
    install = [*PIP, "--no-deps", "--requirement", str(release.packages)]
    subprocess.run([str(release.folder / "bin" / "python"), *install], check=True)
    editable = [*PIP, "--no-deps", "--no-build-isolation", "--editable", str(PLUGIN)]
    subprocess.run([str(release.folder / "bin" / "python"), *editable], check=True)
    stamp.write_text(release.packages.read_text())


def site_packages(python: Path) -> Path:
    """The site-packages folder of an interpreter."""
    code = "import sysconfig; print(sysconfig.get_path('purelib'))"
    found = subprocess.run([python, "-c", code], check=True, capture_output=True, text=True)
    return Path(found.stdout.strip())


def run_tests(release: Release) -> None:
    """Runs the release's tests with the saccade of this checkout."""
    print(f"testing: lerobot {release.lerobot}", flush=True)
    release.result.parent.mkdir(parents=True, exist_ok=True)
    paths = os.pathsep.join(map(str, (ROOT / "python", ROOT / "lab", ROOT, HERE)))
    environment = os.environ | {"PYTHONPATH": paths, "SACCADE_COMPAT_OUT": str(release.result)}
    # The settings of the main suite need packages that this environment lacks.
    command = [str(release.folder / "bin" / "python"), "-m", "pytest", "--noconftest", "--quiet"]
    tests = [str(HERE / test) for test in release.tests]
    # lerobot's async inference writes logs to the working directory as soon as it is imported.
    done = subprocess.run([*command, *tests], cwd=release.result.parent, env=environment)
    if done.returncode:
        sys.exit(done.returncode)


def page(reports: list[dict[str, Any]], commit: str) -> str:
    """The page for the given results of a commit."""
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
    return "\n".join([INTRODUCTION, f"It is of commit {commit}.", "", *lines, "", CHECKED])


def write(path: Path, text: str) -> None:
    """Writes a file under a temporary name first."""
    temporary = path.with_name(f"{path.name}.part")
    temporary.write_text(text)
    temporary.replace(path)
    print(f"wrote {path}")


if __name__ == "__main__":
    main()
