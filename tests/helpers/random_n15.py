"""Random robots and data configs of GR00T N1.5, valid ones and damaged ones."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st

from tests.helpers import oracle_n15
from tests.helpers.oracle_rotations import EULER, WIDTHS, from_numbers, well_conditioned
from tests.helpers.random_robots import F32, JOINTS, rotation, statistics_row, write

MODES = (None, "min_max", "q99", "mean_std", "binary")
STATE_MODES = (*MODES, "scale", "sin_cos")
SOURCES = ("quaternion", "axis_angle", "rotation_6d", *EULER)

CHANGES: tuple[str, ...] = (
    "mode",
    "target",
    "source",
    "discrete",
    "relative",
    "modality",
    "statistics",
    "stranger",
)
CHANGES += ("indices", "unlisted", "action_dim")


@dataclass
class Robot:
    """The files of one robot, and the seed of its numbers."""

    tag: str
    entry: dict[str, Any]
    config: dict[str, Any]
    state_dim: int
    action_dim: int
    seed: int

    @property
    def oracle(self) -> oracle_n15.Oracle:
        return oracle_n15.Oracle(self.entry, self.config, self.state_dim, self.action_dim)

    def save(self, folder: Path) -> Path:
        others = {tag: self.entry for tag in oracle_n15.PROJECTORS if tag > self.tag}
        others = {tag: {**entry, "embodiment_tag": tag} for tag, entry in others.items()}
        write(folder / "experiment_cfg" / "metadata.json", {self.tag: self.entry, **others})
        sizes = {"action_dim": self.action_dim, "max_state_dim": self.state_dim, "action_horizon": 16}
        head = {**sizes, "max_num_embodiments": 32, "num_inference_timesteps": 4}
        model = {"architectures": ["GR00T_N1_5"], "model_type": "gr00t_n1_5", "action_horizon": 16}
        write(folder / "config.json", {**model, "action_dim": self.action_dim, "action_head_cfg": head})
        return folder

    def state(self) -> F32:
        """``(2, history, width)``."""
        rng = np.random.default_rng(self.seed)
        shape = (2, len(self.config["observation_indices"]))
        parts = []
        for key in self.oracle.states:
            if key.converted:
                parts.append(rotation(rng, key.source, shape, to=key.target))
            else:
                parts.append(2 * rng.standard_normal((*shape, key.width)))
        return np.concatenate(parts, -1).astype(np.float32)

    def chunk(self) -> F32:
        """``(2, horizon, action_dim)``, with noise in the padding."""
        rng = np.random.default_rng(self.seed + 1)
        shape = (2, self.oracle.action_horizon)
        chunk = rng.uniform(-1.5, 1.5, (*shape, self.action_dim))
        for key, cut in oracle_n15.Oracle.parts(self.oracle.actions_):
            if not key.converted:
                continue
            drawn = rng.uniform(-0.9, 0.9, (64 * shape[1], key.width))
            turned = from_numbers(key.target, key.denormalised(drawn))
            chunk[..., cut] = rng.choice(drawn[well_conditioned(key.source, turned)], shape)
        return chunk.astype(np.float32)


@st.composite
def keys(draw: st.DrawFn, kind: str) -> list[dict[str, Any]]:
    """The keys of a kind: name, width, mode and rotation, as the released code takes them."""
    names = draw(st.lists(st.sampled_from(JOINTS), min_size=1, max_size=4, unique=True))
    modes = st.sampled_from(STATE_MODES if kind == "state" else MODES)
    found = []
    for name in names:
        key: dict[str, Any] = {"name": name, "mode": draw(modes), "target": None, "source": None}
        key |= {"width": draw(st.integers(1, 5)), "continuous": True, "absolute": draw(st.booleans())}
        if draw(st.booleans()):
            key["source"] = draw(st.sampled_from((*SOURCES, "quaternion", "axis_angle", "rotation_6d")))
            key["width"] = WIDTHS[key["source"]]
            key["target"] = draw(st.none() | st.sampled_from(targets(kind, key["source"])))
            if key["target"] not in (None, key["source"]):
                key["mode"] = draw(st.sampled_from((None, "min_max")))
                key["absolute"] |= key["mode"] is not None
                key["continuous"] = draw(st.booleans())
        elif draw(st.integers(0, 3)) == 0:
            key |= {"continuous": False, "mode": draw(st.sampled_from((None, "binary")))}
        found.append(key)
    return found


def targets(kind: str, source: str) -> list[str]:
    """What a rotation can be converted to."""
    width = WIDTHS[source]
    found = [target for target in SOURCES if WIDTHS[target] == width]
    if kind == "state" and width != 6:
        found.append("rotation_6d")
    return [target for target in found if target == source or {target, source} - set(EULER)]


@st.composite
def robots(draw: st.DrawFn) -> Robot:
    """A valid robot with a data config, and keys in its file that the config does not list."""
    seed = draw(st.integers(0, 2**32 - 2))
    rng = np.random.default_rng(seed)
    entry: dict[str, Any] = {"statistics": {}, "modalities": {"video": {}}}
    config: dict[str, Any] = {"target_rotations": {}, "video_keys": ["video.front"]}
    config["language_keys"] = ["annotation.human.task_description"]
    entry["modalities"]["video"]["front"] = {"resolution": [64, 48], "channels": 3, "fps": 20.0}
    widths = {}
    for kind in ("state", "action"):
        listed = draw(keys(kind))
        config[f"{kind}_keys"] = [f"{kind}.{key['name']}" for key in listed]
        config[f"{kind}_modes"] = {f"{kind}.{key['name']}": key["mode"] for key in listed if key["mode"]}
        config["target_rotations"] |= {
            f"{kind}.{key['name']}": key["target"] for key in listed if key["target"]
        }
        unused = draw(st.sampled_from([(), ("spare",)]))
        listed += [{"name": name, "width": 2, "source": None, "absolute": True} for name in unused]
        order = draw(st.permutations(listed))
        entry["modalities"][kind] = {
            key["name"]: {
                "absolute": key["absolute"],
                "rotation_type": key["source"],
                "shape": [key["width"]],
                "continuous": key.get("continuous", True),
            }
            for key in order
        }
        entry["statistics"][kind] = {key["name"]: statistics_row(rng, key["width"]) for key in order}
        widths[kind] = sum(key["width"] for key in listed)
        for name in unused:
            entry["statistics"][kind][name]["max"] = [float("nan"), float("inf")]
    tag = draw(st.sampled_from(sorted(oracle_n15.PROJECTORS)))
    entry["embodiment_tag"] = tag
    config["observation_indices"] = draw(st.sampled_from([[0], [0], [-1, 0], [-6, -3, 0]]))
    config["action_indices"] = list(range(draw(st.sampled_from([1, 4, 8, 16, 20]))))
    narrow = draw(st.integers(0, 5)) == 0
    state_dim = max(1, widths["state"] - 1) if narrow else 2 * widths["state"] + draw(st.integers(0, 9))
    action_dim = widths["action"] + draw(st.integers(0, 9))
    return Robot(tag, entry, config, state_dim, action_dim, seed)


@st.composite
def damaged(draw: st.DrawFn) -> Robot:
    """A robot with one thing changed at random. The oracle says whether it is still a robot."""
    robot = copy.deepcopy(draw(robots()))
    config, entry = robot.config, robot.entry
    name = draw(st.sampled_from(config["state_keys"] + config["action_keys"]))
    kind, key = name.split(".")
    about = entry["modalities"][kind][key]
    change = draw(st.sampled_from(CHANGES))
    if change == "mode":
        config[f"{kind}_modes"][name] = draw(st.sampled_from(["minmax", "scale", "sin_cos", "q99", "binary"]))
    elif change == "target":
        names = (*SOURCES, "matrix", "rotvec", "euler_angles_xyz")
        config["target_rotations"][name] = draw(st.sampled_from(names))
    elif change == "source":
        about["rotation_type"] = draw(st.sampled_from([None, "matrix", *SOURCES]))
    elif change == "discrete":
        about["continuous"] = False
    elif change == "relative":
        about["absolute"] = False
    elif change in ("modality", "statistics"):
        del entry["modalities" if change == "modality" else "statistics"][kind][key]
    elif change == "stranger":
        where = draw(st.sampled_from(["state_modes", "action_modes", "target_rotations"]))
        prefix = "action" if where == "action_modes" else "state"
        value = "rotation_6d" if where == "target_rotations" else "min_max"
        config[where][f"{prefix}.stranger"] = value
    elif change == "indices":
        config["observation_indices"] = draw(st.sampled_from([[1], [-1], [-3, -1, 0], [0, -1], [0, 1]]))
    elif change == "action_dim":
        robot.action_dim = max(1, robot.action_dim - draw(st.integers(1, 9)))
    elif len(config[f"{kind}_keys"]) > 1:
        config[f"{kind}_keys"].remove(name)
    return robot
