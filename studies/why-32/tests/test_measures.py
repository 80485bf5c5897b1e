"""What the study measures of trained policies, and how well it predicts the effect of a cut."""

from __future__ import annotations

import itertools
import json
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from safetensors.torch import load_file, save_file
from torch import Tensor

from saccade.cli import main
from saccade.head.intervention import Intervention
from saccade_lab.reference import ActionHead
from saccade_lab.sim.policy import DEMO_CHECKPOINT
from saccade_lab.sim.tasks import find_task
from saccade_lab.study.linear_probes import PROPRIO, VL, Frames, join, probe
from saccade_lab.study.questions.patching_section import measured_rows, shares
from saccade_lab.study.questions.probes import frames_of
from saccade_lab.study.simulator import Simulator
from saccade_lab.study.table import read_table
from why_32 import measures, patching, probes, specialise
from why_32.specialise import KEPT, LEARNED, LOST, RANDOM, WEIGHTS, Removal

TASKS = ("button-press-topdown",)


def copy_of_the_demo(out: Path, changed: Callable[[str, Tensor], Tensor]) -> Path:
    """The bundled policy with other tensors."""
    shutil.copytree(DEMO_CHECKPOINT, out, dirs_exist_ok=True)
    tensors = {name: changed(name, one) for name, one in load_file(out / "model.safetensors").items()}
    save_file(tensors, out / "model.safetensors", metadata={"format": "pt"})
    return out


@pytest.fixture(scope="module")
def unseen(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bundled policy, whose future rows nobody sees: the output of self-attention is zero."""

    def changed(name: str, tensor: Tensor) -> Tensor:
        is_read = any(f"transformer_blocks.{block}.attn1.to_out" in name for block in (1, 3))
        return tensor * 0 if is_read else tensor

    return copy_of_the_demo(tmp_path_factory.mktemp("unseen"), changed)


@pytest.fixture(scope="module")
def equal(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The bundled policy with equal future tokens."""

    def changed(name: str, tensor: Tensor) -> Tensor:
        if name != "action_head.future_tokens.weight":
            return tensor
        return tensor.mean(dim=0, keepdim=True).repeat(len(tensor), 1)

    return copy_of_the_demo(tmp_path_factory.mktemp("equal"), changed)


#: As it is where a test replaces it.
GRADIENT_SHARE = measures.gradient_share


@pytest.fixture
def known_shares(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the episodes 0 to 4; computing them takes two seconds each."""
    monkeypatch.setattr(measures, "gradient_share", lambda source, task, seed: 0.1 * seed)


def test_measures_of_the_bundled_policy() -> None:
    (found,) = measures.measure(str(DEMO_CHECKPOINT), TASKS, range(1))
    assert found.keys() == measures.NAMES.keys()
    assert found["chunk_change"] is not None
    assert 0 < found["chunk_change"] < 0.5
    assert found["attention_mass"] is not None
    assert 0.2 < found["attention_mass"] < 0.99  # 32 of 49 rows
    assert found["gradient_share"] is not None
    assert abs(found["gradient_share"]) < 1
    assert found["probe_r2"] is None  # fewer episodes than folds


def test_measures_of_several_episodes(known_shares: None) -> None:
    (found,) = measures.measure(str(DEMO_CHECKPOINT), TASKS, range(5))
    assert found["gradient_share"] == pytest.approx(0.2)
    assert found["chunk_change"] is not None
    assert 0 < found["chunk_change"] < 0.5
    assert found["attention_mass"] is not None
    assert 0.2 < found["attention_mass"] < 0.99
    assert found["probe_r2"] is not None
    assert found["probe_r2"] < 1


def test_probes_of_the_bundled_policy() -> None:
    """The same numbers as those of `saccade study probes` on the same episodes."""
    rows = probes.measure(str(DEMO_CHECKPOINT), TASKS, range(5))
    found = {(row["group"], row["block"]): row["r2"] for row in rows}
    groups = {(group, block) for group in ("state", "future", "action") for block in range(4)}
    assert found.keys() == {("proprioception", -1), ("vl_embs", -1), *groups}
    source = Simulator(str(DEMO_CHECKPOINT), TASKS, range(5))
    frames = [frames_of(source.head(), source.recorded(TASKS[0], seed), 0) for seed in range(5)]
    of_study = pd.DataFrame(probe(join(frames, [0] * 5), probes.DIMENSIONS))
    of_study = of_study[of_study["target"].isin(probes.POSITIONS)]
    means = of_study.groupby(["rows", "block", "tokens"])["r2"].mean()
    for group, block in found:
        tokens = "mean" if group in ("future", "action") else "all"
        assert found[group, block] == pytest.approx(means[group, block, tokens], abs=1e-6)
    assert probes.measure(str(DEMO_CHECKPOINT), TASKS, range(1)) == []  # fewer episodes than folds


def test_probes_find_what_is_there() -> None:
    """A mean that holds the positions, one that holds one of the two, and one that holds none."""
    rng = np.random.default_rng(0)
    frames = []
    for episode in range(20):
        positions = {name: np.tile(rng.normal(size=(1, 3)), (4, 1)) for name in probes.POSITIONS}
        noise = rng.normal(size=(4, 6))
        inputs = {
            PROPRIO: noise,
            VL: np.concatenate(list(positions.values()), axis=1),
            ("future", 0, "mean"): np.concatenate([positions["goal"], noise], axis=1),
        }
        zeros = np.zeros(4, np.int64)
        frames.append(Frames(zeros + episode, zeros, inputs, positions))
    found = probes.r2_of_positions(frames, [0] * len(frames))
    assert found[VL] == pytest.approx(1, abs=0.01)
    assert found[PROPRIO] < 0.1
    assert found["future", 0, "mean"] == pytest.approx(0.5, abs=0.1)


def test_a_single_row_is_its_own_mean(tmp_path: Path, known_shares: None) -> None:
    """That of the state, and the future row of a policy with one token, of which `measures` has none."""

    def changed(name: str, tensor: Tensor) -> Tensor:
        return tensor[:1] if name == "action_head.future_tokens.weight" else tensor

    one = copy_of_the_demo(tmp_path / "one", changed)
    config = json.loads((one / "config.json").read_text())
    config["action_head_cfg"]["num_target_vision_tokens"] = 1
    (one / "config.json").write_text(json.dumps(config))
    rows = probes.measure(str(one), TASKS, range(5))
    assert {row["block"] for row in rows if row["group"] == "future"} == set(range(4))
    assert {row["block"] for row in rows if row["group"] == "state"} == set(range(4))
    (cheap,) = measures.measure(str(one), TASKS, range(5))
    assert cheap["probe_r2"] is None
    share = GRADIENT_SHARE(Simulator(str(one), TASKS, range(1)), TASKS[0], 0)
    assert abs(share) < 1


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


def test_rows_that_nobody_sees_change_nothing(unseen: Path) -> None:
    """Without the output of self-attention no row reaches another one; all vision is read directly."""
    (found,) = measures.measure(str(unseen), TASKS, range(1))
    assert found["chunk_change"] == pytest.approx(0, abs=1e-5)
    assert found["gradient_share"] == pytest.approx(0, abs=1e-4)
    assert found["attention_mass"] is not None
    assert found["attention_mass"] > 0.2  # which a reader of attention maps cannot tell


def specialised(checkpoint: Path, episodes: int = 1) -> dict[tuple[str, str], dict[str, Any]]:
    """The rows of `specialise.measure` by tokens and weight."""
    rows = specialise.measure(str(checkpoint), TASKS, range(episodes))
    return {(row["tokens"], row["weight"]): row for row in rows}


def test_the_mass_that_maps_share() -> None:
    maps = np.random.default_rng(0).dirichlet(np.ones(7), size=5)
    pairs = [np.minimum(one, two).sum() for one, two in itertools.combinations(maps, 2)]
    assert specialise.shared_mass(maps) == pytest.approx(np.mean(pairs))
    assert specialise.shared_mass(np.tile(maps[0], (3, 1))) == pytest.approx(1)
    assert specialise.shared_mass(np.eye(3)) == 0


def test_tokens_of_the_bundled_policy() -> None:
    """As the torch reference has them, where a removed token is a key that nobody sees."""
    found = specialised(DEMO_CHECKPOINT)
    assert list(found) == [(kind, weight) for kind in (LEARNED, RANDOM) for weight in WEIGHTS]
    source = Simulator(str(DEMO_CHECKPOINT), TASKS, range(1))
    rng = source.rng(TASKS[0], 0)
    seen = source.first(TASKS[0], 0, find_task(TASKS[0]).instruction(0)).with_noise(rng, source.config)
    head = ActionHead.from_pretrained(DEMO_CHECKPOINT).requires_grad_(False)
    context = head.encode(seen.backbone_features)
    count = head.config.num_future_tokens
    noise = seen.noise
    assert noise is not None
    whole = head.trace(context, seen.state, 0, noise=noise, record=("attention",))
    overlaps = []
    for (_, block), probabilities in whole.attention.items():
        if block in (0, 2):
            maps = probabilities[0].mean(dim=0)[1 : 1 + count].numpy()
            overlaps += [np.minimum(one, two).sum() for one, two in itertools.combinations(maps, 2)]
    assert found[LEARNED, KEPT]["overlap"] == pytest.approx(np.mean(overlaps), rel=1e-4)
    assert found[LEARNED, KEPT]["overlap"] == found[LEARNED, LOST]["overlap"]

    def changed(removed: list[int], weight: float) -> np.ndarray[Any, Any]:
        bias = np.full(count, weight, dtype=np.float32)
        bias[removed] = -np.inf
        change = Intervention(key_bias={"future": bias})
        after = head.sample(context, seen.state, 0, noise=noise, intervention=change)
        return np.asarray(after - whole.actions, dtype=np.float64)

    together = np.abs(changed(list(range(count)), 0.0)).mean()
    order = rng.permutation(count)
    for name, bias in ((KEPT, math.log(count / (count - 1))), (LOST, 0.0)):
        alone = [changed([token], bias) for token in range(count)]
        effects = np.array([np.abs(one).mean() for one in alone])
        row = found[LEARNED, name]
        assert row["mean_effect"] == pytest.approx(effects.mean(), rel=1e-3)
        assert row["effective_tokens"] == pytest.approx(effects.sum() ** 2 / (effects**2).sum(), rel=1e-3)
        assert row["largest_share"] == pytest.approx(effects.max() / together, rel=1e-3)
        half = order[: count // 2].tolist()
        change = changed(half, math.log(2) if name == KEPT else 0.0)
        added = np.sum([alone[token] for token in half], axis=0)
        share = 1 - np.square(change - added).sum() / np.square(change).sum()
        assert row["explained_half"] == pytest.approx(share, abs=1e-3)
        ratio = math.sqrt(np.square(change).sum() / np.square(added).sum())
        assert row["ratio_half"] == pytest.approx(ratio, rel=1e-3)
        assert (row["ratio_all"] is None) == (name == KEPT)


def test_equal_tokens_have_effects_by_their_number_only(equal: Path) -> None:
    found = specialised(equal)
    kept, lost = found[LEARNED, KEPT], found[LEARNED, LOST]
    assert kept["overlap"] == pytest.approx(1, abs=1e-6)
    assert found[RANDOM, KEPT]["overlap"] < 0.999
    assert (kept["mean_effect"], kept["largest_share"]) == (0, 0)
    nothing = (
        "effective_tokens",
        *(f"{name}_{size}" for name in ("explained", "ratio") for size in ("two", "half")),
    )
    assert [kept[name] for name in nothing] == [None] * 5
    assert lost["effective_tokens"] == pytest.approx(32, rel=1e-3)
    assert lost["mean_effect"] > 10 * specialise.ROUNDING
    assert found[RANDOM, KEPT]["effective_tokens"] > 1


def test_tokens_that_nobody_sees(unseen: Path) -> None:
    for row in specialised(unseen).values():
        assert 0 < row["overlap"] < 1
        assert row["mean_effect"] == 0
        numbers = [
            row[name] for name in row if name.startswith(("effective", "largest", "explained", "ratio"))
        ]
        assert numbers == [None] * 8
    (row,) = [
        row
        for row in patching.measure(str(unseen), TASKS, range(1))
        if (row["group"], row["block"]) == ("future", "all")
    ]
    assert (row["share"], row["pairs"]) == (pytest.approx(0, abs=1e-6), 1)


@pytest.mark.parametrize("count", [2, 3, 4, 7, 32])
@pytest.mark.parametrize("weight", WEIGHTS)
def test_effects_that_add_up(count: int, weight: str) -> None:
    """Toys: a chunk that is the sum of its tokens, and one that is their mean."""
    rng = np.random.default_rng(count)
    tokens, order = rng.standard_normal((count, 3, 2)), rng.permutation(count)

    def of_sum(removed: Any, weight: str) -> Any:
        return -tokens[removed].sum(axis=0)

    def of_mean(removed: Any, weight: str) -> Any:
        left = np.delete(tokens, removed, axis=0)
        return (left.mean(axis=0) if len(left) else 0) - tokens.mean(axis=0)

    sizes = {"two": 2, "half": count // 2, "all": count}
    sizes = {name: size for name, size in sizes.items() if size > 1 and (size < count or weight == LOST)}
    one = specialise.removal(of_sum, order, weight)
    assert set(one.sets) == set(sizes)
    np.testing.assert_allclose(one.effects, np.abs(tokens).mean(axis=(1, 2)))
    assert one.together == pytest.approx(np.abs(tokens.sum(axis=0)).mean())
    found = specialise.summary([one, one])
    assert found["effective_tokens"] == pytest.approx(specialise.effective_number(one.effects))
    for name in specialise.SIZES:
        expected = pytest.approx(1) if name in sizes else None
        assert found[f"explained_{name}"] == expected
        assert found[f"ratio_{name}"] == expected
    found = specialise.summary([specialise.removal(of_mean, order, weight)])
    for name, size in sizes.items():
        if size < count:  # of no tokens there is no mean
            share = 1 - ((size - 1) / (count - 1)) ** 2
            assert found[f"explained_{name}"] == pytest.approx(share)
            assert found[f"ratio_{name}"] == pytest.approx((count - 1) / (count - size))


def test_numbers_that_are_undefined_in_some_observations() -> None:
    nothing = Removal(np.zeros(4), 0.0, {})
    some = Removal(np.array([1.0, 1.0, 0.0, 0.0]), 2.0, {"two": specialise.MeanSquares(4.0, 1.0, 1.0)})
    found = specialise.summary([nothing, some])
    assert (found["effective_tokens"], found["largest_share"], found["mean_effect"]) == (2.0, 0.5, 0.25)
    assert (found["explained_two"], found["ratio_two"]) == (0.75, 2.0)
    assert set(specialise.summary([nothing]).values()) == {None, 0.0}


def test_patching_is_that_of_its_own_study(tmp_path: Path) -> None:
    arguments = ["--kinds", "layout", "--tasks", *TASKS, "--episodes", "2", "--out", str(tmp_path)]
    assert main(["study", "patching", *arguments]) == 0
    table = measured_rows(read_table(tmp_path / "patching.csv"))
    found = patching.measure(str(DEMO_CHECKPOINT), TASKS, range(2))
    assert len(found) == 4 * (1 + 4)
    for row in found:
        rows = table[(table["group"] == row["group"]) & (table["block"] == row["block"])]
        share, size = shares(rows)
        assert (row["share"], row["size"], row["pairs"]) == (
            pytest.approx(share.value),
            pytest.approx(size),
            2,
        )
    by_group = {row["group"]: row["share"] for row in found if row["block"] == "all"}
    assert (by_group["all rows"], by_group["action"]) == (pytest.approx(1, abs=1e-4),) * 2
