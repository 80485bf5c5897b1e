"""saccade inspect: its numbers compared with independent computations, unusual findings, and its output."""

from __future__ import annotations

import dataclasses
import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

import saccade
from saccade import _saccade, cli
from saccade.checkpoints import quantize
from saccade.checkpoints.findings import Counts, Inspection, Part, in_order, part_of
from saccade.checkpoints.initialisation import Draw, distance, draw, is_as_drawn, sample
from saccade.checkpoints.inspection import inspect
from saccade.checkpoints.survey import robust_z, token_statistics
from saccade.errors import CheckpointError
from saccade_lab.reference import random_weights
from saccade_lab.reference.random_weights import CONFIGS, whole_config
from tests.helpers import layout_heads, layouts
from tests.helpers.reference_cases import small_config

#: Of the fork's head, at published sizes: counted by hand from the released code's shapes.
N15_PARTS = {
    "DiT blocks": (224, 541_335_552),
    "timestep encoder": (4, 2_755_584),
    "output projections": (4, 6_295_552),
    "VL self-attention": (64, 201_433_088),
    "vlln": (2, 4_096),
    "state encoder": (4, 52_510_720),
    "action encoder": (6, 228_212_736),
    "action decoders": (4, 34_636_800),
    "future tokens": (1, 49_152),
    "positions": (1, 1_572_864),
}


def published_parts(kind: str) -> dict[str, Part]:
    """Parameters by part of a head with the sizes of the published one."""
    shapes = _saccade.tensor_shapes(json.dumps(whole_config(CONFIGS[kind])))
    counted: dict[str, Part] = {}
    for name, shape in shapes:
        part = counted.setdefault(part_of(name), Part())
        part.tensors += 1
        part.parameters += math.prod(shape)
    return in_order(counted)


def test_parts_add_up_to_the_published_heads() -> None:
    parts = published_parts("n1.5")
    assert {name: (part.tensors, part.parameters) for name, part in parts.items()} == N15_PARTS
    totals = {
        kind: sum(part.parameters for part in published_parts(kind).values())
        for kind in ("n1.5", "n1.6", "n1.7")
    }
    assert totals == {"n1.5": 1_068_806_144, "n1.6": 1_418_624_000, "n1.7": 1_620_515_968}
    fork = sum(part.parameters for part in published_parts("fork").values())
    assert fork + 2 == 1_101_868_546  # and the two logarithms of loss weights
    for kind in ("n1.6", "n1.7"):
        transformer = ("DiT blocks", "timestep encoder", "output projections")
        assert sum(published_parts(kind)[name].parameters for name in transformer) == 1_091_722_240


@pytest.fixture(scope="module")
def base(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """As NVIDIA's: three embodiments trained."""
    return layouts.write(tmp_path_factory.mktemp("base") / "GR00T", "nvidia", trained=[17, 24, 26])


@pytest.mark.parametrize("layout", ["nvidia", "fork", "n1", "n17"])
@pytest.mark.parametrize("precision", ["float32", "bfloat16", "int8", "int4"])
def test_memory_is_what_a_head_holds(tmp_path: Path, layout: str, precision: str) -> None:
    folder = layouts.write(tmp_path / layout, layout)
    memory = inspect(folder).memory[precision]
    assert memory.all == saccade.ActionHead.from_pretrained(folder, precision=precision).nbytes
    assert (
        memory.one
        == saccade.ActionHead.from_pretrained(folder, precision=precision, embodiment_ids=[4]).nbytes
    )


@pytest.mark.parametrize("isa", _saccade.available_isas())
def test_memory_on_every_instruction_set_and_of_an_int8_checkpoint(
    base: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, isa: str
) -> None:
    quantize(base, tmp_path / "int8")
    monkeypatch.setenv("SACCADE_ISA", isa)
    for precision, memory in inspect(tmp_path / "int8").memory.items():
        assert memory.all == saccade.ActionHead.from_pretrained(tmp_path / "int8", precision=precision).nbytes


def test_the_report_of_a_checkpoint(base: Path) -> None:
    tensors = layouts.read(base, "action_head.")
    reported: list[tuple[int, int]] = []
    report = inspect(base, progress=lambda done, total: reported.append((done, total)))
    assert report.parameters == sum(tensor.numel() for tensor in tensors.values())
    assert sum(part.tensors for part in report.parts.values()) == len(tensors)
    assert sum(part.nbytes for part in report.parts.values()) == sum(t.nbytes for t in tensors.values())
    assert report.parts["VL self-attention"].dtypes == {"BF16": 32}
    assert report.outside == {"backbone": Counts(tensors=2, nbytes=2 * 6 * 8 * 2)}
    assert reported[-1][0] == reported[-1][1] == sum(tensor.nbytes for tensor in tensors.values())
    assert len(reported) == len(tensors)
    assert report.odd == []
    json.dumps(dataclasses.asdict(report), allow_nan=False)  # nothing in it needs a converter


def test_which_embodiments_look_trained(base: Path) -> None:
    tensors = layouts.read(base, "action_head.")
    entries = inspect(base).embodiments
    assert [entry.id for entry in entries if entry.weights == "trained"] == [17, 24, 26]
    assert {entry.weights for entry in entries if entry.id not in (17, 24, 26)} == {"as initialised"}
    assert entries[31].names == ["new_embodiment"]
    assert entries[26].names[0] == "agibot_genie1"
    squares = sum(t.double().square().sum((1, 2) if t.ndim == 3 else 1)
                  for name, t in tensors.items() if name.endswith((".W", ".b")))  # fmt: skip
    norms = torch.as_tensor(squares).sqrt()
    np.testing.assert_allclose([entry.norm for entry in entries], norms, rtol=1e-12)
    median = norms.quantile(0.5)
    expected = (norms - median) / (1.4826 * (norms - median).abs().quantile(0.5))
    scores = np.array([entry.robust_z for entry in entries], np.float64)
    np.testing.assert_allclose(scores, expected, rtol=1e-9, atol=1e-9)


def test_robust_z_of_equal_numbers_is_none() -> None:
    assert robust_z(np.zeros(5)) is None


def test_statistics_of_future_tokens_beside_torch() -> None:
    tokens = torch.randn(13, 37, generator=torch.Generator().manual_seed(1))
    tokens[5] = 3 * tokens[2] + 0.1 * tokens[5]
    found = token_statistics(tokens.numpy())
    wide = tokens.double()
    norms = wide.norm(dim=1)
    cosines = nn.functional.cosine_similarity(wide[:, None], wide[None], dim=2)
    pairs = cosines[torch.ones(13, 13).triu(1) > 0]
    shares = torch.linalg.svdvals(wide) / torch.linalg.svdvals(wide).sum()
    for name, values in (("norm", norms), ("cosine", pairs)):
        expected = [values.mean(), values.min(), values.max()]
        np.testing.assert_allclose(
            list(vars(getattr(found, name)).values()), [float(value) for value in expected], rtol=1e-12
        )
    assert math.isclose(found.effective_rank, math.exp(torch.special.entr(shares).sum()), rel_tol=1e-12)
    assert math.isclose(found.std, wide.std(correction=0), rel_tol=1e-7)
    assert (found.count, found.identical, found.zero) == (13, [], [])


def test_tokens_that_are_not_distinct() -> None:
    one = np.ones((1, 6), np.float32)
    found = token_statistics(np.concatenate([one, 0 * one, one, 2 * one, 0 * one]))
    assert found.identical == [[0, 2], [1, 4]]
    assert found.zero == [1, 4]
    assert math.isclose(found.effective_rank, 1.0, rel_tol=1e-12)
    alone = token_statistics(one)
    assert alone.cosine is None
    assert token_statistics(0 * one).effective_rank == 0.0


def test_the_distance_is_that_of_kolmogorov_and_smirnov() -> None:
    """Against scipy, and against the definition written out."""
    stats = pytest.importorskip("scipy.stats")
    values = np.random.default_rng(3).standard_normal(5000)
    ours = distance(values, Draw("normal", 1.1))
    assert math.isclose(ours, stats.kstest(values, "norm", args=(0, 1.1)).statistic, abs_tol=1e-6)
    ours = distance(values, Draw("uniform", 2.0))
    assert math.isclose(ours, stats.kstest(values, "uniform", args=(-2, 4)).statistic, abs_tol=1e-12)
    assert distance(np.array([0.0, 0.0, 1.0, 0.0]), Draw("constant", 0.0)) == 0.25


def fresh_modules() -> dict[str, Tensor]:
    """Tensors of torch's own constructors, under names of the head."""
    torch.manual_seed(4)
    linear, norm = nn.Linear(96, 200), nn.LayerNorm(64)
    embedding = nn.Embedding(40, 96)
    nn.init.normal_(embedding.weight, mean=0.0, std=0.02)
    return {
        "model.transformer_blocks.0.attn1.to_q.weight": linear.weight.detach(),
        "model.transformer_blocks.0.norm1.linear.weight": linear.weight.detach(),
        "vl_self_attention.transformer_blocks.0.norm1.weight": norm.weight.detach(),
        "vl_self_attention.transformer_blocks.0.norm3.bias": norm.bias.detach(),
        "vlln.weight": norm.weight.detach(),
        "future_tokens.weight": embedding.weight.detach(),
        "state_encoder.layer1.W": 0.02 * torch.randn(64, 96),
        "state_encoder.layer1.b": torch.zeros(96),
    }


@pytest.mark.parametrize("name", fresh_modules())
def test_what_torch_constructs_is_as_drawn_and_anything_else_is_not(name: str) -> None:
    tensor = fresh_modules()[name]
    drawn = draw(name, inputs=96)

    def verdict(values: Tensor) -> bool | None:
        return is_as_drawn(sample(values.float().numpy()), drawn)

    assert verdict(tensor) is True
    if drawn.kind != "constant":
        assert verdict(tensor.bfloat16()) is True
    assert verdict(tensor * 1.2 + 0.01) is False
    if drawn.kind == "uniform":
        spread = drawn.scale / math.sqrt(3.0)  # the standard deviation, of another distribution
        assert verdict(torch.randn(200, 96) * spread) is False


def test_too_few_numbers_are_not_judged() -> None:
    assert is_as_drawn(np.zeros(100), Draw("normal", 0.02)) is None


def sides(report: Inspection) -> dict[str, str]:
    """Of each sentence's first words, the side that it is on."""
    return {
        sentence.partition(":")[0]: side for side, given in report.from_noise.items() for sentence in given
    }


def test_evidence_on_a_checkpoint_as_the_constructors_left_it(tmp_path: Path) -> None:
    report = inspect(layouts.write(tmp_path / "fork", "fork", fresh=True))
    assert set(sides(report).values()) == {"for"}
    assert {"DiT blocks", "VL self-attention", "future tokens"} <= set(sides(report))
    assert report.future_tokens is not None
    assert report.future_tokens.as_drawn is True
    for part in report.parts.values():
        assert part.as_drawn == part.judged


def test_evidence_on_a_trained_checkpoint(base: Path) -> None:
    assert set(sides(inspect(base)).values()) == {"against"}


def test_a_reference_of_another_version(base: Path, tmp_path: Path) -> None:
    other = layouts.write(tmp_path / "n17", "n17")
    with pytest.raises(saccade.InputError, match=r"n17 is of GR00T N1\.7, expected N1\.5"):
        inspect(base, reference=other)


def test_tokens_that_are_not_finite(tmp_path: Path) -> None:
    folder = layouts.write(tmp_path / "odd", "saccade")
    tensors = load_file(folder / "model.safetensors")
    tensors["action_head.future_tokens.weight"][0, 0] = torch.nan
    save_file(tensors, folder / "model.safetensors")
    assert inspect(folder).odd == ["future_tokens.weight contains 1 values that are NaN or infinite"]


def fine_tuned(base: Path, folder: Path, tensors: dict[str, Tensor] | None = None) -> Path:
    """A fork's checkpoint that started from `base`: a little training, one more embodiment, new decoders."""
    config = layout_heads.head_config("fork")
    own = layout_heads.head_tensors(config, seed=9, trained=[31])
    start = layouts.read(base, "action_head.")
    generator = torch.Generator().manual_seed(2)
    for name, tensor in start.items():
        if name not in own:
            continue
        if name.endswith((".W", ".b")):
            own[name] = torch.cat([tensor[:31].float(), own[name][31:]])
        else:
            own[name] = tensor.float() * (1 + 0.01 * torch.randn(tensor.shape, generator=generator))
    return layouts.write(folder, "fork", config=config, tensors=own | (tensors or {}))


def test_beside_the_checkpoint_that_it_was_trained_from(base: Path, tmp_path: Path) -> None:
    report = inspect(fine_tuned(base, tmp_path / "kept"), reference=base)
    found = report.reference
    assert found is not None
    state = found.parts["state encoder"]
    assert state.identical == state.compared - 2  # all but the weights of one embodiment
    cosine = found.parts["DiT blocks"].cosine
    assert cosine is not None
    assert cosine.min > 0.999
    assert found.parts["DiT blocks"].largest_change == pytest.approx(0.01, rel=0.1)
    assert found.different_shapes == []
    assert {name.partition(".")[0] for name in found.not_in_reference} == {
        "action_arm_decoder",
        "action_claw_decoder",
        "task_log_sigma",
    }
    assert sides(report)["DiT blocks compared with the reference"] == "against"
    assert sides(report)["state encoder compared with the reference"] == "against"


def test_beside_a_checkpoint_that_was_dropped(base: Path, tmp_path: Path) -> None:
    """64 tokens where the checkpoint had 32, everything dropped, then trained."""
    config = layout_heads.head_config("fork") | {"num_target_vision_tokens": 64}
    folder = layouts.write(tmp_path / "dropped", "fork", config=config, seed=9, trained=[31])
    report = inspect(folder, reference=base)
    assert sides(report)["DiT blocks compared with the reference"] == "for"
    assert sides(report)["embodiment 24 (gr1), which NVIDIA trained"] == "for"
    assert report.reference is not None
    assert report.reference.different_shapes == ["future_tokens.weight: (64, 96), in the reference (32, 96)"]
    assert any("64 future tokens" in sentence for sentence in report.from_noise["neither"])


def test_what_is_odd(base: Path, tmp_path: Path) -> None:
    tokens = layouts.read(base, "action_head.")["future_tokens.weight"].clone()
    tokens[3] = tokens[7]
    tokens[9] = 0.0
    zeros = torch.zeros(96, 96)
    broken = torch.randn(384, 96)
    broken[0, :3] = torch.tensor([math.nan, math.inf, -math.inf])
    odd = {
        "future_tokens.weight": tokens,
        "model.transformer_blocks.1.attn1.to_q.weight": zeros,
        "model.transformer_blocks.2.ff.net.0.proj.weight": broken,
    }
    report = inspect(fine_tuned(base, tmp_path / "odd", odd))
    assert report.odd == [
        "every value of model.transformer_blocks.1.attn1.to_q.weight is 0",
        "model.transformer_blocks.2.ff.net.0.proj.weight contains 3 values that are NaN or infinite",
        "future tokens 3, 7 are identical",
        "future token 9 is zero",
    ]


def test_embodiments_whose_layers_are_zero(base: Path, tmp_path: Path) -> None:
    folder = layouts.write(tmp_path / "few", "saccade", trained=[17])
    tensors = load_file(folder / "model.safetensors")
    for name, tensor in tensors.items():
        if name.endswith((".W", ".b")):
            tensor[[2, 5]] = 0.0
    save_file(tensors, folder / "model.safetensors")
    report = inspect(folder)
    assert [entry.id for entry in report.embodiments if entry.weights == "zero"] == [2, 5]
    assert report.odd == [
        "the layers of 2 embodiments are zero, as after saccade convert: 2, 5",
    ]


def test_a_checkpoint_that_does_not_load_is_not_inspected(base: Path, tmp_path: Path) -> None:
    folder = fine_tuned(base, tmp_path / "more", {"surprise": torch.zeros(3)})
    with pytest.raises(CheckpointError, match="surprise is unknown"):
        inspect(folder)


def run(*arguments: str | Path) -> int:
    return cli.main(["inspect", *map(str, arguments)])


def test_the_command_prints_json(base: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(base, "--json") == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["version"], report["layout"]) == ("n1.5", "nvidia")


def test_the_command_prints_tables(base: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(fine_tuned(base, tmp_path / "fork"), "--reference", base) == 0
    printed = capsys.readouterr().out
    for words in (
        "GR00T N1.5",
        "action_arm_decoder 4, action_claw_decoder 2",
        "width of an action while denoised  8",
        "27 to 30",
        "a random draw",
        "Evidence on",
        "task_log_sigma",
    ):
        assert words in printed
    total = next(line for line in printed.splitlines() if line.strip().startswith("head "))
    assert (
        f"{sum(t.numel() for t in layouts.read(tmp_path / 'fork', '_groot_model.action_head.').values()):,}"
        in total
    )


def test_without_rich_the_columns_are_plain(base: Path) -> None:
    program = (
        "import sys; sys.modules['rich'] = None\n"
        "from saccade import cli\n"
        f"sys.exit(cli.main(['inspect', {str(base)!r}]))"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert "Embodiments" in result.stdout
    assert "DiT blocks" in result.stdout
    assert result.stderr == ""


def test_bad_input_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(tmp_path / "nothing") == 2
    assert run("nvidia/no-such-model") == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 2
    assert "hf download nvidia/no-such-model" in lines[1]


@pytest.mark.parametrize("to", ["int8", "int4"])
def test_a_quantised_checkpoint_is_inspected_by_its_values(to: str, tmp_path: Path) -> None:
    """Also where rows have an odd number of weights, and a byte of int4 is half empty."""
    config = small_config(num_heads=2, head_dim=33, context_dim=62, hidden_dim=51)
    source, out, again = tmp_path / "source", tmp_path / to, tmp_path / "again"
    source.mkdir()
    random_weights.write_checkpoint(source, config, seed=1)
    quantize(source, out, to=to)
    quantize(source, again, to=to)
    expected, report = inspect(source), inspect(out, reference=again)
    scales = dict.fromkeys(expected.parts, 0)
    for tensor in report.tensors:
        if tensor.name.endswith("_scale"):
            scales[part_of(tensor.name.removeprefix(report.prefix))] += tensor.shape[0]
    assert {name: part.parameters - scales[name] for name, part in report.parts.items()} == {
        name: part.parameters for name, part in expected.parts.items()
    }
    shapes = {tensor.name: tensor.shape for tensor in report.tensors}
    assert {tensor.name: shapes[tensor.name] for tensor in expected.tensors} == {
        tensor.name: tensor.shape for tensor in expected.tensors
    }
    assert report.reference is not None
    assert report.reference.different_shapes == []
    assert all(part.identical == part.compared for part in report.reference.parts.values())
    # Against the source, values differ by what rounding changes.
    compared = inspect(out, reference=source).reference
    assert compared is not None
    assert compared.different_shapes == []
    largest = max(part.largest_change for part in compared.parts.values())
    assert 0 < largest < (0.02 if to == "int8" else 0.3)
    json.dumps(dataclasses.asdict(report), allow_nan=False)
