"""saccade's simulated tasks as environments of lerobot: ``--env.type=saccade --env.task=reach``."""

import importlib
import importlib.util
from dataclasses import dataclass, field
from typing import Any

from lerobot.configs.types import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.utils.constants import ACTION, OBS_IMAGES, OBS_STATE

from saccade._internal.extras import install_lab
from saccade.errors import MissingExtraError


@EnvConfig.register_subclass("saccade")
@dataclass
class SaccadeEnv(EnvConfig):
    """The options ``--env.*`` of ``--env.type=saccade``.

    Attributes:
        task: A task of ``saccade_lab.sim.tasks``.
        fps: Frames a second of simulated time, for videos.
        image_size: Pixels along each side of the cameras' frames. Default: that of the bundled policy.

    Raises:
        saccade.MissingExtraError: saccade_lab or its extra ``sim`` is not installed.
        saccade.InputError: There is no such task.
    """

    task: str = "reach"
    fps: int = 80
    image_size: int | None = None
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if importlib.util.find_spec("saccade_lab") is None:
            raise MissingExtraError(
                f"saccade_lab is not installed. Install with: {install_lab('sim')}", name="saccade_lab"
            )
        # Not at the top: it chooses how MuJoCo draws, which concerns only those who use these tasks.
        from saccade_lab.extras import LAB
        from saccade_lab.sim.cameras import DEFAULT_CAMERAS, DEFAULT_IMAGE_SIZE
        from saccade_lab.sim.tasks import ACTION_DIM, PROPRIO_DIM, find_task

        LAB.require("mujoco", "metaworld")
        find_task(self.task)
        size = self.image_size or DEFAULT_IMAGE_SIZE
        shapes: dict[str, tuple[FeatureType, tuple[int, ...], str]] = {
            "action": (FeatureType.ACTION, (ACTION_DIM,), ACTION),
            "agent_pos": (FeatureType.STATE, (PROPRIO_DIM,), OBS_STATE),
        }
        for camera in DEFAULT_CAMERAS:
            shapes[f"pixels/{camera.name}"] = (
                FeatureType.VISUAL,
                (size, size, 3),
                f"{OBS_IMAGES}.{camera.name}",
            )
        self.features = {
            name: PolicyFeature(type=kind, shape=shape) for name, (kind, shape, _) in shapes.items()
        }
        self.features_map = {name: key for name, (_, _, key) in shapes.items()}

    @property
    def package_name(self) -> str:
        """The module that registers the environments."""
        return "saccade_lab.sim.lerobot"

    @property
    def gym_id(self) -> str:
        """The name of the environment, which is registered from now on, also in processes of workers."""
        importlib.import_module(self.package_name)
        return f"saccade/{self.task}-lerobot-v0"

    @property
    def gym_kwargs(self) -> dict[str, Any]:
        """Keyword arguments of ``gymnasium.make``."""
        size = {} if self.image_size is None else {"image_size": self.image_size}
        return {"render_mode": "rgb_array", **size}
