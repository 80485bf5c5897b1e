"""What is repeated on a GPU as a CUDA graph; most of it is tested without one."""

# Torch's dispatch modes are untyped.
# mypy: disable-error-code="no-untyped-call"

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from torch._subclasses.fake_tensor import DataDependentOutputException, FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode

from saccade_lab.libero.recording import describe, load_samples, read_recordings
from saccade_lab.libero.sizes import libero_config
from saccade_lab.reference import masks, tables
from saccade_lab.training import train
from saccade_lab.training.batches import Batches, prompts_of
from saccade_lab.training.graphs import map_tensors, tensors_of
from saccade_lab.training.learner import Batch
from tests.helpers import libero_cases
from tests.helpers.training_cases import ALIGNED, TINY, make_batches, recorded

Given = tuple[Batch, torch.Tensor, torch.Tensor]
Made = tuple[train.Run, Batches]


def of_meta_world(device: str, **changes: Any) -> Made:
    settings = dataclasses.replace(ALIGNED if "alignment_weight" in changes else TINY, **changes)
    with_later = settings.aligned_block is not None
    return make_batches(recorded(), settings, with_later=with_later, device=device)


def of_libero(device: str, recording: Path) -> Made:
    """A policy of N1.7's kind."""
    settings = libero_cases.tiny("n1.7")
    config = libero_config(settings, libero_cases.SAID, libero_cases.SIZE)
    tasks = read_recordings(recording)
    samples, _ = load_samples(recording, tasks, settings.horizon, config.processor())
    config = libero_cases.with_statistics(config)
    run = train.new_run(settings, config, describe(recording, tasks), device)
    targets = samples.targets.mean(axis=0), samples.targets.std(axis=0) + 1
    prompts = prompts_of(config, config.processor())
    return run, Batches(samples, config, run.learner.backbone, prompts, targets, 2, shift=2)


@pytest.fixture(params=["plain", "aligned", "backbone", "n1.7"])
def make(request: pytest.FixtureRequest, tmp_path: Path) -> Callable[[str], Made]:
    """Makes a run before its first step, and what it draws from, on a device."""
    recording = libero_cases.write_recording(tmp_path)
    return {
        "plain": of_meta_world,
        "aligned": lambda device: of_meta_world(device, alignment_weight=0.2),
        "backbone": lambda device: of_meta_world(device, only="backbone"),
        "n1.7": lambda device: of_libero(device, recording),
    }[request.param]


def first(run: train.Run, batches: Batches) -> Given:
    """The first batch with its noise and times."""
    batch = batches.draw(0)
    return (batch, *run.learner.draw_noise(batch, torch.Generator().manual_seed(0)))


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
        if str(function) == "aten.copy_.default":
            self.count += args[0].device != args[1].device
        return result


@pytest.fixture
def no_tables() -> Iterator[None]:
    """Tables are made anew: pretended ones must not stay for other tests."""
    for clear in (True, False):
        tables.action_frequencies.cache_clear()
        tables.timestep_frequencies.cache_clear()
        if clear:
            yield


@pytest.mark.usefixtures("no_tables")
def test_losses_read_nothing_from_a_gpu_and_move_nothing_to_it(
    make: Callable[[str], Made], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A graph cannot: on pretended tensors of a GPU, torch raises where a value would be read."""
    monkeypatch.setattr(torch.cuda, "is_current_stream_capturing", lambda: True)
    run, batches = make("cpu")
    given = first(run, batches)
    with FakeTensorMode(allow_non_fake_inputs=True) as mode:

        def pretended(tensor: torch.Tensor) -> torch.Tensor:
            return mode.from_tensor(tensor.detach()).to("cuda")

        for module in run.learner.modules():
            for name, parameter in list(module.named_parameters(recurse=False)):
                setattr(module, name, torch.nn.Parameter(pretended(parameter)))
        average = {name: pretended(tensor) for name, tensor in run.average.items()}
        there = map_tensors(given, pretended)
        run.learner.losses(*there, average)  # the first call makes tables
        with Moves() as moves:
            losses = run.learner.losses(*there, average)
        assert moves.count == 0
        assert all(loss.is_cuda for loss in losses.values())
        with pytest.raises(DataDependentOutputException):
            losses["loss"].item()


class Reads(TorchDispatchMode):
    """Counts the operations that read values, or whose result has a size that depends on values."""

    NAMES = ("nonzero", "masked_select", "_local_scalar_dense", "equal.default")
    count = 0

    def __torch_dispatch__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        indices = args[1] if str(function).startswith("aten.index") and len(args) > 1 else ()
        by_mask = isinstance(indices, (list, tuple)) and any(
            isinstance(one, torch.Tensor) and one.dtype == torch.bool for one in indices
        )
        self.count += by_mask or any(name in str(function) for name in self.NAMES)
        return function(*args, **(kwargs or {}))


def test_nothing_is_read_on_the_way_back_either(
    make: Callable[[str], Made], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(masks, "can_be_read", lambda tensor: False)
    run, batches = make("cpu")
    losses = run.learner.losses(*first(run, batches), run.average)
    total = torch.stack(list(losses.values())).sum()
    with Reads() as reads:
        total.backward()
    assert reads.count == 0
    with Reads() as reads:
        total.item()
    assert reads.count == 1


GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")


@GPU
def test_batches_are_the_same_on_a_gpu(make: Callable[[str], Made]) -> None:
    here, there = (first(*make(device)) for device in ("cpu", "cuda"))
    for one, other in zip(tensors_of(here), tensors_of(there), strict=True):
        assert torch.equal(one, other.cpu())


@GPU
def test_graphs_give_what_their_kernels_give_one_by_one(make: Callable[[str], Made], tmp_path: Path) -> None:
    found = []
    for repeated in (False, True):
        run, batches = make("cuda")
        run.graphs = run.graphs if repeated else None
        train.train_step(run, batches.draw(0, 0))
        train.validation_losses(run, batches)
        train.save(run, tmp_path / str(repeated))
        train.resume(run, tmp_path / str(repeated) / "training.pt")
        found.append(([train.train_step(run, batches.draw(0, step)) for step in range(1, 9)], run.average))
    (losses, average), (again, average_again) = found
    assert len({tuple(one.values()) for one in again}) == 8
    for one, other in zip(losses, again, strict=True):
        assert one == pytest.approx(other, rel=1e-4)
    for name, tensor in average.items():
        torch.testing.assert_close(average_again[name], tensor, rtol=1e-3, atol=1e-5)
