"""Tests the wheels as users install them, prints the results, and writes a page about them.

    python .ci/wheels/test.py dist --page docs/results/wheels.md

Runs: a fresh environment with the wheel and one NumPy, for each CPython and NumPy; one environment with each
instruction set and on emulated CPUs, the oldest of which lacks AVX; a rollout on each CPython, with the wheel
of the lab and its extra `sim`. A failure is named in its row, and the exit status is then 1. Needs the
environment that built the wheels, the CPythons (on PATH or from pyenv), qemu-user and a C compiler.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from elftools.elf.elffile import ELFFile

CHECK = Path(__file__).resolve().with_name("check.py")
ROOT = CHECK.parents[2]
PAGE = CHECK.with_name("page.md")  # a template
#: CPython -> NumPy: the oldest that saccade accepts and that has a wheel for it, 1.26, 2.0, the newest.
MATRIX = {
    "3.10": ("1.24.0", "1.26.4", "newest"),
    "3.11": ("1.24.0", "1.26.4", "newest"),
    "3.12": ("1.26.4", "2.0.0", "newest"),
    "3.13": ("2.1.0", "newest"),
    "3.14": ("2.3.2", "newest"),
}
#: Its rows say so if it is not at hand: few systems have it yet. The others must be there.
MAY_BE_ABSENT = ("3.14",)
#: CPythons for which the MuJoCo that the lab requires has wheels.
SIMULATED = ("3.10", "3.11", "3.12", "3.13")
#: CPUs that qemu emulates; the first is x86-64-v2 and no more.
CPUS = {"Nehalem": "no AVX", "Haswell": "AVX2, FMA", "max": "everything qemu has"}
#: The same for 64-bit ARM.
ARM_CPUS = {
    "cortex-a72": "NEON",
    "neoverse-n1": "int8 dot products",
    "max,sve=off": "int8 and bfloat16 products",
    "max": "everything qemu has",
}
#: An ARM Python with NumPy, which `.ci/aarch64/run.sh setup` puts there.
ARM_ROOT = ROOT / "target" / "aarch64" / "root"
#: Tolerance of actions against the portable path, by precision; inputs of int8 and int4 may round
#: to a neighbour.
TOLERANCE = {"float32": 1e-5, "bfloat16": 0.05, "int8": 0.1, "int4": 0.1}
#: Stops with an illegal instruction without AVX2: shows that the emulated CPU refuses what it lacks.
AVX2_PROGRAM = """
#include <immintrin.h>
int main(int count, char **arguments) {
    volatile __m256i ones = _mm256_set1_epi32(count);
    return _mm256_extract_epi32(_mm256_add_epi32(ones, ones), 7) != 2 * count;
}
"""

Actions = dict[str, npt.NDArray[np.float32]]


class Failed(Exception):
    """A check of one row failed; the text is for the table."""


class Absent(Exception):
    """A CPython is not at hand, and need not be; the text is for the table."""


def run(command: Iterable[str | Path], folder: Path, **environment: str) -> str:
    """The standard output of a command.

    Raises:
        Failed: its exit status is not 0; with the last line it wrote.
    """
    # Neither the packages of this process nor the checkout may be visible.
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("PYTHON", "SACCADE"))}
    done = subprocess.run(
        [str(word) for word in command], cwd=folder, env=kept | environment, capture_output=True, text=True
    )
    if done.returncode:
        lines = (done.stderr.strip() or done.stdout.strip()).splitlines()
        raise Failed(f"exit status {done.returncode}: {lines[-1] if lines else 'no output'}")
    return done.stdout


def find_python(version: str) -> Path:
    """An interpreter of that version, on PATH or among pyenv's.

    Raises:
        Failed: there is none.
        Absent: the same, of one in `MAY_BE_ABSENT`.
    """
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"), "versions")
    candidates: list[str | Path] = [f"python{version}", *pyenv.glob(f"{version}.*/bin/python")]
    for candidate in candidates:
        try:
            said = run(
                [candidate, "-c", "import sys; print(sys.executable, *sys.version_info[:2])"], Path.cwd()
            )
        except (Failed, FileNotFoundError):
            continue
        executable, *found = said.split()
        if ".".join(found) == version:
            return Path(executable)
    why = f"no CPython {version} on PATH or in pyenv"
    raise Absent(f"not tried: {why}") if version in MAY_BE_ABSENT else Failed(why)


def pin(numpy: str) -> str:
    """The requirement for pip."""
    return "numpy" if numpy == "newest" else f"numpy=={numpy}"


def environment(version: str, folder: Path, *requirements: str | Path) -> Path:
    """A fresh environment; returns its interpreter."""
    run([find_python(version), "-m", "venv", "--clear", "--without-pip", folder], Path.cwd())
    python = folder / "bin" / "python"
    pip: list[str | Path] = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", python]
    run([*pip, "install", "--quiet", "--only-binary", ":all:", *requirements], Path.cwd())
    return python


def check(python: Path, folder: Path, *prefix: str, **variables: str) -> tuple[dict[str, Any], Actions]:
    """Runs check.py with an interpreter; returns the report that it printed and the actions that it wrote."""
    out = folder / "actions.npz"
    said = run([*prefix, python, "-I", CHECK, out], folder, **variables)
    with np.load(out) as actions:
        return json.loads(said.splitlines()[-1]), dict(actions)


def contents(wheel: Path, folder: Path) -> dict[str, Any]:
    """Sizes and properties of the wheel's contents.

    Raises:
        Failed: something is missing, or does not belong there.
    """
    with zipfile.ZipFile(wheel) as archive:
        sizes = {item.filename: item.file_size for item in archive.infolist() if not item.is_dir()}
        archive.extractall(folder)
    library = folder / "saccade" / "_saccade.abi3.so"
    (info,) = {name.split("/")[0] for name in sizes if ".dist-info/" in name}
    wanted = {
        "saccade/py.typed",
        "saccade/_saccade.pyi",
        "saccade/checkpoints/demo/config.json",
        "saccade/checkpoints/demo/model.safetensors",
        f"{info}/licenses/LICENSE-MIT",
        f"{info}/licenses/LICENSE-APACHE",
        f"{info}/entry_points.txt",
    }
    if missing := wanted - set(sizes):
        raise Failed(f"not in the wheel: {', '.join(sorted(missing))}")
    if foreign := {name for name in sizes if name.split("/")[0] not in ("saccade", info) or "test" in name}:
        raise Failed(f"should not be in the wheel: {', '.join(sorted(foreign))}")
    traces = (str(Path.home()).encode(), b"/home/", b"file:///")
    built = [library, *(folder / info).rglob("*")]
    if named := [
        path.name for path in built if path.is_file() and any(t in path.read_bytes() for t in traces)
    ]:
        raise Failed(f"names a folder of the machine that built it: {', '.join(named)}")
    with library.open("rb") as file:
        needs = ELFFile(file).get_section_by_name(".gnu.version_r")
        names = [version.name for _, versions in needs.iter_versions() for version in versions]
    glibc = max((tuple(map(int, n[6:].split("."))) for n in names if n.startswith("GLIBC_")), default=())
    return {
        "library": sizes["saccade/_saccade.abi3.so"],
        "demo": sizes["saccade/checkpoints/demo/model.safetensors"],
        "wheel": wheel.stat().st_size,
        "glibc": ".".join(map(str, glibc)),
    }


def contents_of_lab(wheel: Path) -> None:
    """Checks that the wheel of the lab has every file of its package and nothing else.

    Raises:
        Failed: something is missing, or does not belong there.
    """
    with zipfile.ZipFile(wheel) as archive:
        names = {item.filename for item in archive.infolist() if not item.is_dir()}
    listed = ["git", "ls-files", "saccade_lab"]
    wanted = set(run(listed, ROOT / "lab").split())
    if missing := wanted - names:
        raise Failed(f"not in the wheel of the lab: {', '.join(sorted(missing))}")
    if foreign := {name for name in names - wanted if ".dist-info/" not in name}:
        raise Failed(f"should not be in the wheel of the lab: {', '.join(sorted(foreign))}")
    licences = {Path(name).name for name in names if ".dist-info/licenses/" in name}
    if licences != {"LICENSE-MIT", "LICENSE-APACHE"}:
        raise Failed(f"expected two licences in the wheel of the lab, got {sorted(licences)}")


def try_versions(wheel: Path, work: Path) -> list[list[str]]:
    """A row for each CPython and NumPy."""
    rows = []
    bits: dict[str, Actions] = {}
    for version, numpys in MATRIX.items():
        for numpy in numpys:
            row = [version, numpy]
            try:
                python = environment(version, work / f"{version}-{numpy}", wheel, pin(numpy))
                result, actions = check(python, work)
                if any(np.any(actions[key] != value) for key, value in bits.get(result["isa"], {}).items()):
                    raise Failed("other actions than in the rows above")
                bits[result["isa"]] = actions
                row = [result["python"], result["numpy"], f"{result['cross_attention_error']:.1e}", "passed"]
            except Absent as error:
                row += ["", str(error)]
            except Failed as error:
                row += ["", f"FAILED: {error}"]
            rows.append(row)
            print("  ", *row, flush=True)
    return rows


def try_cpus(python: Path, available: list[str], work: Path) -> list[list[str]]:
    """A row for each available instruction set of this CPU, and for each emulated CPU."""
    native: dict[str, Actions] = {}
    portable: Actions = {}
    arms: list[tuple[str, tuple[str, ...], dict[str, str]]] = [
        (f"this CPU, `SACCADE_ISA={isa}`", (), {"SACCADE_ISA": isa}) for isa in available
    ]
    qemu = shutil.which("qemu-x86_64") or "qemu-x86_64"
    arms += [(f"qemu {cpu} ({has})", (qemu, "-cpu", cpu), {}) for cpu, has in CPUS.items()]
    rows = []
    for name, prefix, variables in arms:
        row = [name]
        try:
            result, actions = check(python, work, *prefix, **variables)
            isa = result["isa"]
            portable = portable or actions  # the first arm
            apart = {key: float(np.abs(actions[key] - portable[key]).max()) for key in actions}
            if far := [key for key in apart if apart[key] > TOLERANCE[key]]:
                raise Failed(f"{', '.join(far)} differ from the portable path by {apart}")
            native = native if prefix else native | {isa: actions}
            same = isa in native and all(np.array_equal(native[isa][key], actions[key]) for key in actions)
            row += [f"`{isa}`", *(f"{apart[key]:.1e}" for key in TOLERANCE)]
            row += [("yes" if same else "no") if prefix and isa in native else "", "passed"]
        except (Failed, FileNotFoundError) as error:
            row += [*[""] * (len(TOLERANCE) + 2), f"FAILED: {error}"]
        rows.append(row)
        print("  ", *row, flush=True)
    rows.append(["qemu Nehalem refuses AVX2", *[""] * (len(TOLERANCE) + 2), refuses_avx2(qemu, work)])
    return rows


def try_arm_cpus(wheel: Path, work: Path) -> list[list[str]]:
    """A row for the portable path and for each emulated ARM CPU."""
    (site,) = ARM_ROOT.glob("usr/local/lib/python3.*/dist-packages")
    (python,) = (path for path in ARM_ROOT.glob("usr/bin/python3.*") if path.suffix[1:].isdigit())
    for old in site.glob("saccade*"):
        shutil.rmtree(old)
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    arms: list[tuple[str, str, dict[str, str]]] = [
        ("qemu max, `SACCADE_ISA=portable`", "max", {"SACCADE_ISA": "portable"})
    ]
    arms += [(f"qemu {cpu} ({has})", cpu, {}) for cpu, has in ARM_CPUS.items()]
    rows = []
    portable: Actions = {}
    for name, cpu, variables in arms:
        row = [name]
        try:
            qemu = ("qemu-aarch64-static", "-cpu", cpu, "-L", str(ARM_ROOT))
            result, actions = check(python, work, *qemu, **variables)
            portable = portable or actions  # the first row
            apart = {key: float(np.abs(actions[key] - portable[key]).max()) for key in actions}
            if far := [key for key in apart if apart[key] > TOLERANCE[key]]:
                raise Failed(f"{', '.join(far)} differ from the portable path by {apart}")
            row += [f"`{result['isa']}`", f"{result['cross_attention_error']:.1e}"]
            row += [*(f"{apart[key]:.1e}" for key in TOLERANCE), "passed"]
        except (Failed, FileNotFoundError) as error:
            row += [*[""] * (len(TOLERANCE) + 2), f"FAILED: {error}"]
        rows.append(row)
        print("  ", *row, flush=True)
    return rows


def refuses_avx2(qemu: str, work: Path) -> str:
    """Whether the oldest emulated CPU stops at an AVX2 instruction; if not, the rows above prove nothing."""
    program = work / "avx2"
    program.with_suffix(".c").write_text(AVX2_PROGRAM)
    try:
        run(["cc", "-mavx2", "-O1", "-o", program, program.with_suffix(".c")], work)
        run([qemu, "-cpu", "Haswell", program], work)
    except (Failed, FileNotFoundError) as error:
        return f"FAILED: {error}"
    stopped = subprocess.run([qemu, "-cpu", "Nehalem", program], capture_output=True, cwd=work).returncode
    return "passed" if stopped in (-4, 132) else f"FAILED: exit status {stopped}"


def try_rollouts(wheel: Path, lab: Path, work: Path) -> list[list[str]]:
    """A row for each CPython, with NumPy 1.26 where it exists and with the newest: one episode."""
    rows = []
    pairs = [(version, numpy) for version in SIMULATED for numpy in MATRIX[version]]
    for version, numpy in pairs:
        if numpy not in ("1.26.4", "newest"):
            continue
        row = [version, numpy]
        try:
            folder = work / f"rollout-{version}-{numpy}"
            python = environment(version, folder, wheel, f"{lab}[sim]", pin(numpy))
            names = ("numpy", "mujoco", "metaworld", "gymnasium")
            code = f"import importlib.metadata as m; print(*map(m.version, {names}))"
            row = [version, *run([python, "-I", "-c", code], work).split()]
            command: list[str | Path] = [
                python.parent / "saccade",
                "rollout",
                "--json",
                "--out",
                folder / "out",
            ]
            said = json.loads(run([*command, "--tasks", "reach", "--episodes", "1"], work))
            row += ["reached" if said["episodes"][0]["success"] else "not reached", "passed"]
        except Failed as error:
            row += [""] * (6 - len(row)) + [f"FAILED: {error}"]
        rows.append(row)
        print("  ", *row, flush=True)
    return rows


def table(header: str, rows: list[list[str]]) -> str:
    """A table in Markdown; the columns of `header` are separated by bars."""
    columns = [column.strip() for column in header.split("|")]
    lines = [columns, ["---"] * len(columns), *rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def of_architecture(folder: Path, name: str) -> Path:
    """The wheel in a folder for an architecture, with glibc.

    Raises:
        Failed: there is none, or more than one.
    """
    wheels = sorted(folder.glob(f"saccade_vla-*-manylinux*_{name}.whl"))
    if len(wheels) != 1:
        raise Failed(f"expected one wheel for {name} in {folder}, got {len(wheels)}")
    return wheels[0]


def commit_of(wheel: Path) -> str:
    """The commit that `build.py` made a wheel of, as it wrote beside the wheel."""
    note = wheel.with_suffix(".commit")
    return note.read_text().strip() if note.exists() else "unknown"


def main() -> int:
    """Runs everything, prints it, and writes the page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="the folder of the wheels")
    parser.add_argument("--page", type=Path, help="where to write the page")
    args = parser.parse_args()
    wheel, arm_wheel = (of_architecture(args.folder.resolve(), name) for name in ("x86_64", "aarch64"))
    (lab,) = args.folder.resolve().glob("saccade_vla_lab-*.whl")
    contents_of_lab(lab)
    with tempfile.TemporaryDirectory() as folder:
        work = Path(folder)
        inside = contents(wheel, work / "unpacked")
        inside_arm = contents(arm_wheel, work / "unpacked-arm")
        megabytes = {key: f"{inside[key] / 1e6:.1f}" for key in ("library", "demo", "wheel")}
        python = environment("3.12", work / "cpus", wheel, "numpy")
        here, _ = check(python, work)
        page = PAGE.read_text().format(
            cpu=f"{here['cpu']}, {here['family']}",
            commit=" and ".join(sorted({commit_of(wheel), commit_of(arm_wheel)})),
            glibc=inside["glibc"],
            **megabytes,
            versions=table("CPython | NumPy | cross-attention | ", try_versions(wheel, work)),
            cpus=table(
                f"CPU | instruction set | {' | '.join(TOLERANCE)} | equal bits | ",
                try_cpus(python, here["available_isas"], work),
            ),
            rollouts=table(
                "CPython | NumPy | mujoco | metaworld | gymnasium | goal | ", try_rollouts(wheel, lab, work)
            ),
            arm_glibc=inside_arm["glibc"],
            arm_wheel=f"{inside_arm['wheel'] / 1e6:.1f}",
            arm_cpus=table(
                f"CPU | instruction set | cross-attention | {' | '.join(TOLERANCE)} | ",
                try_arm_cpus(arm_wheel, work),
            ),
            machine=f"{wheel.name}, {arm_wheel.name}, on {platform.system()} {platform.release()}",
        )
        print(page, flush=True)
        if args.page is not None:
            args.page.write_text(page)
    return 1 if "FAILED" in page else 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except Failed as error:
        sys.exit(str(error))
