"""Random robots of GR00T N1.6 and N1.7, valid ones and damaged ones."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st

from tests.helpers import oracle_processor
from tests.helpers.oracle_rotations import F64
from tests.helpers.random_robots import F32, JOINTS, rotation, statistics_row, write

FORMS = {"joints": "DEFAULT", "rot6d": "XYZ_ROT6D", "rotvec": "XYZ_ROTVEC"}
CLASSES = {"n1.6": "Gr00tN1d6Processor", "n1.7": "Gr00tN1d7Processor"}
FLAGS = ("use_percentiles", "clip_outliers", "apply_sincos_state_encoding", "use_relative_action")
IMAGES = {"image_crop_size": [230, 230], "image_target_size": [256, 256], "use_albumentations": True}
MODALITY = {"sin_cos_embedding_keys": None, "mean_std_embedding_keys": None, "action_configs": None}


@dataclass
class Robot:
    """The files of one robot, where they lie, and the seed of its numbers."""

    tag: str
    name: str
    processor: dict[str, Any]
    statistics: dict[str, Any]
    ids: dict[str, int] | None
    folder: str
    forms: dict[str, str]
    seed: int

    @property
    def oracle(self) -> oracle_processor.Oracle:
        return oracle_processor.Oracle(self.processor, self.statistics, self.ids, self.tag)

    @property
    def kwargs(self) -> dict[str, Any]:
        found: dict[str, Any] = self.processor["processor_kwargs"]
        return found

    def modality(self, kind: str) -> dict[str, Any]:
        found: dict[str, Any] = self.kwargs["modality_configs"][self.tag][kind]
        return found

    def save(self, root: Path) -> Path:
        folder = root / self.folder
        write(folder / "processor_config.json", self.processor)
        write(folder / "statistics.json", self.statistics)
        if self.ids is not None:
            write(folder / "embodiment_id.json", self.ids)
        if not self.folder:  # The root comes before processor/, whatever lies there.
            write(root / "processor" / "statistics.json", {})
            write(root / "processor" / "embodiment_id.json", {self.tag: 31})
        return root

    def state(self) -> F32:
        """``(2, history, width)``."""
        rng = np.random.default_rng(self.seed)
        shape = (2, len(self.modality("state")["delta_indices"]))
        parts = []
        for key, cut in self.oracle.slices("state").items():
            numbers = 2 * rng.standard_normal((*shape, cut.stop - cut.start))
            form = self.forms.get(key, "joints")
            if cut.stop - cut.start != {"rot6d": 9, "rotvec": 6}.get(form):  # not a pose any more
                form = "joints"
            if form == "rot6d":
                numbers[..., 3:] = rotation(rng, "rotation_6d", shape, to="rotation_6d")
            if form == "rotvec":
                # Up to 2 radians about any axis, sometimes written as the other way round.
                angle = rng.uniform(0.1, 2.0, (*shape, 1))
                unit = numbers[..., 3:] / np.linalg.norm(numbers[..., 3:], axis=-1, keepdims=True)
                turns = rng.choice([0.0, -2 * np.pi], (*shape, 1))
                numbers[..., 3:] = unit * (angle + turns)
            parts.append(numbers)
        return np.concatenate(parts, -1).astype(np.float32)

    def chunk(self) -> F32:
        """``(2, steps, max_action_dim)``: more steps than the robot has, and noise in the padding."""
        rng = np.random.default_rng(self.seed + 1)
        shape = (2, self.oracle.action_horizon + 3, self.oracle.options["max_action_dim"])
        return rng.uniform(-1.5, 1.5, shape).astype(np.float32)


def offsets(rng: np.random.Generator, form: str, width: int, rows: tuple[int, ...]) -> dict[str, Any]:
    """Statistics of relative actions. Turns are small, so that no pose comes near a half turn."""
    centre = rng.uniform(-0.5, 0.5, (*rows, width))
    half = rng.uniform(0.05, 0.4, (*rows, width))
    if form == "rot6d":
        centre[..., 3:] = [1, 0, 0, 0, 1, 0]
    if form == "rotvec":
        centre[..., 3:] *= 0.4
        half[..., 3:] *= 0.5
    numbers: dict[str, F64] = {"min": centre - half, "max": centre + half, "mean": centre, "std": half / 3}
    numbers |= {"q01": centre - 9.0, "q99": centre + 9.0}  # never read
    return {name: values.tolist() for name, values in numbers.items()}


@st.composite
def states(draw: st.DrawFn) -> dict[str, tuple[str, int]]:
    """Form and width of each state key."""
    names = draw(st.lists(st.sampled_from(JOINTS), min_size=1, max_size=4, unique=True))
    found = {}
    for name in names:
        form = draw(st.sampled_from(("joints", "joints", "rot6d", "rotvec")))
        found[name] = (form, {"rot6d": 9, "rotvec": 6}.get(form) or draw(st.integers(1, 5)))
    return found


@st.composite
def actions(draw: st.DrawFn, listed: dict[str, tuple[str, int]]) -> dict[str, dict[str, Any]]:
    """Width and action config of each action key."""
    names = draw(
        st.lists(st.sampled_from((*listed, "goal", "rail", "push")), min_size=1, max_size=4, unique=True)
    )
    found: dict[str, dict[str, Any]] = {}
    for name in names:
        reference = name if name in listed else draw(st.sampled_from([*listed]))
        form, width = listed[reference]
        if draw(st.integers(0, 2)):
            kind = "NON_EEF" if form == "joints" else "EEF"
            config: dict[str, Any] = {
                "rep": "RELATIVE",
                "type": kind,
                "format": FORMS[form],
                "state_key": reference,
            }
            if reference == name:
                config["state_key"] = draw(st.sampled_from([name, None, ""]))
        else:  # nothing but the rep matters
            config = {"rep": draw(st.sampled_from(["ABSOLUTE", "DELTA"]))}
            config["type"] = draw(st.sampled_from(["EEF", "NON_EEF"]))
            config["format"] = draw(st.sampled_from(["DEFAULT", "XYZ_ROT6D", "XYZ_ROTVEC"]))
            config["state_key"] = draw(st.sampled_from([None, "", "nothing"]))
            form, width = "joints", draw(st.integers(1, 5))
        found[name] = {"form": form, "width": width, "config": config}
    return found


@st.composite
def robots(draw: st.DrawFn) -> Robot:
    """A valid robot of either release."""
    seed, release = draw(st.integers(0, 2**32 - 2)), draw(st.sampled_from(["n1.6", "n1.7"]))
    rng = np.random.default_rng(seed)
    tag = draw(st.sampled_from(sorted(oracle_processor.IDS[release])))
    state = draw(states())
    action = draw(actions(state))
    horizon, history = draw(st.integers(1, 16)), draw(st.integers(1, 2))
    some_states = st.none() | st.lists(st.sampled_from([*state]), unique=True)
    some_actions = st.none() | st.lists(st.sampled_from([*action]), unique=True)
    modalities: dict[str, Any] = {
        "video": {"delta_indices": [0], "modality_keys": ["ego_view"], **MODALITY},
        "language": {"delta_indices": [0], "modality_keys": ["annotation.human.task_description"]},
        "state": {"delta_indices": list(range(1 - history, 1)), "modality_keys": [*state]},
        "action": {"delta_indices": list(range(horizon)), "modality_keys": [*action]},
    }
    modalities["state"] |= {
        "sin_cos_embedding_keys": draw(some_states),
        "mean_std_embedding_keys": draw(some_states),
    }
    modalities["action"]["mean_std_embedding_keys"] = draw(some_actions)
    if any(a["config"]["rep"] == "RELATIVE" for a in action.values()) or draw(st.booleans()):
        modalities["action"]["action_configs"] = [a["config"] for a in action.values()]
    numbers = {
        "state": {key: statistics_row(rng, width, gap=4e-6) for key, (_, width) in state.items()},
        "action": {key: statistics_row(rng, a["width"]) for key, a in action.items()},
        "relative_action": {
            key: offsets(rng, a["form"], a["width"], draw(st.sampled_from([(), (1,), (horizon,)])))
            for key, a in action.items()
            if a["config"]["rep"] == "RELATIVE"
        },
    }
    numbers["state"]["spare"] = numbers["action"]["spare"] = {
        **statistics_row(rng, 2),
        "min": [float("nan")] * 2,
    }
    flags = {name: draw(st.sampled_from([True, True, False, None, "absent"])) for name in FLAGS}
    kwargs: dict[str, Any] = {name: value for name, value in flags.items() if value != "absent"} | IMAGES
    kwargs |= {"modality_configs": {tag: modalities}, "model_name": "nvidia/Eagle-Block2A-2B-v2"}
    kwargs["max_state_dim"] = 2 * sum(width for _, width in state.values()) + draw(st.integers(0, 4))
    kwargs["max_action_dim"] = sum(a["width"] for a in action.values()) + draw(st.integers(0, 4))
    kwargs["max_action_horizon"] = draw(st.sampled_from([16, 40]))
    if release == "n1.7":
        kwargs |= {
            "use_mean_std": draw(st.booleans()),
            "exclude_state": draw(st.sampled_from([False] * 5 + [True])),
        }
    ids = draw(st.sampled_from([None, {}, {"new_embodiment": 10}, {tag: 7}, {"of_my_own": 12}]))
    statistics = {tag: numbers}
    if draw(st.booleans()):
        kwargs["modality_configs"]["second"] = copy.deepcopy(modalities)
        statistics["second"] = numbers
    names = [tag, tag.upper()] if release == "n1.6" else [tag, tag.upper(), f" {tag} "]
    names += [name for name, value in oracle_processor.NAMES.items() if release == "n1.7" and value == tag]
    processor = {"processor_class": CLASSES[release], "processor_kwargs": kwargs}
    forms = {key: form for key, (form, _) in state.items()}
    folder = draw(st.sampled_from(["", "processor"]))
    return Robot(tag, draw(st.sampled_from(names)), processor, statistics, ids, folder, forms, seed)


@st.composite
def damaged(draw: st.DrawFn) -> Robot:
    """A robot with one thing changed at random. The oracle says whether it is still a robot."""
    robot = copy.deepcopy(draw(robots()))
    action, statistics = robot.modality("action"), robot.statistics[robot.tag]
    key = draw(st.sampled_from(action["modality_keys"]))
    configs = action.get("action_configs")
    changes = ["configs", "horizon", "state_dim", "action_dim", "statistics", "relative", "steps", "second"]
    if configs:
        changes += ["rep", "type", "format", "state_key"] * 2
        config = configs[action["modality_keys"].index(key)]
    change = draw(st.sampled_from(changes))
    if change == "configs":
        one = {"rep": "ABSOLUTE", "type": "NON_EEF", "format": "DEFAULT", "state_key": None}
        action["action_configs"] = [one] * draw(st.integers(1, 5))
    elif change in ("horizon", "second"):
        tag = robot.tag if change == "horizon" else next(reversed(robot.kwargs["modality_configs"]))
        indices = list(range(robot.kwargs["max_action_horizon"] + draw(st.integers(0, 1))))
        robot.kwargs["modality_configs"][tag]["action"]["delta_indices"] = indices
    elif change in ("state_dim", "action_dim"):
        robot.kwargs[f"max_{change}"] = draw(st.integers(1, 12))
    elif change in ("statistics", "steps"):
        kind = draw(st.sampled_from([kind for kind in statistics if statistics[kind]]))
        rows = statistics[kind][draw(st.sampled_from(sorted({*statistics[kind]} - {"spare"})))]
        for name, values in rows.items():
            if np.ndim(values) == (2 if change == "steps" else 1):
                rows[name] = [*values, values[-1]]
    elif change == "relative":
        statistics["relative_action"].pop(key, None)
    elif change == "state_key":
        config["state_key"] = draw(
            st.sampled_from([None, "nothing", *robot.modality("state")["modality_keys"]])
        )
    else:
        values = {
            "rep": ["ABSOLUTE", "DELTA", "RELATIVE"],
            "type": ["EEF", "NON_EEF"],
            "format": [*FORMS.values()],
        }
        config[change] = draw(st.sampled_from(values[change]))
    return robot
