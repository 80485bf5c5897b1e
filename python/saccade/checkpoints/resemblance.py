"""How similar a checkpoint is to a reference checkpoint, tensor by tensor."""

from __future__ import annotations

import os

import numpy as np

from saccade.checkpoints.description import Source, open_published
from saccade.checkpoints.findings import PartResemblance, Resemblance, in_order, part_of
from saccade.checkpoints.initialisation import is_norm
from saccade.checkpoints.survey import Slice, dot, spread_of


class Reference:
    """A reference checkpoint that slices of another checkpoint are compared with.

    Raises:
        FileNotFoundError, CheckpointError: As :func:`saccade.checkpoints.describe`.
    """

    def __init__(self, source: Source) -> None:
        self.source = os.fspath(source)
        self._published = open_published(source)
        self.version: str = self._published.config()["version"]
        self._shapes = {name: tuple(shape) for name, _, shape, _ in self._published.tensors()}
        self._parts: dict[str, PartResemblance] = {}
        self._cosines: dict[str, list[float]] = {}
        self._different_shapes: list[str] = []
        self._absent: list[str] = []

    def compare(self, one: Slice) -> None:
        """Compares a tensor or slice with the same one of the reference."""
        name = self._published.prefix + one.name
        shape = self._shapes.get(name)
        own = one.values.shape
        if shape is None:
            self._absent += [one.name] if not one.embodiment else []
            return
        if one.embodiment is not None and one.embodiment >= shape[0]:
            return
        if shape[0 if one.embodiment is None else 1 :] != own:
            if not one.embodiment:
                self._different_shapes.append(f"{one.name}: {own}, in the reference {shape}")
            return
        theirs = self._published.read(name, one.embodiment)
        drawn = one.drawn
        if drawn is not None and drawn.kind == "constant" and np.all(theirs == drawn.scale):
            return  # as in every checkpoint
        part = self._parts.setdefault(part_of(one.name), PartResemblance())
        part.compared += 1
        if np.array_equal(one.values, theirs):
            part.identical += 1
        elif one.values.size > 1 and not one.name.endswith((".b", ".bias")) and not is_norm(one.name):
            mine, norm = np.sqrt(dot(one.values, one.values)), np.sqrt(dot(theirs, theirs))
            if mine > 0.0 and norm > 0.0:
                cosine = dot(one.values, theirs) / float(mine * norm)
                self._cosines.setdefault(part_of(one.name), []).append(cosine)
                difference = one.values - theirs
                change = np.sqrt(dot(difference, difference)) / norm
                part.largest_change = max(part.largest_change, float(change))

    def resemblance(self) -> Resemblance:
        """What was found, in the order of the parts."""
        for name, cosines in self._cosines.items():
            self._parts[name].cosine = spread_of(np.array(cosines))
        return Resemblance(self.source, self._different_shapes, self._absent, in_order(self._parts))
