"""The plugin's rule of real-time chunking, on what lerobot 0.6.1's own GR00T policy computed."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from safetensors.torch import load_file

import saccade
from saccade_lab.reference.chunking import start_of
from tests.helpers.plugin_module import plugin_module

ROOT = Path(__file__).resolve().parents[2]
DATA = ROOT / "tests" / "data" / "rtc_lerobot"
CASES: list[dict[str, Any]] = json.loads((DATA / "dev.json").read_text())
RULE = saccade.Chunking(overlap=0, frozen=0)


continued = plugin_module("real_time_chunking").continued


@pytest.mark.parametrize("case", CASES, ids=lambda case: str(case["case"]))
def test_as_released(case: dict[str, Any]) -> None:
    tensors = load_file(DATA / "dev.safetensors")
    previous, noise, expected = (tensors[f"{case['case']}.{name}"] for name in ("prev", "noise", "out"))
    batch, horizon, width = noise.shape
    options = continued(
        previous,
        case["inference_delay"],
        batch=batch,
        horizon=horizon,
        execution_horizon=case["execution_horizon"],
        chunking=saccade.Chunking(0, 0, ramp_rate=case["ramp"]),
    )
    chunking = options["chunking"]
    assert (chunking.overlap, chunking.frozen) == (case["overlap"], case["frozen"])
    rows = torch.nn.functional.pad(options["previous_chunk"], (0, width - previous.shape[-1]))
    config: Any = SimpleNamespace(action_horizon=horizon, action_dim=width, encoder_action_dim=width)
    x, strength = start_of(noise, rows, chunking, config)
    assert strength is not None
    for _ in range(case["steps"]):
        x = x + (x / 2 + 1) * strength / case["steps"]
    torch.testing.assert_close(x, expected, rtol=1e-5, atol=1e-5)


def rows(*numbers: float) -> torch.Tensor:
    return torch.tensor(numbers)[:, None].expand(-1, 2)


@pytest.mark.parametrize(
    ("left_over", "options", "taken", "frozen"),
    [
        (rows(1, 0, 2, 0, 0), {}, [1, 0, 2], 0),  # only what is at the end is padding
        (rows(*range(1, 8)), {}, [4, 5, 6, 7], 0),
        (rows(*range(1, 8)), {"execution_horizon": 3}, [5, 6, 7], 0),
        (rows(1, 2, 3), {"inference_delay": 2.9}, [1, 2, 3], 2),
        (rows(1, 2, 3), {"inference_delay": -1}, [1, 2, 3], 0),
        (rows(1, 2, 3), {"inference_delay": 99}, [1, 2, 3], 3),
    ],
)
def test_which_actions_are_taken(
    left_over: torch.Tensor, options: dict[str, Any], taken: list[int], frozen: int
) -> None:
    found = continued(
        left_over,
        options.get("inference_delay"),
        batch=2,
        horizon=4,
        execution_horizon=options.get("execution_horizon"),
        chunking=RULE,
    )
    assert found["previous_chunk"].tolist() == [[[number, number] for number in taken]] * 2
    rule = found["chunking"]
    assert (rule.overlap, rule.frozen, rule.horizon) == (len(taken), frozen, len(taken))


@pytest.mark.parametrize("left_over", [None, torch.zeros(0, 2), torch.zeros(3, 2), rows(1, 2)])
def test_nothing_to_continue(left_over: torch.Tensor | None) -> None:
    found = continued(left_over, 1, batch=1, horizon=4, execution_horizon=0, chunking=RULE)
    assert found == {}


@pytest.mark.parametrize(
    ("left_over", "delay", "kind", "message"),
    [
        ([[1.0]], 0, TypeError, "prev_chunk_left_over: expected a torch tensor, got list"),
        (torch.ones(4), 0, ValueError, r"prev_chunk_left_over: expected \(T, D\), or .* got \(4,\)"),
        (torch.ones(3, 4, 2), 0, ValueError, r"with B 2, got \(3, 4, 2\)"),
        (rows(1, 2), "soon", ValueError, "inference_delay: expected a number of actions, got 'soon'"),
        (rows(1, 2), float("nan"), ValueError, "inference_delay: .* got nan"),
    ],
)
def test_refusals(left_over: Any, delay: Any, kind: type[Exception], message: str) -> None:
    with pytest.raises(kind, match=message):
        continued(left_over, delay, batch=2, horizon=4, execution_horizon=10, chunking=RULE)


def test_a_row_that_is_no_number_is_not_padding() -> None:
    found = continued(rows(1, float("nan")), 0, batch=1, horizon=4, execution_horizon=None, chunking=RULE)
    assert found["previous_chunk"].shape == (1, 2, 2)  # so that saccade refuses it
