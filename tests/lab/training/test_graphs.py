"""What is repeated on a GPU as a CUDA graph; most of it is tested without one."""

# Torch's dispatch modes are untyped.
# mypy: disable-error-code="no-untyped-call"

from __future__ import annotations

import dataclasses
from typing import Any

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode

from saccade_lab.reference import intervene
from saccade_lab.training import train
from saccade_lab.training.graphs import map_tensors, tensors_of
from saccade_lab.training.learner import Batch
from saccade_lab.training.settings import TrainingSettings
from tests.helpers.training_cases import ALIGNED, TINY, make_batches, recorded

Given = tuple[Batch, torch.Tensor, torch.Tensor]
WHOLE = pytest.mark.parametrize(
    "settings",
    [TINY, ALIGNED, dataclasses.replace(TINY, only="backbone")],
    ids=["plain", "aligned", "backbone"],
)


def make(settings: TrainingSettings) -> tuple[train.Run, Given]:
    """A run before its first step, and its first batch with noise and times."""
    run, batches = make_batches(recorded(), settings, with_later=settings.aligned_block is not None)
    batch = batches.draw(0)
    return run, (batch, *run.learner.noise(batch, torch.Generator().manual_seed(0)))


@dataclasses.dataclass(frozen=True)
class Pair:
    first: torch.Tensor
    rest: list[Any]


def test_tensors_are_found_and_changed_wherever_they_are() -> None:
    given = (Pair(torch.ones(2), [torch.zeros(1), (3, 4)]), None, torch.ones(3))
    assert [len(tensor) for tensor in tensors_of(given)] == [2, 1, 3]
    pair, nothing, last = map_tensors(given, torch.neg)
    assert (nothing, pair.rest[1]) == (None, (3, 4))
    assert torch.equal(torch.cat((pair.first, pair.rest[0], last)), torch.tensor([-1.0, -1, 0, -1, -1, -1]))
    assert given[0].first.tolist() == [1, 1]


class Moves(TorchDispatchMode):
    """Counts what is copied from one device to another."""

    count = 0

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        result = function(*args, **(kwargs or {}))
        if str(function) == "aten._to_copy.default":
            self.count += args[0].device != result.device
        return result


@WHOLE
def test_losses_read_nothing_from_a_gpu_and_move_nothing_to_it(
    settings: TrainingSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A graph cannot: on pretended tensors of a GPU, torch raises where a value would be read."""
    monkeypatch.setattr(torch.cuda, "is_current_stream_capturing", lambda: True)
    run, given = make(settings)
    with FakeTensorMode(allow_non_fake_inputs=True) as mode:

        def pretended(tensor: torch.Tensor) -> torch.Tensor:
            return mode.from_tensor(tensor.detach()).to("cuda")

        for module in run.learner.modules():
            for name, parameter in list(module.named_parameters(recurse=False)):
                setattr(module, name, torch.nn.Parameter(pretended(parameter)))
        average = {name: pretended(tensor) for name, tensor in run.average.items()}
        there: Given = map_tensors(given, pretended)
        run.learner.losses(*there, average)  # the first call makes tables
        with Moves() as moves:
            losses = run.learner.losses(*there, average)
        assert moves.count == 0
        assert all(loss.is_cuda for loss in losses.values())
        with pytest.raises(Exception, match=r"data-dependent|DataDependent|_local_scalar_dense"):
            losses["loss"].item()


class Reads(TorchDispatchMode):
    """Counts the operations whose result has a size that depends on values."""

    count = 0

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        indices = args[1] if str(function).startswith("aten.index") and len(args) > 1 else ()
        by_mask = isinstance(indices, (list, tuple)) and any(
            isinstance(one, torch.Tensor) and one.dtype == torch.bool for one in indices
        )
        self.count += by_mask or any(name in str(function) for name in ("nonzero", "masked_select"))
        return function(*args, **(kwargs or {}))


@WHOLE
def test_no_size_depends_on_values_on_the_way_back_either(
    settings: TrainingSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(intervene, "can_be_read", lambda tensor: False)
    run, given = make(settings)
    with Reads() as reads:
        train.gradients(run, given)
    assert reads.count == 0


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@WHOLE
def test_a_graph_gives_what_its_kernels_give_one_by_one(settings: TrainingSettings) -> None:
    found = []
    for graphs in (False, True):
        run, batches = make_batches(
            recorded(), settings, with_later=settings.aligned_block is not None, device="cuda"
        )
        run.graphs = run.graphs if graphs else None
        losses = [train.train_step(run, batches.draw(settings.seed, step)) for step in range(5)]
        found.append((losses, run.average))
    for one, other in zip(*(losses for losses, _ in found), strict=True):
        assert one == pytest.approx(other, rel=1e-3)
    for name, tensor in found[0][1].items():
        torch.testing.assert_close(found[1][1][name], tensor, rtol=1e-2, atol=1e-4)
