"""Resized checkpoints: what is exact, what else changes, and what is refused."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from scipy.cluster.hierarchy import fcluster, linkage
from torch import Tensor

import saccade
from saccade import cli
from saccade.checkpoints import convert, resize
from saccade.checkpoints.comparison import action_changes
from saccade.errors import CheckpointError, InputError
from tests.helpers import layouts
from tests.helpers.checkpoint_files import equal, others_of, tensors_of

TOKENS = "action_head.future_tokens.weight"
N = 32


@pytest.fixture
def source(tmp_path: Path) -> Path:
    return layouts.write(tmp_path / "source", "nvidia", trained=[0])


def config_of(folder: Path) -> dict[str, Any]:
    config: dict[str, Any] = json.loads((folder / "config.json").read_text())
    return config


def tokens_of(folder: Path) -> Tensor:
    return tensors_of(folder)[TOKENS]


def all_but_tokens(folder: Path) -> dict[str, Tensor]:
    return {name: t for name, t in tensors_of(folder).items() if not name.endswith("future_tokens.weight")}


def changes(source: Path, resized: Path, **options: Any) -> Any:
    return action_changes(source, resized, num_observations=2, num_vl_tokens=11, **options)


@pytest.mark.parametrize("count", [33, 64, 100])
def test_growing_moves_no_action_in_saccade(count: int, source: Path, tmp_path: Path) -> None:
    report = resize(source, tmp_path / "out", num_future_tokens=count)
    before, after = tokens_of(source), tokens_of(tmp_path / "out")
    assert (report.num_before, report.num_after) == (N, count)
    assert torch.equal(after, before[torch.arange(count) % N])
    copies = torch.bincount(torch.arange(count) % N)
    expected = [-math.log(float(copies[index % N])) for index in range(count)]
    assert report.future_key_bias == pytest.approx(expected, abs=1e-7)
    assert report.is_exact
    assert report.sources == tuple((index % N,) for index in range(count))
    assert equal(all_but_tokens(source), all_but_tokens(tmp_path / "out"))

    config, old = config_of(tmp_path / "out"), config_of(source)
    own = config["action_head_cfg"].pop("saccade")
    assert own == {"future_key_bias": pytest.approx(expected, abs=1e-7)}
    assert config["action_head_cfg"].pop("num_target_vision_tokens") == count
    assert old["action_head_cfg"].pop("num_target_vision_tokens") == N
    assert config == old

    moved = changes(source, tmp_path / "out")
    assert moved.in_saccade.largest < 5e-6 * moved.actions_rms
    assert moved.in_other_programs.largest > 1e-3 * moved.actions_rms
    assert moved.in_other_programs.mean < moved.of_other_noise.mean


def test_other_programs_see_plain_copies(source: Path, tmp_path: Path) -> None:
    """What is said of them is what the copy does without saccade's own key."""
    out = tmp_path / "out"
    resize(source, out, num_future_tokens=50)
    said = changes(source, out).in_other_programs
    config = config_of(out)
    del config["action_head_cfg"]["saccade"]
    (out / "config.json").write_text(json.dumps(config))
    without = changes(source, out)
    assert without.in_saccade == said
    assert without.in_other_programs == said


@pytest.mark.parametrize("count", [64, 71, 160])
def test_there_and_back(count: int, source: Path, tmp_path: Path) -> None:
    resize(source, tmp_path / "more", num_future_tokens=count)
    report = resize(tmp_path / "more", tmp_path / "back", num_future_tokens=N)
    assert report.is_exact
    assert report.future_key_bias is None
    assert equal(tensors_of(source), tensors_of(tmp_path / "back"))
    assert others_of(source) == others_of(tmp_path / "back")


def test_twice_is_as_good_as_once(source: Path, tmp_path: Path) -> None:
    """A bias that is there already is kept: the copies of a copy weigh what the token did."""
    resize(source, tmp_path / "first", num_future_tokens=48)
    report = resize(tmp_path / "first", tmp_path / "second", num_future_tokens=70)
    assert report.future_key_bias is not None
    mass = np.zeros(N)
    for index, group in enumerate(report.sources):
        mass[group[0] % N] += math.exp(report.future_key_bias[index])
    assert mass == pytest.approx(np.ones(N), abs=1e-6)
    moved = changes(source, tmp_path / "second")
    assert moved.in_saccade.largest < 5e-6 * moved.actions_rms


def test_merging_equal_tokens_is_exact(source: Path, tmp_path: Path) -> None:
    tensors = tensors_of(source)
    tensors[TOKENS] = tensors[TOKENS][torch.arange(N) % 5].clone()
    save_file(tensors, source / "model.safetensors")
    report = resize(source, tmp_path / "out", num_future_tokens=5)
    assert report.is_exact
    assert report.sources == tuple(tuple(range(first, N, 5)) for first in range(5))
    expected = [math.log(len(group)) for group in report.sources]
    assert report.future_key_bias == pytest.approx(expected, abs=1e-6)
    moved = changes(source, tmp_path / "out")
    assert moved.in_saccade.largest < 5e-6 * moved.actions_rms
    assert moved.in_other_programs.largest > moved.in_saccade.largest


@pytest.mark.parametrize("count", [1, 7, 31])
def test_merging(count: int, source: Path, tmp_path: Path) -> None:
    report = resize(source, tmp_path / "out", num_future_tokens=count)
    assert not report.is_exact
    tokens = tokens_of(source).double()
    assert sorted(index for group in report.sources for index in group) == list(range(N))
    assert len(report.sources) == count
    assert report.future_key_bias is not None
    merged = tokens_of(tmp_path / "out").double()
    for group, token, bias in zip(report.sources, merged, report.future_key_bias, strict=True):
        torch.testing.assert_close(token, tokens[list(group)].mean(dim=0), rtol=1e-6, atol=1e-7)
        assert bias == pytest.approx(math.log(len(group)), abs=1e-6)
    # The same groups as SciPy's, which merges by the same rule: least squares, here of directions.
    directions = (tokens / tokens.norm(dim=1, keepdim=True)).numpy()
    names = fcluster(linkage(directions, "ward"), count, "maxclust")
    expected = {tuple(np.flatnonzero(names == name).tolist()) for name in set(names)}
    assert set(report.sources) == expected
    assert equal(all_but_tokens(source), all_but_tokens(tmp_path / "out"))


def test_a_bias_counts_in_merging(source: Path, tmp_path: Path) -> None:
    config = config_of(source)
    bias = [0.5 * math.sin(index) for index in range(N)]
    config["action_head_cfg"]["saccade"] = {"future_key_bias": bias}
    (source / "config.json").write_text(json.dumps(config))
    report = resize(source, tmp_path / "out", num_future_tokens=6)
    assert report.future_key_bias is not None
    tokens, weights = tokens_of(source).double(), np.exp(bias)
    for index, group in enumerate(report.sources):
        members = list(group)
        assert report.future_key_bias[index] == pytest.approx(math.log(weights[members].sum()), abs=1e-6)
        mean = (weights[members][:, None] * tokens[members].numpy()).sum(0) / weights[members].sum()
        np.testing.assert_allclose(tokens_of(tmp_path / "out")[index].numpy(), mean, rtol=1e-5, atol=1e-6)


def test_none_at_all(source: Path, tmp_path: Path) -> None:
    """As if all that looks at future tokens were cut, which another part of the engine does."""
    report = resize(source, tmp_path / "out", num_future_tokens=0)
    assert (report.sources, report.future_key_bias, report.is_exact) == ((), None, False)
    assert tokens_of(tmp_path / "out").shape == (0, 96)
    without, whole = (
        saccade.ActionHead.from_pretrained(tmp_path / "out"),
        saccade.ActionHead.from_pretrained(source),
    )
    features = np.random.default_rng(1).standard_normal((1, 9, 128), np.float32)
    state = np.ones((1, 12), np.float32)
    cut = saccade.Intervention(cut=[("state", "future"), ("action", "future")])
    given = without(features, state, 0, seed=3)
    np.testing.assert_allclose(given, whole(features, state, 0, seed=3, intervention=cut), atol=1e-5)
    with pytest.raises(CheckpointError, match="it has no future tokens: there is nothing to copy"):
        resize(tmp_path / "out", tmp_path / "more", num_future_tokens=4)


def test_as_many_is_a_copy(source: Path, tmp_path: Path) -> None:
    report = resize(source, tmp_path / "out", num_future_tokens=N)
    assert report.is_exact
    assert equal(tensors_of(source), tensors_of(tmp_path / "out"))
    assert others_of(source) == others_of(tmp_path / "out")


def test_perturbation(source: Path, tmp_path: Path) -> None:
    report = resize(source, tmp_path / "out", num_future_tokens=3 * N, perturbation=0.25, seed=7)
    before, after = tokens_of(source), tokens_of(tmp_path / "out")
    assert torch.equal(after[:N], before)
    noise = (after[N:] - before.repeat(2, 1)).double()
    rms = float(noise.square().mean().sqrt())
    assert rms == pytest.approx(0.25 * float(before.double().square().mean().sqrt()), rel=0.03)
    assert report.perturbation_rms == pytest.approx(rms, rel=1e-5)
    assert abs(float(noise.mean())) < 0.05 * rms
    assert not report.is_exact
    moved = changes(source, tmp_path / "out")
    assert moved.in_saccade.largest > 1e-4
    for seed, is_same in ((7, True), (8, False)):
        again = tmp_path / f"again{seed}"
        resize(source, again, num_future_tokens=3 * N, perturbation=0.25, seed=seed)
        assert torch.equal(tokens_of(again), after) == is_same
    with pytest.raises(InputError, match="perturbation: copies are perturbed"):
        resize(source, tmp_path / "less", num_future_tokens=5, perturbation=0.25)
    for amount in (-1.0, math.nan, math.inf, 1e300, 1e38, 1e20):
        with pytest.raises(InputError, match="perturbation"):
            resize(source, tmp_path / "more", num_future_tokens=64, perturbation=amount)


@pytest.mark.parametrize("dtype", ["bfloat16", "float16"])
def test_copies_keep_their_type_and_means_get_a_wider_one(dtype: str, source: Path, tmp_path: Path) -> None:
    convert(source, tmp_path / "half", dtype=dtype)
    grown = resize(tmp_path / "half", tmp_path / "more", num_future_tokens=40)
    assert not grown.is_widened
    assert tokens_of(tmp_path / "more").dtype == getattr(torch, dtype)
    merged = resize(tmp_path / "half", tmp_path / "less", num_future_tokens=4)
    assert merged.is_widened
    assert tokens_of(tmp_path / "less").dtype == torch.float32


@pytest.mark.parametrize("layout", layouts.LAYOUTS)
def test_every_layout(layout: str, tmp_path: Path) -> None:
    source = layouts.write(tmp_path / "source", layout)
    if layout in ("n1", "n16", "n17", "lerobot-n17"):
        with pytest.raises(CheckpointError, match=r"GR00T N1(\.[67])? has no future tokens"):
            resize(source, tmp_path / "out", num_future_tokens=8)
        return
    count = saccade.ActionHead.from_pretrained(source).config.num_future_tokens
    report = resize(source, tmp_path / "out", num_future_tokens=count + 5)
    assert (report.num_before, report.num_after) == (count, count + 5)
    config = saccade.ActionHead.from_pretrained(tmp_path / "out").config
    assert config.num_future_tokens == count + 5
    assert config.future_key_bias == report.future_key_bias
    assert equal(all_but_tokens(source), all_but_tokens(tmp_path / "out"))
    moved = changes(source, tmp_path / "out")
    assert moved.in_saccade.largest < 5e-6 * moved.actions_rms
    before, after = others_of(source), others_of(tmp_path / "out")
    if layout.startswith(("lerobot", "fork")):
        # Their config.json has no such number, and takes no keys that it does not know.
        assert json.loads(after.pop("saccade.json")) == {
            "future_key_bias": pytest.approx(report.future_key_bias)
        }
        assert after == before
    else:
        assert after.keys() == before.keys()
    resize(tmp_path / "out", tmp_path / "back", num_future_tokens=count)
    assert others_of(tmp_path / "back") == before
    assert equal(tensors_of(source), tensors_of(tmp_path / "back"))


def test_the_number_is_changed_wherever_it_stands(source: Path, tmp_path: Path) -> None:
    config = {**config_of(source), "num_target_vision_tokens": N, "extra": [{"num_target_vision_tokens": N}]}
    (source / "config.json").write_text(json.dumps(config, indent=3))
    resize(source, tmp_path / "out", num_future_tokens=40)
    changed = config_of(tmp_path / "out")
    assert changed["num_target_vision_tokens"] == changed["extra"][0]["num_target_vision_tokens"] == 40
    config["extra"] = [{"num_target_vision_tokens": 64}]
    (source / "config.json").write_text(json.dumps(config))
    with pytest.raises(CheckpointError, match=r"extra\[0\]\.num_target_vision_tokens is 64, but .* 32"):
        resize(source, tmp_path / "more", num_future_tokens=40)


def test_mismatches_are_fatal_and_all_listed(source: Path, tmp_path: Path) -> None:
    """What a public fork forgives, and then trains from noise."""
    config, tensors = config_of(source), tensors_of(source)
    changed = {**tensors, "action_head.vlln.weight": torch.zeros(3), "action_head.extra": torch.zeros(1)}
    save_file(changed, source / "model.safetensors")
    with pytest.raises(CheckpointError, match=r"(?s)vlln\.weight has shape \(3,\).*extra is unknown"):
        resize(source, tmp_path / "out", num_future_tokens=64)
    save_file(tensors, source / "model.safetensors")
    config["action_head_cfg"]["num_target_vision_tokens"] = 64
    (source / "config.json").write_text(json.dumps(config))
    with pytest.raises(CheckpointError, match=r"64 in the config, but .*future_tokens\.weight is \(32, 96\)"):
        resize(source, tmp_path / "out", num_future_tokens=64)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("bias", [-1000.0, 800.0, -3e38, 3e38])
@pytest.mark.parametrize("count", [5, N, 40])
def test_large_biases_stay_finite(bias: float, count: int, source: Path, tmp_path: Path) -> None:
    config = config_of(source)
    config["action_head_cfg"]["saccade"] = {"future_key_bias": [bias] * N}
    (source / "config.json").write_text(json.dumps(config))
    report = resize(source, tmp_path / "out", num_future_tokens=count)
    assert report.future_key_bias is not None
    copies = [sum(index % N == one for index in range(count)) for one in range(N)]
    for group, found in zip(report.sources, report.future_key_bias, strict=True):
        weight = len(group) if count < N else 1 / copies[group[0]]
        assert found == pytest.approx(bias + math.log(weight), rel=1e-6)
    written = config_of(tmp_path / "out")["action_head_cfg"]["saccade"]["future_key_bias"]
    assert written == pytest.approx(list(report.future_key_bias))
    assert torch.isfinite(tokens_of(tmp_path / "out")).all()


def test_the_heaviest_token_is_what_merging_leaves(source: Path, tmp_path: Path) -> None:
    """Weights whose exponentials float64 does not hold."""
    config = config_of(source)
    config["action_head_cfg"]["saccade"] = {"future_key_bias": [-1000.0] * (N - 1) + [1000.0]}
    (source / "config.json").write_text(json.dumps(config))
    report = resize(source, tmp_path / "out", num_future_tokens=1)
    assert report.future_key_bias == (1000.0,)
    assert torch.equal(tokens_of(tmp_path / "out")[0], tokens_of(source)[-1])


def test_tokens_that_are_not_finite(source: Path, tmp_path: Path) -> None:
    tensors = tensors_of(source)
    tensors[TOKENS][3, 4] = torch.nan
    save_file(tensors, source / "model.safetensors")
    with pytest.raises(CheckpointError, match=r"future_tokens\.weight holds NaN"):
        resize(source, tmp_path / "out", num_future_tokens=64)


@pytest.mark.parametrize("count", [-1, 4097, 2**63, 1.5])
def test_numbers_out_of_range(count: Any, source: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="num_future_tokens"):
        resize(source, tmp_path / "out", num_future_tokens=count)


def test_tokens_of_zeros(source: Path, tmp_path: Path) -> None:
    """They have no direction."""
    tensors = tensors_of(source)
    tensors[TOKENS][:] = 0
    tensors[TOKENS][5] = 1
    save_file(tensors, source / "model.safetensors")
    report = resize(source, tmp_path / "out", num_future_tokens=2)
    assert report.is_exact
    assert (5,) in report.sources


def features(folder: Path, **more: Any) -> Path:
    rng = np.random.default_rng(4)
    held: dict[str, Any] = {
        "backbone_features": rng.standard_normal((3, 9, 128), np.float32),
        "state": rng.standard_normal((3, 12), np.float32),
        "embodiment_id": np.array([2, 0, 2]),
    }
    np.savez(folder / "observations.npz", **held, **more)
    return folder / "observations.npz"


def test_actions_on_recorded_features(source: Path, tmp_path: Path) -> None:
    resize(source, tmp_path / "out", num_future_tokens=9)
    noise = np.random.default_rng(5).standard_normal((3, 16, 8), np.float32)
    drop_vl = np.zeros((3, 9), bool)
    drop_vl[1, 4:] = True
    file = features(tmp_path, noise=noise, drop_vl=drop_vl)
    found = action_changes(source, tmp_path / "out", features=file)
    assert found.observations == 3
    held = np.load(file)
    before, after = (
        np.asarray(
            saccade.ActionHead.from_pretrained(folder)(
                held["backbone_features"], held["state"], held["embodiment_id"], noise=noise, drop_vl=drop_vl
            )
        )
        for folder in (source, tmp_path / "out")
    )
    moved = np.abs(after.astype(float) - before)
    assert found.in_saccade.largest == pytest.approx(moved.max(), rel=1e-6)
    assert found.in_saccade.mean == pytest.approx(moved.mean(), rel=1e-6)


@pytest.mark.parametrize(
    ("name", "mask", "message"),
    [
        ("drop_vl", np.ones((3, 9), bool), "drop_vl: row 0 drops every position"),
        ("attention_mask", np.zeros((3, 9), bool), "attention_mask: false entries"),
    ],
)
def test_masks_that_the_head_would_refuse_are_refused_before_anything_is_written(
    name: str, mask: Any, message: str, source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, out = features(tmp_path, **{name: mask}), tmp_path / "out"
    options = ["--num-future-tokens", "8", "--out", str(out), "--features", str(file)]
    assert cli.main(["resize", str(source), *options]) == 2
    assert message in capsys.readouterr().err
    assert not out.exists()
    resize(source, out, num_future_tokens=8)
    with pytest.raises(InputError, match=message):
        action_changes(source, out, features=file)


def test_the_command(source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(tmp_path / "out")
    assert cli.main(["resize", str(source), "--num-future-tokens", "64", "--out", out]) == 0
    printed = capsys.readouterr().out
    for part in ("64 future tokens (was 32)", "in saccade", "in other programs", "rounding"):
        assert part in printed
    options = ["--num-future-tokens", "8", "--out", out, "--features", str(features(tmp_path)), "--force"]
    assert cli.main(["resize", str(source), *options, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["num_after"] == 8
    assert report["actions"]["observations"] == 3
    assert load_file(report["files"][0])[TOKENS].shape == (8, 96)
    for bad in (
        options[:-1],
        [*options[:1], "-3", *options[2:]],
        ["--num-future-tokens", "9", "--out", str(source)],
    ):
        assert cli.main(["resize", str(source), *bad]) == cli.EXIT_BAD_INPUT
        assert len(capsys.readouterr().err.splitlines()) == 1
