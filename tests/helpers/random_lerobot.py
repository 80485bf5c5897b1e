"""Random robots as lerobot saves them, N1.5 and N1.7, valid ones and damaged ones."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st

from tests.helpers import oracle_lerobot
from tests.helpers.random_processor import offsets
from tests.helpers.random_robots import F32, JOINTS, rotation, statistics_row, write
from tests.helpers.tensor_files import write_tensor_file

MAPPING = {
    "n1.5": {
        "new_embodiment": 31,
        "oxe_droid": 17,
        "agibot_genie1": 26,
        "gr1": 24,
        "so100": 2,
        "unitree_g1": 3,
    },
    "n1.7": {"simpler_env_google": 0, "simpler_env_widowx": 1, "libero_sim": 2, "new_embodiment": 10},
}
PACK = {"n1.5": "groot_pack_inputs_v3", "n1.7": "groot_n1_7_pack_inputs_v1"}
UNPACK = {
    "n1.5": "groot_action_unpack_unnormalize_v1",
    "n1.7": "groot_action_unpack_unnormalize_v2",
    "native": "groot_n1_7_action_decode_v1",
}
DEVICE = {"registry_name": "device_processor", "config": {"device": "cpu", "float_dtype": None}}
VLM: dict[str, Any] = {
    "model_name": "nvidia/Cosmos-Reason2-2B",
    "image_crop_size": [230, 230],
    "image_target_size": [256, 256],
}
VLM |= {"shortest_image_edge": None, "crop_fraction": None, "use_albumentations": False}
RELATIVES = tuple(oracle_lerobot.RELATIVE.values())
Step = dict[str, Any]


@dataclass
class Robot:
    """The files of a saved folder, and the seed of its numbers."""

    config: dict[str, Any]
    before: list[Step]
    after: list[Step]
    states: dict[str, oracle_lerobot.Tensors]
    forms: dict[str, tuple[str, int]]
    seed: int

    def pipelines(self) -> dict[str, dict[str, Any]]:
        """Both pipelines as they are saved, with the names of the state files."""
        found = {}
        for name, steps in (("policy_preprocessor", self.before), ("policy_postprocessor", self.after)):
            named = [dict(step) for step in steps]
            for number, step in enumerate(named):
                if (kind := step.get("registry_name")) in self.states:
                    step["state_file"] = f"{name}_step_{number}_{kind}.safetensors"
            found[name] = {"name": name, "steps": named}
        return found

    @property
    def oracle(self) -> oracle_lerobot.Oracle:
        before, after = self.pipelines().values()
        return oracle_lerobot.Oracle(self.config, before, after, self.states)

    def save(self, folder: Path) -> Path:
        write(folder / "config.json", self.config)
        for name, pipeline in self.pipelines().items():
            write(folder / f"{name}.json", pipeline)
            for step in pipeline["steps"]:
                if file := step.get("state_file"):
                    write_tensor_file(folder / file, self.states[step["registry_name"]])
        return folder

    def state(self) -> F32:
        """``(2, width)``."""
        rng = np.random.default_rng(self.seed)
        width = self.oracle.state_width
        state, start = 2 * rng.standard_normal((2, width)), 0
        for form, size in self.forms.values():
            if form == "rot6d":
                state[:, start + 3 : start + 9] = rotation(rng, "rotation_6d", (2,), to="rotation_6d")
            start += size
        return state.astype(np.float32)

    def chunk(self) -> F32:
        """``(2, 40, max_action_dim)``: N1.5 has 16 steps."""
        rng = np.random.default_rng(self.seed + 1)
        steps = 16 if self.oracle.release == "n1.5" else 40
        return rng.uniform(-1.5, 1.5, (2, steps, self.config["max_action_dim"])).astype(np.float32)


def step(name: str, **config: Any) -> Step:
    return {"registry_name": name, "config": config}


@st.composite
def tensors(draw: st.DrawFn, rng: np.random.Generator, feature: str, width: int) -> oracle_lerobot.Tensors:
    """A state file: bounds, mostly of the right width, and statistics that nothing reads."""
    size = max(1, width + draw(st.sampled_from([0, 0, 0, 0, -1, 2])))
    found = {
        f"{feature}.{name}": np.asarray(row, np.float32)
        for name, row in statistics_row(rng, size, gap=1e-6).items()
    }
    found[f"{feature}.mean"][0] = np.nan
    found["timestamp.max"] = np.asarray([np.inf], np.float32)
    if draw(st.integers(0, 7)) == 0:  # A missing bound is 0 or 1. Bounds in the wrong order are refused.
        gone, kept = draw(st.sampled_from([("min", "max"), ("max", "min")]))
        del found[f"{feature}.{gone}"]
        found[f"{feature}.{kept}"] = np.abs(found[f"{feature}.{kept}"]) * (1 if kept == "max" else -1)
    if draw(st.integers(0, 9)) == 0:
        found = {name: row for name, row in found.items() if name.startswith("timestamp")}
    return found


@st.composite
def generic(draw: st.DrawFn, release: str, width: int) -> tuple[list[Step], list[Step]]:
    """The two generic relative steps, or none."""
    if draw(st.integers(0, 2)):
        return [], []
    names = draw(st.none() | st.just([f"joint_{n}.pos" for n in range(width - 1)] + ["GRIPPER.pos"]))
    if names is not None and width > 1:
        names = names[: draw(st.integers(1, width))]
    exclude = draw(st.sampled_from([[], ["grip"], ["Joint_0", "joint_2.pos"], ["elbow"]]))
    config = {"enabled": draw(st.booleans()), "exclude_joints": exclude, "action_names": names}
    before = step(oracle_lerobot.RELATIVE[release], **config)
    return [before], [step("absolute_actions_processor", enabled=draw(st.booleans()))]


@st.composite
def configs(draw: st.DrawFn, release: str, tag: str, widths: tuple[int, int]) -> dict[str, Any]:
    """``config.json``."""
    chunk = draw(st.sampled_from([8, 16, 40, 50, 64]))
    images = {"observation.images.front": {"type": "VISUAL", "shape": [3, 32, 40]}}
    state = {"observation.state": {"type": "STATE", "shape": [widths[0]]}}
    config: dict[str, Any] = {
        "type": "groot",
        "input_features": state | images,
        "output_features": {"action": {"type": "ACTION", "shape": [widths[1]]}},
        "device": "cpu",
        "chunk_size": chunk,
        "n_action_steps": draw(st.sampled_from([n for n in (1, 8, 16, 40, 50, 64) if n <= chunk])),
        "embodiment_tag": tag,
        "max_state_dim": widths[0] + 3,
        "max_action_dim": widths[1] + draw(st.integers(0, 4)),
        "use_relative_actions": False,
        "base_model_path": "nvidia/GR00T-N1.7-3B",
        "tokenizer_assets_repo": None,
    }
    if release == "n1.5":
        del config["use_relative_actions"]
        config["base_model_path"] = "nvidia/GR00T-N1.5-3B"
        config["tokenizer_assets_repo"] = "lerobot/eagle2hg-processor-groot-n1p5"
        return config
    for name in draw(st.sampled_from([(), (), ("chunk_size", "n_action_steps"), ("n_action_steps",)])):
        del config[name]
    if "chunk_size" in config and "n_action_steps" not in config:
        config["chunk_size"] = max(40, config["chunk_size"])
    transform = draw(st.sampled_from(["absent", "auto", "libero", "none", "", None]))
    return config if transform == "absent" else config | {"action_decode_transform": transform}


@st.composite
def native(draw: st.DrawFn, rng: np.random.Generator) -> tuple[Step, dict[str, tuple[str, int]]]:
    """The decode step of a raw checkpoint's statistics, and the form of each group of the state."""
    names = draw(st.lists(st.sampled_from(JOINTS), min_size=1, max_size=3, unique=True))
    kinds = st.sampled_from(["joints", "joints", "rot6d"])
    forms = {name: (form := draw(kinds), 9 if form == "rot6d" else draw(st.integers(1, 4))) for name in names}
    forms["grasp"] = ("joints", 1)
    keys = draw(st.lists(st.sampled_from((*forms, "rail")), min_size=1, max_size=3, unique=True))
    keys += [] if draw(st.integers(0, 3)) == 0 else ["gripper"]
    horizon = draw(st.sampled_from([0, 8, 16, 40]))
    listed: list[dict[str, Any]] = []
    numbers: dict[str, dict[str, Any]] = {"state": {}, "action": {}, "relative_action": {}}
    numbers["state"] = {name: statistics_row(rng, width) for name, (_, width) in forms.items()}
    for key in keys:
        reference = key if key in forms else draw(st.sampled_from([*forms]))
        form, width = ("joints", 1) if key == "gripper" else forms[reference]
        rep = draw(st.sampled_from(["RELATIVE", "relative", "ABSOLUTE", "DELTA"]))
        if key == "gripper":
            rep, reference = draw(st.sampled_from([("ABSOLUTE", "grasp"), ("RELATIVE", "grasp")]))
        kind = "NON_EEF" if form == "joints" else draw(st.sampled_from(["EEF", "eef"]))
        written = draw(st.sampled_from(["XYZ_ROT6D", "xyz+rot6d"]))
        if form == "joints":  # lerobot does not look at it
            written = draw(st.sampled_from(["DEFAULT", "DEFAULT", "default", "xyz+rotvec", "XYZ_ROT6D"]))
        listed.append({"rep": rep, "type": kind, "format": written, "state_key": reference})
        if reference == key:
            listed[-1]["state_key"] = draw(st.sampled_from([key, None]))
        rows = draw(st.sampled_from([(), (40,), (horizon or 40,)]))
        numbers["action"][key] = statistics_row(rng, width)
        if rep.lower() == "relative":
            numbers["relative_action"][key] = offsets(rng, form, width, rows)
    count = draw(st.integers(0, len(listed))) if draw(st.integers(0, 3)) == 0 else len(listed)
    modality = {
        "state": {"delta_indices": [0], "modality_keys": [*forms], "sin_cos_embedding_keys": names[:1]},
        "action": {
            "modality_keys": keys,
            "action_configs": listed[:count],
            "delta_indices": list(range(horizon)),
        },
    }
    decode = step(UNPACK["native"], env_action_dim=0, raw_stats=numbers, modality_config=modality)
    decode["config"] |= {"use_percentiles": draw(st.booleans()), "use_relative_action": draw(st.booleans())}
    return decode, forms


@st.composite
def robots(draw: st.DrawFn) -> Robot:
    """A saved folder. Some are refused: the oracle says which."""
    seed = draw(st.integers(0, 2**32 - 2))
    rng = np.random.default_rng(seed)
    kind = draw(st.sampled_from(["n1.5", "n1.7", "native"]))
    release = "n1.7" if kind == "native" else kind
    tag = draw(st.sampled_from([*MAPPING[release], "of_my_own"]))
    forms: dict[str, tuple[str, int]] = {}
    if kind == "native":
        decode, forms = draw(native(rng))
        rows = decode["config"]["raw_stats"]
        total = sum(len(row["mean"]) for row in rows["action"].values())
        widths = (sum(width for _, width in forms.values()), total)
        decode["config"]["env_action_dim"] = draw(st.sampled_from([0, total, total, max(1, total - 1)]))
        decode["config"]["action_decode_transform"] = draw(st.sampled_from([None, "libero"]))  # not read
    else:
        widths = (draw(st.integers(7, 10)), draw(st.integers(1, 10)))
        decode = step(UNPACK[kind], env_action_dim=draw(st.sampled_from([0, widths[1], 6])))
        decode["config"]["normalize_min_max"] = draw(st.sampled_from([True, True, False]))
    if kind == "n1.7":
        decode["config"] |= {"clip_normalized_action": draw(st.booleans())}
        decode["config"] |= {"libero_gripper_action": draw(st.booleans()), "libero_gripper_binarize": True}
    config = draw(configs(release, tag, widths))
    pack = step(PACK[release], embodiment_tag=tag, embodiment_mapping=MAPPING[release], language_key="task")
    pack["config"] |= {"normalize_min_max": draw(st.sampled_from([True, True, False])), "state_horizon": 1}
    pack["config"] |= {"max_state_dim": config["max_state_dim"], "max_action_dim": config["max_action_dim"]}
    pack["config"] |= {"action_horizon": 16 if release == "n1.5" else 40, "formalize_language": False}
    encode = [step("groot_eagle_encode_v3"), step("groot_eagle_collate_v3")]
    if release == "n1.7":
        pack["config"] |= {"clip_outliers": draw(st.booleans()), "valid_action_horizon": 16}
        encode = [step("groot_n1_7_vlm_encode_v1", **VLM)]
    if kind == "native":
        shared = {
            name: decode["config"][name] for name in ("raw_stats", "modality_config", "use_percentiles")
        }
        pack["config"] |= copy.deepcopy(shared)
    states = {}
    if draw(st.integers(0, 5)):
        states[PACK[release]] = draw(tensors(rng, "observation.state", widths[0]))
    if kind != "native" and draw(st.integers(0, 5)):
        states[UNPACK[kind]] = draw(tensors(rng, "action", widths[1]))
    relative, absolute = draw(generic(release, widths[1]))
    rename = {"observation.images.zed": "observation.images.front", "observation.joints": "observation.state"}
    rename_step = step("rename_observations_processor", rename_map=draw(st.sampled_from([{}, rename])))
    before = [rename_step, step("to_batch_processor"), *relative, pack, *encode, DEVICE]
    return Robot(config, before, [decode, *absolute, DEVICE], states, forms, seed)


@st.composite
def damaged(draw: st.DrawFn) -> Robot:
    """A saved folder with one thing changed at random. The oracle says whether it is still a robot."""
    robot = copy.deepcopy(draw(robots()))
    config, pack = robot.config, next(step for step in robot.before if "pack" in step["registry_name"])
    decode = robot.after[0]["config"]
    changes = ["widths", "steps", "no relative step", "other release's relative step"]
    if relative := decode.get("raw_stats", {}).get("relative_action"):
        decode["use_relative_action"] = True
        changes = ["reference", "format", "type", "no statistics", "rows"]
        key = draw(st.sampled_from([*relative]))
        about = decode["modality_config"]["action"]
        about["action_configs"] = about["action_configs"] or []
        place = about["modality_keys"].index(key)
    change = draw(st.sampled_from(changes))
    if change == "widths":
        pack["config"]["max_state_dim"] = config["max_state_dim"] = draw(st.integers(1, 8))
    elif change == "steps":
        config |= draw(st.sampled_from([{"n_action_steps": 41}, {"chunk_size": 4}, {"n_action_steps": 50}]))
    elif change == "no relative step":
        robot.before = [step for step in robot.before if step["registry_name"] not in RELATIVES]
        robot.after[1:-1] = [step("absolute_actions_processor", enabled=draw(st.booleans()))]
    elif change == "other release's relative step":
        name = draw(st.sampled_from(RELATIVES))
        robot.before.insert(2, step(name, enabled=True, exclude_joints=[], action_names=None))
        robot.after[1:-1] = [step("absolute_actions_processor", enabled=True)]
    elif change == "no statistics":
        del relative[key]
    elif change == "rows":
        count = draw(st.integers(1, 12))
        for name, values in relative[key].items():
            relative[key][name] = values[:count] if np.ndim(values) == 2 else values
    elif place < len(about["action_configs"]):
        values = {"format": ["DEFAULT", "XYZ_ROTVEC", "XYZ_ROT6D"], "type": ["EEF", "NON_EEF"]}
        values["reference"] = ["nothing", *robot.forms]
        field = "state_key" if change == "reference" else change
        about["action_configs"][place] = {
            **about["action_configs"][place],
            field: draw(st.sampled_from(values[change])),
        }
    return robot
