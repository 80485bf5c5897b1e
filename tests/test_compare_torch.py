"""The benchmark beside torch: that it runs, and that its count of the exact work is right."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import saccade
from saccade.reference.random_weights import n15_config

SCRIPT = Path(__file__).parents[1] / "benches" / "compare_torch.py"


@pytest.fixture(scope="module")
def compare_torch() -> ModuleType:
    spec = importlib.util.spec_from_file_location("compare_torch", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["compare_torch"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def test_exact_work_at_the_released_size(compare_torch: ModuleType) -> None:
    config = saccade.HeadConfig.from_dict(n15_config())
    macs = compare_torch.exact_macs(config, 296)
    # By hand: 61.0 G for the VL self-attention, 14.9 G for the keys and values of the cross blocks;
    # 81.4 G of linear layers and 1.7 G of attention in four steps, less 3.1 G that the last block saves.
    assert macs["encode"] == pytest.approx(61.0e9 + 14.9e9, rel=2e-3)
    assert macs["sample"] == pytest.approx(81.4e9 + 1.7e9 - 3.1e9, rel=1e-2)
    assert macs["both"] == macs["encode"] + macs["sample"]


def test_quartiles(compare_torch: ModuleType) -> None:
    assert compare_torch.quartiles([3.0]) == (3.0, 3.0, 3.0)
    assert compare_torch.quartiles([4.0, 1.0, 3.0, 2.0, 5.0]) == (2.0, 3.0, 4.0)


def test_it_runs_at_a_small_size() -> None:
    command = [
        sys.executable,
        str(SCRIPT),
        "--size",
        "small",
        "--rounds",
        "2",
        "--threads",
        "1",
        "--vl-tokens",
        "7",
    ]
    command += ["--contenders", "saccade-f32", "saccade-bf16-stored", "lerobot-bf16", "--json"]
    finished = subprocess.run(command, capture_output=True, text=True, check=True)
    report = json.loads(finished.stdout)
    records = report["runs"][0]["contenders"]
    assert [record["contender"] for record in records] == command[command.index("--contenders") + 1 : -1]
    # Equal numbers in two files; then bfloat16 arithmetic.
    allowed = [0.0, 0.0, 0.1]
    for record, most in zip(records, allowed, strict=True):
        assert record["max_abs_from_first"] <= most
        for work in ("encode", "sample", "both"):
            assert len(record[work]["seconds"]) == 2
            assert record[work]["quartiles"][1] > 0


def test_unknown_contenders_are_refused() -> None:
    finished = subprocess.run(
        [sys.executable, str(SCRIPT), "--contenders", "jax"], capture_output=True, text=True
    )
    assert finished.returncode == 2
    assert "jax" in finished.stderr
