"""Rounds weights to four bits for what their layers are given on a user's own observations (GPTQ)."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import saccade._saccade as _saccade
from saccade._internal.run_settings import begin
from saccade.backbone.backbone import Backbone
from saccade.backbone.features import BackboneFeatures
from saccade.errors import InputError
from saccade.head.head import ActionHead
from saccade.observations import ParsedObservation
from saccade.policy.encoding import compute_features, encode_features
from saccade.policy.policy import Policy
from saccade.policy.preparing import prepare_inputs
from saccade.policy.reading import Observation, read_observations
from saccade.processor import Processor

#: Gram matrices that are held together, in bytes. All observations are run once for each such group of
#: layers. All matrices of N1.5 take 9 GB.
GROUP_BYTES = 1 << 30


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
        errors: By the name of a layer's first weight, sums over its outputs: their squared error if weights
            are rounded each for itself (``plain``) and as they are (``rounded``), and their squares
            (``outputs``).
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
        InputError: The policy is not that of the source in float32, there are no observations, or the folder
            has layers of another calibration.
        ShapeError, DtypeError: An observation does not fit the policy.
    """
    runs = _Runs(given, Path(rewrite["source"]))
    head = given.policy.head
    assert isinstance(head, ActionHead)
    head_prefix, backbone_prefix, names = _saccade.quantized_weights(dict(rewrite))
    note = {
        "observations": len(given.observations),
        "observations_sha256": runs.digest(),
        "seed": given.seed,
        "embodiment_id": given.policy.embodiment_id,
    }
    settings = {
        **note,
        "source_sha256": rewrite["metadata"]["source_sha256"],
        "parts": ["head"] if backbone_prefix is None else ["backbone", "head"],
        "saccade": _saccade.__version__,
        "instruction_set": head.isa,
    }
    folder.mkdir(parents=True, exist_ok=True)
    begin(folder / "settings.json", settings, folder)

    prefixes = {"backbone": backbone_prefix, "head": head_prefix}
    parts = {
        part: list(_layers(runs.watch(part, [], 1), prefix, names))
        for part, prefix in prefixes.items()
        if prefix is not None
    }
    todo = {
        part: [layer for layer in layers if not layer.directory(folder).is_dir()]
        for part, layers in parts.items()
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
            _saccade.round_layer(
                published,
                list(layer.weights),
                grams.pop(layer.watched),
                os.fspath(layer.directory(folder)),
                head.num_threads,
            )
            steps.add()
    rounded = [layer.directory(folder) for layers in parts.values() for layer in layers]
    errors = {path.name: _saccade.rounded_layer(os.fspath(path))[1] for path in rounded}
    return Rounded(tuple(rounded), errors, note)


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


@dataclass(eq=False)
class _Runs:
    """Runs the parts of a policy on observations, watched."""

    given: Calibration
    source: Path
    #: What the backbone made of each observation, once it was run.
    features: dict[int, tuple[BackboneFeatures, ...]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        policy = self.given.policy
        if not isinstance(policy, Policy):
            raise InputError(f"calibration: policy: expected a saccade.Policy, got {type(policy).__name__}")
        parts = {"processor": Processor, "backbone": Backbone, "head": ActionHead}
        for name, kind in parts.items():
            if not isinstance(getattr(policy, name), kind):
                raise InputError(f"calibration: policy: expected saccade's own {name}, got {policy!r:.80}")
        for model in (policy.backbone, policy.head):
            assert isinstance(model, Backbone | ActionHead)
            if model.precision != "float32":
                raise InputError(f"calibration: policy: expected one in float32, got {model.precision}")
            if model.source is None or Path(model.source).resolve() != self.source.resolve():
                raise InputError(
                    f"calibration: policy: expected the policy of {self.source}, got that of {model.source}"
                )
        if len(self.given.observations) == 0:
            raise InputError("calibration: observations: expected at least one, got none")

    def digest(self) -> str:
        """SHA-256 of all observations, as the policy reads them."""
        found = hashlib.sha256()
        for given in self.given.observations:
            for parsed in read_observations(given, self.given.policy.requirements):
                for frames, instruction in zip(parsed.frames, parsed.instructions, strict=True):
                    for name, frame in frames.items():
                        found.update(f"{name} {frame.shape}\n".encode())
                        found.update(np.ascontiguousarray(frame).tobytes())
                    found.update(f"{instruction!r} {parsed.is_plain}\n".encode())
                found.update(f"{parsed.state.shape}\n".encode())
                found.update(np.ascontiguousarray(parsed.state).tobytes())
        return found.hexdigest()

    def watch(
        self, part: str, wanted: Sequence[str], count: int, done: Callable[[], None] = lambda: None
    ) -> list[tuple[list[str], int, _saccade.Gram | None]]:
        """The layers that the first ``count`` observations run, with what those wanted are given."""
        if part == "head":
            for index in range(count):
                self._encode(index)
        with _saccade.watch_linears(list(wanted)) as watched:
            for index in range(count):
                if part == "backbone":
                    self.features.pop(index, None)
                    self._encode(index)
                else:
                    self._denoise(index)
                done()
        return watched.layers()

    def _encode(self, index: int) -> None:
        policy = self.given.policy
        if index in self.features:
            return
        assert policy.processor is not None
        assert policy.backbone is not None
        parsed = read_observations(self.given.observations[index], policy.requirements)
        self.features[index] = compute_features(prepare_inputs(parsed, policy.processor), policy.backbone)

    def _denoise(self, index: int) -> None:
        policy = self.given.policy
        context = encode_features(self.features[index], policy.head)
        policy.sample(context, self.given.observations[index], seed=self.given.seed + index)


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
