"""What can be tested without torch: every fixture on every instruction set, errors, threads and fork.

`make test-aarch64` runs this file on emulated ARM CPUs, for which torch would be too slow.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import saccade
from saccade._internal.environment import _name_in, cpu_name
from saccade.errors import CheckpointError, InputError, ShapeError
from tests.helpers.released import NAMES, VARIANTS, Released, load_released

#: How far actions may be from those of float32, relative to the largest.
NARROW = {"bfloat16": 0.05, "int8": 0.1}


@pytest.fixture(params=NAMES + VARIANTS)
def fixture(request: pytest.FixtureRequest) -> Released:
    """Every file of tests/data that holds a head."""
    return load_released(request.param)


def load(released: Released, **options: Any) -> saccade.ActionHead:
    return saccade.ActionHead.from_pretrained(released.path, config=released.config, **options)


def sample(released: Released, **options: Any) -> NDArray[np.float32]:
    return np.asarray(load(released, **options)(**released.arguments))


def test_parity_on_every_instruction_set(fixture: Released, isa: str) -> None:
    head = load(fixture)
    assert head.isa == isa
    actions = np.asarray(head(**fixture.arguments))
    assert (np.abs(actions - fixture.actions_f64) <= fixture.tolerance).all()


@pytest.mark.parametrize("precision", NARROW)
def test_narrow_precisions_stay_near(fixture: Released, isa: str, precision: str) -> None:
    actions = sample(fixture, precision=precision)
    error = np.abs(actions - fixture.actions_f64).max() / np.abs(fixture.actions_f64).max()
    assert 0 < error < NARROW[precision]


@pytest.mark.parametrize("precision", ["float32", *NARROW])
def test_bits_do_not_depend_on_threads(isa: str, precision: str) -> None:
    released = load_released("n15_bf16")
    alone = sample(released, precision=precision, num_threads=1)
    for num_threads in (2, 3):
        np.testing.assert_array_equal(sample(released, precision=precision, num_threads=num_threads), alone)


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_forked_child_computes_the_same() -> None:
    released = load_released("n15_bf16")
    head = load(released, num_threads=2)
    before = np.asarray(head(**released.arguments))
    child = os.fork()
    if child == 0:
        os._exit(0 if (np.asarray(head(**released.arguments)) == before).all() else 1)
    assert os.waitpid(child, 0)[1] == 0


def test_an_instruction_set_that_this_cpu_lacks_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    available = saccade.show_config("dicts")["available_isas"]
    lacking = next(isa for isa in ("neon", "avx2", "avx1024") if isa not in available)
    monkeypatch.setenv("SACCADE_ISA", lacking)
    with pytest.raises(
        InputError, match=f"SACCADE_ISA: expected one of {', '.join(available)}, got `{lacking}`"
    ):
        load(load_released("n15_tiny"))


def test_inputs_and_files_that_do_not_fit(tmp_path: Path) -> None:
    released = load_released("n15_tiny")
    head = load(released)
    with pytest.raises(ShapeError, match="state"):
        head(**released.arguments | {"state": released.state[:, :, :-1]})
    with pytest.raises(InputError, match="precision"):
        load(released, precision="float64")
    cut = tmp_path / "cut.safetensors"
    cut.write_bytes(released.path.read_bytes()[:-1])
    with pytest.raises(CheckpointError):
        saccade.ActionHead.from_pretrained(cut, config=released.config)


@pytest.mark.parametrize(
    ("cpuinfo", "name"),
    [
        ("processor\t: 0\nmodel name\t: AMD EPYC: 7\nmodel name\t: another\n", "AMD EPYC: 7"),
        ("CPU implementer\t: 0x41\nCPU part\t: 0xd0b\n", "implementer 0x41 part 0xd0b"),
        ("CPU part\t: 0xd05\n\nCPU part\t: 0xd41\n", "implementer unknown part 0xd05"),
        ("CPU implementer\t: 0x7f\nCPU part\t: 0x123\n", "implementer 0x7f part 0x123"),
        ("CPU implementer\t:\nCPU part\t:\nno colon\n", ""),
    ],
)
def test_the_name_of_a_cpu(cpuinfo: str, name: str) -> None:
    assert _name_in(cpuinfo) == name
    assert saccade.show_config("dicts")["cpu"] == cpu_name() != ""
