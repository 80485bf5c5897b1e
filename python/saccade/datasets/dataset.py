"""A recorded data set: its episodes, and at each step the observation, the state and the actions."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from saccade._internal.arrays import LARGEST, Float32Array, UInt8Array, integer
from saccade._internal.files import remembered_sha256
from saccade.datasets import forms
from saccade.datasets.features import Episode
from saccade.datasets.modality import ANNOTATION, TASK, Columns, Modality, plain
from saccade.datasets.selection import Part, Selection, selection_of
from saccade.datasets.stored import Stored
from saccade.datasets.videos import Frame
from saccade.errors import DatasetError, InputError
from saccade.observations.pictures import ObservingPolicy


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

    def __init__(self, stored: Stored, modality: Modality, selection: Selection) -> None:
        self._stored = stored
        self._metadata = stored.metadata
        self._modality = modality
        self._selection = selection

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
        return Dataset(self._stored, keys, selection_of(policy, keys, self._selection))

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
        given = self._stored.steps(episode).values(column)[place]
        if isinstance(given, list) and len(given) == 1:  # features of shape (1,) may be lists
            given = given[0]
        if isinstance(given, str):
            return given
        text = self._metadata.tasks.get(given) if type(given) is int else None
        if text is None:
            where = self._stored.steps(episode).where
            raise DatasetError(
                f"{where}, step {place}: {column}: expected the index of a task or a text, got {given!r:.60}"
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
        place, key = self._place(episode, step), self._modality.video[camera]
        if self._metadata.features[key].is_depth:
            raise InputError(f"camera: expected colours, got the depth map {camera!r}")
        return self._stored.frame(episode, place, key)

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
        return self._stored.column(episode, name)

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
        if self._stored.column(episode, "chunk_step")[place, 0]:
            return None
        given = self._stored.column(episode, "noise_seed")[place].tolist()
        if len(given) != 3 or not all(type(one) is int and one >= 0 for one in given) or given[-1] > place:
            raise DatasetError(
                f"{self._stored.steps(episode).where}, step {place}: noise_seed: expected two seeds and the "
                f"number of the chunk, at most that of the step, got {given}"
            )
        *seed, draw = given
        rng = np.random.default_rng(seed)
        for _ in range(draw):
            rng.standard_normal(shape, dtype=np.float32)
        return rng.standard_normal(shape, dtype=np.float32)

    @property
    def statistics(self) -> dict[str, dict[str, dict[str, npt.NDArray[np.float64]]]]:
        """Recorded statistics by modality, key and name: ``statistics["action"]["arm"]["mean"]``.

        Empty if the data set has none.

        Raises:
            DatasetError: They have another shape than the data, or are not finite.
        """
        found: dict[str, dict[str, dict[str, npt.NDArray[np.float64]]]] = {"state": {}, "action": {}}
        recorded = self._metadata.statistics or {}
        for kind, keys in (("state", self._modality.state), ("action", self._modality.action)):
            for key in getattr(self._selection, kind).keys:
                columns = keys[key]
                for name, value in recorded.get(columns.column, {}).items():
                    shape = self._metadata.features[columns.column].shape
                    if name != "count" and (value.shape != shape or not np.isfinite(value).all()):
                        raise DatasetError(
                            f"{self.root / 'meta'}: statistics: {columns.column}: {name}: expected finite "
                            f"numbers of shape {shape}, got shape {value.shape}"
                        )
                    if name != "count":
                        found[kind].setdefault(key, {})[name] = value[columns.numbers]
        return found

    def fingerprint(self) -> str:
        """SHA-256 of the names and contents of all files of metadata, steps and videos."""
        names = {
            path.relative_to(self.root).as_posix()
            for folder in ("meta", "data", "videos")
            for path in self.root.glob(f"{folder}/**/*")
            if path.is_file()
        }
        # A template of paths may lead to other folders, and links to folders are not followed above.
        for one in self.episodes:
            names |= {one.file, *(part.file for part in one.videos.values())}
        digest = hashlib.sha256()
        for name in sorted(names):
            digest.update(f"{name}\0{remembered_sha256(self.root / name)}\n".encode())
        return digest.hexdigest()

    def _observation(self, episode: int, step: int, form: str) -> dict[str, Any]:
        frames = {camera: self._history(episode, step, camera) for camera in self.cameras}
        text = self.instruction(episode, step)
        return forms.FORMS[form](frames, self.state(episode, step), self.language_key, text)

    def _as_lerobot(self) -> Dataset:
        """The data set with lerobot's names, and the history of this one."""
        keys = plain(self._metadata.features, self._modality.where)
        seen = self._selection
        video = Part(tuple(keys.video), seen.video.indices)
        state = Part(tuple(keys.state), seen.state.indices)
        return Dataset(
            self._stored, keys, Selection(video, state, Part(tuple(keys.action), seen.action.indices), None)
        )

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
        steps = self._stored.steps(episode)
        wanted = place + np.asarray(indices)
        inside = np.clip(wanted, 0, len(steps) - 1)
        found = {}
        for key in keys:
            columns = known[key]
            rows = self._stored.column(episode, columns.column)[inside, columns.numbers]
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
