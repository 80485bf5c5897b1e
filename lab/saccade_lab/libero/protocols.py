"""The released protocols of evaluation on LIBERO, as a table.

A success rate on LIBERO is a number of a protocol: where an episode begins, how long it lasts, how many
actions of a chunk are executed, what the gripper's number means, and more. Three released programs have three
of them. Everything that they fix is data here; nothing in this module needs the simulator.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from saccade.errors import InputError
from saccade_lab.libero.suites import OFFICIAL, find_suite

AUTO = "auto"

#: What a gripper's action means, and what the environment gets: -1 opens, 1 closes.
AS_GIVEN = "as given"
OPEN_IS_ONE = "-sign(2 g - 1)"

#: When the environment's generator is seeded.
EVERY_EPISODE, EVERY_TASK = "every episode", "every task"


@dataclass(frozen=True)
class Protocol:
    """How one released program evaluates.

    Attributes:
        name: One of ``PROTOCOLS``.
        program: The released program, and its version; ``{version}`` stands for the checkpoint's.
        loads: Versions of checkpoints that the program loads. Those of Isaac-GR00T load no checkpoint that
            lerobot saved.
        official_states: Whether trial ``i`` begins in the official initial state ``i`` (modulo their number).
            Otherwise it begins in a random layout.
        settle_steps: Control steps with the arm at rest before the first observation.
        limits: Control steps of an episode, settling not counted, by official suite.
        execute_steps: Actions of a chunk that are executed; None for what the checkpoint says.
        image_size: Pixels along each side of both cameras' frames.
        lerobot_form: Whether observations have lerobot's keys and its arithmetic. Otherwise Isaac-GR00T's.
        gripper: What the program does with the gripper's number, ``AS_GIVEN`` or ``OPEN_IS_ONE``.
        seeding: ``EVERY_EPISODE``: trial ``i`` is reset after seeding with ``first_seed + i``.
            ``EVERY_TASK``: the generator is seeded once, and trial ``i`` is the ``i + 1``-th reset after
            that. Seeds matter with official states too: these do not contain where cabinets and stoves are.
        first_seed: See ``seeding``.
        num_steps: Denoising steps; None for the checkpoint's.
        remark: What else there is to know.
    """

    name: str
    program: str
    loads: tuple[str, ...]
    official_states: bool
    settle_steps: int
    limits: Mapping[str, int]
    execute_steps: int | None
    image_size: int
    lerobot_form: bool
    gripper: str
    seeding: str
    first_seed: int
    num_steps: int | None = None
    remark: str = ""

    def limit(self, suite: str) -> int:
        """Control steps of an episode of a suite; a perturbed suite has those of the one it perturbs.

        Raises:
            InputError: There is no such suite.

        Example:
            >>> PROTOCOLS["isaac-n15"].limit("libero_goal_swap")
            600
        """
        return self.limits[find_suite(suite).base]

    def seed(self, trial: int) -> int:
        """The seed before the reset of a trial."""
        return self.first_seed + (trial if self.seeding == EVERY_EPISODE else 0)

    def record(self, suites: Iterable[str]) -> dict[str, Any]:
        """What results say of the protocol, except what depends on the checkpoint."""
        return {
            "name": self.name,
            "program": self.program,
            "start": "official states" if self.official_states else "random layouts",
            "settle_steps": self.settle_steps,
            "max_steps": {suite: self.limit(suite) for suite in suites},
            "image_size": self.image_size,
            "observations": "lerobot" if self.lerobot_form else "isaac",
            "seeds": {"first": self.first_seed, "seeded": self.seeding},
            "remark": self.remark,
        }


#: The three, by name.
PROTOCOLS: Mapping[str, Protocol] = {
    protocol.name: protocol
    for protocol in (
        Protocol(
            name="lerobot",
            program="lerobot-eval --env.type=libero --eval.batch_size=1, lerobot 0.6.2 (7427f31)",
            loads=("n1.7",),
            official_states=True,
            settle_steps=10,
            limits={suite: steps for suite, (_, steps) in OFFICIAL.items()},
            execute_steps=None,
            image_size=360,
            lerobot_form=True,
            gripper=AS_GIVEN,
            seeding=EVERY_EPISODE,
            first_seed=1000,
            remark="By default lerobot-eval runs several environments at once, as many as the machine has "
            "cores for; trials then have other seeds. lerobot before 2026-07-31 (7a3298ea2) left out initial "
            "states when it reset by itself; its numbers are of other states.",
        ),
        Protocol(
            name="isaac-n17",
            program="rollout_policy.py --max-episode-steps 720 --n-action-steps 8 of Isaac-GR00T {version}",
            loads=("n1.6", "n1.7"),
            official_states=False,
            settle_steps=0,
            limits=dict.fromkeys(OFFICIAL, 720),
            execute_steps=8,
            image_size=256,
            lerobot_form=False,
            gripper=OPEN_IS_ONE,
            seeding=EVERY_EPISODE,
            first_seed=0,
            remark="The options are those of its README's command; stored revisions of the program itself "
            "have 504 or 720 steps as their default. The program stops at a number of finished episodes and "
            "drops those that are still running. Of several environments short episodes finish first, so "
            "its rates are biased upwards; here every trial counts. It gives no seed, so that each of its "
            "runs has other layouts; here they can be repeated. Objects are still falling in the first "
            "frames.",
        ),
        Protocol(
            name="isaac-n15",
            program="examples/Libero/eval/run_libero_eval.py of Isaac-GR00T N1.5 (15166e3)",
            loads=("n1.5",),
            official_states=True,
            settle_steps=10,
            # libero_10 has 1000 there, but robosuite refuses to go beyond 1000 steps with those of settling,
            # which the program counts as a failure.
            limits=dict(zip(OFFICIAL, (220, 280, 600, 990, 400), strict=True)),
            execute_steps=1,
            image_size=256,
            lerobot_form=False,
            gripper=OPEN_IS_ONE,
            seeding=EVERY_TASK,
            first_seed=0,
            num_steps=8,
            remark="8 denoising steps, with which its README serves the checkpoints. The program sends the "
            "state as float64; here it is rounded to float32 first.",
        ),
    )
}

#: The protocol that ``auto`` takes for checkpoints of Isaac-GR00T's layouts, by version.
OF_VERSION = {"n1.5": "isaac-n15", "n1.6": "isaac-n17", "n1.7": "isaac-n17"}
#: Why nothing evaluates an N1.5 that lerobot saved.
OLD_LEROBOT = (
    "lerobot 0.6.2 does not load N1.5; the last release that does, 0.5.1, begins its episodes in other states"
)


def choose_protocol(asked: str, version: str, *, from_lerobot: bool) -> tuple[Protocol, str]:
    """The protocol that is asked for, and why it is this one.

    Args:
        asked: A name of ``PROTOCOLS``, or ``"auto"`` for the checkpoint's.
        version: Version of the checkpoint's head, such as ``"n1.7"``.
        from_lerobot: Whether lerobot saved the checkpoint.

    Raises:
        InputError: The name is unknown, its program does not load such a checkpoint, or none does.

    Example:
        >>> protocol, reason = choose_protocol("auto", "n1.7", from_lerobot=False)
        >>> protocol.name, reason
        ('isaac-n17', 'the checkpoint has the layout of Isaac-GR00T n1.7')
    """
    if asked not in (AUTO, *PROTOCOLS):
        raise InputError(
            f"--protocol: unknown name {asked!r}, expected one of {', '.join((AUTO, *PROTOCOLS))}"
        )
    fitting = [
        protocol.name
        for protocol in PROTOCOLS.values()
        if version in protocol.loads and (protocol.lerobot_form or not from_lerobot)
    ]
    kind = f"{version} that lerobot saved" if from_lerobot else f"{version} in Isaac-GR00T's layout"
    if not fitting:
        why = f": {OLD_LEROBOT}" if from_lerobot and version == "n1.5" else ""
        raise InputError(f"--protocol {asked}: no protocol is known for checkpoints of {kind}{why}")
    if asked == AUTO:
        if from_lerobot:
            return PROTOCOLS[fitting[0]], "lerobot saved the checkpoint"
        return PROTOCOLS[OF_VERSION[version]], f"the checkpoint has the layout of Isaac-GR00T {version}"
    if asked not in fitting:
        raise InputError(
            f"--protocol {asked}: its program does not load checkpoints of {kind}: expected one of "
            f"{', '.join((AUTO, *fitting))}"
        )
    return PROTOCOLS[asked], "as given"


def described(protocol: Mapping[str, Any]) -> dict[str, str]:
    """A protocol of a result file in words, by aspect."""
    limits = {f"{steps} ({suite})" for suite, steps in protocol["max_steps"].items()}
    seeds = protocol["seeds"]
    seeded = (
        f"{seeds['first']} + trial, before each reset"
        if seeds["seeded"] == "every episode"
        else f"{seeds['first']}, once for each task"
    )
    return {
        "protocol": f"{protocol['name']}, {protocol['chosen']}: {protocol['program']}",
        "start": f"{protocol['start']}, {protocol['settle_steps']} steps of settling; seed {seeded}",
        "steps": f"at most {', '.join(sorted(limits))}",
        "chunk": f"{protocol['execute_steps']} actions executed ({protocol['execute_steps_reason']}), "
        f"{protocol['denoising_steps']} denoising steps",
        "frames": f"{protocol['image_size']} x {protocol['image_size']}, "
        + ", ".join(f"{camera} as {name}" for camera, name in protocol["cameras"].items()),
        "gripper": f"{protocol['gripper']['rule']}: {protocol['gripper']['reason']}",
    }
