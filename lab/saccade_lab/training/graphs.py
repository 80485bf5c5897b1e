"""Repeats the work of a training step on a GPU as a CUDA graph."""

# Some calls of torch are untyped.
# mypy: disable-error-code="no-untyped-call"

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, TypeVar

import torch
from torch import Tensor

WARM_UP = 3  # calls before one is recorded, as torch advises
Given = TypeVar("Given")
Losses = dict[str, Tensor]


def map_tensors(value: Any, change: Callable[[Tensor], Tensor]) -> Any:
    """A value with its tensors changed, which may be in dataclasses, lists and tuples.

    Example:
        >>> map_tensors([torch.ones(2), (3, torch.zeros(1))], lambda one: one + 1)
        [tensor([2., 2.]), (3, tensor([1.]))]
    """
    if isinstance(value, Tensor):
        return change(value)
    if isinstance(value, (list, tuple)):
        return type(value)(map_tensors(one, change) for one in value)
    if is_dataclass(value) and not isinstance(value, type):
        changed = {one.name: map_tensors(getattr(value, one.name), change) for one in fields(value)}
        return replace(value, **changed)
    return value


def tensors_of(value: Any) -> list[Tensor]:
    """The tensors that ``map_tensors`` changes, in order."""
    found: list[Tensor] = []

    def keep(tensor: Tensor) -> Tensor:
        found.append(tensor)
        return tensor

    map_tensors(value, keep)
    return found


@dataclass(frozen=True)
class Recorded:
    """A recorded call.

    Attributes:
        graph: The graph.
        given: The tensors that it reads.
        losses: The tensors that it writes.
    """

    graph: torch.cuda.CUDAGraph
    given: list[Tensor]
    losses: Losses


class CudaGraphs:
    """Computes losses and gradients by CUDA graphs, one for each shape of what is given.

    A small policy's step is 1,800 kernels of 5 microseconds. Launching them one by one takes seven times as
    long as they run: 67 ms instead of 9 for 32 frames of LIBERO, on an H100.

    Args:
        compute: The losses of a batch. It writes gradients, reads nothing back from the GPU, and changes
            nothing else.
    """

    def __init__(self, compute: Callable[[Given], Losses]) -> None:
        self._compute = compute
        self._recorded: dict[tuple[torch.Size, ...], Recorded] = {}

    def __call__(self, given: Given) -> Losses:
        """The losses, in tensors that the next call overwrites."""
        tensors = tensors_of(given)
        shapes = tuple(tensor.shape for tensor in tensors)
        if shapes not in self._recorded:
            self._recorded[shapes] = self._record(given)
        recorded = self._recorded[shapes]
        for own, tensor in zip(recorded.given, tensors, strict=True):
            own.copy_(tensor)
        recorded.graph.replay()
        return recorded.losses

    def _record(self, given: Given) -> Recorded:
        own = map_tensors(given, Tensor.clone)
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):
            for _ in range(WARM_UP):
                self._compute(own)
        torch.cuda.current_stream().wait_stream(stream)
        graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(graph):
            losses = self._compute(own)
        return Recorded(graph, tensors_of(own), losses)
