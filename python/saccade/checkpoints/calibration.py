"""Rounds weights to four bits for what their layers are given on a user's own observations (GPTQ)."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt

import saccade._saccade as _saccade
from saccade._internal import run_settings
from saccade._internal.arrays import Float32Array, integer
from saccade._internal.environment import library
from saccade.backbone.backbone import Backbone
from saccade.checkpoints.given_inputs import inputs_sha256
from saccade.errors import CheckpointError, InputError
from saccade.head.head import ActionHead
from saccade.observations import ParsedObservation
from saccade.policy.encoding import compute_features, encode_features
from saccade.policy.policy import Policy
from saccade.policy.preparing import prepare_inputs
from saccade.policy.reading import Observation, read_observations
from saccade.processor import Processor

if TYPE_CHECKING:
    from saccade.backbone.features import BackboneFeatures

#: Gram matrices that are held together, in bytes. All observations are run once for each such group of
#: layers. All matrices of N1.5 take 9 GB.
GROUP_BYTES = 1 << 30
SETTINGS = "settings.json"


@dataclass(frozen=True, eq=False)
class Calibration:
    """Observations for which :func:`saccade.checkpoints.quantize` rounds weights to four bits.

    Attributes:
        policy: The whole policy of the checkpoint that is quantised, in float32.
        observations: Each as for :meth:`saccade.Policy.encode`. They should be like those that the robot will
            see; a sequence that reads them when they are asked for is read several times.
        seed: Seed of the noise, at least 0; observation ``i`` is denoised from ``seed + i``.
        progress: Called with the steps that are done and all steps. A step is one observation run for one
            group of layers, or one layer rounded.

    Example:
        >>> import saccade
        >>> from saccade.checkpoints import Calibration, quantize
        >>> def calibrated(checkpoint: str, recordings: str, out: str) -> None:
        ...     policy = saccade.Policy.from_pretrained(checkpoint)
        ...     data = saccade.datasets.open(recordings)
        ...     seen = [data.observation(episode, 0) for episode in range(len(data))]
        ...     quantize(checkpoint, out, to="int4", calibration=Calibration(policy, seen))
    """

    policy: Policy
    observations: Sequence[Observation | ParsedObservation]
    seed: int = 0
    progress: Callable[[int, int], object] | None = None


@dataclass(frozen=True)
class Layer:
    """A linear layer whose weights are rounded together.

    Attributes:
        watched: The name of its first weight, as the watch knows it.
        weights: The names of its weights in the checkpoint.
        in_features: Number of inputs.
    """

    watched: str
    weights: tuple[str, ...]
    in_features: int

    @property
    def gram_bytes(self) -> int:
        """Size of its Gram matrix."""
        return 4 * self.in_features**2

    def directory(self, folder: Path) -> Path:
        """Where its rounded weights are."""
        return folder / self.weights[0]


@dataclass(frozen=True)
class Rounded:
    """Layers that were rounded.

    Attributes:
        directories: Where their weights are.
        errors: By the name of a layer's first weight; see :class:`saccade.checkpoints.QuantizeReport`.
        note: What the files of the copy say of the calibration.
    """

    directories: tuple[Path, ...]
    errors: Mapping[str, Mapping[str, float]]
    note: Mapping[str, Any]


def round_layers(given: Calibration, rewrite: Mapping[str, Any], folder: Path) -> Rounded:
    """Rounds the weights that a call of the engine's ``quantize`` would round, and writes them into a folder.

    A run that was interrupted goes on with the layers that are missing in the folder.

    Args:
        given: The observations.
        rewrite: The arguments of ``quantize``.
        folder: The folder.

    Raises:
        InputError: The policy is not that of the source in float32, there are no observations, they do not
            run all layers, or the folder has other files or layers of another calibration.
        ShapeError, DtypeError: An observation does not fit the policy.
    """
    runs = _Runs(given, Path(rewrite["source"]))
    head = runs.head
    head_prefix, backbone_prefix, names = _saccade.quantized_weights(dict(rewrite))
    note = {
        "observations": len(given.observations),
        "inputs_sha256": inputs_sha256(given.policy, given.observations),
        "seed": given.seed,
        "embodiment_id": given.policy.embodiment_id,
    }
    prefixes = {"backbone": backbone_prefix, "head": head_prefix}
    settings = {
        **note,
        "source_sha256": rewrite["metadata"]["source_sha256"],
        "action_horizon": head.config.action_horizon,
        "parts": [part for part, prefix in prefixes.items() if prefix is not None],
        "saccade": _saccade.__version__,
        "library": library(),
        "instruction_set": head.isa,
    }
    _begin(folder, settings)
    parts = {
        part: list(_layers(runs.watch(part, [], 1), prefix, names))
        for part, prefix in prefixes.items()
        if prefix is not None
    }
    run = {name for layers in parts.values() for layer in layers for name in layer.weights}
    if run != names:
        raise InputError(
            "calibration: expected observations that all layers are run on, got none for "
            f"{', '.join(sorted(names - run))[:200]}"
        )
    todo = {
        part: [layer for layer in layers if not _is_finished(layer, folder)] for part, layers in parts.items()
    }
    passes = [(part, group) for part, layers in todo.items() for group in _groups(layers)]
    steps = _Steps(given, len(passes), sum(map(len, todo.values())))
    published = _saccade.HeadCheckpoint.open_base(rewrite["source"], rewrite["config"], None)
    for part, group in passes:
        wanted = [layer.watched for layer in group]
        seen = runs.watch(part, wanted, len(given.observations), steps.add)
        grams = {weights[0]: gram for weights, _, gram in seen if gram is not None}
        del seen
        for layer in group:
            directory = os.fspath(layer.directory(folder))
            gram = grams.pop(layer.watched)
            _saccade.round_layer(published, list(layer.weights), gram, directory, head.num_threads)
            steps.add()
    rounded = [layer.directory(folder) for layers in parts.values() for layer in layers]
    errors = {path.name: _saccade.rounded_layer(os.fspath(path))[1] for path in rounded}
    return Rounded(tuple(rounded), errors, note)


def remove(rounded: Rounded, folder: Path) -> None:
    """Removes the layers of a folder, then its settings, and the folder if nothing else is in it."""
    for directory in rounded.directories:
        shutil.rmtree(directory)
    (folder / SETTINGS).unlink()
    with contextlib.suppress(OSError):  # a file of somebody else
        folder.rmdir()


def _begin(folder: Path, settings: Mapping[str, Any]) -> None:
    """Makes the folder, or checks that it belongs to this calibration."""
    file = folder / SETTINGS
    there = sorted(folder.iterdir()) if folder.is_dir() else []
    if there and not file.is_file():
        raise InputError(
            f"{folder}: expected no such folder or one of a calibration, got one with {there[0].name} and "
            f"without {SETTINGS}"
        )
    folder.mkdir(parents=True, exist_ok=True)
    if there == [file]:  # no layer was finished
        file.unlink()
    run_settings.begin(file, settings, folder)


def _is_finished(layer: Layer, folder: Path) -> bool:
    """Whether a layer is in the folder; one that is damaged is removed."""
    directory = layer.directory(folder)
    if not directory.is_dir():
        return False
    try:
        names, _ = _saccade.rounded_layer(os.fspath(directory))
    except (CheckpointError, FileNotFoundError):
        names = []
    if set(names) == set(layer.weights):
        return True
    shutil.rmtree(directory)
    return False


class _Steps:
    """Reports progress."""

    def __init__(self, given: Calibration, num_passes: int, num_layers: int) -> None:
        self._progress = given.progress
        self._done, self._total = 0, num_passes * len(given.observations) + num_layers
        self._report()

    def add(self) -> None:
        """One more is done."""
        self._done += 1
        self._report()

    def _report(self) -> None:
        if self._progress is not None:
            self._progress(self._done, self._total)


@dataclass(frozen=True, eq=False)
class _Features:
    """What the head takes of an observation. All that a backbone keeps would be ten times as much."""

    backbone_features: Float32Array
    image_mask: npt.NDArray[np.bool_]


class _Runs:
    """Runs the parts of a policy on observations, watched.

    Args:
        given: The observations.
        source: The checkpoint that is quantised.
    """

    def __init__(self, given: Calibration, source: Path) -> None:
        policy = given.policy
        if not isinstance(policy, Policy):
            raise InputError(f"calibration: policy: expected a saccade.Policy, got {type(policy).__name__}")
        for name, kind in (("processor", Processor), ("backbone", Backbone), ("head", ActionHead)):
            if not isinstance(getattr(policy, name), kind):
                raise InputError(f"calibration: policy: expected saccade's own {name}, got {policy!r:.80}")
        assert isinstance(policy.processor, Processor)
        assert isinstance(policy.backbone, Backbone)
        assert isinstance(policy.head, ActionHead)
        for model in (policy.backbone, policy.head):
            if model.precision != "float32":
                raise InputError(f"calibration: policy: expected one in float32, got {model.precision}")
            if model.source is None or Path(model.source).resolve() != source.resolve():
                raise InputError(
                    f"calibration: policy: expected the policy of {source}, got that of {model.source}"
                )
        observations: Any = given.observations
        if not isinstance(observations, Sequence):
            kind_of = type(observations).__name__
            raise InputError(f"calibration: observations: expected a sequence, got {kind_of}")
        if len(observations) == 0:
            raise InputError("calibration: observations: expected at least one, got none")
        integer("calibration: seed", given.seed, least=0)
        self.given, self.policy = given, policy
        self.processor, self.backbone, self.head = policy.processor, policy.backbone, policy.head
        self._features: dict[int, tuple[_Features, ...]] = {}

    def watch(
        self, part: str, wanted: Sequence[str], count: int, done: Callable[[], None] = lambda: None
    ) -> list[tuple[list[str], int, _saccade.Gram | None]]:
        """The layers that the first ``count`` observations run, with what those wanted are given."""
        if part == "head":
            for index in range(count):
                if index not in self._features:
                    self._encode(index)
        with _saccade.watch_linears(list(wanted)) as watched:
            for index in range(count):
                if part == "backbone":
                    self._encode(index)
                else:
                    self._denoise(index)
                done()
        return watched.layers()

    def _encode(self, index: int) -> None:
        parsed = read_observations(self.given.observations[index], self.policy.requirements)
        features = compute_features(prepare_inputs(parsed, self.processor), self.backbone)
        self._features[index] = tuple(
            _Features(np.array(one.backbone_features), np.array(one.image_mask)) for one in features
        )

    def _denoise(self, index: int) -> None:
        features = cast("tuple[BackboneFeatures, ...]", self._features[index])
        context = encode_features(features, self.head)
        self.policy.sample(context, self.given.observations[index], seed=self.given.seed + index)


def _layers(
    seen: Sequence[tuple[list[str], int, _saccade.Gram | None]], prefix: str, names: set[str]
) -> Iterator[Layer]:
    """The layers that were run and whose weights are quantised."""
    for weights, in_features, _ in seen:
        full = tuple(prefix + name for name in weights)
        if names.issuperset(full):
            yield Layer(weights[0], full, in_features)


def _groups(layers: Sequence[Layer]) -> Iterator[list[Layer]]:
    """The layers in their order, in groups whose Gram matrices are held together."""
    group: list[Layer] = []
    for layer in layers:
        if group and sum(one.gram_bytes for one in (*group, layer)) > GROUP_BYTES:
            yield group
            group = []
        group.append(layer)
    if group:
        yield group
