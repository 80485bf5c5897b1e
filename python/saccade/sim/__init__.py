"""Simulated robot tasks seen through cameras, and the small policy that solves them.

Importing this package registers a gymnasium environment for each task of `saccade.sim.tasks`:

    >>> import gymnasium, saccade.sim
    >>> env = gymnasium.make("saccade/drawer-open-v0")
    >>> observation, info = env.reset(seed=5)
    >>> observation["images"]["left"].shape, observation["proprio"].shape, observation["instruction"]
    ((64, 64, 3), (4,), 'open the drawer')
    >>> env.close()

Where to read what: `tasks` (instructions, seeds), `scenarios` (layouts, success, what experts do), `cameras`,
`environment` (what the robot sees and does), `experts` and `demos` (demonstrations), `backbone` and `policy`
(numpy at run time), `learner` and `train` (torch), `rollout`, `report` and `video` (closed loop). Needs
`pip install 'saccade[sim]'`; nothing here opens a window.
"""

from saccade.sim import graphics
from saccade.sim.tasks import TASKS

graphics.choose_backend()  # MuJoCo reads the choice once, when it is imported


def register_environments() -> None:
    """Makes `gymnasium.make("saccade/<task>-v0")` work; does nothing where gymnasium is not installed."""
    try:
        import gymnasium
    except ModuleNotFoundError:  # the numpy side (`policy`, `backbone`) works without the simulator
        return
    entry_point = "saccade.sim.environment:TaskEnvironment"
    for name in TASKS:
        gymnasium.register(f"saccade/{name}-v0", entry_point=entry_point, kwargs={"task": name})


register_environments()
