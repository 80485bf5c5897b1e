"""How similar a checkpoint is to a reference checkpoint, tensor by tensor."""

from __future__ import annotations

import os
from dataclasses import dataclass, field

import numpy as np

from saccade.checkpoints.description import Source, open_published
from saccade.checkpoints.findings import PartResemblance, Resemblance
from saccade.checkpoints.initialisation import is_norm
from saccade.checkpoints.parts import PARTS, UNUSED, part_of
from saccade.checkpoints.survey import Piece, dot
from saccade.checkpoints.tokens import spread_of


@dataclass
class _Compared:
    """What was counted of one part so far."""

    pieces: int = 0
    identical: int = 0
    cosines: list[float] = field(default_factory=list)
    largest_change: float = 0.0


class Reference:
    """A reference checkpoint that pieces of another checkpoint are compared with.

    Raises:
        FileNotFoundError, CheckpointError: As :func:`saccade.checkpoints.describe`.
    """

    def __init__(self, source: Source) -> None:
        self.source = os.fspath(source)
        self._published = open_published(source)
        self.version: str = self._published.config()["version"]
        self._shapes = {name: tuple(shape) for name, _, shape, _ in self._published.tensors()}
        self._parts: dict[str, _Compared] = {}
        self._different_shapes: list[str] = []
        self._absent: list[str] = []

    def compare(self, piece: Piece) -> None:
        """Compares a piece with the same piece of the reference."""
        name = self._published.prefix + piece.name
        shape = self._shapes.get(name)
        own = piece.values.shape
        if shape is None:
            self._absent += [piece.name] if not piece.embodiment else []
            return
        if piece.embodiment is not None and piece.embodiment >= shape[0]:
            return
        if shape[0 if piece.embodiment is None else 1 :] != own:
            if not piece.embodiment:
                self._different_shapes.append(f"{piece.name}: {own}, in the reference {shape}")
            return
        theirs = self._published.read(name, piece.embodiment)
        drawn = piece.drawn
        if drawn is not None and drawn.kind == "constant" and np.all(theirs == drawn.scale):
            return  # as in every checkpoint
        part = self._parts.setdefault(part_of(piece.name), _Compared())
        part.pieces += 1
        if np.array_equal(piece.values, theirs):
            part.identical += 1
        elif piece.values.size > 1 and not piece.name.endswith((".b", ".bias")) and not is_norm(piece.name):
            mine, norm = np.sqrt(dot(piece.values, piece.values)), np.sqrt(dot(theirs, theirs))
            if mine > 0.0 and norm > 0.0:
                part.cosines.append(dot(piece.values, theirs) / float(mine * norm))
                difference = piece.values - theirs
                change = np.sqrt(dot(difference, difference)) / norm
                part.largest_change = max(part.largest_change, float(change))

    def resemblance(self) -> Resemblance:
        """What was found, in the order of the parts."""
        return Resemblance(
            source=self.source,
            different_shapes=self._different_shapes,
            not_in_reference=self._absent,
            parts={
                name: PartResemblance(
                    pieces=part.pieces,
                    identical=part.identical,
                    cosine=spread_of(np.array(part.cosines)),
                    largest_change=part.largest_change,
                )
                for name, part in ((name, self._parts.get(name)) for name in (*PARTS, UNUSED))
                if part is not None
            },
        )
