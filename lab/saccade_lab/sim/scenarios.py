"""Scenarios: the layout, the success and the expert of a task inside its Meta-World scene.

Most tasks use those of Meta-World. The tasks at the end add balls to the scene of reach. The balls exist in
the images only: the hand passes through them.
"""

import warnings
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

Float64Array = npt.NDArray[np.float64]
Rgba = tuple[float, float, float, float]

TOUCH = 0.05  # metres between fingertips and centre of a ball; Meta-World uses the same for a reach
GAIN = 4.0  # gain of the expert: full speed at 25 cm and more
BALL_RADIUS = 0.03
NOT_NEARER = 0.15  # smallest distance from the fingertips at the start, metres
YELLOW, BLUE, GREEN = (1.0, 0.85, 0.0, 1.0), (0.1, 0.2, 1.0, 1.0), (0.0, 1.0, 0.0, 1.0)
PUCK_AWAY = np.array([0.0, 0.15, 0.02])  # off the table, outside all images


@dataclass(frozen=True)
class StepOutcome:
    """The outcome of one control step."""

    reward: float
    success: bool


@dataclass(frozen=True)
class Ball:
    """A ball that is drawn into the scene.

    Attributes:
        position: Its centre ``(3,)``, metres.
        radius: Its radius, metres.
        rgba: Its colour, each component in [0, 1].
    """

    position: Float64Array
    radius: float
    rgba: Rgba


class Scenario(Protocol):
    """The rules of one environment. ``state`` is Meta-World's own observation ``(39,)``, goal included."""

    def start(self, seed: int) -> None:
        """Creates the layout of an episode; Meta-World has already been reset with the same seed."""

    def outcome(self, reward: float, success: bool) -> StepOutcome:
        """The outcome of a control step, given Meta-World's reward and success."""

    def balls(self) -> tuple[Ball, ...]:
        """The balls to draw into the scene now."""

    def targets(self, state: Float64Array) -> Float64Array:
        """Two positions ``(6,)``, metres, that a policy should locate in the images."""

    def expert_action(self, state: Float64Array) -> Float64Array:
        """The expert's action ``(4,)``; may exceed full speed."""


class MetaWorldScenario:
    """A task with the layout, success and scripted expert of Meta-World.

    Args:
        world: The Meta-World environment.
        expert: Class of the expert in ``metaworld.policies``.
        aims_with_fingertips: Bring the fingertips to the goal instead of the wrist. The script of reach
            brings the wrist there, but success is measured between the fingertips, 4.5 cm below. With this
            correction the whole tolerance of 5 cm is left for the errors of the learned policy.
    """

    def __init__(self, world: Any, *, expert: str, aims_with_fingertips: bool = False) -> None:
        import metaworld.policies  # not at the top: policies run where there is no simulator

        self._world = world
        self._script: Any = getattr(metaworld.policies, expert)()
        self._aims_with_fingertips = aims_with_fingertips

    def start(self, seed: int) -> None:
        """Keeps the layout."""

    def outcome(self, reward: float, success: bool) -> StepOutcome:
        """The outcome according to Meta-World."""
        return StepOutcome(reward, success)

    def balls(self) -> tuple[Ball, ...]:
        """No balls: Meta-World draws its own marker."""
        return ()

    def targets(self, state: Float64Array) -> Float64Array:
        """The object, then the goal."""
        goal = np.asarray(self._world._target_pos, dtype=np.float64)
        return np.concatenate((state[4:7], goal))

    def expert_action(self, state: Float64Array) -> Float64Array:
        """The action of the script."""
        state = state.copy()
        if self._aims_with_fingertips:
            state[-3:] += state[:3] - self._world.tcp_center
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it warns whenever an action exceeds full speed
            return np.asarray(self._script.get_action(state), dtype=np.float64)


class BallScenario(ABC):
    """Balls to be touched with the fingertips, in the scene of reach without its puck.

    Args:
        world: Meta-World's reach environment.

    Attributes:
        workspace: Lower and upper corner of the region of the balls' centres, metres. All cameras see it.
        placed: The balls of the episode, vanished ones included. ``targets`` are the positions of the
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
        """The point that the expert moves the fingertips to ``(3,)``, metres."""

    @abstractmethod
    def distance_left(self) -> float:
        """Length of the path from the fingertips through all balls that must still be touched, metres."""

    def start(self, seed: int) -> None:
        """Draws the layout and moves the puck out of sight."""
        self.placed = self.place(np.random.default_rng(seed))
        self._world._set_obj_xyz(PUCK_AWAY)

    def outcome(self, reward: float, success: bool) -> StepOutcome:
        """Success is a touch; the reward is minus the distance that is left."""
        return StepOutcome(-self.distance_left(), self.distance_left() <= TOUCH)

    def balls(self) -> tuple[Ball, ...]:
        """All balls."""
        return self.placed

    def targets(self, state: Float64Array) -> Float64Array:
        """The first ball, then the last one."""
        return np.concatenate((self.placed[0].position, self.placed[-1].position))

    def expert_action(self, state: Float64Array) -> Float64Array:
        """Moves straight to ``aim``; the gripper is not used."""
        return np.append(GAIN * (self.aim() - self.fingertips()), 0.0)

    def fingertips(self) -> Float64Array:
        """The point between the fingertips ``(3,)``, metres."""
        return np.asarray(self._world.tcp_center, dtype=np.float64)

    def draw_position(self, rng: np.random.Generator) -> Float64Array:
        """A position for a ball, at least ``NOT_NEARER`` from the fingertips."""
        while True:
            position = rng.uniform(*self.workspace)
            if np.linalg.norm(position - self.fingertips()) >= NOT_NEARER:
                return position

    def distance(self, ball: Ball) -> float:
        """Distance between the fingertips and the centre of a ball, metres."""
        return float(np.linalg.norm(self.fingertips() - ball.position))


class TwoGoals(BallScenario):
    """Two equal balls, about equally far from the hand; touching either is success.

    The expert goes to one of them, which is drawn for each episode and cannot be seen in the images. A policy
    that predicts the mean of the demonstrations goes between them. The balls are in the order left, right,
    which does not reveal the choice.

    Attributes:
        chosen: The ball that the expert goes to, 0 or 1.
    """

    APART = 0.2  # smallest distance between the balls, metres
    EQUALLY_FAR = 0.02  # largest difference of the distances from the hand, metres

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

    def distance_left(self) -> float:
        """Distance to the nearer ball."""
        return min(self.distance(ball) for ball in self.placed)


class StereoReach(BallScenario):
    """One ball whose apparent size does not give its distance.

    Its radius and its height are random, so that one image gives the direction of the ball but not its
    distance. The workspace is deep: the best estimate from the ball's position and size in one image is
    within ``TOUCH`` in half of the layouts; from two images it always is.
    """

    RADII = (0.018, 0.045)  # metres; the logarithm is uniform
    workspace = (np.array([-0.16, 0.62, 0.06]), np.array([0.16, 0.9, 0.34]))

    def place(self, rng: np.random.Generator) -> tuple[Ball, ...]:
        """The ball."""
        radius = float(np.exp(rng.uniform(*np.log(self.RADII))))
        return (Ball(self.draw_position(rng), radius, BLUE),)

    def aim(self) -> Float64Array:
        """The ball."""
        return self.placed[0].position

    def distance_left(self) -> float:
        """Distance to the ball."""
        return self.distance(self.placed[0])


class TwoStage(BallScenario):
    """A blue ball that must be touched first and then vanishes, and a green one to touch next.

    Attributes:
        stage: The ball that is next, 0 or 1.
    """

    APART = 0.3  # smallest distance between the balls, metres

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
        """Removes the blue ball once it is touched."""
        if self.stage == 0 and self.distance(self.placed[0]) <= TOUCH:
            self.stage = 1
        return super().outcome(reward, success)

    def balls(self) -> tuple[Ball, ...]:
        """The balls that have not vanished."""
        return self.placed[self.stage :]

    def aim(self) -> Float64Array:
        """The ball that is next."""
        return self.placed[self.stage].position

    def distance_left(self) -> float:
        """Distance to the next ball, and from the first ball to the second if the first is next."""
        between = np.linalg.norm(self.placed[0].position - self.placed[1].position)
        return self.distance(self.placed[self.stage]) + (float(between) if self.stage == 0 else 0.0)


class Fork(BallScenario):
    """A blue ball straight ahead that must not be touched, and a yellow one on each side: touch either.

    The hand starts on the middle line and the layout is symmetric, so that both paths are equally good. The
    expert takes one of them, which is drawn for each episode and cannot be seen in the images. Once the hand
    has left the middle line, the nearer ball is the better one. A policy that predicts the mean of the
    demonstrations goes straight ahead, to the blue ball.

    Attributes:
        chosen: The yellow ball that the expert goes to, 0 or 1.
        spoiled: Whether the blue ball was touched, after which the episode cannot succeed.
    """

    ASIDE = 0.17  # metres from the middle line to a yellow ball
    AHEAD = 0.1  # metres from the fingertips forwards to the balls
    JITTER = np.array([0.015, 0.015, 0.03])  # variation of a layout, metres: aside, ahead, height
    HEIGHT = 0.15  # metres
    SPEED = 6.0  # gain of the expert: full speed at 17 cm and more

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
        """Touching a yellow ball is success if the blue one was not touched before."""
        self.spoiled = self.spoiled or self.distance(self.placed[1]) <= TOUCH
        judged = super().outcome(reward, success)
        return StepOutcome(judged.reward, judged.success and not self.spoiled)

    def aim(self) -> Float64Array:
        """The chosen ball."""
        return self.placed[2 * self.chosen].position

    def distance_left(self) -> float:
        """Distance to the nearer yellow ball."""
        return min(self.distance(ball) for ball in self.placed[::2])

    def expert_action(self, state: Float64Array) -> Float64Array:
        """Moves straight to ``aim``, faster than in the other tasks; the gripper is not used."""
        return np.append(self.SPEED * (self.aim() - self.fingertips()), 0.0)


class NamedBall(BallScenario):
    """A yellow ball and a blue one, one on each side: touch the one that the instruction names.

    The layout is that of :class:`Fork` without the ball in the middle. Which colour is on the left is drawn
    for each episode from its seed alone, so the tasks of both colours have the same layouts.

    Args:
        world: Meta-World's reach environment.
        named: The place of the named colour in ``COLOURS``.

    Attributes:
        touched: The place in ``COLOURS`` of the ball that was touched first; None before.
    """

    COLOURS = (YELLOW, BLUE)

    touched: int | None = None

    def __init__(self, world: Any, named: int) -> None:
        super().__init__(world)
        self.named = named

    def place(self, rng: np.random.Generator) -> tuple[Ball, ...]:
        """The yellow ball, the blue one."""
        self.touched = None
        side = int(rng.choice((-1, 1)))
        aside, ahead, up = np.array([Fork.ASIDE, Fork.AHEAD, 0.0]) + rng.uniform(-Fork.JITTER, Fork.JITTER)
        hand = self.fingertips()
        middle = np.array([hand[0], hand[1] + ahead, Fork.HEIGHT + up])
        return tuple(
            Ball(middle + np.array([way * aside, 0.0, 0.0]), BALL_RADIUS, colour)
            for way, colour in zip((side, -side), self.COLOURS, strict=True)
        )

    @property
    def is_right(self) -> bool:
        """Whether the named ball is on the right."""
        return bool(self.placed[self.named].position[0] > self.placed[1 - self.named].position[0])

    def outcome(self, reward: float, success: bool) -> StepOutcome:
        """Touching the named ball is success if the other one was not touched before."""
        if self.touched is None:
            near = [place for place, ball in enumerate(self.placed) if self.distance(ball) <= TOUCH]
            self.touched = near[0] if near else None
        return StepOutcome(-self.distance_left(), self.touched == self.named)

    def aim(self) -> Float64Array:
        """The named ball."""
        return self.placed[self.named].position

    def distance_left(self) -> float:
        """Distance to the named ball."""
        return self.distance(self.placed[self.named])

    def expert_action(self, state: Float64Array) -> Float64Array:
        """Moves straight to ``aim``, as fast as the expert of :class:`Fork`; the gripper is not used."""
        return np.append(Fork.SPEED * (self.aim() - self.fingertips()), 0.0)
