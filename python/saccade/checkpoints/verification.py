"""All that can be known of a checkpoint without the program that trained it: tensors, values, robots, runs.

One precision at a time is in memory.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import saccade._saccade as _saccade
from saccade._internal.arrays import integer
from saccade._internal.hub import locate
from saccade._internal.hub_files import WEIGHTS
from saccade.checkpoints.description import Description, Source, description_of, open_published
from saccade.checkpoints.finite import count_not_finite
from saccade.checkpoints.trial import Reference, Run, lines_of, run_head, run_policy
from saccade.checkpoints.whole import RobotFindings, robots_of
from saccade.errors import InputError, MissingExtraError, SaccadeError
from saccade.robots import DataConfigLike

#: At this error against the reference, of an action's range, code or files are wrong: rounding of float32
#: gives some 1e-6, and computing in bfloat16 less than 1e-2 (docs/parity.md, docs/precision.md).
TOLERANCE = 1e-3


@dataclass
class Tensors:
    """The tensors of one part of a checkpoint."""

    count: int = 0
    """Number of tensors."""
    parameters: int = 0
    """Number of values."""
    nbytes: int = 0
    """Size in the files, in bytes."""
    dtypes: dict[str, int] = field(default_factory=dict)
    """Number of tensors of each type, in the names of safetensors."""


@dataclass
class Verification:
    """What :func:`verify` found. ``dataclasses.asdict`` converts it to JSON values."""

    source: str
    """The checkpoint as it was given."""
    published: str | None = None
    """The id and commit of a published one, ``owner/name@commit``; None for a path."""
    version: str | None = None
    """The release, such as ``"n1.5"``; None if the checkpoint could not be opened."""
    layout: str | None = None
    """The program that wrote it, as in :class:`saccade.checkpoints.Description`."""
    tensors: dict[str, Tensors] = field(default_factory=dict)
    """By part: ``"head"``, ``"backbone"`` and ``"neither"``, which is not read."""
    problems: list[str] = field(default_factory=list)
    """What is wrong with the checkpoint, or with what it computes: sentences that name tensors."""
    robots: list[RobotFindings] = field(default_factory=list)
    """The robots whose statistics are among the files, and why one cannot be used as it is."""
    refused: str | None = None
    """Why the whole policy was not run, although the checkpoint has a backbone or a reference was given."""
    part: Literal["policy", "head"] | None = None
    """What was run: the whole policy, from frames to actions in the robot's units, or the head alone, on
    random features, to normalised actions. None if nothing was."""
    robot: str | None = None
    """The robot whose actions were computed: its tag, or else its id. Of a head alone its id."""
    runs: list[Run] = field(default_factory=list)
    """One of each precision, float32 first."""
    reference: dict[str, float] | None = None
    """Largest differences of float32 from the torch reference; None if it was not asked for."""

    @property
    def verdict(self) -> Literal["passed", "failed", "incomplete"]:
        """``"failed"`` with problems, ``"incomplete"`` if a part was not run, else ``"passed"``."""
        if self.problems:
            return "failed"
        return "incomplete" if self.refused is not None or not self.runs else "passed"


def verify(
    source: Source,
    *,
    embodiment: str | int | None = None,
    preprocessing: Literal["lerobot", "isaac"] | None = None,
    tokenizer: str | os.PathLike[str] | None = None,
    data_config: DataConfigLike | None = None,
    action_horizon: int | None = None,
    processor_options: Mapping[str, Any] | None = None,
    num_threads: int | None = None,
    seed: int = 0,
    reference: Reference | None = None,
    progress: Callable[[str], object] | None = None,
) -> Verification:
    """Checks all of a checkpoint that can be checked here, and runs it. This is ``saccade verify``.

    Every tensor must be there, of the expected shape and type, and finite. Then one chunk is computed at each
    precision from the same random frames and noise, and compared with float32. A checkpoint without a
    backbone runs its head on random features, and so does one whose whole policy is refused.

    Args:
        source: The checkpoint, as for :meth:`saccade.ActionHead.from_pretrained`.
        embodiment, preprocessing, tokenizer, data_config, action_horizon, processor_options, num_threads: As
            for :meth:`saccade.Policy.from_pretrained`. Default of ``embodiment``: the first robot that can be
            used.
        seed: Seed of frames, features and noise, at least 0.
        reference: Compares with another implementation, as ``saccade_lab`` does; None does not.
        progress: Called with what is done next.

    Raises:
        FileNotFoundError: ``source`` does not exist. Everything else that is wrong with it is among the
            ``problems``.
        InputError: ``seed`` or ``num_threads`` is out of range, or the files of a head alone have no id
            of the tag ``embodiment``.
        MissingExtraError: ``reference`` needs a package that is not installed.

    Example:
        >>> import saccade
        >>> from saccade.checkpoints import verify
        >>> found = verify(saccade.demo_checkpoint())
        >>> found.verdict, found.tensors["backbone"].count
        ('passed', 79)
    """
    seed = integer("seed", seed, least=0)
    say = progress or (lambda text: None)
    place = locate(source, files=WEIGHTS)
    path = place.path
    found = Verification(os.fspath(source), place.published)
    if not path.exists():
        raise FileNotFoundError(f"{path}: no such checkpoint")
    read = _read(found, path, data_config, say)
    if read is None or found.problems:
        return found
    published, has_backbone = read
    given = embodiment
    if embodiment is None:
        usable = [robot.embodiment for robot in found.robots if robot.problem is None]
        embodiment = usable[0] if usable and len(found.robots) > 1 else None
    if has_backbone:
        options = {
            "embodiment": embodiment,
            "preprocessing": preprocessing,
            "tokenizer": tokenizer,
            "data_config": data_config,
            "action_horizon": action_horizon,
            "processor_options": processor_options,
            "num_threads": num_threads,
        }
        _run_whole(found, path, options, seed, reference, say)
    elif reference is not None:
        found.refused = "the reference compares whole policies, and the checkpoint has no backbone"
    if not found.runs:
        chosen = _head_embodiment(published, found.robots, given, has_backbone)
        try:
            found.runs = run_head(path, chosen, num_threads, seed, say)
            found.part, found.robot = "head", str(chosen)
        except (SaccadeError, FileNotFoundError) as error:
            found.problems += lines_of(error)
    found.problems += [f"{run.name}: {run.problem}" for run in found.runs if run.problem is not None]
    worst = 0.0 if found.reference is None else found.reference["of range"]
    if not worst <= TOLERANCE:  # also if it is NaN
        found.problems.append(
            f"float32 differs from the reference by {worst:.1e} of an action's range, expected at most "
            f"{TOLERANCE:.0e}"
        )
    return found


def _read(
    found: Verification,
    path: Path,
    data_config: DataConfigLike | None,
    say: Callable[[str], object],
) -> tuple[_saccade.HeadCheckpoint, bool] | None:
    """Checks the files; what opened them, and whether there is a backbone. None if they cannot be read."""
    say("names, shapes and types of the tensors")
    try:
        published = open_published(path)
    except SaccadeError as error:
        found.problems += lines_of(error)
        return None
    description = description_of(published, path)
    found.version, found.layout = description.version, description.layout
    has_backbone = _check_tensors(found, published, description, path)
    say("values of the tensors")
    try:
        not_finite = count_not_finite([Path(file.path) for file in description.files])
    except SaccadeError as error:
        found.problems += lines_of(error)
        return None
    found.problems += [
        f"{name}: {count} of {of} values are NaN or infinite" for name, (count, of) in not_finite.items()
    ]
    found.robots = robots_of(path, description.config.num_states, data_config)
    return published, has_backbone


def _run_whole(
    found: Verification,
    path: Path,
    options: Mapping[str, Any],
    seed: int,
    reference: Reference | None,
    say: Callable[[str], object],
) -> None:
    """Runs the whole policy at each precision, or notes why it is refused."""
    try:
        result = run_policy(path, options, seed, reference, say)
    except MissingExtraError:
        raise
    except (SaccadeError, FileNotFoundError) as error:
        found.refused = "; ".join(lines_of(error))
    else:
        found.part, found.robot, found.reference = "policy", result.robot, result.reference
        found.runs = result.runs


def _check_tensors(
    found: Verification, published: _saccade.HeadCheckpoint, description: Description, path: Path
) -> bool:
    """Counts the tensors of each part and lists what does not fit; whether there is a backbone."""
    try:
        published.check()
    except SaccadeError as error:
        found.problems += lines_of(error)
    outside = [one for one in description.tensors if not one.name.startswith(description.prefix)]
    backbone_prefix = None
    if outside:
        try:
            backbone_prefix = _saccade.BackboneCheckpoint.open(str(path), None).prefix
        except SaccadeError as error:
            found.problems += lines_of(error)
    for tensor in description.tensors:
        if tensor.name.startswith(description.prefix):
            part = "head"
        elif backbone_prefix is not None and tensor.name.startswith(backbone_prefix):
            part = "backbone"
        else:
            part = "neither"
        counts = found.tensors.setdefault(part, Tensors())
        counts.count += 1
        counts.parameters += math.prod(tensor.shape)
        counts.nbytes += tensor.nbytes
        counts.dtypes[tensor.dtype] = counts.dtypes.get(tensor.dtype, 0) + 1
    return backbone_prefix is not None


def _head_embodiment(
    published: _saccade.HeadCheckpoint,
    robots: list[RobotFindings],
    given: str | int | None,
    has_backbone: bool,
) -> int:
    """The id whose layers a head alone is run with: the given one, or else the first robot's that it has."""
    if isinstance(given, int):
        return given
    ids = {one.embodiment: one.embodiment_id for one in robots if one.embodiment_id is not None}
    if given is not None and given in ids:
        return ids[given]
    if given is not None and not has_backbone:  # with one, `refused` says what is wrong with the tag
        raise InputError(
            f"embodiment: the files of this head have no id of {given!r}, expected an id or one of "
            f"{', '.join(tag for tag in ids if tag) or 'no tags'}"
        )
    kept = published.kept_embodiments() or [0]
    return next((number for number in ids.values() if number in kept), kept[0])
