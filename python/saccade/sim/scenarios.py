"""Scenarios: how one task is laid out, judged and solved inside its Meta-World scene.

Most tasks leave all of that to Meta-World. Those at the end put balls of our own into the scene of reach.
They only exist in the pictures: the hand passes through them.
"""

import warnings
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

Float64Array = npt.NDArray[np.float64]
Rgba = tuple[float, float, float, float]

TOUCH = 0.05  # metres between fingertips and middle of a ball; Meta-World judges a reach by the same
GAIN = 4.0  # of the expert here: full speed from 25 cm on, slower below
BALL_RADIUS = 0.03
NOT_NEARER = 0.15  # metres from the fingertips at the start
YELLOW, BLUE, GREEN = (1.0, 0.85, 0.0, 1.0), (0.1, 0.2, 1.0, 1.0), (0.0, 1.0, 0.0, 1.0)
PUCK_AWAY = np.array([0.0, 0.15, 0.02])  # off the table, where no camera looks


@dataclass(frozen=True)
class StepOutcome:
    """What the simulator says about one control step."""

    reward: float
    success: bool


@dataclass(frozen=True)
class Ball:
    """A ball drawn into the scene.

    Attributes:
        position: Of its middle `(3,)`, metres.
        radius: Metres.
        rgba: Its colour, each in [0, 1].
    """

    position: Float64Array
    radius: float
    rgba: Rgba


class Scenario(Protocol):
    """One environment's rules. `state` is Meta-World's own observation `(39,)`, goal included."""

    def start(self, seed: int) -> None:
        """Lays an episode out; Meta-World has already been reset with the same seed."""

    def outcome(self, reward: float, success: bool) -> StepOutcome:
        """Judges a control step, told what Meta-World says of it."""

    def balls(self) -> tuple[Ball, ...]:
        """What is to be drawn into the scene now."""

    def targets(self, state: Float64Array) -> Float64Array:
        """Two positions `(6,)`, metres, that a policy should find in the pictures."""

    def expert_action(self, state: Float64Array) -> Float64Array:
        """What the expert does now `(4,)`; may ask for more than full speed."""


class MetaWorldScenario:
    """A task as Meta-World has it: its layout, its success, its scripted expert.

    Args:
        world: the Meta-World environment.
        expert: class of the expert in `metaworld.policies`.
        aims_with_fingertips: bring the fingertips to the goal instead of the wrist. The script of reach
            brings the wrist there, but success is judged between the fingertips, 4.5 cm below: aiming with
            them leaves the whole 5 cm for the errors of whoever learns from it.
    """

    def __init__(self, world: Any, *, expert: str, aims_with_fingertips: bool = False) -> None:
        import metaworld.policies  # not at the top: policies run where there is no simulator

        self._world = world
        self._script: Any = getattr(metaworld.policies, expert)()
        self._aims_with_fingertips = aims_with_fingertips

    def start(self, seed: int) -> None:
        """Leaves the layout as it is."""

    def outcome(self, reward: float, success: bool) -> StepOutcome:
        """What Meta-World says."""
        return StepOutcome(reward, success)

    def balls(self) -> tuple[Ball, ...]:
        """None: Meta-World draws its own marker."""
        return ()

    def targets(self, state: Float64Array) -> Float64Array:
        """The object, then the goal."""
        goal = np.asarray(self._world._target_pos, dtype=np.float64)
        return np.concatenate((state[4:7], goal))

    def expert_action(self, state: Float64Array) -> Float64Array:
        """What the script does."""
        state = state.copy()
        if self._aims_with_fingertips:
            state[-3:] += state[:3] - self._world.tcp_center
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it warns whenever it asks for more than full speed
            return np.asarray(self._script.get_action(state), dtype=np.float64)


class BallScenario(ABC):
    """Balls to be touched with the fingertips, in the scene of reach without its puck.

    Args:
        world: Meta-World's reach environment.

    Attributes:
        workspace: Where middles of balls may lie, lower and upper corner, metres. All three cameras see it.
        placed: The episode's balls, those that have vanished included. `targets` are the positions of the
            first and the last one, which may be the same ball.
    """

    workspace = (np.array([-0.2, 0.68, 0.06]), np.array([0.2, 0.86, 0.28]))

    def __init__(self, world: Any) -> None:
        self._world = world
        self.placed: tuple[Ball, ...] = ()

    @abstractmethod
    def place(self, rng: np.random.Generator) -> tuple[Ball, ...]:
        """The balls of a new episode."""

    @abstractmethod
    def aim(self) -> Float64Array:
        """Where the expert brings the fingertips now `(3,)`."""

    @abstractmethod
    def way_left(self) -> float:
        """Metres from the fingertips to the end of the task, by way of all that is still to be touched."""

    def start(self, seed: int) -> None:
        """Draws the layout and puts the puck out of sight."""
        self.placed = self.place(np.random.default_rng(seed))
        self._world._set_obj_xyz(PUCK_AWAY)

    def outcome(self, reward: float, success: bool) -> StepOutcome:
        """Success is a touch; the reward is minus the way that is left."""
        return StepOutcome(-self.way_left(), self.way_left() <= TOUCH)

    def balls(self) -> tuple[Ball, ...]:
        """All that were placed."""
        return self.placed

    def targets(self, state: Float64Array) -> Float64Array:
        """The first ball, then the last one."""
        return np.concatenate((self.placed[0].position, self.placed[-1].position))

    def expert_action(self, state: Float64Array) -> Float64Array:
        """Straight to where it aims; the gripper is left alone."""
        return np.append(GAIN * (self.aim() - self.fingertips()), 0.0)

    def fingertips(self) -> Float64Array:
        """The point between them `(3,)`, metres."""
        return np.asarray(self._world.tcp_center, dtype=np.float64)

    def draw_position(self, rng: np.random.Generator) -> Float64Array:
        """A place for a ball, not too close to the fingertips as they are now."""
        while True:
            position = rng.uniform(*self.workspace)
            if np.linalg.norm(position - self.fingertips()) >= NOT_NEARER:
                return position

    def distance(self, ball: Ball) -> float:
        """Metres between the fingertips and the ball's middle."""
        return float(np.linalg.norm(self.fingertips() - ball.position))


class TwoGoals(BallScenario):
    """Two equal balls, about equally far from the hand; touching either is success.

    The expert goes to one of them, drawn anew for each episode and not to be seen in the pictures. A policy
    that answers with the mean of what it was shown goes between them. The balls are kept in the order left,
    right, which does not tell the choice.

    Attributes:
        chosen: Which one the expert goes to, 0 or 1.
    """

    APART = 0.2  # metres at least
    EQUALLY_FAR = 0.02  # metres by which the ways from the hand may differ

    chosen = 0

    def place(self, rng: np.random.Generator) -> tuple[Ball, ...]:
        """One ball on each side."""
        while True:
            one, other = (Ball(self.draw_position(rng), BALL_RADIUS, YELLOW) for _ in range(2))
            uneven = abs(self.distance(one) - self.distance(other))
            if other.position[0] - one.position[0] >= self.APART and uneven <= self.EQUALLY_FAR:
                self.chosen = int(rng.integers(2))
                return one, other

    def aim(self) -> Float64Array:
        """The chosen ball."""
        return self.placed[self.chosen].position

    def way_left(self) -> float:
        """To the nearer ball."""
        return min(self.distance(ball) for ball in self.placed)


class StereoReach(BallScenario):
    """One ball whose size says nothing about how far away it is.

    Its radius is random and it may hang at any height, so one picture tells the direction in which it lies
    and not the distance. The workspace is deep: the best guess from where the ball is in one picture and how
    large it looks comes within `TOUCH` in half of the layouts, from two pictures in all.
    """

    RADII = (0.018, 0.045)  # metres; the logarithm is drawn evenly
    workspace = (np.array([-0.16, 0.62, 0.06]), np.array([0.16, 0.9, 0.34]))

    def place(self, rng: np.random.Generator) -> tuple[Ball, ...]:
        """The ball."""
        radius = float(np.exp(rng.uniform(*np.log(self.RADII))))
        return (Ball(self.draw_position(rng), radius, BLUE),)

    def aim(self) -> Float64Array:
        """The ball."""
        return self.placed[0].position

    def way_left(self) -> float:
        """To the ball."""
        return self.distance(self.placed[0])


class TwoStage(BallScenario):
    """A blue ball to be touched first, which then vanishes, and a green one to be touched next.

    Attributes:
        stage: Which one is next, 0 or 1.
    """

    APART = 0.3  # metres at least

    stage = 0

    def place(self, rng: np.random.Generator) -> tuple[Ball, ...]:
        """Both balls, the blue one first."""
        self.stage = 0
        while True:
            first = Ball(self.draw_position(rng), BALL_RADIUS, BLUE)
            second = Ball(self.draw_position(rng), BALL_RADIUS, GREEN)
            if np.linalg.norm(first.position - second.position) >= self.APART:
                return first, second

    def outcome(self, reward: float, success: bool) -> StepOutcome:
        """Takes the blue ball away once it is touched."""
        if self.stage == 0 and self.distance(self.placed[0]) <= TOUCH:
            self.stage = 1
        return super().outcome(reward, success)

    def balls(self) -> tuple[Ball, ...]:
        """Those that have not vanished."""
        return self.placed[self.stage :]

    def aim(self) -> Float64Array:
        """The ball that is next."""
        return self.placed[self.stage].position

    def way_left(self) -> float:
        """To the ball that is next, and on to the other one if that is the first."""
        between = np.linalg.norm(self.placed[0].position - self.placed[1].position)
        return self.distance(self.placed[self.stage]) + (float(between) if self.stage == 0 else 0.0)


class Fork(BallScenario):
    """A blue ball straight ahead that must not be touched, and a yellow one on each side: touch either.

    The hand starts on the middle line and the layout is its own mirror image, so both ways are equally good.
    The expert takes one of them, drawn anew for each episode and not to be seen in the pictures; once the
    hand is off the middle line the nearer ball is the one to go to. A policy that answers with the mean of
    what it was shown goes straight ahead, to the blue ball.

    Attributes:
        chosen: Which yellow ball the expert goes to, 0 or 1.
        spoiled: Whether the blue one was touched; the episode can then not succeed any more.
    """

    ASIDE = 0.17  # metres from the middle line to a yellow ball
    AHEAD = 0.1  # metres from the fingertips, forwards, to all three
    JITTER = np.array([0.015, 0.015, 0.03])  # metres by which a layout may differ: aside, ahead, height
    HEIGHT = 0.15  # metres
    SPEED = 6.0  # gain of the expert: full speed from 17 cm on

    chosen = 0
    spoiled = False

    def place(self, rng: np.random.Generator) -> tuple[Ball, ...]:
        """The left ball, the blue one, the right one."""
        self.spoiled = False
        self.chosen = int(rng.integers(2))
        aside, ahead, up = np.array([self.ASIDE, self.AHEAD, 0.0]) + rng.uniform(-self.JITTER, self.JITTER)
        hand = self.fingertips()
        middle = np.array([hand[0], hand[1] + ahead, self.HEIGHT + up])
        return tuple(
            Ball(middle + np.array([side * aside, 0.0, 0.0]), BALL_RADIUS, colour)
            for side, colour in ((-1, YELLOW), (0, BLUE), (1, YELLOW))
        )

    def outcome(self, reward: float, success: bool) -> StepOutcome:
        """A touch of a yellow ball counts if the blue one was not touched before."""
        self.spoiled = self.spoiled or self.distance(self.placed[1]) <= TOUCH
        judged = super().outcome(reward, success)
        return StepOutcome(judged.reward, judged.success and not self.spoiled)

    def aim(self) -> Float64Array:
        """The chosen ball."""
        return self.placed[2 * self.chosen].position

    def way_left(self) -> float:
        """To the nearer yellow ball."""
        return min(self.distance(ball) for ball in self.placed[::2])

    def expert_action(self, state: Float64Array) -> Float64Array:
        """Straight to where it aims, faster than in the other tasks; the gripper is left alone."""
        return np.append(self.SPEED * (self.aim() - self.fingertips()), 0.0)
