"""One observation as the action head takes it: read from a file, drawn at random, or recorded, and run."""

from __future__ import annotations

import dataclasses
import json
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

import saccade._saccade as _saccade
from saccade._internal.arrays import Float32Array, boolean
from saccade.errors import CheckpointError, InputError, ShapeError
from saccade.head.options import SampleOptions, TraceOptions

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from saccade.head.config import HeadConfig
    from saccade.head.context import Context
    from saccade.head.head import ActionHead
    from saccade.head.trace import Trace

BoolArray = npt.NDArray[np.bool_]

REQUIRED = ("backbone_features", "state", "embodiment_id")
MASKS = ("attention_mask", "image_mask", "drop_vl")
OPTIONAL = ("noise", "input_ids", *MASKS, "images", "tokens", "episode")


@dataclass(frozen=True, eq=False)
class Observation:
    """One observation, or a batch of them, as the action head takes it.

    Attributes:
        backbone_features: ``(batch, T_vl, context_dim)``, floating point.
        state: ``(batch, state_dim)`` or ``(batch, num_states, state_dim)``, normalised, floating point.
        embodiment_id: ``(batch,)`` int64.
        noise: The noise that sampling starts from, ``(batch, action_horizon, encoder_action_dim)``, or with
            several draws for each row ``(batch, draws, action_horizon, encoder_action_dim)``; None if it has
            not been drawn.
        attention_mask, image_mask, drop_vl: ``(batch, T_vl)`` bool, see :meth:`saccade.ActionHead.encode`; or
            None.
        episode: ``(batch,)`` int64, the episode of each row, counted from 0; None if unknown.
    """

    backbone_features: npt.NDArray[Any]
    state: npt.NDArray[Any]
    embodiment_id: npt.NDArray[np.int64]
    noise: npt.NDArray[Any] | None = None
    attention_mask: BoolArray | None = None
    image_mask: BoolArray | None = None
    drop_vl: BoolArray | None = None
    episode: npt.NDArray[np.int64] | None = None

    def __len__(self) -> int:
        return len(self.backbone_features)

    @property
    def num_vl_tokens(self) -> int:
        """T_vl."""
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

    def row(self, row: int) -> Observation:
        """One row as a batch of one, its floating point arrays in float32."""
        chosen = slice(row, row + 1)

        def float32(array: npt.NDArray[Any]) -> Float32Array:
            return np.ascontiguousarray(array[chosen], np.float32)

        def kept(array: npt.NDArray[Any] | None) -> Any:
            return None if array is None else array[chosen]

        return Observation(
            float32(self.backbone_features),
            float32(self.state),
            self.embodiment_id[chosen],
            None if self.noise is None else float32(self.noise),
            kept(self.attention_mask),
            kept(self.image_mask),
            kept(self.drop_vl),
            kept(self.episode),
        )

    def rows(self) -> Iterator[Observation]:
        """Every row as a batch of one."""
        return (self.row(row) for row in range(len(self)))

    def repeated(self, count: int) -> Observation:
        """Every row `count` times, one after the other."""

        def repeat(array: npt.NDArray[Any] | None) -> Any:
            return None if array is None else np.repeat(array, count, axis=0)

        fields = dataclasses.fields(self)
        return dataclasses.replace(
            self, **{field.name: repeat(getattr(self, field.name)) for field in fields}
        )

    def with_noise(
        self, rng: np.random.Generator, config: HeadConfig, draws: int | None = None
    ) -> Observation:
        """The same observation with standard normal float32 noise; unchanged if it already has noise.

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

    def with_draw(self, draw: int) -> Observation:
        """The same observation with only one draw of its noise, ``(batch, action_horizon,
        encoder_action_dim)``.
        """
        if self.noise is None or self.noise.ndim == 3:
            return self
        return dataclasses.replace(self, noise=self.noise[:, draw])

    def encode(self, head: ActionHead) -> Context:
        """:meth:`saccade.ActionHead.encode` of the features with these masks."""
        return head.encode(
            self.backbone_features,
            attention_mask=self.attention_mask,
            image_mask=self.image_mask,
            drop_vl=self.drop_vl,
        )

    def sample(
        self, head: ActionHead, context: Context | None = None, **options: Unpack[SampleOptions]
    ) -> Float32Array:
        """The head's own, normalised actions from this noise.

        Args:
            head: The head that computes them.
            context: The result of :meth:`encode` with this head. Default: it is computed.
            **options: Keyword arguments of :meth:`saccade.ActionHead.sample`, except ``noise`` and
                ``num_samples``.

        Returns:
            ``(batch, action_horizon, action_dim)`` float32, or ``(batch, draws, action_horizon, action_dim)``
            if the noise has an axis of draws.

        Raises:
            InputError: As :meth:`saccade.ActionHead.sample`, or ``noise`` is given.
        """
        _refuse_noise(options)
        options["noise"] = self.noise
        if self.noise is not None and self.noise.ndim == 4:
            options["num_samples"] = self.draws
        found = head.sample(
            self.encode(head) if context is None else context,
            self.state,
            self.embodiment_id,
            **options,
        )
        return np.asarray(found)

    def trace(
        self, head: ActionHead, context: Context | None = None, **options: Unpack[TraceOptions]
    ) -> Trace[Any]:
        """:meth:`saccade.ActionHead.trace` from this noise, which must be a single draw.

        Args:
            head, context: As in :meth:`sample`.
            **options: Keyword arguments of :meth:`saccade.ActionHead.trace`, except ``noise``.

        Raises:
            InputError: As :meth:`saccade.ActionHead.trace`, or ``noise`` is given.
        """
        _refuse_noise(options)
        options["noise"] = self.noise
        found = self.encode(head) if context is None else context
        return head.trace(found, self.state, self.embodiment_id, **options)

    @classmethod
    def random(
        cls, config: HeadConfig, num_vl_tokens: int, rng: np.random.Generator, embodiment_id: int = 0
    ) -> Observation:
        """One observation of standard normal features, state and noise, drawn in this order."""
        shapes = (
            (1, num_vl_tokens, config.context_dim),
            (1, config.num_states, config.state_dim),
            (1, config.action_horizon, config.encoder_action_dim),
        )
        features, state, noise = (rng.standard_normal(shape, dtype=np.float32) for shape in shapes)
        return cls(features, state, np.array([embodiment_id]), noise)


def _refuse_noise(options: Mapping[str, Any]) -> None:
    if "noise" in options:
        raise InputError("noise: expected none, since sampling starts from the noise of the observation")


def read(path: Path, config: HeadConfig) -> Observation:
    """All observations of a file, checked against the head that will take them; see :func:`read_arrays`.

    Raises:
        FileNotFoundError: there is no such file.
        InputError, ShapeError: an array is missing, does not fit the head or the others, or contains NaN or
            infinity.
    """
    return from_arrays(read_arrays(path), config, str(path))


def from_arrays(arrays: Mapping[str, npt.NDArray[Any]], config: HeadConfig, where: str) -> Observation:
    """Creates observations from the arrays of a file.

    Args:
        arrays: The arrays by name, as :func:`read_arrays` returns them.
        config: Config of the head that will take them.
        where: Name of the file, for messages.

    Raises:
        InputError, ShapeError: as :func:`read`.
    """
    features = np.asarray(arrays["backbone_features"])
    if features.ndim != 3 or features.shape[2] != config.context_dim:
        raise ShapeError(
            f"{where}: backbone_features: shape {features.shape}, the checkpoint expects (batch, T_vl, "
            f"{config.context_dim})"
        )
    if not features.size:
        raise InputError(f"{where}: backbone_features: shape {features.shape}, expected no empty axis")
    batch, num_tokens, _ = features.shape
    found = Observation(
        features,
        _state(arrays["state"], batch, config, where),
        _embodiments(arrays["embodiment_id"], batch, config, where),
        _noise(arrays.get("noise"), batch, config, where),
        **{name: _mask(arrays.get(name), name, (batch, num_tokens), where) for name in MASKS},
        episode=_episodes(arrays.get("episode"), batch, where),
    )
    _check_finite(found, where)
    return _check_masks(found, config, where)


def _embodiments(
    given: npt.NDArray[Any], batch: int, config: HeadConfig, where: str
) -> npt.NDArray[np.int64]:
    ids = np.asarray(given)
    if ids.dtype.kind not in "iu" or ids.size not in (1, batch):
        raise InputError(f"{where}: embodiment_id: expected an integer, or one for each of {batch} rows")
    if not 0 <= int(ids.min()) <= int(ids.max()) < config.num_embodiments:
        raise InputError(
            f"{where}: embodiment_id: given {ids.min()} to {ids.max()}, the checkpoint has 0 to "
            f"{config.num_embodiments - 1}"
        )
    return np.broadcast_to(ids.reshape(-1).astype(np.int64), batch)


def _state(given: npt.NDArray[Any], batch: int, config: HeadConfig, where: str) -> npt.NDArray[Any]:
    state = np.asarray(given)
    shapes: list[tuple[int, ...]] = [(batch, config.num_states, config.state_dim)]
    if config.num_states == 1:
        shapes.insert(0, (batch, config.state_dim))
    if state.shape not in shapes:
        expected = " or ".join(map(str, shapes))
        raise ShapeError(f"{where}: state: shape {state.shape}, expected {expected}")
    return state


def _noise(
    given: npt.NDArray[Any] | None, batch: int, config: HeadConfig, where: str
) -> npt.NDArray[Any] | None:
    if given is None:
        return None
    shape = (batch, config.action_horizon, config.encoder_action_dim)
    noise = np.asarray(given)
    if batch == 1 and noise.ndim == 2:
        noise = noise[None]
    if noise.shape != shape:
        raise ShapeError(f"{where}: noise: shape {noise.shape}, expected {shape}")
    return noise


def _mask(given: npt.NDArray[Any] | None, name: str, shape: tuple[int, int], where: str) -> BoolArray | None:
    found = as_mask(where, name, given)
    if found is not None and shape[0] == 1 and found.ndim == 1:
        found = found[None]
    if found is not None and found.shape != shape:
        raise ShapeError(f"{where}: {name}: shape {found.shape}, expected {shape}")
    return found


def _episodes(given: npt.NDArray[Any] | None, batch: int, where: str) -> npt.NDArray[np.int64] | None:
    if given is None:
        return None
    named = np.atleast_1d(given)
    if named.dtype.kind not in "iu" or named.shape != (batch,):
        raise InputError(
            f"{where}: episode: {named.dtype} of shape {named.shape}, expected integers, ({batch},)"
        )
    return np.unique(named, return_inverse=True)[1].reshape(-1)


def _check_finite(found: Observation, where: str) -> None:
    """Row by row, because the file may be large."""
    for name in ("backbone_features", "state", "noise"):
        array = getattr(found, name)
        for row in range(0 if array is None else len(found)):
            if not np.isfinite(array[row]).all():
                raise InputError(f"{where}: {name}: NaN or infinity in row {row}, expected finite numbers")


def _check_masks(found: Observation, config: HeadConfig, where: str) -> Observation:
    """Refuses masks that the head would refuse or ignore; leaves out those that change nothing."""
    mask, drop_vl = found.attention_mask, found.drop_vl
    if drop_vl is not None and drop_vl.all(axis=1).any():
        raise InputError(f"{where}: drop_vl: row {int(drop_vl.all(axis=1).argmax())} drops every position")
    if config.mask_mode == "alternate":
        return found
    if mask is not None and not mask.all():
        raise InputError(
            f"{where}: attention_mask: false entries, but the released head reads padding like any other "
            "token; expected no attention_mask, or drop_vl, true where a position is to be removed"
        )
    return dataclasses.replace(found, attention_mask=None, image_mask=None)


def as_mask(where: str, name: str, array: npt.NDArray[Any] | None) -> BoolArray | None:
    """A mask as booleans. Tokenizers write integers 0 and 1.

    Raises:
        InputError: The array contains anything else.
    """
    if array is None:
        return None
    if array.dtype == np.bool_:
        return boolean(name, array)
    if array.dtype.kind not in "iu" or not np.isin(array, (0, 1)).all():
        raise InputError(f"{where}: {name}: expected booleans, or 0 and 1")
    return np.asarray(array, dtype=np.bool_)


def read_arrays(path: Path) -> dict[str, npt.NDArray[Any]]:
    """Reads a file of backbone features.

    It contains ``backbone_features (batch, T_vl, context_dim)``, ``state (batch, state_dim)`` and
    ``embodiment_id``. It may contain ``noise (batch, action_horizon, encoder_action_dim)``; ``input_ids``,
    ``image_mask``, ``attention_mask`` and ``drop_vl``, each ``(batch, T_vl)``; ``images (batch, cameras, H,
    W, 3)`` uint8; ``tokens (batch, T_vl)`` strings; ``episode (batch,)`` integers. A file with one row may
    leave out the batch axis of the optional arrays. Names may be prefixed with ``_in.``. In a safetensors
    file, which cannot contain strings, ``tokens`` is a JSON list in the metadata.

    Args:
        path: ``.npz`` or ``.safetensors``.

    Returns:
        The arrays by name. Whether they fit each other is not checked.

    Raises:
        FileNotFoundError: there is no such file.
        InputError: it cannot be read, or a required array is missing or not floating point.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    if path.suffix == ".npz":
        found = _read_npz(path)
    elif path.suffix == ".safetensors":
        found = _read_safetensors(path)
    else:
        raise InputError(f"{path}: expected a file that ends in .npz or .safetensors")
    arrays = {
        name: found[key] for name in (*REQUIRED, *OPTIONAL) for key in (name, f"_in.{name}") if key in found
    }
    missing = [name for name in REQUIRED if name not in arrays]
    if missing:
        raise InputError(
            f"{path}: no {', '.join(missing)}; there are {', '.join(sorted(found)) or 'no arrays'}"
        )
    wrong = [
        name
        for name in ("backbone_features", "state", "noise")
        if name in arrays and arrays[name].dtype.kind != "f"
    ]
    if wrong:
        raise InputError(f"{path}: {', '.join(wrong)}: expected floating point values")
    return arrays


def _read_npz(path: Path) -> dict[str, npt.NDArray[Any]]:
    try:
        with np.load(path, allow_pickle=False) as file:
            return {name: file[name] for name in file.files}
    except (ValueError, OSError, EOFError, zipfile.BadZipFile) as error:
        raise InputError(f"{path}: cannot be read as .npz: {error}") from None


def _read_safetensors(path: Path) -> dict[str, npt.NDArray[Any]]:
    from safetensors import SafetensorError, safe_open

    found: dict[str, npt.NDArray[Any]] = {}
    try:
        with safe_open(path, framework="np") as file:
            for name in file.keys():  # noqa: SIM118
                if name.removeprefix("_in.") not in (*REQUIRED, *OPTIONAL):
                    continue  # a checkpoint that also holds inputs
                if file.get_slice(name).get_dtype() in ("F32", "F16", "BF16"):
                    found[name] = _saccade.read_tensors(str(path), name)[""]  # NumPy has no bfloat16
                else:
                    found[name] = file.get_tensor(name)
            names = (file.metadata() or {}).get("tokens")
            if names is not None:
                found["tokens"] = np.array(json.loads(names), dtype=np.str_)
    except (SafetensorError, CheckpointError, ValueError) as error:
        raise InputError(f"{path}: cannot be read as .safetensors: {error}") from None
    return found
