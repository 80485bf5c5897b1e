"""LIBERO on a CPU: its tasks as gymnasium environments, and policies and experts that act in them.

Importing this package registers a gymnasium environment for each task of ``saccade_lab.libero.suites``:

    >>> import gymnasium, saccade_lab.libero
    >>> env = gymnasium.make("saccade/libero_object-0-v0")
    >>> observation, info = env.reset(seed=5, options={"state": 0})
    >>> observation["images"]["image"].shape, observation["state"].shape, observation["instruction"]
    ((256, 256, 3), (8,), 'pick up the alphabet soup and place it in the basket')
    >>> env.close()

Modules: ``packages`` (LIBERO's packages and their versions), ``suites`` (tasks, instructions, initial
states), ``state`` (the state vector), ``drawing`` (cameras), ``simulation`` (starts and steps),
``environment``; ``protocols``, ``policy``, ``execution``, ``gripper``, ``episode``, ``starts``, ``rollout``,
``episodes``, ``video``, ``results`` and ``page`` (measuring a checkpoint); ``grasps``, ``expert``,
``scene``, ``placements``, ``demos`` and ``recording`` (demonstrations); ``checkpoint``, ``sizes`` and
``training`` (small policies).
Needs the extra ``libero``. Opens no window.
"""

from saccade_lab.libero.suites import SUITES
from saccade_lab.sim import graphics

graphics.choose_backend()  # MuJoCo reads the choice once, when it is imported


def register_environments() -> None:
    """Registers ``saccade/<suite>-<task>-v0`` with gymnasium, if it is installed."""
    try:
        import gymnasium
    except ModuleNotFoundError:  # protocols and tables need NumPy only
        return
    entry_point = "saccade_lab.libero.environment:LiberoEnvironment"
    for suite in SUITES.values():
        for task in range(suite.num_tasks):
            name = f"saccade/{suite.name}-{task}-v0"
            gymnasium.register(name, entry_point=entry_point, kwargs={"suite": suite.name, "task": task})


register_environments()
