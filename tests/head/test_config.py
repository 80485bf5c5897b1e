"""Configs of every version: values that are read, defaults of missing keys, contradictions."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import pytest

import saccade
from saccade_lab.random_checkpoint.head import config_of_size
from saccade_lab.reference.random_weights import CONFIGS, small_config, whole_config

Config = dict[str, Any]


def read(config: Config) -> saccade.HeadConfig:
    return saccade.HeadConfig.from_dict(config)


def changed(kind: str, **changes: Any) -> Config:
    """The small config of a kind with other values; None takes a key away."""
    config = small_config(kind) | changes
    return {key: value for key, value in config.items() if value is not None}


@pytest.mark.parametrize("kind", CONFIGS)
def test_a_version_is_told_by_the_keys_of_its_head(kind: str) -> None:
    whole = whole_config(CONFIGS[kind])
    alone = {key: value for key, value in CONFIGS[kind].items() if key != "model_type"}
    expected = kind if kind in ("n1", "n1.6", "n1.7") else "n1.5"
    assert read(whole).version == read(alone).version == expected
    assert read(whole) == read(alone)


#: What the published configs say, and the fork's code for its heads.
PUBLISHED: dict[str, Config] = {
    "n1": {"context_dim": 1536, "num_future_tokens": 0, "use_vlln": False, "vl_num_layers": 0},
    "n1.5": {"context_dim": 2048, "num_future_tokens": 32, "use_vlln": True, "vl_num_layers": 4},
    "n1.6": {"num_layers": 32, "action_horizon": 50, "vl_num_layers": 0, "use_vlln": True},
    "n1.7": {"num_layers": 32, "action_horizon": 40, "vl_num_layers": 4, "num_future_tokens": 0},
    "fork": {
        "decoders": (("action_arm_decoder", 14), ("action_claw_decoder", 2)),
        "action_dim": 16,
        "encoder_action_dim": 32,
    },
    "split-arms": {
        "decoders": (
            ("action_left_arm_decoder", 9),
            ("action_right_arm_decoder", 9),
            ("action_claw_decoder", 2),
        ),
        "action_dim": 20,
    },
}


@pytest.mark.parametrize("kind", PUBLISHED)
def test_published_sizes(kind: str) -> None:
    config = read(dict(CONFIGS[kind]))
    given = {name: getattr(config, name) for name in PUBLISHED[kind]}
    assert given == PUBLISHED[kind]
    alternates = kind in ("n1.6", "n1.7")
    assert config.mask_mode == ("alternate" if alternates else "none")
    assert config.attend_text_every_n_blocks == (2 if alternates else 0)
    assert config.state_history == 1
    assert config.future_key_bias is None
    if "decoders" not in given:
        assert config.decoders == (("action_decoder", config.action_dim),)
        assert config.encoder_action_dim == config.action_dim


@pytest.mark.parametrize("size", ["n1.5", "n1.6", "n1.7"])
def test_the_sizes_to_time_are_the_published_ones(size: str) -> None:
    assert read(config_of_size(size)) == read({**CONFIGS[size], "max_num_embodiments": 1})


@pytest.mark.parametrize(
    ("kind", "key", "field", "expected"),
    [
        ("n1.5", "num_target_vision_tokens", "num_future_tokens", 32),
        ("n1.5", "max_num_embodiments", "num_embodiments", 32),
        ("n1.5", "max_seq_len", "max_positions", 1024),
        ("n1.5", "add_pos_embed", "add_pos_embed", True),
        ("n1.5", "use_vlln", "use_vlln", True),
        ("n1.5", "input_embedding_dim", "width", 96),
        ("fork", "split_arm_heads", "decoders", (("action_arm_decoder", 14), ("action_claw_decoder", 2))),
        ("n1", "num_timestep_buckets", "num_timestep_buckets", 1000),
        ("n1.6", "max_state_dim", "state_dim", 29),
        ("n1.6", "max_action_dim", "encoder_action_dim", 29),
        ("n1.6", "action_horizon", "action_horizon", 16),
        ("n1.7", "max_state_dim", "state_dim", 132),
        ("n1.7", "max_action_dim", "action_dim", 132),
        ("n1.7", "action_horizon", "action_horizon", 40),
        ("n1.7", "num_inference_timesteps", "num_steps", 4),
        ("n1.7", "state_history_length", "state_history", 1),
        ("n1.7", "use_alternate_vl_dit", "mask_mode", "alternate"),
        ("n1.7", "attend_text_every_n_blocks", "attend_text_every_n_blocks", 2),
        ("n1.7", "vl_self_attention_cfg", "vl_num_layers", 0),
    ],
)
def test_what_a_config_leaves_out_is_as_its_class_has_it(
    kind: str, key: str, field: str, expected: object
) -> None:
    model_type = {"n1": "gr00t_n1", "n1.6": "Gr00tN1d6", "n1.7": "Gr00tN1d7"}.get(kind, "gr00t_n1_5")
    config = changed(kind, **{"model_type": model_type, key: None})
    assert key not in config
    assert getattr(read(config), field) == expected


def in_dit(**changes: Any) -> Callable[[Config], None]:
    return lambda config: config["diffusion_model_cfg"].update(changes)


def without(part: str, key: str) -> Callable[[Config], None]:
    return lambda config: config[part].pop(key)


@pytest.mark.parametrize(
    ("kind", "change", "message"),
    [
        (
            "n1.5",
            {"model_type": "gr00t_n2"},
            'model_type is "gr00t_n2", expected one of gr00t_n1, gr00t_n1_5',
        ),
        ("n1.5", {"model_type": 3}, "model_type is 3, expected one of"),
        (
            "n1.5",
            {"model_type": "gr00t_n1"},
            "num_target_vision_tokens is 32, which only N1.5 has, .* of N1;",
        ),
        ("n1.5", {"model_type": "gr00t_n1"}, "use_vlln is true, which only N1.5, N1.6, N1.7 has"),
        ("n1.5", {"model_type": "Gr00tN1d7"}, "num_target_vision_tokens is 32, which only N1.5 has"),
        ("n1.5", {"use_alternate_vl_dit": True}, "use_alternate_vl_dit is true, which only N1.6, N1.7 has"),
        ("n1.5", {"state_history_length": 2}, "state_history_length is 2, which only N1.7 has"),
        ("n1.7", {"model_type": "Gr00tN1d6"}, "vl_self_attention_cfg is .*, which only N1.5, N1.7 has"),
        ("n1.7", {"use_multi_action_heads": True}, "use_multi_action_heads is true, which only N1.5 has"),
        ("n1.7", {"action_dim": 7}, "action_dim is 7, but max_action_dim is 132"),
        (
            "n1.7",
            {"attend_text_every_n_blocks": 0},
            "attend_text_every_n_blocks is 0, expected a whole number",
        ),
        (
            "n1.7",
            in_dit(interleave_self_attention=False),
            "interleave_self_attention is false, expected true",
        ),
        (
            "n1.7",
            in_dit(cross_attention_dim=64),
            "cross_attention_dim is 64, but backbone_embedding_dim is 128",
        ),
        ("n1.5", in_dit(cross_attention_dim=None), r"cross_attention_dim \(null, .*\) is 96, but .* is 128"),
        ("n1.5", in_dit(num_layers=1025), "num_layers is 1025, expected a whole number from 1 to 1024"),
        (
            "n1.5",
            without("diffusion_model_cfg", "positional_embeddings"),
            "embeddings is missing, expected null",
        ),
        (
            "n1.7",
            without("vl_self_attention_cfg", "positional_embeddings"),
            "embeddings is missing, expected null",
        ),
        (
            "n1.7",
            {"state_history_length": 1 << 20},
            "max_state_dim x state_history_length is .*, expected at most",
        ),
        ("fork", {"action_dim": 15}, "action_dim is 15, but the decoders of arm, claw have 16 outputs"),
        ("fork", {"pretrained_action_dim": 15}, "pretrained_action_dim is 15, expected at least the 16"),
        ("fork", {"action_claw_dim": 0}, "action_claw_dim is 0, expected a whole number"),
        ("split-arms", {"use_shared_arm_features": True}, "use_shared_arm_features is true, expected false"),
        ("n1.5", {"saccade": 3}, "saccade: expected an object"),
        ("n1.5", {"saccade": {"bias": [1.0]}}, "saccade.bias is unknown, expected future_key_bias"),
        ("n1.5", {"saccade": {"future_key_bias": ["a"] * 32}}, "future_key_bias: expected a list of finite"),
        (
            "n1.5",
            {"saccade": {"future_key_bias": [1e300] * 32}},
            "future_key_bias: expected a list of finite",
        ),
        ("n1.5", {"saccade": {"future_key_bias": [0.0] * 3}}, "length of saccade.future_key_bias is 3, but"),
    ],
)
def test_what_contradicts_itself_is_refused(
    kind: str, change: Config | Callable[[Config], None], message: str
) -> None:
    config = copy.deepcopy(small_config(kind))
    if callable(change):
        change(config)
    else:
        config |= change
    with pytest.raises(saccade.CheckpointError, match=message):
        read(config)


def test_all_that_is_wrong_is_listed() -> None:
    config = changed("n1.7", num_target_vision_tokens=3, use_multi_action_heads=True, hidden_size="wide")
    with pytest.raises(saccade.CheckpointError) as raised:
        read(config)
    for key in ("num_target_vision_tokens", "use_multi_action_heads", "hidden_size"):
        assert key in str(raised.value)


def test_a_fork_that_names_its_encoders_width_returns_what_it_decodes() -> None:
    """The fork's loader takes `action_dim` of a published config for the encoder's."""
    config = read(changed("fork", action_dim=32, pretrained_action_dim=None))
    assert (config.action_dim, config.encoder_action_dim) == (16, 32)


def test_plain_blocks_of_later_versions_ignore_masks() -> None:
    config = read(changed("n1.7", use_alternate_vl_dit=False))
    assert (config.version, config.mask_mode, config.attend_text_every_n_blocks) == ("n1.7", "none", 0)


@pytest.mark.parametrize("none", [{}, {"num_layers": 0}])
def test_no_layers_are_no_self_attention(none: Config) -> None:
    for kind in ("n1.6", "n1.7"):
        config = read(changed(kind, vl_self_attention_cfg=none))
        assert (config.version, config.vl_num_layers, config.use_vlln) == (kind, 0, True)
    with pytest.raises(saccade.CheckpointError, match="num_layers is missing"):
        read(changed("n1.5", vl_self_attention_cfg=none and {"num_attention_heads": 2}))


def test_a_bias_of_the_future_keys_is_read() -> None:
    bias = [0.5 * index for index in range(32)]
    assert read(changed("n1.5", saccade={"future_key_bias": bias})).future_key_bias == tuple(bias)
    assert read(changed("n1.5", saccade={"future_key_bias": None})).future_key_bias is None
