"""The machine: its name, the installed versions, and its peak rates."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
import platform
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import saccade

ROOT = Path(__file__).resolve().parents[2]
FLAGS = ("avx2", "fma", "f16c", "avx_vnni", "avx512f", "avx512bw", "avx512vl", "avx512_vnni", "avx512_bf16")
AMX = ("amx_tile", "amx_bf16", "amx_int8")
PACKAGES = (
    "saccade",
    "torch",
    "lerobot",
    "transformers",
    "diffusers",
    "onnxruntime",
    "openvino",
    "nncf",
    "numpy",
)


TIMING = "rest, warm-up"
"""What comes before a measurement. Records without it had the rest alone."""


def describe() -> dict[str, Any]:
    """CPU, its flags that matter here, cores, memory, versions of all engines, the build of saccade.

    `name` is that of the CPU's family, of which there is one record each.
    """
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    cpuinfo = {key.strip(): value.strip() for key, _, value in (line.partition(":") for line in lines)}
    flags = set(cpuinfo.get("flags", "").split())
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    config = saccade.show_config("dicts")
    return {
        "cpu": cpuinfo.get("model name", platform.machine()),
        "name": family_name(config["family"]),
        "family": f"family {cpuinfo.get('cpu family')}, model {cpuinfo.get('model')}",
        "flags": [flag for flag in FLAGS + AMX if flag in flags],
        "cores": len(os.sched_getaffinity(0)),
        "memory_gb": round(memory / 1e9),
        "kernel": platform.release(),
        "isa": config["isa"],
        "isas": config["available_isas"],
        "versions": {
            "python": platform.python_version(),
            **{name: version(name) for name in PACKAGES},
            "ggml": os.environ.get("SACCADE_PEERS_GGML_VERSION", ""),
        },
        "timing": TIMING,
        "build": hashlib.sha256(Path(saccade._saccade.__file__).read_bytes()).hexdigest()[:12],
        "commit": said("git", "describe", "--always", "--dirty", "--exclude", "*"),
    }


def family_name(cpu: str) -> str:
    """The family that `saccade.show_config` tells: `Zen 4` of `Zen 4 (AuthenticAMD, family 25, model 17)`;
    vendor and numbers of an unknown one.
    """
    name, _, numbers = cpu.partition(" (")
    return numbers.removesuffix(")") if name == "unknown family" else name


def thread_counts() -> list[int]:
    """1, 2, 4, ... and the physical cores that this process may use, in ascending order."""
    cores = saccade.show_config("dicts")["num_threads"]
    return sorted({cores, *(1 << power for power in range(cores.bit_length()))})


def version(name: str) -> str:
    """Version of an installed package; empty if it is not installed."""
    if name == "saccade":
        return saccade.__version__
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return ""


def said(*command: str) -> str:
    """Output of a command; empty if it failed."""
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    return done.stdout.strip() if done.returncode == 0 else ""


def peaks(threads: int) -> dict[str, Any]:
    """Current peak rates of the CPU: multiply-adds per second from registers, of every instruction set and
    arithmetic; read bandwidth; clock.
    """
    return {"threads": threads, **saccade._saccade.measure_peaks(threads)}


def linear_bench(threads: list[int], rounds: int) -> Any:
    """Rates of saccade's linear layers relative to the peak, by `cargo bench --bench linear`."""
    with tempfile.NamedTemporaryFile(suffix=".json") as file:
        command = [
            "cargo",
            "bench",
            "--locked",
            "--quiet",
            "--package",
            "saccade-benches",
            "--bench",
            "linear",
        ]
        command += [
            "--",
            "--no-peers",
            "--threads",
            ",".join(map(str, threads)),
            "--rounds",
            str(rounds),
            "--json",
            file.name,
        ]
        subprocess.run(command, check=True, cwd=ROOT, stdout=subprocess.DEVNULL)
        return json.load(file)
