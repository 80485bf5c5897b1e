"""One observation with what a map of it needs: title, pictures, layout of its tokens, occluder."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from saccade._internal.arrays import UInt8Array
from saccade.errors import InputError, ShapeError
from saccade.head.config import HeadConfig
from saccade.head.input_files import as_mask, read_arrays
from saccade.observations import read
from saccade.policy.policy import Policy
from saccade_lab.head_inputs import HeadInputs
from saccade_lab.inside import context_of, features_of, head_inputs, inputs_of
from saccade_lab.maps import layout as layouts
from saccade_lab.maps.grid import layout_of
from saccade_lab.maps.layout import Layout
from saccade_lab.maps.occlusion import BlankedFrames, DroppedPositions, Occluder

if TYPE_CHECKING:
    from saccade_lab.sim.policy import Policy as SimulatorPolicy


@dataclass(frozen=True)
class View:
    """One observation to be mapped.

    Attributes:
        title: What it is, on one line.
        source: Description of the observation for JSON.
        observation: One row, with noise.
        layout: What the positions of T_vl are.
        images: Images by camera name, ``(H, W, 3)``; empty if there are none.
        occluder: Function that removes patches.
    """

    title: str
    source: dict[str, Any]
    observation: HeadInputs
    layout: Layout
    images: dict[str, UInt8Array]
    occluder: Occluder


@dataclass(frozen=True)
class LayoutOptions:
    """How to find the image tokens in a file of features.

    Attributes:
        text: A layout written by hand, see ``layout.parse_layout``; it overrides what the file says.
        grid: Rows and columns of a picture.
        image_token_index: The id of the token that stands for one patch.
    """

    text: str | None = None
    grid: tuple[int, int] | None = None
    image_token_index: int = layouts.IMAGE_TOKEN_INDEX


def from_simulator(policy: SimulatorPolicy, task: str, seed: int, control_steps: int) -> View:
    """What the policy sees after a number of control steps of a rollout, with the noise of that rollout.

    Raises:
        InputError: The episode ends before that.
    """
    from saccade_lab.sim.rollout import environment_for
    from saccade_lab.sim.tasks import TASKS

    rng = np.random.default_rng((list(TASKS).index(task), seed))
    with contextlib.closing(environment_for(policy, task)) as environment:
        environment.restart(seed)
        steps = 0
        while True:
            observation = environment.observe()
            if steps == control_steps:
                break
            chunk = policy.act(observation, noise=policy.noise(rng))
            for action in chunk.actions[: min(policy.config.execute_steps, control_steps - steps)]:
                success = environment.advance(action).success
                steps += 1
                if steps < control_steps and (success or steps == environment.task.max_steps):
                    raise InputError(
                        f"--after: given {control_steps}, but the episode {task} {seed} ends after "
                        f"{steps} steps"
                    )
    instruction = observation["instruction"]
    return from_policy(
        policy.whole,
        policy.observation(observation),
        rng=rng,
        title=f'{task}, seed {seed}, after {control_steps} control steps: "{instruction}"',
        source={
            "kind": "simulator",
            "task": task,
            "seed": seed,
            "control_steps": control_steps,
            "instruction": instruction,
        },
    )


def from_policy(
    policy: Policy,
    seen: Mapping[str, Any],
    *,
    rng: np.random.Generator,
    title: str,
    source: Mapping[str, Any],
) -> View:
    """What a whole policy sees, and what it makes of it.

    Args:
        policy: A policy of :meth:`saccade.Policy.from_pretrained`.
        seen: An observation in Isaac-GR00T's nested form, with a batch of one.
        rng: Generator of the noise.
        title: What the observation is, on one line.
        source: Where it comes from, for JSON; the views are added.

    Raises:
        InputError, ShapeError, DtypeError: As :meth:`saccade.Policy.encode`.
    """
    (inputs,) = inputs_of(policy, seen)
    features = features_of(policy, [inputs])
    encoded = context_of(policy, features)
    given = head_inputs(policy, seen, features[0]).with_noise(rng, policy.head.config)
    frames = read(seen, policy.requirements).frames[0]
    return View(
        title=title,
        source={**source, "views": list(frames)},
        observation=given,
        layout=layout_of(policy, frames, inputs, features[0].views),
        images=dict(frames),
        occluder=BlankedFrames(policy, seen, encoded, given),
    )


def from_file(path: Path, config: HeadConfig, *, row: int, options: LayoutOptions, seed: int) -> View:
    """One observation of a file of backbone features.

    Args:
        path: ``.npz`` or ``.safetensors``, see ``saccade.head.input_files.read_arrays``.
        config: Config of the head that will take them.
        row: Which of the observations of the file.
        options: Where its image tokens are.
        seed: Seed of the noise, if the file contains none.

    Raises:
        FileNotFoundError: There is no such file.
        InputError: Arrays are missing or not finite, or nothing says where the image tokens are.
        ShapeError: Sizes that do not fit the head or each other.
    """
    arrays = read_arrays(path)
    # Heads that ignore padding show it: there these masks say what the positions are, and nothing else.
    shown = () if config.mask_mode == "alternate" else ("attention_mask", "image_mask")
    given = HeadInputs.from_arrays(
        {name: array for name, array in arrays.items() if name not in shown}, config, str(path)
    )
    batch, num_tokens = len(given), given.num_vl_tokens
    if not 0 <= row < batch:
        raise InputError(f"--row: given {row}, {path} has rows 0 to {batch - 1}")

    def of_row(name: str, shape: tuple[int, ...]) -> npt.NDArray[Any] | None:
        """The row of an array ``(batch, *shape)``; -1 is any size. One row may leave out the batch axis."""
        if name not in arrays:
            return None
        array = np.asarray(arrays[name])
        if batch == 1 and array.ndim == len(shape):
            array = array[None]
        sizes = (batch, *shape)
        if array.ndim != len(sizes) or any(
            size not in (-1, given) for given, size in zip(array.shape, sizes, strict=True)
        ):
            shown = ", ".join("any" if size < 0 else str(size) for size in sizes)
            raise ShapeError(f"{path}: {name}: shape {array.shape}, expected ({shown})")
        chosen: npt.NDArray[Any] = array[row]
        return chosen

    names = of_row("tokens", (num_tokens,))
    layout = _layout(
        num_tokens,
        options,
        input_ids=of_row("input_ids", (num_tokens,)),
        image_mask=as_mask(str(path), "image_mask", of_row("image_mask", (num_tokens,))),
        attention_mask=as_mask(str(path), "attention_mask", of_row("attention_mask", (num_tokens,))),
        names=None if names is None else [str(name) for name in names],
        path=path,
    )
    pictures = of_row("images", (len(layout.cameras), -1, -1, 3))
    if pictures is not None and pictures.dtype != np.uint8:
        raise InputError(f"{path}: images: expected uint8, got {pictures.dtype}")
    dropped = as_mask(str(path), "drop_vl", of_row("drop_vl", (num_tokens,)))
    if dropped is not None and dropped.any():
        raise InputError(f"{path}: drop_vl: maps show all positions, expected none dropped in row {row}")
    observation = given.row(row).with_noise(np.random.default_rng(seed), config)
    embodiment_id = int(observation.embodiment_id[0])
    return View(
        title=f"{path.name}, row {row} of {batch}, embodiment {embodiment_id}",
        source={
            "kind": "features",
            "file": path.name,
            "row": row,
            "embodiment_id": embodiment_id,
            "noise": "from the file" if "noise" in arrays else f"seed {seed}",
        },
        observation=observation,
        layout=layout,
        images={}
        if pictures is None
        else {camera.name: picture for camera, picture in zip(layout.cameras, pictures, strict=True)},
        occluder=DroppedPositions(observation),
    )


def _layout(
    num_tokens: int,
    options: LayoutOptions,
    *,
    input_ids: npt.NDArray[Any] | None,
    image_mask: npt.NDArray[np.bool_] | None,
    attention_mask: npt.NDArray[np.bool_] | None,
    names: Sequence[str] | None,
    path: Path,
) -> Layout:
    if options.text is not None:
        return layouts.parse_layout(options.text, num_tokens, names)
    if input_ids is not None:
        if input_ids.dtype.kind not in "iu":
            raise InputError(f"{path}: input_ids: expected integers, got {input_ids.dtype}")
        return layouts.from_input_ids(
            input_ids,
            image_token_index=options.image_token_index,
            grid=options.grid or layouts.DEFAULT_GRID,
            names=names,
            attention_mask=attention_mask,
        )
    if image_mask is not None:
        return layouts.from_image_mask(
            image_mask, grid=options.grid, names=names, attention_mask=attention_mask
        )
    raise InputError(
        f"{path}: neither input_ids nor image_mask; give the positions of image tokens with --layout "
        f"({layouts.GRAMMAR})"
    )
