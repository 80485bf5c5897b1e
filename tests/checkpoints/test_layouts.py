"""Every published layout loads as it is, and what contradicts itself is refused with all that was found."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

import saccade
from saccade.checkpoints import convert, describe, quantize
from saccade.errors import CheckpointError
from tests.helpers import layout_heads, layouts

Json = dict[str, Any]

EXPECTED = {  # layout: (who wrote it, version, prefix)
    "nvidia": ("nvidia", "n1.5", "action_head."),
    "nvidia-sharded": ("nvidia", "n1.5", "action_head."),
    "isaac": ("isaac", "n1.5", "action_head."),
    "lerobot": ("lerobot", "n1.5", "_groot_model.action_head."),
    "fork": ("fork", "n1.5", "_groot_model.action_head."),
    "fork-split": ("fork", "n1.5", "_groot_model.action_head."),
    "saccade": ("saccade", "n1.5", "action_head."),
    "n1": ("nvidia", "n1", "action_head."),
    "n16": ("nvidia", "n1.6", "action_head."),
    "n17": ("nvidia", "n1.7", "action_head."),
    "lerobot-n17": ("lerobot", "n1.7", "_groot_model.action_head."),
}


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("layouts")
    return {name: layouts.write(folder / name, name, seed=5) for name in layouts.LAYOUTS}


def actions(head: saccade.ActionHead) -> np.ndarray[Any, Any]:
    rng, config = np.random.default_rng(1), head.config
    masks: dict[str, Any] = {}
    if config.mask_mode != "none":
        masks = {"image_mask": np.array([[True, False] * 4]), "attention_mask": np.ones((1, 8), bool)}
    features = rng.standard_normal((1, 8, config.context_dim), np.float32)
    state = rng.standard_normal((1, config.num_states, config.state_dim), np.float32)
    return np.asarray(head(features, state, 31, seed=2, **masks))


@pytest.mark.parametrize("layout", layouts.LAYOUTS)
def test_every_layout_loads_as_with_the_config_and_the_tensors_alone(
    written: dict[str, Path], layout: str, tmp_path: Path
) -> None:
    head = saccade.ActionHead.from_pretrained(written[layout], embodiment_ids=[31])
    # The head's tensors alone, and the config that the layout was made from.
    tensors = layouts.read(written[layout], EXPECTED[layout][2])
    save_file(tensors, tmp_path / "head.safetensors")
    config = layout_heads.head_config(layout)
    alone = saccade.ActionHead.from_pretrained(
        tmp_path / "head.safetensors", config=config, embodiment_ids=[31]
    )
    assert head.config == alone.config
    assert head.config.num_future_tokens == config.get("num_target_vision_tokens", 0)
    assert head.config.decoders == tuple(layout_heads.decoders(config).items())
    assert np.array_equal(actions(head), actions(alone))


@pytest.mark.parametrize("layout", layouts.LAYOUTS)
def test_every_layout_is_described(written: dict[str, Path], layout: str) -> None:
    found = describe(written[layout])
    assert (found.layout, found.version, found.prefix) == EXPECTED[layout]
    assert json.loads(json.dumps(found.head_config)) == found.head_config
    again = saccade.HeadConfig.from_dict(found.head_config)
    assert again == saccade.HeadConfig.from_dict(layout_heads.head_config(layout))
    stored = load_file(sorted(written[layout].glob("model*.safetensors"))[0])
    tensors = {tensor.name: tensor for tensor in found.tensors}
    names = {torch.float32: "F32", torch.bfloat16: "BF16"}
    for name, tensor in stored.items():
        assert tensors[name].dtype == names[tensor.dtype]
        assert tuple(tensors[name].shape) == tuple(tensor.shape)
        assert tensors[name].nbytes == tensor.nbytes


def change_config(folder: Path, change: Callable[[Json], object]) -> None:
    path = folder / "config.json"
    config = json.loads(path.read_text())
    change(config)
    path.write_text(json.dumps(config))


def change_tensors(folder: Path, change: Callable[[Json], object]) -> None:
    path = folder / "model.safetensors"
    tensors = load_file(path)
    change(tensors)
    save_file(tensors, path)


def test_sizes_that_lerobots_config_lacks_come_from_the_tensors(tmp_path: Path) -> None:
    config = layout_heads.head_config("lerobot")
    config |= {"num_target_vision_tokens": 7, "max_num_embodiments": 3, "max_seq_len": 20, "hidden_size": 24}
    config["diffusion_model_cfg"] |= {"num_layers": 2, "output_dim": 24, "num_attention_heads": 3}
    config["vl_self_attention_cfg"]["num_layers"] = 1
    config["input_embedding_dim"] = 144
    found = saccade.ActionHead.from_pretrained(
        layouts.write(tmp_path / "policy", "lerobot", config=config)
    ).config
    assert found == saccade.HeadConfig.from_dict(config)


HORIZONS: Json = json.loads((Path(__file__).parents[1] / "data" / "lerobot_horizons.json").read_text())


@pytest.mark.parametrize("case", HORIZONS)
def test_lerobots_head_denoises_what_lerobots_model_denoises(tmp_path: Path, case: str) -> None:
    """Neither `chunk_size` nor the pack step says it: they say what is trained and returned."""
    found, layout = HORIZONS[case], "lerobot-n17" if case.startswith("n17") else "lerobot"
    widths = {key: found["pack"][key] for key in ("max_state_dim", "max_action_dim")}
    config = layout_heads.head_config(layout) | widths
    if layout == "lerobot":
        config["action_dim"] = widths["max_action_dim"]
    folder = layouts.write(tmp_path / "policy", layout, config=config)
    change_config(folder, lambda policy: policy.update(found["config"]))
    change_pack(folder, found["pack"])
    head = saccade.ActionHead.from_pretrained(folder, embodiment_ids=[31])
    assert head.config.action_horizon == found["head_horizon"]


@pytest.mark.parametrize(("layout", "horizon"), [("lerobot", 16), ("fork", 16), ("lerobot-n17", 40)])
def test_no_chunk_of_lerobots_changes_its_head(tmp_path: Path, layout: str, horizon: int) -> None:
    folder = layouts.write(tmp_path / "policy", layout)
    for chunk in (1, 8, 16, 50, 64):
        policy = json.loads((folder / "config.json").read_text()) | {"chunk_size": chunk}
        (folder / "config.json").write_text(json.dumps(policy))
        change_pack(folder, {"action_horizon": chunk, "valid_action_horizon": chunk})
        assert describe(folder).config.action_horizon == horizon
    (folder / "policy_preprocessor.json").write_text("{")
    assert describe(folder).config.action_horizon == horizon


def change_pack(folder: Path, change: Json) -> None:
    """Changes the config of the pack step of lerobot's preprocessor."""
    path = folder / "policy_preprocessor.json"
    processors = json.loads(path.read_text())
    processors["steps"][2]["config"] |= change
    path.write_text(json.dumps(processors))


def test_n15_as_it_was_first_published_has_no_future_tokens(tmp_path: Path) -> None:
    folder = layouts.write(tmp_path / "first", "nvidia")
    change_config(folder, lambda config: config["action_head_cfg"].pop("num_target_vision_tokens"))
    change_tensors(folder, lambda tensors: tensors.pop("action_head.future_tokens.weight"))
    assert saccade.ActionHead.from_pretrained(folder, embodiment_ids=[0]).config.num_future_tokens == 0


def test_a_forks_decoders_beside_the_config_of_the_model_that_it_started_from(tmp_path: Path) -> None:
    """The fork's model class makes its keys up while it loads and saves the config without them."""
    config = layout_heads.head_config("fork")
    folder = layouts.write(tmp_path / "fork", "nvidia", config=config)
    plain = layout_heads.n15_head()
    change_config(folder, lambda config: config.update(action_head_cfg=plain))
    found = saccade.ActionHead.from_pretrained(folder, embodiment_ids=[0]).config
    assert found == saccade.HeadConfig.from_dict(config)


#: Checkpoints that contradict themselves: layout, change of config.json, change of the tensors, what is said.
CONTRADICTIONS: dict[str, tuple[str, Callable[[Json], object], Callable[[Json], object], list[str]]] = {
    "another N": (
        "nvidia",
        lambda config: config["action_head_cfg"].update(num_target_vision_tokens=64),
        lambda tensors: None,
        ["num_target_vision_tokens is 64 in the config", r"future_tokens\.weight is \(32, 96\)"],
    ),
    "several sizes": (
        "nvidia",
        lambda config: config["action_head_cfg"].update(max_state_dim=13, action_dim=9),
        lambda tensors: None,
        [
            r"max_state_dim is 13 .*state_encoder\.layer1\.W is \(32, 12, 40\)",
            r"action_dim is 9 .*action_encoder\.W1\.W is \(32, 8, 96\)",
        ],
    ),
    "fewer blocks": (
        "nvidia",
        lambda config: config["action_head_cfg"]["diffusion_model_cfg"].update(num_layers=6),
        lambda tensors: None,
        [r"diffusion_model_cfg\.num_layers is 6 .*has 4 blocks"],
    ),
    "model_type of N1.6, future tokens": (
        "nvidia",
        lambda config: config.update(model_type="Gr00tN1d6"),
        lambda tensors: None,
        [
            'model_type is "Gr00tN1d6": N1.6',
            'architectures names "GR00T_N1_5": N1.5',
            r"future_tokens.*: N1\.5",
        ],
    ),
    "future tokens in N1.7": (
        "lerobot-n17",
        lambda config: None,
        lambda tensors: tensors.update(
            {f"{EXPECTED['lerobot'][2]}future_tokens.weight": torch.zeros(32, 96)}
        ),
        [r'base_model_path is "nvidia/GR00T-N1\.7-3B": N1\.7', r"future_tokens\.weight is \(32, 96\): N1\.5"],
    ),
    "arm decoder in N1": (
        "n1",
        lambda config: None,
        lambda tensors: tensors.update({"action_head.action_arm_decoder.layer2.W": torch.zeros(32, 40, 4)}),
        ['model_type is "gr00t_n1": N1', r"action_arm_decoder\.layer2\.W is \(32, 40, 4\): N1\.5"],
    ),
    "alternating blocks in N1.5": (
        "nvidia",
        lambda config: config["action_head_cfg"].update(use_alternate_vl_dit=True),
        lambda tensors: None,
        [r"use_alternate_vl_dit is true: N1\.6 or N1\.7", 'model_type is "gr00t_n1_5": N1.5'],
    ),
    "padding of another width": (
        "lerobot",
        lambda config: config.update(max_state_dim=64, max_action_dim=32),
        lambda tensors: None,
        ["max_state_dim is 64 in the config", "max_action_dim is 32 in the config"],
    ),
    "a version that is not known": (
        "nvidia",
        lambda config: config.update(model_type="gr00t_n2"),
        lambda tensors: None,
        ['model_type is "gr00t_n2", expected one of gr00t_n1, gr00t_n1_5, Gr00tN1d6, Gr00tN1d7'],
    ),
    "another model": (
        "nvidia",
        lambda config: config.update(model_type="bert"),
        lambda tensors: None,
        ['model_type is "bert", expected one of gr00t_n1, gr00t_n1_5'],
    ),
    "two models": (
        "nvidia",
        lambda config: config["action_head_cfg"].update(model_type="Gr00tN1d7"),
        lambda tensors: None,
        ['model_type is "gr00t_n1_5": N1.5', r'action_head_cfg\.model_type is "Gr00tN1d7": N1\.7'],
    ),
    "saccade's own key in the wrong place": (
        "nvidia",
        lambda config: config.update(saccade={"future_key_bias": [0.0] * 32}),
        lambda tensors: None,
        ["saccade is next to action_head_cfg, expected inside it"],
    ),
    "another policy of lerobot's": (
        "lerobot",
        lambda config: config.update(type="act"),
        lambda tensors: None,
        ['type is "act"', 'expected "groot"'],
    ),
    "arms that share features": (
        "fork-split",
        lambda config: None,
        lambda tensors: tensors.update(
            {f"{EXPECTED['fork'][2]}shared_arm_decoder.shared_layer.W": torch.zeros(32, 40, 40)}
        ),
        [r"shared_arm_decoder\.shared_layer\.W is unknown"],
    ),
}


@pytest.mark.parametrize("case", CONTRADICTIONS)
def test_contradictions_are_one_error_with_all_that_was_found(tmp_path: Path, case: str) -> None:
    layout, change, replace, messages = CONTRADICTIONS[case]
    folder = layouts.write(tmp_path / "checkpoint", layout)
    change_config(folder, change)
    change_tensors(folder, replace)
    with pytest.raises(CheckpointError) as caught:
        saccade.ActionHead.from_pretrained(folder, embodiment_ids=[0])
    for message in messages:
        assert re.search(message, str(caught.value)), caught.value


def test_an_encoder_without_inputs(tmp_path: Path) -> None:
    """Its width is a multiple of every state's, none of which it holds."""
    folder = layouts.write(tmp_path / "checkpoint", "lerobot-n17")
    name = f"{EXPECTED['lerobot'][2]}state_encoder.layer1.W"
    change_tensors(folder, lambda tensors: tensors.update({name: torch.zeros(1, 0, 4)}))
    with pytest.raises(CheckpointError, match="max_state_dim is"):
        saccade.ActionHead.from_pretrained(folder)


def test_contradictions_of_a_config_alone() -> None:
    config = {"model_type": "gr00t_n1_5", "action_head_cfg": layout_heads.n15_head()}
    saccade.HeadConfig.from_dict(config)
    with pytest.raises(CheckpointError, match=r"action_head_cfg\.model_type is \"Gr00tN1d7\""):
        saccade.HeadConfig.from_dict(
            config | {"action_head_cfg": layout_heads.n15_head() | {"model_type": "Gr00tN1d7"}}
        )
    with pytest.raises(CheckpointError, match="saccade is next to action_head_cfg"):
        saccade.HeadConfig.from_dict(config | {"saccade": {"future_key_bias": [0.0] * 32}})


def test_lerobots_n17_is_known_without_the_name_of_its_base(tmp_path: Path) -> None:
    folder = layouts.write(tmp_path / "policy", "lerobot-n17")
    (folder / "config.json").write_text('{"type": "groot", "chunk_size": 40}')
    assert saccade.ActionHead.from_pretrained(folder, embodiment_ids=[0]).config.version == "n1.7"


def test_heads_whose_width_lerobots_config_would_have_to_tell(tmp_path: Path) -> None:
    config = layout_heads.head_config("lerobot")
    config["diffusion_model_cfg"] |= {"num_attention_heads": 2, "attention_head_dim": 40}
    config["input_embedding_dim"] = 80
    folder = layouts.write(tmp_path / "policy", "lerobot", config=config)
    with pytest.raises(CheckpointError, match=r"input_embedding_dim is 80: not a multiple of 48"):
        saccade.ActionHead.from_pretrained(folder)
    assert saccade.ActionHead.from_pretrained(folder, config=config, embodiment_ids=[0]).config.head_dim == 40


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "3",
        "null",
        "{",
        '{"type": 3}',
        '{"action_head_cfg": []}',
        "[" * 10_000,
        '{"a":' * 5_000,
        "\ud800",
    ],
)
def test_configs_that_are_none(tmp_path: Path, text: str) -> None:
    folder = layouts.write(tmp_path / "checkpoint", "saccade")
    (folder / "config.json").write_bytes(text.encode("utf-8", "surrogatepass"))
    with pytest.raises(CheckpointError, match="config"):
        saccade.ActionHead.from_pretrained(folder)


def test_a_config_that_is_a_directory_or_missing(tmp_path: Path) -> None:
    folder = layouts.write(tmp_path / "checkpoint", "saccade")
    (folder / "config.json").unlink()
    with pytest.raises(FileNotFoundError, match="config"):
        saccade.ActionHead.from_pretrained(folder)
    (folder / "config.json").mkdir()
    with pytest.raises(CheckpointError, match="config"):
        saccade.ActionHead.from_pretrained(folder)


def test_saccades_own_file_goes_with_a_single_file(tmp_path: Path) -> None:
    folder = layouts.write(tmp_path / "policy", "lerobot")
    (folder / "saccade.json").write_text(json.dumps({"future_key_bias": [0.5] * 32}))
    for rewrite in (convert, quantize):
        out = tmp_path / rewrite.__name__
        rewrite(folder / "model.safetensors", out)
        found = saccade.ActionHead.from_pretrained(out, embodiment_ids=[0]).config
        assert found.future_key_bias == (0.5,) * 32


def test_saccades_own_file_beside_lerobots_config(tmp_path: Path) -> None:
    folder = layouts.write(tmp_path / "policy", "lerobot")
    bias = [0.5] * 32
    (folder / "saccade.json").write_text(json.dumps({"future_key_bias": bias}))
    assert saccade.ActionHead.from_pretrained(folder, embodiment_ids=[0]).config.future_key_bias == tuple(
        bias
    )
    for text in ("[]", "{", '{"future_key_bias": [1]}', '{"other": 1}'):
        (folder / "saccade.json").write_text(text)
        with pytest.raises(CheckpointError):
            saccade.ActionHead.from_pretrained(folder)
