"""The work of a head, the cost model and the roofline. No test looks at a time."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest

import saccade
from benches import cost, roofline
from benches.cost import ELEMENT_BYTES, floors, measured_like, predict
from benches.work import encode_work, sample_work, total
from saccade import _saccade
from saccade.head.config import HeadConfig
from saccade_lab.random_checkpoint.head import config_of_size, write_head
from saccade_lab.timing import Call, Machine, profiled, works_of

GIGA = 10**9


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A head of the small size."""
    path = tmp_path_factory.mktemp("small")
    write_head(path, config_of_size("small"))
    return path


@pytest.fixture(scope="module")
def head(folder: Path) -> saccade.ActionHead:
    return saccade.ActionHead.from_pretrained(folder)


def n15() -> HeadConfig:
    return HeadConfig(**_saccade.parse_config(json.dumps({"action_head_cfg": config_of_size("n1.5")})))


# What is exact, and a table of rounded numbers, of N1.5's published sizes.


@pytest.mark.parametrize(
    ("num_vl_tokens", "vl_self_attention", "cross", "attention"),
    [
        (296, 61.0, 14.9, (0.5, 1.7, 3.0)),
        (559, 117.7, 28.1, (1.0, 2.9, 5.1)),
        (822, 176.6, 41.4, (1.4, 4.2, 7.2)),
    ],
)
def test_encode_is_as_much_as_the_sizes_say(
    num_vl_tokens: int, vl_self_attention: float, cross: float, attention: tuple[float, ...]
) -> None:
    config = n15()
    works = encode_work(config, Call.of(config, num_vl_tokens))
    once = works.pop("context_to_kv").multiply_adds
    assert once == 8 * num_vl_tokens * 2048 * 2 * 1536
    assert round(once / GIGA, 1) == cross
    # Per layer: 12 widths squared a row for its linear layers, 2 widths a pair of rows for its attention.
    exact = 4 * (num_vl_tokens * 12 * 2048**2 + 2 * num_vl_tokens**2 * 2048)
    assert total(works).multiply_adds == exact
    assert round(exact / GIGA, 1) == pytest.approx(vl_self_attention, abs=0.11)
    for num_future_tokens, expected in zip((0, 32, 64), attention, strict=True):
        call = Call.of(config, num_vl_tokens, num_future_tokens=num_future_tokens)
        saved = 4 * 2 * (1 + num_future_tokens) * (17 + num_future_tokens) * 1536  # the last block
        counted = sample_work(config, call)["attention"].multiply_adds + saved
        assert round(counted / GIGA, 1) == pytest.approx(expected, abs=0.11)


@pytest.mark.parametrize(("num_future_tokens", "expected"), [(0, 28.2), (32, 81.4), (64, 134.5)])
def test_the_blocks_are_as_much_as_the_sizes_say(num_future_tokens: int, expected: float) -> None:
    config = n15()
    works = sample_work(config, Call.of(config, 296, num_future_tokens=num_future_tokens))
    for part in ("attention", "embodiment", "output"):
        del works[part]
    rows = 17 + num_future_tokens
    all_rows = 4 * rows * (8 * 10 * 1536**2 + 8 * 12 * 1536**2)  # 415.2 M a row and step
    assert round(all_rows / GIGA, 1) == expected
    saved = 4 * (1 + num_future_tokens) * 10 * 1536**2  # the last block, on the action rows only
    assert total(works).multiply_adds == all_rows - saved


def test_weights_are_as_many_as_the_sizes_say() -> None:
    config = n15()
    works = sample_work(config, Call.of(config, 296, 1))
    blocks = sum(works[part].elements for part in works if part not in ("attention", "embodiment"))
    # 417 M a step; biases are not counted here.
    assert blocks == 8 * 10 * 1536**2 + 8 * 12 * 1536**2 + 1536 * 1024
    assert round(blocks / 1e6) == 417


@pytest.mark.parametrize(
    "sizes",
    [
        {},
        {"num_steps": 1},
        {"num_samples": 3},
        {"future_refresh": 2, "num_steps": 5},
        {"future_refresh": 9, "num_samples": 2},
        {"num_future_tokens": 0, "future_refresh": 3},
        {"num_future_tokens": 7},
        {"batch": 2, "num_samples": 2},
    ],
)
def test_the_engine_does_as_much_as_is_counted(head: saccade.ActionHead, sizes: dict[str, int]) -> None:
    call = Call.of(head.config, 11, **sizes)
    assert_counted(head, call)


def test_heads_of_another_structure_are_counted_too(tmp_path: Path) -> None:
    """An odd number of layers, so that the last one is a cross-attention; no VL self-attention."""
    config = config_of_size("small")
    config["diffusion_model_cfg"]["num_layers"] = 3
    config["use_vlln"] = False
    write_head(tmp_path, config)
    head = saccade.ActionHead.from_pretrained(tmp_path)
    assert_counted(head, Call.of(head.config, 5, future_refresh=2))


@pytest.mark.parametrize("size", ["n1.6", "n1.7"])
def test_later_versions_are_counted_and_are_of_the_published_size(tmp_path: Path, size: str) -> None:
    """Seven blocks, so that text is read by twice as many of them as images are; five image tokens of 13."""
    config = config_of_size(size)
    published = _saccade.tensor_shapes(json.dumps(config))
    parameters = sum(math.prod(shape) for _, shape in published)
    assert parameters == {"n1.6": 1_103_465_600, "n1.7": 1_304_913_028}[size]  # with one embodiment
    config |= {"backbone_embedding_dim": 128, "hidden_size": 64, "input_embedding_dim": 96}
    config["diffusion_model_cfg"] |= {"cross_attention_dim": 128, "num_attention_heads": 2, "num_layers": 7}
    config["diffusion_model_cfg"]["output_dim"] = 64
    if "vl_self_attention_cfg" in config:
        config["vl_self_attention_cfg"] |= {"num_attention_heads": 2}
    write_head(tmp_path, config)
    head = saccade.ActionHead.from_pretrained(tmp_path)
    call = Call.of(head.config, 13, num_image_tokens=5)
    assert encode_work(head.config, call)["context_to_kv"].multiply_adds == (2 * 8 + 2 * 5) * 128 * 2 * 96
    assert_counted(head, call)
    assert_counted(head, replace(call, num_image_tokens=None, num_samples=2))


def test_several_decoders_are_counted(tmp_path: Path) -> None:
    config = config_of_size("small") | {"use_multi_action_heads": True, "action_arm_dim": 5}
    write_head(tmp_path, config)
    head = saccade.ActionHead.from_pretrained(tmp_path)
    assert (head.config.action_dim, head.config.encoder_action_dim) == (7, 32)
    assert_counted(head, Call.of(head.config, 5))


def assert_counted(head: saccade.ActionHead, call: Call) -> None:
    """The engine's own counters against the counts from the sizes."""
    calls = works_of(head, call)
    for name, works in (
        ("encode", encode_work(head.config, call)),
        ("sample", sample_work(head.config, call)),
    ):
        seconds, counters = profiled(calls[name])
        counted = {part: counter.multiply_adds for part, counter in counters.items()}
        assert counted.pop("norm", 0) == counted.pop("pack", 0) == 0
        assert counted == {part: work.multiply_adds for part, work in works.items()}
        assert sum(counter.seconds for counter in counters.values()) <= seconds
        for part, work in works.items():
            if part != "attention":
                assert counters[part].num_bytes >= work.elements  # int8 would be one byte a weight


# Floors and the model


#: Those that were measured.
PRECISIONS = tuple(ELEMENT_BYTES)
MACHINE = Machine("avx512", 1, {"float32": 1e9, "bfloat16": 2e9, "int8": 4e9}, 1e9)


def test_floors_of_a_part_follow_its_arithmetic() -> None:
    config = n15()
    works = sample_work(config, Call.of(config, 296))
    by_precision = {precision: floors(MACHINE, precision, works) for precision in PRECISIONS}
    for part, work in works.items():
        float32, bfloat16, int8 = (by_precision[precision][part] for precision in PRECISIONS)
        assert float32 >= work.multiply_adds / 1e9
        assert bfloat16 == float32 / 2
        not_int8 = part in ("attention", "embodiment", "output")
        assert int8 == (bfloat16 if not_int8 else float32 / 4)


def test_the_model_grows_with_the_work() -> None:
    config = n15()

    def times(**sizes: int) -> dict[str, float]:
        return predict(config, Call.of(config, **({"num_vl_tokens": 296} | sizes)), "bfloat16", MACHINE)

    base = times()
    assert times(num_vl_tokens=822)["encode"] > 2 * base["encode"]
    assert times(num_steps=8)["sample"] == pytest.approx(2 * base["sample"], rel=1e-2)
    assert times(num_future_tokens=0)["sample"] < base["sample"] < times(num_future_tokens=64)["sample"]
    assert times(future_refresh=4)["sample"] < times(future_refresh=2)["sample"] < base["sample"]
    assert times(num_samples=8)["encode"] == base["encode"]
    for precision in PRECISIONS:
        least = floors(MACHINE, precision, encode_work(config, Call.of(config, 296)))
        expected = predict(config, Call.of(config, 296), precision, MACHINE)
        assert expected["encode"] > sum(least.values())


def test_the_model_expects_less_of_tiles() -> None:
    """AMX is expected to come less near to its floor; a CPU that was not measured counts as a Zen 5."""
    config = n15()
    call = Call.of(config, 296)
    tiles = replace(MACHINE, isa="amx")
    for precision in PRECISIONS:
        assert (
            predict(config, call, precision, tiles)["encode"]
            > predict(config, call, precision, MACHINE)["encode"]
        )
    assert measured_like(replace(MACHINE, isa="amx", family="Granite Rapids")).cpu == "a Xeon with AMX"
    others = [replace(MACHINE, isa=isa) for isa in ("avx512", "avx2", "bf16")]
    assert {measured_like(each).cpu for each in others} == {"a Zen 5 with AVX-512"}
    hidden = replace(MACHINE, isa="avx512", family="Sapphire Rapids")
    assert measured_like(hidden).cpu == "a Xeon without AMX"


# The roofline

#: Attention at half its roof, a layer at the memory's, and a part that reads nothing.
PARTS = [
    {"part": "norm", "seconds": 9.0, "multiply_adds": 0, "bytes": 0},
    {"part": "attention", "seconds": 4.0, "multiply_adds": 2e9, "bytes": 1e8},
    {"part": "feed_forward_in", "seconds": 10.0, "multiply_adds": 5e9, "bytes": 1e10},
]


def test_points_of_the_roofline() -> None:
    layer, attention = roofline.points(MACHINE, "int8", PARTS)
    assert (layer.part, layer.runs_in, layer.intensity, layer.rate) == ("feed_forward_in", "int8", 0.5, 5e8)
    assert (layer.share, layer.limit) == (1.0, "memory")
    assert (attention.runs_in, attention.intensity, attention.rate) == ("bfloat16", 20.0, 5e8)
    assert (attention.share, attention.limit) == (0.25, "arithmetic")
    assert [roofline.roof(MACHINE, "int8", intensity) for intensity in (0.5, 4.0, 100.0)] == [5e8, 4e9, 4e9]


def test_the_roofline_as_text() -> None:
    shown = roofline.points(MACHINE, "int8", PARTS)
    lines = roofline.text(MACHINE, shown)
    picture, legend = lines[: roofline.HEIGHT + 3], lines[roofline.HEIGHT + 4 :]
    assert all(len(line) <= roofline.WIDTH + 11 for line in picture)
    assert sum(line.count("a") for line in picture[1 : roofline.HEIGHT + 1]) == 1
    assert any("/" in line for line in picture)
    assert any("---" in line for line in picture[1 : roofline.HEIGHT + 1])
    assert [line.split() for line in legend] == [
        ["part", "arithmetic", "a", "byte", "GMAC/s", "roof", "of", "it", "limit"],
        ["a", "feed_forward_in", "int8", "0.5", "0.5", "0.5", "100%", "memory"],
        ["b", "attention", "bfloat16", "20.0", "0.5", "2.0", "25%", "arithmetic"],
    ]
    # A point on its roof stands on the line: above it there is nothing.
    plane = roofline.Range.of(MACHINE, shown)
    column = 11 + plane.column(0.5)
    above = [line[column] for line in picture[1 : roofline.HEIGHT - plane.row(5e8)] if len(line) > column]
    assert set(above) <= {" "}
    assert roofline.text(MACHINE, []) == ["no part has both multiply-adds and bytes"]


SMALL = ("--precisions", "float32", "--rounds", "1", "--num-vl-tokens", "5", "--num-threads", "1")


def test_the_program_draws_the_roofline(
    capsys: pytest.CaptureFixture[str], folder: Path, tmp_path: Path
) -> None:
    pytest.importorskip("matplotlib")
    image = tmp_path / "roofline.png"
    assert roofline.main(["--checkpoint", str(folder), *SMALL, "--figure", str(image)]) == 0
    text = capsys.readouterr().out
    assert "float32 encode, roofline" in text
    assert "float32 sample, roofline" in text
    assert image.read_bytes().startswith(b"\x89PNG")


def test_the_program_compares_the_model_with_times(
    capsys: pytest.CaptureFixture[str], folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cost, "VARIED", {"num_steps": (1, 2), "num_vl_tokens": (3,)})
    assert cost.main(["--checkpoint", str(folder), *SMALL]) == 0
    first, *lines = capsys.readouterr().out.splitlines()
    here = Machine.measured(saccade.show_config("dicts")["isa"], 1)
    assert first.endswith(f"efficiency as on {measured_like(here).cpu}")
    assert [line.split()[:4] for line in lines[2:]] == [
        [varied, value, "float32", call]
        for varied, value in (("num_steps", "1"), ("num_steps", "2"), ("num_vl_tokens", "3"))
        for call in ("encode", "sample")
    ]
