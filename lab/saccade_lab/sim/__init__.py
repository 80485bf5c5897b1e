"""Simulated robot tasks with camera images, and the small policy that solves them.

Importing this package registers a gymnasium environment for each task of ``saccade_lab.sim.tasks``:

    >>> import gymnasium, saccade_lab.sim
    >>> env = gymnasium.make("saccade/drawer-open-v0")
    >>> observation, info = env.reset(seed=5)
    >>> observation["images"]["left"].shape, observation["proprio"].shape, observation["instruction"]
    ((68, 68, 3), (4,), 'open the drawer')
    >>> env.close()

Modules: ``tasks`` (instructions, seeds), ``scenarios`` (layouts, success, experts' actions), ``cameras``,
``environment`` (observations and actions), ``graphics`` and ``rendering`` (OpenGL), ``experts`` and ``demos``
(demonstrations), ``settings`` (the files of a policy), ``policy`` and ``torch_engine`` (a whole policy in the
simulator), ``dataset``, ``learner``, ``training_settings`` and ``train`` (training in torch), ``rollout``,
``episodes``, ``environment_cache``, ``report`` and ``video`` (closed loop), ``lerobot`` (lerobot's keys).
Needs the extra ``sim``. Opens no window.
"""

from saccade_lab.sim import graphics
from saccade_lab.sim.tasks import TASKS

graphics.choose_backend()  # MuJoCo reads the choice once, when it is imported


def register_environments() -> None:
    """Registers ``saccade/<task>-v0`` with gymnasium, if it is installed."""
    try:
        import gymnasium
    except ModuleNotFoundError:  # `policy` needs NumPy only
        return
    entry_point = "saccade_lab.sim.environment:TaskEnvironment"
    for name in TASKS:
        gymnasium.register(f"saccade/{name}-v0", entry_point=entry_point, kwargs={"task": name})


register_environments()
