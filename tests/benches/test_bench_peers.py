"""The benchmark of peers: all compute the same, runs continue where they stopped, docs have the results."""

from __future__ import annotations

import argparse
import importlib
import json
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import saccade
from benches.cost import predict
from benches.peers import __main__ as command
from benches.peers import figures, goals, inputs, processes, report, text
from benches.peers.cases import COST, Case, exact_macs
from benches.peers.contenders import CONTENDERS, GROUPS, able
from benches.peers.engines import Task
from benches.peers.floors import floor, limits, machine_of
from benches.peers.machine import describe, family_name
from benches.peers.processes import difference
from benches.peers.results import Results, records
from benches.peers.throughput import throughput
from saccade_lab.reference.random_weights import sized_config
from saccade_lab.timing import Call, quartiles

N15 = saccade.HeadConfig.from_dict(sized_config("n1.5"))


def test_exact_work_at_the_released_size() -> None:
    macs = exact_macs(N15, Case("head", 1))
    # By hand: 61.0 G for the VL self-attention, 14.9 G for the keys and values of the cross blocks;
    # 81.4 G of linear layers and 1.7 G of attention in four steps, less 3.1 G that the last block saves.
    assert macs["encode"] == pytest.approx(61.0e9 + 14.9e9, rel=2e-3)
    assert macs["sample"] == pytest.approx(81.4e9 + 1.7e9 - 3.1e9, rel=1e-2)
    assert macs["both"] == macs["encode"] + macs["sample"]


def test_exact_work_grows_with_observations_samples_and_steps() -> None:
    one = exact_macs(N15, Case("head", 1))
    assert exact_macs(N15, Case("head", 1, batch=8))["both"] == 8 * one["both"]
    eight = exact_macs(N15, Case("head", 1, samples=8))
    assert eight["encode"] == one["encode"]
    assert 7.9 * one["sample"] < eight["sample"] < 8 * one["sample"]  # the state row is computed once
    cost = exact_macs(N15, Case("cost", 1))
    assert cost["sample, samples 8"] == eight["sample"]
    assert cost["sample, T_vl 296"] == cost["sample, N 32"] == cost["sample, steps 4"] == one["sample"]
    assert cost["encode, T_vl 296"] == one["encode"]


def test_quartiles() -> None:
    assert quartiles([3.0]) == (3.0, 3.0, 3.0)
    assert quartiles([4.0, 1.0, 3.0, 2.0, 5.0]) == (2.0, 3.0, 4.0)


def test_a_straight_line() -> None:
    slope, start, fit = figures.straight([(0.0, 1.0), (1.0, 3.0), (2.0, 5.0)])
    assert (slope, start, fit) == pytest.approx((2.0, 1.0, 1.0))
    assert figures.straight([(0.0, 0.0), (1.0, 1.0), (2.0, 0.0)])[2] == pytest.approx(0.0)


ENGINES = {
    "saccade_head": [{"precision": "float32"}],
    "pytorch": [{"arithmetic": "float32"}, {"arithmetic": "bfloat16"}, {"arithmetic": "autocast"}],
    "lerobot": [{"arithmetic": "float32"}, {"arithmetic": "autocast"}, {"arithmetic": "bfloat16"}],
    "onnx_runtime": [{"arithmetic": "float32"}, {"arithmetic": "int8"}],
    "open_vino": [{"arithmetic": "float32"}, {"arithmetic": "bfloat16"}],
}
PACKAGES = {"onnx_runtime": "onnxruntime", "open_vino": "openvino", "lerobot": "lerobot"}


@pytest.mark.parametrize(
    ("engine", "options"),
    [(engine, options) for engine, settings in ENGINES.items() for options in settings],
    ids=str,
)
@pytest.mark.parametrize("piece", ["head", "blocks", "cross", "throughput", "cost"])
def test_every_engine_computes_what_the_reference_does(
    engine: str, options: dict[str, Any], piece: str, tmp_path: Path
) -> None:
    if engine in PACKAGES:
        pytest.importorskip(PACKAGES[engine], reason="in the environment of make bench-peers")
    if not any(piece in c.pieces for c in CONTENDERS.values() if c.engine == engine):
        pytest.skip(f"{engine} has no piece {piece}")
    samples = 1 if piece in ("blocks", "throughput", "cost") else 3
    batch = 1 if piece == "cost" else 2
    case = Case(piece, 1, 7, 5, batch=batch, samples=samples, steps=3, size="small")
    arrays = inputs.expected_of(case, tmp_path)
    task = Task(case, options, inputs.checkpoint(case, tmp_path), arrays, tmp_path)
    built = importlib.import_module(f"benches.peers.engines.{engine}").build(task)
    error, scale = difference(built.result(), arrays["expected"])
    allowed = 1e-5 if "float32" in options.values() else 0.03
    assert 0.0 <= error <= allowed * scale
    assert set(built.works) <= set(case.works)
    for work in built.works.values():
        work()


def test_a_wrong_result_is_refused() -> None:
    np = importlib.import_module("numpy")
    with pytest.raises(ValueError, match="shape"):
        difference(np.zeros(3), np.zeros(4))
    with pytest.raises(ValueError, match="finite"):
        difference(np.array([np.nan]), np.zeros(1))
    assert difference(np.array([1.0, 2.0]), np.array([1.5, -4.0])) == (6.0, 4.0)


CASE = Case("head", 2)


def measured(path: Path) -> Results:
    """Two records of the whole head: float32 in both, saccade's bfloat16 and int8 in one."""
    results = Results(path)
    results.data["machine"] = {
        "cpu": "Some CPU",
        "name": "Some CPU",
        "family": "family 1, model 2",
        "isa": "avx512",
        "isas": ["portable", "avx512"],
        "cores": 2,
        "memory_gb": 24,
        "kernel": "6.1",
        "flags": ["fma"],
        "versions": {"torch": "2"},
        "commit": "abc",
    }
    rates = {"avx512": {"float32": 1e11, "bfloat16": 2e11, "int8": 4e11}}
    results.data["peaks"] = [{"threads": 2, "macs_per_second": rates, "read_bytes_per_second": 2e10}]
    for scale in (1.0, 2.0):
        record = results.open(CASE)
        times = {"saccade-float32": 1.6, "lerobot-float32": 6.4, "openvino-float32": 1.5}
        if scale == 2.0:
            times = {"saccade-float32": 1.6, "saccade-bfloat16": 0.8, "torch-bfloat16": 1.0}
        for name, both in times.items():
            seconds = {"encode": [0.5 * both * scale], "sample": [0.5 * both * scale]}
            record["contenders"][name] = {"error": 1e-6, "scale": 4.0, "notes": "", "seconds": seconds}
    return results


def test_ratios_are_of_rounds_done_in_turn(tmp_path: Path) -> None:
    results = measured(tmp_path / "results.json")
    # saccade's two times differ, since the machine was slower in the second run: the ratio does not see it.
    assert results.ratios(CASE, "lerobot-float32", "saccade-float32", "both") == [4.0]
    assert results.ratio(CASE, "saccade-bfloat16", "saccade-float32", "both") == (0.5, 0.5, 0.5)
    # Never in one run: all pairs of their times.
    assert results.ratio(CASE, "lerobot-float32", "saccade-bfloat16", "both") == (4.0, 4.0, 4.0)
    assert results.ratio(CASE, "ggml-int8", "saccade-bfloat16", "both") is None


def test_results_survive_the_file(tmp_path: Path) -> None:
    results = measured(tmp_path / "folder" / "results.json")
    results.save()
    again = Results(results.path)
    assert again.data == json.loads(json.dumps(results.data))
    assert again.rounds(CASE, "saccade-float32") == 2
    assert again.rounds(CASE, "torch-float32") == 0
    results.path.write_text('{"format": 0}')
    with pytest.raises(SystemExit, match="format 0"):
        Results(results.path)


def batches(results: Results, case: Case, *arguments: str) -> list[list[str]]:
    """The batches that a command line leads to."""
    args = command.parse(list(arguments))
    return command.batches(results, case, args, args.contenders)


def test_batches_fit_into_memory_and_begin_with_the_first_of_their_group(tmp_path: Path) -> None:
    results = Results(tmp_path / "results.json")
    found = batches(results, CASE, "--memory", "10")
    assert {name for batch in found for name in batch} == {
        name for name, one in CONTENDERS.items() if one.usual and "head" in one.pieces
    }
    for batch in found:
        assert command.gigabytes(CASE, batch) <= 10
        assert batch[0] in [next(iter(group)) for group in GROUPS.values()]
    # Of parts of the head all fit at once, a batch an arithmetic.
    assert len(batches(results, replace(CASE, piece="cross"), "--memory", "12")) == len(GROUPS)


def test_what_is_done_is_not_started_again(tmp_path: Path) -> None:
    results = measured(tmp_path / "results.json")
    names = ["--contenders", "saccade-float32", "lerobot-float32", "torch-float32"]
    assert batches(results, CASE, *names, "--rounds", "1") == [["saccade-float32", "torch-float32"]]
    assert batches(results, CASE, *names[:3], "--rounds", "1") == []
    assert batches(results, CASE, *names[:3], "--rounds", "2") == [["saccade-float32", "lerobot-float32"]]
    results.open(CASE)["contenders"]["torch-float32"] = {"failed": "it said no"}
    assert batches(results, CASE, *names, "--rounds", "1") == []


def test_a_contender_that_was_killed_is_started_again(tmp_path: Path) -> None:
    results = measured(tmp_path / "results.json")
    killed, crashed = processes.ended(-signal.SIGKILL), processes.ended(-signal.SIGSEGV)
    assert isinstance(killed, processes.KilledError)
    assert not isinstance(crashed, processes.KilledError)
    names = ["--contenders", "saccade-float32", "torch-float32"]
    entries = results.open(CASE)["contenders"]
    entries["torch-float32"] = {"killed": str(killed)}
    assert batches(results, CASE, *names, "--rounds", "1") == [["saccade-float32", "torch-float32"]]
    assert f"{CONTENDERS['torch-float32'].label}: the process was killed by signal 9" in report.document(
        results
    )
    # As many rounds as it had before count.
    entries["saccade-float32"] = {"killed": str(killed)}
    assert batches(results, CASE, *names[:2], "--rounds", "2") == []
    assert batches(results, CASE, *names[:2], "--rounds", "3") == [["saccade-float32"]]


def test_the_report_of_known_numbers(tmp_path: Path) -> None:
    results = measured(tmp_path / "results.json")
    rows = [line for line in report.overview(results).splitlines() if line.startswith("| saccade bf")]
    assert rows == ["| saccade bfloat16 | 1600 | 800 | 1e-06 |"]
    rows = goals.goals(results).splitlines()
    assert any(
        "float32, encode + sample" in line and "4.00 x" in line and "exceeded" in line for line in rows
    )
    assert any("float32, sample" in line and "**no**" in line for line in rows)
    # Of float32 OpenVINO is the faster one (1.5 s and 1.6 s in turn); torch in bfloat16 is not.
    assert report.faster_peers(results).count("OpenVINO float32") == 3
    assert "torch" not in report.faster_peers(results)
    page = report.document(results)
    # 156 G at 100 G/s over 1.6 s and 3.2 s, whose median is 2.4 s. Reading is the limit of the state encoder
    # alone: 20 GB/s are a weight in the time of 20 multiply-adds, and most layers have 49 rows or more.
    least = exact_macs(N15, CASE)["both"] / 1e11
    assert floor(results, CASE, "lerobot-float32") == pytest.approx(least, rel=0.03)
    assert f"| {100 * least / 2.4:.0f} % |" in page
    assert "Some CPU" in page


def test_throughput_of_known_numbers(tmp_path: Path) -> None:
    results = measured(tmp_path / "results.json")
    results.data["machine"]["isa"] = "amx"
    rates = {"float32": 1e11, "bfloat16": 2e12, "int8": 4e12}
    results.data["peaks"] = [
        {"threads": threads, "macs_per_second": {"amx": rates}, "read_bytes_per_second": 2e10}
        for threads in (1, 2)
    ]
    for threads, batch, both in [(1, 1, 1.0), (1, 32, 8.0), (2, 1, 0.8), (2, 32, 4.0)]:
        record = results.open(Case("throughput", threads, batch=batch))
        seconds = {"encode": [0.5 * both], "sample": [0.5 * both]}
        record["contenders"]["saccade-int8"] = {"error": 1e-3, "scale": 4.0, "notes": "", "seconds": seconds}
    lines = "\n".join(throughput(results)).splitlines()
    assert "| saccade int8 | 1 |  | 4 | 4.00 x |" in lines
    assert "| saccade int8 | 1.25 |  | 8 | 6.40 x |" in lines
    assert "| saccade int8 | 32 | 4 (1.00 x) | 8 (2.00 x) |" in lines
    rows = [row for row in goals.goals(results).splitlines() if "batch 32" in row]
    assert [row.split(" | ")[1:] for row in rows] == [
        ["1 thread", "4.0 x", "4.00 x", "yes |"],
        ["2 threads", "4.0 x", "6.40 x", "yes |"],
    ]
    # One observation reads 415 M weights in a step; 32 multiply 32 times as often and read the same weights.
    one, many = (limits(results, Case("throughput", 1, batch=batch), "saccade-int8") for batch in (1, 32))
    assert one is not None
    assert many is not None
    assert one[0] < one[1]
    assert many[0] == pytest.approx(32 * one[0], rel=1e-2)
    assert many[0] > many[1]


def test_names_of_families() -> None:
    assert family_name("Zen 4 (AuthenticAMD, family 25, model 17)") == "Zen 4"
    assert (
        family_name("unknown family (GenuineIntel, family 6, model 1)") == "GenuineIntel, family 6, model 1"
    )
    assert family_name("aarch64") == "aarch64"
    assert describe()["name"] == family_name(saccade.show_config("dicts")["family"])


def test_forced_instruction_sets_are_those_that_the_machine_does_not_choose() -> None:
    names = ["saccade-int8", "saccade-int8-avx2", "saccade-int8-avx512"]
    assert able(names, {"isa": "amx", "isas": ["avx2", "avx512", "amx"]}) == names
    assert able(names, {"isa": "avx512", "isas": ["avx2", "avx512"]}) == names[:2]
    assert able(names, {"isa": "neon", "isas": ["neon"]}) == names[:1]


def test_a_result_that_is_wrong_is_marked_and_not_ranked(tmp_path: Path) -> None:
    results = measured(tmp_path / "results.json")
    for entry in results.entries(CASE, "openvino-float32"):
        entry["error"] = 0.1
    assert "OpenVINO" not in report.faster_peers(results)
    assert "**not correct**" in report.section(results, CASE)


def test_figures_of_known_numbers(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    results = measured(tmp_path / "results.json")
    case = Case("cost", 2)
    record = results.open(case)
    seconds = {work: [0.001 * float(work.rpartition(" ")[2]) + 0.5] for work in case.works}
    record["contenders"]["saccade-int8"] = {"error": 0.1, "scale": 4.0, "notes": "", "seconds": seconds}
    figures.write_figures(results, tmp_path)
    assert (tmp_path / "performance-some-cpu.png").stat().st_size > 1000
    assert (tmp_path / "cost-some-cpu.png").stat().st_size > 1000
    lines = figures.cost_lines(results, case, "saccade-int8")
    assert set(lines) == {"encode, T_vl", *(f"sample, {name}" for name in COST)}
    assert all(figures.straight(points)[2] > 0.999 for points in lines.values())


@pytest.mark.parametrize("results", records(), ids=lambda results: results.slug)
def test_the_picture_shows_the_numbers_of_the_table(results: Results) -> None:
    """A median of sums is not the sum of medians, so the picture takes it from where the table does."""
    pytest.importorskip("matplotlib")
    cases = text.usual(results, "head")
    table = [line.split(" | ") for line in report.overview(results).splitlines()[2:] if line.startswith("| ")]
    both, sample = (
        {cells[0].removeprefix("| "): cells[start : start + len(cases)] for cells in table}
        for start in (1, 1 + len(cases))
    )
    panels = figures.head_figure(results).axes
    labels = [label.get_text() for label in panels[0].get_yticklabels()]
    for number, panel in enumerate(panels):
        drawn = {labels[round(one.get_position()[1])]: one.get_text().strip() for one in panel.texts}
        bars: Any = panel.patches
        ends = {(labels[round(bar.get_y() + bar.get_height() / 2)], round(bar.get_width())) for bar in bars}
        for label, cells in both.items():
            assert drawn[label] == cells[number]
            assert {(label, int(cells[number])), (label, int(sample[label][number]))} <= ends


def test_the_page_contains_what_was_measured() -> None:
    measured = records()
    assert "zen-5" in [results.slug for results in measured]
    for results in measured:
        assert results.cases
        assert results.path.name == f"{results.slug}.json"
        assert (report.IMAGES / f"performance-{results.slug}.png").exists()
    assert report.PAGE.read_text() == report.page(measured)


@pytest.mark.parametrize("slug", ["zen-5", "genuineintel-family-6-model-167"])
def test_the_cost_model_expects_what_was_measured(slug: str) -> None:
    (results,) = (results for results in records() if results.slug == slug)
    config = text.config(CASE)
    call = Call.of(config, CASE.num_vl_tokens, CASE.steps)
    names = [name for name in results.names(CASE) if name.startswith("saccade") and "refresh" not in name]
    assert len(names) >= 3
    for name in names:
        machine = machine_of(results, CASE, name)
        assert machine is not None
        for work, expected in predict(config, call, text.arithmetic(name), machine).items():
            assert quartiles(results.seconds(CASE, name, work))[1] == pytest.approx(expected, rel=0.15)


def test_a_run_is_kept_under_the_name_of_its_cpu(tmp_path: Path) -> None:
    results = measured(tmp_path / "results.json")
    command.keep(results, tmp_path / "record")
    other = measured(tmp_path / "other.json")
    other.data["machine"] |= {"name": "Other CPU, family 1", "isa": "amx"}
    for entry in other.entries(CASE, "saccade-bfloat16"):
        entry["seconds"] = {"encode": [0.1], "sample": [0.3]}
    command.keep(other, tmp_path / "record")
    empty = Results(tmp_path / "empty.json")
    command.keep(empty, tmp_path / "record")
    kept = records(tmp_path / "record")
    assert [one.path.name for one in kept] == ["other-cpu-family-1.json", "some-cpu.json"]
    (tmp_path / "record" / "some-cpu.md").write_text("## What it shows\n\nSome sentence.\n")
    page = report.page(kept)
    assert "CPUs measured: Other CPU, family 1; Some CPU. " in page
    assert page.index("## Other CPU, family 1") < page.index("## Some CPU") < page.index("### What it shows")
    assert "| saccade bfloat16 | 400 / 300 | 1600 / 800 |" in page


def test_targets_where_there_are_tiles(tmp_path: Path) -> None:
    results = measured(tmp_path / "results.json")
    results.data["machine"]["isa"] = "amx"
    rates = {"float32": 1e11, "bfloat16": 2e12, "int8": 4e12}
    results.data["peaks"] = [{"threads": 2, "macs_per_second": {"amx": rates}, "read_bytes_per_second": 2e10}]
    record = results.open(CASE)
    for name, both in {"saccade-float32": 2.0, "saccade-bfloat16": 0.4, "lerobot-bfloat16-pure": 1.2}.items():
        seconds = {"encode": [0.5 * both], "sample": [0.5 * both]}
        record["contenders"][name] = {"error": 1e-3, "scale": 4.0, "notes": "", "seconds": seconds}
    rows = goals.goals(results).splitlines()
    assert any(
        "lerobot 0.4.4 bfloat16, no autocast" in row and "3.00 x" in row and "| yes |" in row for row in rows
    )
    # An Euler step reads 415 M weights, 42 ms at 20 GB/s, and multiplies for 10 ms: reading is the floor.
    shortest = floor(results, CASE, "saccade-bfloat16")
    assert shortest is not None
    assert 4 * 0.041 < shortest < 4 * 0.041 + 0.12
    assert any("share of the floor" in row and "60 % (75 %)" in row for row in rows)
    # 156e9 multiply-adds take 1.56 s at 100 GMAC/s.
    float32 = "| saccade float32, encode + sample, share of the floor | 2 threads | 85 % | 78 % | **no** |"
    assert float32 in rows
    assert goals.reached(0.9, 0.85, None) == "yes"


@pytest.mark.parametrize("wrong", [["--contenders", "jax"], ["--rounds", "0"], ["--only", "backbone"]])
def test_wrong_options_are_refused(wrong: list[str]) -> None:
    with pytest.raises(SystemExit) as refused:
        command.parse(wrong)
    assert refused.value.code == 2


def test_help_names_every_contender(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        command.parse(["--help"])
    said = "".join(capsys.readouterr().out.split())
    assert all(name in said for name in CONTENDERS)
    assert isinstance(command.parse([]), argparse.Namespace)
