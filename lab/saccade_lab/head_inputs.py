"""The inputs of an action head: features of a backbone, states, and the noise that sampling starts from."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from saccade._internal.arrays import Float32Array
from saccade.errors import InputError
from saccade.head.chunking import Chunking
from saccade.head.config import HeadConfig
from saccade.head.context import Context
from saccade.head.head import ActionHead
from saccade.head.input_files import BoolArray, checked, read_arrays
from saccade.head.intervention import Intervention
from saccade.head.trace import Trace


@dataclass(frozen=True, eq=False)
class HeadInputs:
    """The inputs of an action head for a batch of observations.

    Attributes:
        backbone_features: ``(batch, T_vl, context_dim)``, floating point.
        state: ``(batch, state_dim)`` or ``(batch, num_states, state_dim)``, normalised, floating point.
        embodiment_id: ``(batch,)`` int64.
        noise: The noise that sampling starts from, ``(batch, action_horizon, encoder_action_dim)``, or with
            several draws for each row ``(batch, draws, action_horizon, encoder_action_dim)``; None before it
            is drawn.
        attention_mask, image_mask, drop_vl: ``(batch, T_vl)`` bool, see ``saccade.ActionHead.encode``; or
            None.
        episode: ``(batch,)`` int64, the episode of each row, counted from 0; None if unknown.

    Example:
        >>> import numpy as np, saccade
        >>> from saccade_lab.head_inputs import HeadInputs
        >>> head = saccade.ActionHead.from_pretrained(saccade.demo_checkpoint())
        >>> inputs = HeadInputs.random(head.config, num_vl_tokens=60, rng=np.random.default_rng(0))
        >>> inputs.sample(head).shape
        (1, 16, 4)
    """

    backbone_features: npt.NDArray[Any]
    state: npt.NDArray[Any]
    embodiment_id: npt.NDArray[np.int64]
    noise: npt.NDArray[Any] | None = None
    attention_mask: BoolArray | None = None
    image_mask: BoolArray | None = None
    drop_vl: BoolArray | None = None
    episode: npt.NDArray[np.int64] | None = None

    @classmethod
    def random(
        cls, config: HeadConfig, num_vl_tokens: int, rng: np.random.Generator, embodiment_id: int = 0
    ) -> HeadInputs:
        """One observation of standard normal features, state and noise, drawn in this order.

        Args:
            config: Config of the head.
            num_vl_tokens: Number of vision-language tokens (T_vl).
            rng: Generator of the numbers.
            embodiment_id: The embodiment.
        """
        shapes = (
            (1, num_vl_tokens, config.context_dim),
            (1, config.num_states, config.state_dim),
            (1, config.action_horizon, config.encoder_action_dim),
        )
        features, state, noise = (rng.standard_normal(shape, dtype=np.float32) for shape in shapes)
        return cls(features, state, np.array([embodiment_id]), noise)

    @classmethod
    def from_file(cls, path: Path, config: HeadConfig) -> HeadInputs:
        """All observations of a file.

        Args:
            path: A file that ``saccade.head.input_files.read_arrays`` reads.
            config: Config of the head, which they are checked against.

        Raises:
            FileNotFoundError: The file does not exist.
            InputError, ShapeError: An array is missing, does not fit the head or the others, or contains NaN
                or infinity.
        """
        return cls.from_arrays(read_arrays(path), config, str(path))

    @classmethod
    def from_arrays(
        cls, arrays: Mapping[str, npt.NDArray[Any]], config: HeadConfig, where: str
    ) -> HeadInputs:
        """The observations in the arrays of a file.

        Args:
            arrays: The arrays by name, as ``saccade.head.input_files.read_arrays`` returns them.
            config: Config of the head, which they are checked against.
            where: Name of the file, for messages.

        Raises:
            InputError, ShapeError: As ``from_file``.
        """
        fields = checked(arrays, config, where)
        return cls(**fields, episode=_episodes(arrays.get("episode"), len(fields["state"]), where))

    def __len__(self) -> int:
        return len(self.backbone_features)

    @property
    def num_vl_tokens(self) -> int:
        """Number of vision-language tokens (T_vl)."""
        return int(self.backbone_features.shape[1])

    @property
    def draws(self) -> int:
        """Draws of noise for each row; 0 without noise."""
        if self.noise is None:
            return 0
        return 1 if self.noise.ndim == 3 else int(self.noise.shape[1])

    @property
    def clusters(self) -> npt.NDArray[np.int64]:
        """The bootstrap cluster of each row, ``(batch,)``: its episode, or the row itself if unknown."""
        return np.arange(len(self)) if self.episode is None else self.episode

    def row(self, row: int) -> HeadInputs:
        """One row as a batch of one, its floating point arrays in float32."""

        def chosen(array: npt.NDArray[Any] | None) -> Any:
            if array is None:
                return None
            part = array[row : row + 1]
            return np.ascontiguousarray(part, np.float32) if part.dtype.kind == "f" else part

        return self._each(chosen)

    def rows(self) -> Iterator[HeadInputs]:
        """Every row as a batch of one."""
        return (self.row(row) for row in range(len(self)))

    def repeated(self, count: int) -> HeadInputs:
        """Every row ``count`` times, one after the other."""
        return self._each(lambda array: None if array is None else np.repeat(array, count, axis=0))

    def _each(self, change: Any) -> HeadInputs:
        """The inputs with every field changed."""
        return HeadInputs(**{name: change(value) for name, value in vars(self).items()})

    def with_noise(
        self, rng: np.random.Generator, config: HeadConfig, draws: int | None = None
    ) -> HeadInputs:
        """The same inputs with standard normal float32 noise; unchanged if they already have noise.

        Args:
            rng: Generator of the noise.
            config: Config of the head.
            draws: Number of draws for each row. None: one draw, without an axis of draws.
        """
        if self.noise is not None:
            return self
        leading = (len(self),) if draws is None else (len(self), draws)
        shape = (*leading, config.action_horizon, config.encoder_action_dim)
        return dataclasses.replace(self, noise=rng.standard_normal(shape, dtype=np.float32))

    def with_draw(self, draw: int) -> HeadInputs:
        """The same inputs with one draw of their noise, ``(batch, action_horizon, encoder_action_dim)``."""
        if self.noise is None or self.noise.ndim == 3:
            return self
        return dataclasses.replace(self, noise=self.noise[:, draw])

    def encode(self, head: ActionHead) -> Context:
        """``saccade.ActionHead.encode`` of the features with these masks."""
        return head.encode(
            self.backbone_features,
            attention_mask=self.attention_mask,
            image_mask=self.image_mask,
            drop_vl=self.drop_vl,
        )

    def sample(
        self,
        head: ActionHead,
        context: Context | None = None,
        *,
        num_steps: int | None = None,
        integrator: str | None = None,
        future_refresh: int | None = None,
        intervention: Intervention | Sequence[Intervention] | None = None,
        previous_chunk: npt.NDArray[Any] | None = None,
        chunking: Chunking | None = None,
    ) -> Float32Array:
        """The normalised actions of a head from this noise.

        Args:
            head: The head that computes them.
            context: The result of ``encode`` with this head. Default: it is computed.
            num_steps, integrator, future_refresh, intervention, previous_chunk, chunking: As in
                ``saccade.ActionHead.sample``.

        Returns:
            ``(batch, action_horizon, action_dim)`` float32, or ``(batch, draws, action_horizon, action_dim)``
            if the noise has an axis of draws.

        Raises:
            InputError, ShapeError, DtypeError: As ``saccade.ActionHead.sample``.
        """
        has_draws = self.noise is not None and self.noise.ndim == 4
        found = head.sample(
            self.encode(head) if context is None else context,
            self.state,
            self.embodiment_id,
            noise=self.noise,
            num_steps=num_steps,
            integrator=integrator,
            num_samples=self.draws if has_draws else None,
            future_refresh=future_refresh,
            intervention=intervention,
            previous_chunk=previous_chunk,
            chunking=chunking,
        )
        return np.asarray(found)

    def trace(
        self,
        head: ActionHead,
        context: Context | None = None,
        *,
        num_steps: int | None = None,
        intervention: Intervention | Sequence[Intervention] | None = None,
        record: Sequence[str] = ("attention",),
        blocks: int | Sequence[int] | None = None,
        steps: int | Sequence[int] | None = None,
        max_bytes: int = 2**31,
    ) -> Trace[Any]:
        """``saccade.ActionHead.trace`` from this noise, which must be a single draw.

        Args:
            head, context: As in ``sample``.
            num_steps, intervention, record, blocks, steps, max_bytes: As in
                ``saccade.ActionHead.trace``.

        Raises:
            InputError, ShapeError, DtypeError: As ``saccade.ActionHead.trace``.
        """
        return head.trace(
            self.encode(head) if context is None else context,
            self.state,
            self.embodiment_id,
            noise=self.noise,
            num_steps=num_steps,
            intervention=intervention,
            record=record,
            blocks=blocks,
            steps=steps,
            max_bytes=max_bytes,
        )


def _episodes(given: npt.NDArray[Any] | None, batch: int, where: str) -> npt.NDArray[np.int64] | None:
    if given is None:
        return None
    named = np.atleast_1d(given)
    if named.dtype.kind not in "iu" or named.shape != (batch,):
        raise InputError(
            f"{where}: episode: {named.dtype} of shape {named.shape}, expected integers, ({batch},)"
        )
    return np.unique(named, return_inverse=True)[1].reshape(-1)
