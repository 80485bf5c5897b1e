"""The study of gradients: paths and sensitivities against autograd, finite differences and identities."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from saccade.cli import main
from saccade_lab.reference import ActionHead, random_weights
from saccade_lab.sim import demos, graphics
from saccade_lab.sim.cameras import DEFAULT_CAMERAS
from saccade_lab.study import derivatives
from saccade_lab.study.arms import NO_TOKENS
from saccade_lab.study.paths import ALL_PATHS, DETOUR, DIRECT, PATHS, READ
from saccade_lab.study.questions import gradients
from saccade_lab.study.table import read_provenance, read_table
from saccade_lab.training import train
from saccade_lab.training.settings import TrainingSettings

TASK = "button-press-topdown"


@pytest.fixture(autouse=True)
def no_probe(monkeypatch: pytest.MonkeyPatch) -> None:
    """The machine that runs these tests draws; test_sim_environment.py has the probe."""
    monkeypatch.setattr(graphics, "check", lambda: None)
    torch.set_num_threads(1)


@pytest.fixture(scope="module")
def case() -> tuple[ActionHead, Tensor, Tensor, Tensor]:
    """A small float64 head, and what it is given for one observation."""
    config = random_weights.small_config()
    config |= {"action_dim": 3, "max_action_dim": 3, "action_horizon": 4, "num_target_vision_tokens": 5}
    head = random_weights.random_head(config, seed=0, dtype=torch.float64)
    inputs = random_weights.random_inputs(head.config, seed=1, batch=1, num_vl_tokens=5)
    vl_embs, state, noise = (head.as_input(inputs[name]) for name in ("backbone_features", "state", "noise"))
    return head, head.encode(vl_embs).detach(), state.flatten(1), noise


def cotangents(head: ActionHead, count: int, seed: int = 0) -> Tensor:
    shape = (count, head.config.action_horizon, head.config.action_dim)
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def test_the_paths_add_up_to_the_whole_derivative(case: tuple[ActionHead, Tensor, Tensor, Tensor]) -> None:
    head, vl_embs, state, noise = case
    chosen = cotangents(head, 3)
    parts = derivatives.path_derivatives(head, vl_embs, state, noise, chosen)
    assert all(part.abs().max() > 0 for part in parts.values())

    # The whole against central differences along a random direction.
    direction = torch.randn(vl_embs.shape, generator=torch.Generator().manual_seed(7), dtype=torch.float64)
    step = 1e-5
    with torch.no_grad():
        ahead, behind = (
            head.sample(vl_embs + sign * step * direction, state, 0, noise=noise) for sign in (1, -1)
        )
    along = (ahead - behind) / (2 * step)  # (1, T, action_dim)
    for part, cotangent in zip(parts[ALL_PATHS], chosen, strict=True):
        assert float((part * direction).sum()) == pytest.approx(float((cotangent * along).sum()), rel=1e-6)

    # Independent of how the detour is computed: what future rows do not read is direct or a detour.
    leaf = vl_embs.expand(3, -1, -1).clone().requires_grad_()
    actions = head.sample(
        leaf,
        state.expand(3, -1),
        0,
        noise=noise.expand(3, -1, -1),
        stop_gradient=[("future", "vl")],
    )
    unread = torch.autograd.grad((actions * chosen).sum(), leaf)[0]
    torch.testing.assert_close(parts[DIRECT] + parts[DETOUR], unread, rtol=0, atol=1e-12)
    torch.testing.assert_close(unread + parts[READ], parts[ALL_PATHS], rtol=0, atol=1e-12)


def test_shares_of_known_parts() -> None:
    along, across = torch.zeros(2, 3, 4), torch.zeros(2, 3, 4)
    along[..., 0], across[..., 1] = 1.0, 1.0
    parts = {DIRECT: 3 * along, READ: along + across, DETOUR: -across, ALL_PATHS: 4 * along}
    found = derivatives.shares(parts)
    assert found.share == pytest.approx({DIRECT: 0.75, READ: 0.25, DETOUR: 0.0})
    assert found.length == pytest.approx({DIRECT: 0.75, READ: math.sqrt(2) / 4, DETOUR: 0.25})
    assert found.cosine[DIRECT, READ] == pytest.approx(math.sqrt(0.5))
    assert found.cosine[DIRECT, DETOUR] == 0.0
    nothing = derivatives.shares({**parts, DETOUR: 0 * along, READ: along})
    assert math.isnan(nothing.cosine[READ, DETOUR])


def test_random_projections_estimate_the_frobenius_norms(
    case: tuple[ActionHead, Tensor, Tensor, Tensor],
) -> None:
    head, vl_embs, state, noise = case
    outputs = head.config.action_horizon * head.config.action_dim
    every = torch.eye(outputs, dtype=torch.float64).view(outputs, head.config.action_horizon, -1)
    exact = derivatives.shares(derivatives.path_derivatives(head, vl_embs, state, noise, every))
    drawn = cotangents(head, 64, seed=3)
    estimated = derivatives.shares(derivatives.path_derivatives(head, vl_embs, state, noise, drawn))
    assert sum(exact.share.values()) == pytest.approx(1.0)
    for path in PATHS:
        assert estimated.length[path] == pytest.approx(exact.length[path], abs=0.15)
        assert estimated.share[path] == pytest.approx(exact.share[path], abs=0.15)


def test_sensitivity_of_learned_tokens_is_autograd_s(case: tuple[ActionHead, Tensor, Tensor, Tensor]) -> None:
    head, vl_embs, state, noise = case
    chosen = cotangents(head, 1)
    measured = derivatives.action_sensitivity(head, vl_embs, state, noise, chosen)
    assert len(measured) == head.config.num_layers + 1
    tokens = head.future_tokens.weight
    actions = head.sample(vl_embs, state, 0, noise=noise)
    derivative = torch.autograd.grad((actions * chosen).sum(), tokens)[0]
    future = slice(1, 1 + head.config.num_future_tokens)
    norm, relative = measured[0]
    torch.testing.assert_close(norm[future], derivative.norm(dim=-1))
    torch.testing.assert_close(relative[future], (derivative.norm(dim=-1) * tokens.norm(dim=-1)).detach())
    # After the last block only action rows are decoded.
    last = measured[-1][0]
    assert float(last[: future.stop].abs().max()) == 0.0
    assert float(last[future.stop :].min()) > 0.0
    # Nothing is left behind in the head.
    torch.testing.assert_close(head.sample(vl_embs, state, 0, noise=noise), actions, rtol=0, atol=0)
    assert not head.model.transformer_blocks[0]._forward_pre_hooks


def test_sensitivity_after_a_block_is_that_of_a_patch(
    case: tuple[ActionHead, Tensor, Tensor, Tensor],
) -> None:
    """Against central differences: a row after a block nudged at every step, by a hook of our own."""
    head, vl_embs, state, noise = case
    chosen = cotangents(head, 1)
    block, row = 1, 2
    direction = torch.randn(
        head.config.width, generator=torch.Generator().manual_seed(5), dtype=torch.float64
    )
    measured = derivatives.Nudges(head, 1)
    with measured.applied():
        actions = head.sample(vl_embs, state, 0, noise=noise)
    derivative = measured.derivatives((actions * chosen).sum())[block + 1][0, row]
    step = 1e-5

    def nudged(sign: int) -> Tensor:
        def add(module: object, inputs: object, rows: Tensor) -> Tensor:
            changed = rows.clone()
            changed[:, row] += sign * step * direction
            return changed

        handle = head.model.transformer_blocks[block].register_forward_hook(add)
        with torch.no_grad():
            found = head.sample(vl_embs, state, 0, noise=noise)
        handle.remove()
        return found

    along = float(((nudged(1) - nudged(-1)) * chosen).sum()) / (2 * step)
    assert float(derivative @ direction) == pytest.approx(along, rel=1e-6)


def test_sensitivity_of_the_loss_is_autograd_s(case: tuple[ActionHead, Tensor, Tensor, Tensor]) -> None:
    head, features, state, actions = case
    mask = torch.ones(1, head.config.action_horizon, 1, dtype=torch.float64)
    mask[:, 3:] = 0.0
    draws = 4
    generator = torch.Generator().manual_seed(0)
    measured = derivatives.loss_sensitivity(head, features, state, actions, mask, generator, draws)
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn(draws, *actions.shape[1:], generator=generator, dtype=torch.float64)
    time = head.sample_time(draws, generator)
    losses = [
        head.loss(features, state, 0, actions, noise=noise[[one]], time=time[[one]], action_mask=mask)
        for one in range(draws)
    ]
    derivative = torch.autograd.grad(torch.stack(losses).mean(), head.future_tokens.weight)[0]
    future = slice(1, 1 + head.config.num_future_tokens)
    torch.testing.assert_close(measured[0][0][future], derivative.norm(dim=-1))


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two demonstrations as the shipped policy would see them."""
    out = tmp_path_factory.mktemp("demos")
    settings = demos.RecordingSettings(frame_stride=12, cameras=DEFAULT_CAMERAS)
    demos.record_tasks({TASK: 2}, out, settings, lambda task: None)
    return out


def test_the_study_end_to_end(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = [
        "study",
        "gradients",
        "--tasks",
        TASK,
        "--episodes",
        "2",
        "--num-observations",
        "2",
        "--projections",
        "2",
    ]
    assert main([*arguments, "--demos", str(recording), "--out", str(tmp_path)]) == 0
    assert "runs through state and action rows only" in capsys.readouterr().out
    table = read_table(tmp_path / "gradients.csv")
    provenance = read_provenance(tmp_path / "gradients.json")
    assert provenance.complete
    assert set(table["of"]) == {"actions", "loss"}
    shares = table[table["share"].notna()].groupby("seed")["share"].sum()
    np.testing.assert_allclose(shares, 1.0, rtol=1e-5)
    tokens = table[(table["of"] == "actions") & (table["seed"] == 0) & table["token"].notna()]
    assert tokens["token"].tolist() == list(range(32))
    section = gradients.Gradients.summarise(table, provenance)
    assert [figure.name for figure in section.figures] == [
        "paths",
        "rows-of-actions",
        "rows-of-loss",
        "tokens",
    ]
    assert section.not_shown


def test_a_policy_without_future_tokens(recording: Path, tmp_path: Path) -> None:
    settings = TrainingSettings(
        steps=1, batch_size=1, width=8, num_layers=2, num_heads=1, language_layers=1, num_future_tokens=0
    )
    train.train(recording, tmp_path / "policy", settings, lambda progress: None)
    arguments = [
        "study",
        "gradients",
        "--checkpoint",
        str(tmp_path / "policy"),
        "--episodes",
        "1",
        "--num-observations",
        "1",
    ]
    assert main([*arguments, "--projections", "1", "--out", str(tmp_path)]) == 0
    table = read_table(tmp_path / "gradients.csv")
    assert NO_TOKENS in set(table["note"])
    section = gradients.Gradients.summarise(table, read_provenance(tmp_path / "gradients.json"))
    assert section.concluded == ["Paths: not measured, the checkpoint has no future tokens."]


def test_bad_input(recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def refused(*arguments: str) -> str:
        assert main(["study", "gradients", *arguments, "--out", str(tmp_path / "out")]) == 2
        return capsys.readouterr().err

    assert "num-observations: given 0, expected at least 1" in refused("--num-observations", "0")
    assert "projections: given -1" in refused("--projections", "-1")
    assert "has none of reach" in refused("--tasks", "reach", "--demos", str(recording))
    other = demos.RecordingSettings(image_size=16, frame_stride=12, cameras=DEFAULT_CAMERAS[:1])
    demos.record_tasks({TASK: 1}, tmp_path / "other", other, lambda task: None)
    assert "another image size" in refused("--tasks", TASK, "--demos", str(tmp_path / "other"))
    assert not (tmp_path / "out").exists()
