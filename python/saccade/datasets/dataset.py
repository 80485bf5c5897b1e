"""A recorded data set: its episodes, and at each step the observation, the state and the actions."""

from __future__ import annotations

import hashlib
import io
import threading
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from saccade._internal.arrays import Float32Array, UInt8Array, integer
from saccade._internal.extras import SACCADE
from saccade._internal.files import sha256_of
from saccade.datasets import forms
from saccade.datasets.features import Episode, Metadata
from saccade.datasets.modality import ANNOTATION, TASK, Columns, Modality, plain
from saccade.datasets.parquet import Steps, read_steps
from saccade.datasets.selection import Part, Selection, selection_of
from saccade.datasets.videos import TOLERANCE, Frame, Videos
from saccade.errors import DatasetError, InputError
from saccade.observations.pictures import ObservingPolicy

#: The largest number that float32 can hold.
LARGEST = float(np.finfo(np.float32).max)
#: Episodes whose steps are kept in memory.
MOST_EPISODES = 4


class Dataset:
    """A recorded data set, as :func:`saccade.datasets.open` returns it.

    Steps are read when they are asked for. A few episodes stay in memory and a few videos open. Any number
    of threads may use a data set, and it can be pickled.

    Attributes:
        episodes: The episodes, in the order of the metadata. ``episode`` of all methods is a place in it.
        tasks: The instructions, in the order of their indices.
        fps: Steps per second.
        root: The folder.
        version: Version of the format, such as ``"v3.0"``.
    """

    def __init__(self, metadata: Metadata, modality: Modality, selection: Selection) -> None:
        self._metadata = metadata
        self._modality = modality
        self._selection = selection
        self._videos = Videos()
        self._cache: OrderedDict[tuple[int, str], Any] = OrderedDict()
        self._lock = threading.Lock()

    @property
    def episodes(self) -> tuple[Episode, ...]:
        """The episodes."""
        return self._metadata.episodes

    @property
    def tasks(self) -> tuple[str, ...]:
        """The instructions, in the order of their indices."""
        return tuple(self._metadata.tasks[index] for index in sorted(self._metadata.tasks))

    @property
    def fps(self) -> float:
        """Steps per second."""
        return self._metadata.fps

    @property
    def root(self) -> Path:
        """The folder."""
        return self._metadata.root

    @property
    def version(self) -> str:
        """Version of the format."""
        return self._metadata.version

    @property
    def robot(self) -> str | None:
        """The robot, as the recording program called it."""
        return self._metadata.robot

    @property
    def cameras(self) -> tuple[str, ...]:
        """Names of the cameras that an observation has, in order."""
        return self._selection.video.keys

    @property
    def state_widths(self) -> dict[str, int]:
        """Number of values of each key of the state, in order."""
        return {key: self._modality.state[key].width for key in self._selection.state.keys}

    @property
    def action_widths(self) -> dict[str, int]:
        """Number of values of each key of the action, in order."""
        return {key: self._modality.action[key].width for key in self._selection.action.keys}

    def __len__(self) -> int:
        return len(self.episodes)

    def __repr__(self) -> str:
        return (
            f"Dataset({str(self.root)!r}, {self.version}: {len(self)} episodes, "
            f"{sum(one.length for one in self.episodes)} steps at {self.fps:g} Hz, {len(self.tasks)} tasks)"
        )

    def for_policy(self, policy: ObservingPolicy) -> Dataset:
        """The data set with the keys and the history that a policy takes.

        For a policy of lerobot these are the names of the data set, and the keys ``state`` and ``action``.

        Raises:
            InputError: The data set has not the policy's keys, or the checkpoint does not say at which steps
                its history is: then open the data set with a data config.

        Example:
            >>> import saccade
            >>> def first_chunk(policy: saccade.Policy, data: Dataset) -> dict:
            ...     return policy.act(data.for_policy(policy).observation(0, 0), seed=0)
        """
        keys = self._modality
        if policy.normalizer.pipeline is not None:
            keys = plain(self._metadata.features, keys.where)
        return self._with(keys, selection_of(policy, keys))

    def observation(self, episode: int, step: int, form: str = "isaac") -> dict[str, Any]:
        """The observation at a step, as :meth:`saccade.Policy.act` takes it, with a batch axis of one.

        Steps of a history before the first one are the first one, as in the released loaders.

        Args:
            episode, step: Which step.
            form: ``"isaac"`` (nested), ``"isaac flat"`` or ``"lerobot"``. That of lerobot has every camera,
                the whole state and the task, by the names that the data set gives them, whatever
                ``modality.json`` says; a data config only gives it its history.

        Raises:
            InputError: There is no such step or form, or the data set does not say which instruction counts.
            DatasetError: What was recorded is damaged; the message names file, episode and step.
        """
        if form not in forms.FORMS:
            raise InputError(f"form: expected one of {', '.join(forms.FORMS)}, got {form!r}")
        self._place(episode, step)
        if form == "lerobot":
            return self._as_lerobot()._observation(episode, step, form)
        return self._observation(episode, step, form)

    def state(self, episode: int, step: int) -> dict[str, Float32Array]:
        """The state at a step, ``{key: (history, width)}`` float32 in the robot's units.

        Raises:
            InputError, DatasetError: As :meth:`observation`.
        """
        part = self._selection.state
        found = self._numbers(episode, step, self._modality.state, part.keys, part.indices or (0,))
        return {key: values.astype(np.float32) for key, values in found.items()}

    def actions(
        self, episode: int, step: int, horizon: int | None = None
    ) -> dict[str, npt.NDArray[np.floating[Any]]]:
        """The actions that were recorded from a step on, ``{key: (horizon, width)}`` in the robot's units.

        They have the type of the column if it is a floating one, otherwise float32. After the end of the
        episode the last action is repeated, as in the released loaders; keys that ``modality.json`` calls not
        absolute become zero there, as in N1.5.

        Args:
            episode, step: Which step.
            horizon: Number of actions, one for each step. Default: those at the steps that the data config
                has.

        Raises:
            InputError, DatasetError: As :meth:`observation`.
        """
        part = self._selection.action
        if horizon is not None:
            indices: Sequence[int] = range(integer("horizon", horizon))
        elif part.indices is None:
            raise InputError(
                "horizon: expected a number of actions, because no data config has any, got None"
            )
        else:
            indices = part.indices
        return self._numbers(episode, step, self._modality.action, part.keys, indices)

    def instruction(self, episode: int, step: int) -> str:
        """The instruction at a step.

        Raises:
            InputError, DatasetError: As :meth:`observation`.
        """
        place = self._place(episode, step)
        column = self._modality.language[self.language_key]
        given = self._steps(episode).values(column)[place]
        if isinstance(given, list) and len(given) == 1:  # features of shape (1,) may be lists
            given = given[0]
        if isinstance(given, str):
            return given
        text = self._metadata.tasks.get(given) if type(given) is int else None
        if text is None:
            raise DatasetError(
                f"{self._steps(episode).where}, step {place}: {column}: expected the index of a task or a "
                f"text, got {given!r:.60}"
            )
        return text

    @property
    def language_key(self) -> str:
        """The key of the instruction, ``"task"`` without a ``modality.json``.

        Raises:
            InputError: There are several, and no data config chooses one.
        """
        if self._selection.language is not None:
            return self._selection.language
        there = {TASK, *self._metadata.features}
        known = [key for key, column in self._modality.language.items() if column in there]
        keys = [key for key in known if key.startswith(ANNOTATION)] or ["task"]
        if len(keys) > 1:
            raise InputError(
                f"data_config: expected one that says which is the instruction, because "
                f"{self._modality.where} has several: {', '.join(keys)}"
            )
        return keys[0]

    def frame(self, episode: int, step: int, camera: str) -> Frame:
        """The frame of a camera at a step, as it was recorded, with its time stamp.

        Raises:
            InputError, DatasetError: As :meth:`observation`.
        """
        if camera not in self._modality.video:
            raise InputError(f"camera: expected one of {', '.join(self._modality.video)}, got {camera!r}")
        place = self._place(episode, step)
        feature = self._metadata.features[self._modality.video[camera]]
        where = f"{self._metadata.root}: episode {self.episodes[episode].index}, step {place}, {feature.key}"
        if feature.is_depth:
            raise InputError(f"camera: expected colours, got the depth map {camera!r}")
        time = self._time(episode, place)
        if feature.dtype == "image":
            found = Frame(self._image(episode, place, feature.key, where), time)
        else:
            part = self.episodes[episode].videos[feature.key]
            found = self._videos.frame(where, self.root / part.file, part.start + time, part.start)
        _check_shape(where, found.pixels, feature.shape)
        return found

    def column(self, episode: int, name: str) -> npt.NDArray[Any]:
        """A column of numbers as it was recorded, ``(steps, width)``, of the type that it has.

        Raises:
            InputError: There is no such episode or column.
            DatasetError: What was recorded is damaged.
        """
        self._place(episode, 0)
        feature = self._metadata.features.get(name)
        if feature is None or feature.is_camera:
            known = ", ".join(key for key, one in self._metadata.features.items() if not one.is_camera)
            raise InputError(f"name: expected a column, one of {known}, got {name!r}")
        return self._column(episode, name)

    def noise(self, episode: int, step: int, shape: tuple[int, ...]) -> Float32Array | None:
        """The noise that a policy computed the chunk of a step from, if `saccade rollout` recorded it.

        The column ``noise_seed`` has three integers ``(a, b, k)``: the noise is the draw ``k``, from 0, of
        ``numpy.random.default_rng((a, b))``, standard normal in float32.

        Args:
            episode, step: Which step.
            shape: The shape of the noise, ``(1, horizon, width)`` as :meth:`saccade.Policy.act` takes it.

        Returns:
            None if the data set has no such column, or no chunk begins at this step.

        Raises:
            InputError, DatasetError: As :meth:`observation`.
        """
        place = self._place(episode, step)
        if not {"noise_seed", "chunk_step"} <= set(self._metadata.features):
            return None
        if self._column(episode, "chunk_step")[place, 0]:
            return None
        *seed, draw = self._column(episode, "noise_seed")[place].tolist()
        rng = np.random.default_rng(seed)
        for _ in range(draw):
            rng.standard_normal(shape, dtype=np.float32)
        return rng.standard_normal(shape, dtype=np.float32)

    @property
    def statistics(self) -> dict[str, dict[str, dict[str, npt.NDArray[np.float64]]]]:
        """Recorded statistics by modality, key and name: ``statistics["action"]["arm"]["mean"]``.

        Empty if the data set has none.
        """
        found: dict[str, dict[str, dict[str, npt.NDArray[np.float64]]]] = {"state": {}, "action": {}}
        recorded = self._metadata.statistics or {}
        for kind, keys in (("state", self._modality.state), ("action", self._modality.action)):
            for key in getattr(self._selection, kind).keys:
                columns = keys[key]
                numbers = recorded.get(columns.column)
                if numbers is not None:
                    found[kind][key] = {
                        name: np.asarray(value, np.float64)[columns.numbers]
                        for name, value in numbers.items()
                        if name != "count"
                    }
        return found

    def fingerprint(self) -> str:
        """SHA-256 of the names and contents of all files of metadata, steps and videos."""
        digest = hashlib.sha256()
        for folder in ("meta", "data", "videos"):
            for path in sorted(self.root.glob(f"{folder}/**/*")):
                if path.is_file():
                    digest.update(f"{path.relative_to(self.root).as_posix()}\0{sha256_of(path)}\n".encode())
        return digest.hexdigest()

    def __getstate__(self) -> dict[str, Any]:
        return {"metadata": self._metadata, "modality": self._modality, "selection": self._selection}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(**state)  # type: ignore[misc]

    def _observation(self, episode: int, step: int, form: str) -> dict[str, Any]:
        frames = {camera: self._history(episode, step, camera) for camera in self.cameras}
        text = self.instruction(episode, step)
        return forms.FORMS[form](frames, self.state(episode, step), self.language_key, text)

    def _as_lerobot(self) -> Dataset:
        """The data set with lerobot's names, and the history of this one."""
        keys = plain(self._metadata.features, self._modality.where)
        seen = self._selection
        video, state = (
            Part(tuple(keys.video), seen.video.indices),
            Part(tuple(keys.state), seen.state.indices),
        )
        return self._with(keys, Selection(video, state, Part(tuple(keys.action), seen.action.indices), None))

    def _with(self, modality: Modality, selection: Selection) -> Dataset:
        """The data set with other keys, which shares what is open and read."""
        found = Dataset(self._metadata, modality, selection)
        found._videos, found._cache, found._lock = self._videos, self._cache, self._lock
        return found

    def _place(self, episode: int, step: int) -> int:
        """The step, after checking that both are there."""
        if integer("episode", episode, least=0) >= len(self):
            raise InputError(f"episode: expected a number below {len(self)}, got {episode}")
        length = self.episodes[episode].length
        if integer("step", step, least=0) >= length:
            raise InputError(
                f"step: expected a number below {length}, the steps of episode {episode}, got {step}"
            )
        return int(step)

    def _history(self, episode: int, step: int, camera: str) -> UInt8Array:
        """The frames of an observation, ``(history, height, width, 3)``."""
        last = self.episodes[episode].length - 1
        places = [min(max(step + index, 0), last) for index in self._selection.video.indices or (0,)]
        frames = {place: self.frame(episode, place, camera).pixels for place in sorted(set(places))}
        return np.stack([frames[place] for place in places])

    def _numbers(
        self,
        episode: int,
        step: int,
        known: Mapping[str, Columns],
        keys: Sequence[str],
        indices: Sequence[int],
    ) -> dict[str, npt.NDArray[np.floating[Any]]]:
        """The numbers of keys at steps relative to one."""
        place = self._place(episode, step)
        steps = self._steps(episode)
        wanted = place + np.asarray(indices)
        inside = np.clip(wanted, 0, len(steps) - 1)
        found = {}
        for key in keys:
            columns = known[key]
            rows = self._column(episode, columns.column)[inside, columns.numbers]
            is_good = np.abs(rows) <= LARGEST  # false for NaN
            if not is_good.all():
                bad = int(inside[~is_good.all(axis=1)][0])
                raise DatasetError(
                    f"{steps.where}, step {bad}: {columns.column}: {key}: expected numbers that float32 can "
                    f"hold, got {rows[~is_good][0]}"
                )
            rows = rows if rows.dtype.kind == "f" else rows.astype(np.float32)
            if not columns.is_absolute:
                rows[wanted != inside] = 0
            found[key] = rows
        return found

    def _column(self, episode: int, name: str) -> npt.NDArray[Any]:
        """A column of an episode, ``(steps, width)``."""
        steps = self._steps(episode)
        values = steps.numbers(name)
        expected = self._metadata.features[name].shape
        if (values.shape[1],) != expected:
            raise DatasetError(
                f"{steps.where}: {name}: expected {expected[0]} numbers a step, as info.json says, got "
                f"{values.shape[1]}"
            )
        return values

    def _time(self, episode: int, step: int) -> float:
        """The time of a step in its episode, seconds: ``timestamp``, or what follows from the frame rate."""
        steps = self._steps(episode)
        return float(steps.numbers("timestamp")[step, 0]) if "timestamp" in steps.names else step / self.fps

    def _steps(self, episode: int) -> Steps:
        """The steps of an episode without its images, checked."""
        about = self.episodes[episode]
        images = {key for key, feature in self._metadata.features.items() if feature.dtype == "image"}

        def read() -> Steps:
            found = read_steps(self.root / about.file, about.index, lambda name: name not in images)
            _check_steps(found, about, self.fps)
            return found

        steps: Steps = self._cached((episode, ""), read)
        return steps

    def _image(self, episode: int, step: int, key: str, where: str) -> UInt8Array:
        """A frame that is stored as a picture in the Parquet file."""
        about = self.episodes[episode]

        def read() -> list[Any]:
            found = read_steps(self.root / about.file, about.index, lambda name: name == key).values(key)
            if len(found) != about.length:
                raise DatasetError(f"{where}: expected {about.length} pictures, got {len(found)}")
            return found

        stored = self._cached((episode, key), read)[step]
        content = stored.get("bytes") if isinstance(stored, Mapping) else None
        if not isinstance(content, bytes):
            raise DatasetError(f"{where}: expected the bytes of a picture, got {stored!r:.60}")
        SACCADE.require("PIL")
        from PIL import Image

        try:
            with Image.open(io.BytesIO(content)) as picture:
                return np.asarray(picture.convert("RGB"))
        # Pillow raises SyntaxError and others for files that are damaged in their own ways.
        except (OSError, ValueError, SyntaxError, EOFError, Image.DecompressionBombError) as error:
            raise DatasetError(f"{where}: cannot be read as a picture: {error}") from None

    def _cached(self, key: tuple[int, str], read: Any) -> Any:
        with self._lock:
            if key in self._cache:
                self._cache.move_to_end(key)
                return self._cache[key]
        found = read()
        with self._lock:
            self._cache[key] = found
            while len(self._cache) > MOST_EPISODES:
                self._cache.popitem(last=False)
        return found


def _check_steps(steps: Steps, about: Episode, fps: float) -> None:
    """The table has the steps that the metadata say, in order, at the frame rate."""
    if len(steps) != about.length:
        raise DatasetError(
            f"{steps.where}: expected {about.length} steps, as the metadata say, got {len(steps)}"
        )
    if "frame_index" in steps.names:
        wrong = np.flatnonzero(steps.numbers("frame_index")[:, 0] != np.arange(len(steps)))
        if len(wrong):
            raise DatasetError(
                f"{steps.where}, step {wrong[0]}: frame_index: expected the steps in order from 0"
            )
    if "timestamp" in steps.names:
        times = steps.numbers("timestamp")[:, 0].astype(np.float64)
        # float32 cannot hold later times more exactly.
        allowed = TOLERANCE + np.spacing(times[1:].astype(np.float32)).astype(np.float64)
        wrong = np.flatnonzero(~(np.abs(np.diff(times) - 1 / fps) <= allowed))
        if len(wrong) or not np.isfinite(times).all():
            step = int(wrong[0]) + 1 if len(wrong) else 0
            raise DatasetError(
                f"{steps.where}, step {step}: timestamp: expected {1 / fps:.6f} s after the step before "
                f"(within {TOLERANCE} s), got {times[step]:.6f} s after {times[max(step - 1, 0)]:.6f} s"
            )


def _check_shape(where: str, pixels: UInt8Array, shape: tuple[int, ...]) -> None:
    """A frame has the shape that ``info.json`` says, where colours may come first or last."""
    height, width, _ = pixels.shape
    if len(shape) != 3 or shape not in ((height, width, 3), (3, height, width)):
        raise DatasetError(
            f"{where}: expected a frame of shape {shape}, as info.json says, got {pixels.shape}"
        )
