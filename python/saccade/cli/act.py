"""`saccade act`: runs a whole checkpoint on images and an instruction, and prints the actions."""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from saccade._internal import flags as arguments
from saccade._internal.flags import UsageError, add_policy_options, policy_options
from saccade.cli import EXIT_OK, output, require
from saccade.cli.output import Section, show

if TYPE_CHECKING:
    from saccade._internal.arrays import Float32Array
    from saccade.policy.policy import Policy

HELP = "run a whole checkpoint on images and an instruction"
EPILOG = """\
Prints a chunk of actions in the robot's units, and how long each part took. The checkpoint must hold the
backbone and the head. `saccade inspect` lists its robots, cameras and states.

Without --image the images are random, without --state the state is in the middle of the robot's range.

examples:
  saccade act GR00T-N1.5-3B/ --embodiment gr1 --data-config fourier_gr1_arms_only --image ego_view=table.png
  saccade act my-policy/ --image front=a.png wrist=b.png --instruction "open the drawer" --state state.json
  saccade act my-policy/ --precision int8 --head-precision bfloat16 --seed 7 --json
  saccade act my-policy/ --profile
state.json holds numbers by key, {"single_arm": [0, 0.1, 0, 0, 0], "gripper": [1]}, or one list of all.
"""

#: The parts that are timed, in order, and what each does.
PARTS = {
    "load": "checkpoint, tokenizer, statistics",
    "frames": "reading the images",
    "processor": "resizing images, making tokens",
    "backbone": "vision tower and language model",
    "encode": "the head's keys and values",
    "sample": "denoising the actions",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.epilog = EPILOG
    arguments.add_checkpoint_argument(parser)
    seen = parser.add_argument_group("observation")
    seen.add_argument(
        "--image",
        nargs="+",
        action="extend",
        default=[],
        metavar="[CAMERA=]FILE",
        help="image of each camera; the name may be left out if there is one camera",
    )
    arguments.add_words_and_state(seen, "what to do", "JSON: the robot's state in its own units")
    add_policy_options(parser)
    arguments.add_seed(parser, "seed of the noise")
    arguments.add_num_steps(parser)
    arguments.add_num_threads(parser, "threads (default: the physical cores)")
    parser.add_argument("--profile", action="store_true", help="repeat the call, and say where its time goes")
    arguments.add_json(parser)


def run(args: argparse.Namespace) -> int:
    """Loads the checkpoint, computes a chunk and prints it."""
    if args.image:
        require("act --image")
    from saccade.observations.pictures import instruction_of, observation, read_state
    from saccade.policy.encoding import compute_features, encode_features
    from saccade.policy.policy import Policy
    from saccade.policy.preparing import prepare_inputs
    from saccade.policy.reading import read_observations

    pictures = named_pictures(args.image)
    state = None if args.state is None else read_state(args.state)
    clock = Clock()
    with output.progress_bar("loading", transient=True):
        policy = Policy.from_pretrained(args.checkpoint, **policy_options(args))
    clock.done("load")
    given = observation(policy, pictures, args.instruction, state)
    clock.done("frames")
    processor, backbone = policy.processor, policy.backbone
    assert processor is not None
    assert backbone is not None
    inputs = prepare_inputs(read_observations(given, policy.requirements), processor)
    clock.done("processor")
    features = compute_features(inputs, backbone)
    clock.done("backbone")
    context = encode_features(features, policy.head)
    clock.done("encode")
    actions = policy.sample(context, given, seed=args.seed, num_steps=args.num_steps)
    clock.done("sample")
    found = None
    if args.profile:
        from saccade.cli import profiling

        found = profiling.profile(policy, given, args.seed, args.num_steps)
    if args.json:
        report = {
            "checkpoint": str(args.checkpoint),
            "embodiment": policy.normalizer.embodiment,
            "embodiment_id": policy.embodiment_id,
            "precision": policy_options(args)["precision"],
            "num_vl_tokens": inputs[0].input_ids.shape[1],
            "actions": {key: part[0].tolist() for key, part in actions.items()},
            "milliseconds": clock.milliseconds,
        }
        if found is not None:
            report["profile"] = {**dataclasses.asdict(found), "not_arithmetic": found.not_arithmetic}
        output.print_json(report)
        return EXIT_OK
    assumed = [
        *(["random images"] if not pictures else []),
        *(["a state in the middle of the robot's range"] if state is None else []),
        *([f'the instruction "{instruction_of(given)}"'] if args.instruction is None else []),
    ]
    if assumed:
        output.note("act", f"using defaults: {', '.join(assumed)}")
    show([chunk(policy, actions), times(clock), *(profiling.tables(found) if found is not None else ())])
    return EXIT_OK


class Clock:
    """Milliseconds of each part, measured from the end of the part before."""

    def __init__(self) -> None:
        self.milliseconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def done(self, part: str) -> None:
        """Ends a part of `PARTS`."""
        now = time.perf_counter()
        self.milliseconds[part] = 1e3 * (now - self._last)
        self._last = now


def named_pictures(given: list[str]) -> dict[str, Path]:
    """Files by camera; the name is empty if it was left out."""
    found: dict[str, Path] = {}
    for word in given:
        name, separator, file = word.partition("=")
        # A file may have an equals sign in its name.
        if not separator or Path(word).is_file():
            name, file = "", word
        if name in found or (found and "" in (name, *found)):
            raise UsageError(f"--image: expected CAMERA=FILE, each camera once, got {' '.join(given)}")
        found[name] = Path(file)
    return found


def chunk(policy: Policy, actions: Mapping[str, Float32Array]) -> Section:
    """The chunk: a row for each step, a column for each number."""
    columns = [">step"]
    for key, part in actions.items():
        columns += [f">{key}", *[">"] * (part.shape[-1] - 1)]
    joined = np.concatenate([part[0] for part in actions.values()], axis=-1)
    rows = [[str(step), *(f"{value:.4f}" for value in row)] for step, row in enumerate(joined)]
    robot = policy.normalizer.embodiment or policy.embodiment_id
    return Section(f"Actions of {robot}, in its units", columns, rows)


def times(clock: Clock) -> Section:
    """How long each part took."""
    spent = clock.milliseconds
    rows = [[part, f"{spent[part]:,.1f}", what] for part, what in PARTS.items()]
    rest = sum(spent.values()) - spent["load"]
    rows.append(["all but load", f"{rest:,.1f}", "the first call; later ones need not allocate memory"])
    return Section("Time", ["", ">ms", ""], rows)
