"""lerobot's own policies, accelerated: `make test-compat` runs this in an environment of each release.

The backbone's constructor downloads assets from the Hub, so a small module replaces it; policy, model and
head are small instances of lerobot's classes. Results are written to the file named by SACCADE_COMPAT_OUT.
"""

# Calls of torch modules are untyped, and lerobot has no types.
# mypy: disable-error-code="no-any-return, no-untyped-call, operator, attr-defined"

from __future__ import annotations

import contextlib
import copy
import functools
import importlib.metadata
import io
import json
import os
import platform
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
import torch
from torch import Tensor, nn
from transformers.feature_extraction_utils import BatchFeature

from saccade.integrations import Accelerated, accelerate
from saccade_lab.reference.random_weights import sized_config, small_config
from tests.helpers import integration_cases as cases
from tests.helpers.integration_refusals import check_refusals

LEROBOT = importlib.metadata.version("lerobot")
KIND = "n1.5" if LEROBOT.startswith(("0.4", "0.5")) else "n1.7"
IMAGE_TOKEN = 7
ACTION_DIM = 6
PACKAGES = ("lerobot", "torch", "transformers", "diffusers", "numpy")

RESULTS: dict[str, Any] = {}

torch.set_num_threads(1)  # small tensors gain nothing from more


@pytest.fixture(scope="module", autouse=True)
def written_results() -> Iterator[None]:
    """Writes what the tests have recorded."""
    yield
    versions = {name: importlib.metadata.version(name) for name in PACKAGES}
    report = {"python": platform.python_version(), "kind": KIND, "versions": versions, "results": RESULTS}
    if "SACCADE_COMPAT_OUT" in os.environ:
        Path(os.environ["SACCADE_COMPAT_OUT"]).write_text(json.dumps(report, indent=1))


class Backbone(nn.Module):
    """Features from token ids, in place of a vision-language model."""

    def __init__(self, context_dim: int) -> None:
        super().__init__()
        self.table = nn.Embedding(32, context_dim)
        self.linear = nn.Linear(context_dim, context_dim)

    def prepare_input(self, batch: dict[str, Any]) -> Any:
        return BatchFeature(data=batch)

    def forward(self, vl_input: Any) -> Any:
        prefix = "eagle_" if KIND == "n1.5" else ""
        ids, attended = vl_input[f"{prefix}input_ids"], vl_input[f"{prefix}attention_mask"]
        data = {"backbone_features": self.linear(self.table(ids)), "backbone_attention_mask": attended}
        if KIND == "n1.7":
            data |= {"image_mask": ids == IMAGE_TOKEN, "backbone_attention_mask": attended == 1}
        return BatchFeature(data=data)


def model(config: dict[str, Any]) -> Any:
    """lerobot's model around the stub and its own head."""
    context_dim = config["backbone_embedding_dim"]
    if KIND == "n1.5":
        from lerobot.policies.groot import groot_n1

        whole = groot_n1.GR00TN15Config(
            backbone_cfg={},
            action_head_cfg=config,
            action_horizon=config["action_horizon"],
            action_dim=config["action_dim"],
            compute_dtype="float32",
        )
        with mock.patch.object(groot_n1, "EagleBackbone", lambda: Backbone(context_dim)):
            return groot_n1.GR00TN15(whole, local_model_path="")
    from lerobot.policies.groot import groot_n1_7

    stub = mock.patch.object(groot_n1_7, "get_backbone_cls", lambda config: lambda **_: Backbone(context_dim))
    with stub:
        return groot_n1_7.GR00TN17(groot_n1_7.GR00TN17Config(**config))


def policy_around(model: Any) -> Any:
    """A `GrootPolicy` that holds the model."""
    from lerobot.configs.types import FeatureType, PolicyFeature
    from lerobot.policies.groot.configuration_groot import GrootConfig
    from lerobot.policies.groot.modeling_groot import GrootPolicy

    config = GrootConfig(
        input_features={"observation.images.front": PolicyFeature(FeatureType.VISUAL, (3, 8, 8))},
        output_features={"action": PolicyFeature(FeatureType.ACTION, (ACTION_DIM,))},
        device="cpu",
        use_bf16=False,
    )
    with (
        contextlib.redirect_stdout(io.StringIO()),
        mock.patch.object(GrootPolicy, "_create_groot_model", lambda self: model),
    ):
        return GrootPolicy(config).eval()


@functools.cache
def built() -> Any:
    """A `GrootPolicy` with random weights."""
    policy = policy_around(model(small_config(KIND)))
    cases.fill(policy)
    return policy.eval()


@pytest.fixture
def policy() -> Any:
    return copy.deepcopy(built())


@pytest.fixture
def case(policy: Any) -> cases.Case:
    return cases.Case(policy._groot_model.action_head, BatchFeature)


def use_bfloat16(policy: Any) -> None:
    """What lerobot does for `use_bf16`."""
    policy.config.use_bf16 = True
    if KIND == "n1.5":
        policy._groot_model.compute_dtype = "bfloat16"


def observations(batch: int) -> dict[str, Tensor]:
    """What a processor gives the policy: left-padded tokens, a run of image tokens, state and embodiment."""
    generator = torch.Generator().manual_seed(batch)
    ids = torch.randint(8, 32, (batch, 12), generator=generator)
    attended = torch.ones(batch, 12, dtype=torch.int64)
    for row in range(batch):
        attended[row, : 2 * row] = 0
        ids[row, 2 * row + 1 : 2 * row + 5] = IMAGE_TOKEN
    prefix = "eagle_" if KIND == "n1.5" else ""
    head = built()._groot_model.action_head
    state = torch.randn(batch, 1, head.config.max_state_dim, generator=generator)
    return {
        f"{prefix}input_ids": ids,
        f"{prefix}attention_mask": attended,
        "pixel_values": torch.zeros(1),
        "state": state,
        "embodiment_id": torch.arange(batch) % 3,
    }


def predict(policy: Any, batch: int, **options: Any) -> Tensor:
    torch.manual_seed(3)
    chunk = policy.predict_action_chunk(observations(batch), **options)
    assert chunk.shape[0] == batch
    assert chunk.shape[2] == ACTION_DIM
    return chunk


@pytest.mark.parametrize("batch", [1, 3])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16], ids=["float32", "bfloat16"])
@pytest.mark.parametrize("autocast", [False, True], ids=["plain", "autocast"])
def test_policy_predicts_the_same(policy: Any, batch: int, dtype: torch.dtype, autocast: bool) -> None:
    policy.to(dtype)
    if dtype is torch.bfloat16 and KIND == "n1.5":
        policy._groot_model.compute_dtype = "bfloat16"
    if autocast:
        use_bfloat16(policy)
    theirs = predict(policy, batch)
    with accelerate(policy):
        assert isinstance(policy._groot_model.action_head.get_action, Accelerated)
        ours = predict(policy, batch)
    assert ours.dtype is theirs.dtype
    error = cases.error(ours, theirs)
    name = f"{str(dtype).removeprefix('torch.')}{', autocast' if autocast else ''}"
    RESULTS[name] = max(error, RESULTS.get(name, 0.0))
    exact = dtype is torch.float32 and not autocast
    assert error <= (cases.EXACT if exact else cases.ROUNDED)


def test_policy_steps_the_same(policy: Any) -> None:
    def actions() -> Tensor:
        policy.reset()
        torch.manual_seed(4)
        return torch.stack(
            [policy.select_action(observations(1)) for _ in range(policy.config.n_action_steps + 3)]
        )

    theirs = actions()
    with accelerate(policy):
        ours = actions()
    assert cases.error(ours, theirs) <= cases.EXACT
    RESULTS["select_action"] = True


@pytest.mark.skipif(KIND != "n1.7", reason="N1.5 has no real-time chunking")
def test_policy_continues_a_chunk(policy: Any) -> None:
    """Through the policy's own translation of leftovers into the head's options."""
    left = torch.randn(9, ACTION_DIM, generator=torch.Generator().manual_seed(5))
    theirs = predict(policy, 2, prev_chunk_left_over=left, inference_delay=3)
    with accelerate(policy):
        ours = predict(policy, 2, prev_chunk_left_over=left, inference_delay=3)
    torch.testing.assert_close(ours[:, :3], left[None, :3].expand(2, -1, -1))
    RESULTS["real-time chunking"] = cases.error(ours, theirs)
    assert RESULTS["real-time chunking"] <= cases.EXACT


def test_training_between_evaluations(policy: Any) -> None:
    """An optimizer's steps in lerobot's training mode, then `predict_action_chunk`, which turns it off."""
    handle = accelerate(policy)
    before = predict(policy, 1)
    policy.train()
    optimizer = torch.optim.AdamW(policy.parameters(), lr=0.05)
    for parameter in policy.parameters():
        parameter.grad = torch.ones_like(parameter)
    optimizer.step()
    ours = predict(policy, 1)
    handle.restore()
    assert cases.error(ours, predict(policy, 1)) <= cases.EXACT
    assert cases.error(ours, before) > 0.1
    RESULTS["training in between"] = True


def test_saved_policies_are_the_originals(policy: Any, tmp_path: Path) -> None:
    from safetensors.torch import load_file

    tensors = policy.state_dict()
    with accelerate(policy):
        policy.save_pretrained(tmp_path)
    saved = load_file(tmp_path / "model.safetensors")
    assert saved.keys() == tensors.keys()
    assert all(torch.equal(saved[name], tensors[name]) for name in saved)
    RESULTS["save_pretrained"] = True


@pytest.mark.parametrize("precision", ["bfloat16", "int8"])
def test_other_precisions(case: cases.Case, precision: str) -> None:
    RESULTS[f"precision {precision}"] = cases.check_equal_seeds(case, batch=2, precision=precision)


def test_head_alone(case: cases.Case) -> None:
    RESULTS["head alone"] = max(cases.check_equal_seeds(copy.deepcopy(case), batch=batch) for batch in (1, 3))


@pytest.mark.skipif(KIND != "n1.7", reason="N1.5 has no real-time chunking")
def test_chunking_by_options(case: cases.Case) -> None:
    RESULTS["chunking by options"] = cases.check_chunking(case)


def test_restore(case: cases.Case) -> None:
    cases.check_restore(case)
    RESULTS["restore"] = True


@pytest.mark.parametrize("change", cases.CHANGES)
def test_weights_that_change_are_taken_anew(case: cases.Case, change: str) -> None:
    cases.check_changed_weights(case, cases.CHANGES[change])
    RESULTS[f"changed weights: {change}"] = True


def test_settings_are_read_live(case: cases.Case) -> None:
    cases.check_settings_are_read_live(case)
    RESULTS["settings"] = True


def test_copies_hold_the_original(case: cases.Case) -> None:
    cases.check_copies(case)
    RESULTS["copies"] = True


def test_refusals(case: cases.Case) -> None:
    check_refusals(case)
    RESULTS["refusals"] = True


def test_threads(case: cases.Case) -> None:
    cases.check_threads(case)
    RESULTS["threads"] = True


def test_published_widths() -> None:
    """Fewer blocks and embodiments, otherwise the published sizes."""
    config = sized_config(KIND, num_layers=6, vl_num_layers=1, num_embodiments=2)
    with contextlib.redirect_stdout(io.StringIO()):
        head = model(config).action_head.eval()
    case = cases.Case(cases.fill(head), BatchFeature)
    given = cases.inputs(case, num_vl_tokens=296)
    theirs = cases.call(case, given)
    with accelerate(head, embodiment_ids=[0]) as handle:
        ours = cases.call(case, given)
        assert handle.head.embodiment_ids == (0,)
    RESULTS["published widths"] = cases.assert_same(ours, theirs, cases.EXACT)
    difference = (ours.results["action_pred"] - theirs.results["action_pred"]).abs().max()
    RESULTS["published widths, largest difference"] = float(difference)
    assert float(difference) <= 3e-4 * max(1.0, float(theirs.results["action_pred"].abs().max()))
