"""What `saccade study answer` measures of trained policies, and how well it predicts the effect of a cut."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest

from saccade.sim.policy import DEMO_CHECKPOINT
from saccade.study.answer import measures
from saccade.study.simulator import Simulator

TASKS = ("button-press-topdown",)


@pytest.fixture(scope="module")
def untrained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bundled policy, whose future rows nobody sees: their values are zero in the self-attention."""
    from safetensors.torch import load_file, save_file

    out = tmp_path_factory.mktemp("policy")
    shutil.copytree(DEMO_CHECKPOINT, out, dirs_exist_ok=True)
    tensors = load_file(out / "model.safetensors")
    for name, tensor in tensors.items():
        if "transformer_blocks.1.attn1.to_out" in name or "transformer_blocks.3.attn1.to_out" in name:
            tensors[name] = tensor * 0
    save_file(tensors, out / "model.safetensors", metadata={"format": "pt"})
    return out


def test_measures_of_the_bundled_policy() -> None:
    (found,) = measures.measure(str(DEMO_CHECKPOINT), TASKS, range(5))
    assert found.keys() == measures.NAMES.keys()
    assert found["chunk_change"] is not None
    assert 0 < found["chunk_change"] < 0.5
    assert found["attention_mass"] is not None
    assert 0.2 < found["attention_mass"] < 0.99  # 32 of 49 rows
    assert found["gradient_share"] is not None
    assert abs(found["gradient_share"]) < 1
    assert found["probe_r2"] is not None
    assert found["probe_r2"] < 1
    (found,) = measures.measure(str(DEMO_CHECKPOINT), TASKS, range(1))
    assert found["probe_r2"] is None


def test_attention_mass_is_that_of_the_trace() -> None:
    source = Simulator(str(DEMO_CHECKPOINT), TASKS, range(1))
    recorded, head = source.recorded(TASKS[0], 0), source.head()
    trace = source.recorded(TASKS[0], 0).observation.row(0).trace(head, record=("attention",))
    rows = len(head.future_tokens) + 1 + head.config.action_horizon
    square = {key: np.asarray(one) for key, one in trace.attention.items() if one.shape[-1] == rows}
    assert {block for _, block in square} == {1, 3}
    first = [one[0, :, -head.config.action_horizon :, 1:33].sum(-1).mean() for one in square.values()]
    one = type(recorded)(recorded.episode, recorded.observation.row(0), recorded.privileged)
    assert measures.attention_mass(head, one) == pytest.approx(np.mean(first))


def test_rows_that_nobody_sees_change_nothing(untrained: Path) -> None:
    """Without the output of self-attention no row reaches another one; all vision is read directly."""
    (found,) = measures.measure(str(untrained), TASKS, range(1))
    assert found["chunk_change"] == pytest.approx(0, abs=1e-5)
    assert found["gradient_share"] == pytest.approx(0, abs=1e-4)
    assert found["attention_mass"] is not None
    assert found["attention_mass"] > 0.2  # which a reader of attention maps cannot tell
