"""The benchmark of the whole policy: engines compute what the reference does, and the report is right."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benches.peers import __main__ as command
from benches.peers import machine, policy_inputs, policy_report
from benches.peers.cases import RELEASES, Case
from benches.peers.contenders import CONTENDERS, POLICY_GROUPS, PROCESSES
from benches.peers.engines import Task, vla_cpp
from benches.peers.processes import difference, sharing
from benches.peers.results import Results
from tests.benches.test_bench_peers_runs import ROOT, run, small

CASE = Case("policy", 2)
SMALL = {release: Case("policy", 1, size="small", release=release) for release in RELEASES}
PACKAGES = {
    "open_vino": ["onnxscript", "openvino"],
    "onnx_runtime": ["onnxscript", "onnxruntime"],
}
LEROBOT = {"n1.5": "0.4.4", "n1.7": "0.6.1"}
TOLERANCES = {"float32": 1e-5, "int4": 0.4}
"""By arithmetic, of others 0.04."""


@pytest.fixture(scope="module")
def work(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("policy")


def task_of(release: str, work: Path, options: Mapping[str, Any]) -> Task:
    case = SMALL[release]
    graphs = work / f"graphs-{release}"
    graphs.mkdir(exist_ok=True)
    arrays = policy_inputs.expected_of(case, work)
    return Task(case, dict(options), policy_inputs.source_of(case, work), arrays, graphs)


@pytest.mark.parametrize("release", RELEASES)
@pytest.mark.parametrize("name", [name for group in POLICY_GROUPS.values() for name in group])
def test_every_engine_computes_what_the_reference_does(name: str, release: str, work: Path) -> None:
    contender = CONTENDERS[name]
    if contender.engine == "lerobot_policy" and machine.version("lerobot") != LEROBOT[release]:
        pytest.skip(f"needs lerobot {LEROBOT[release]}")
    if "compiled" in contender.options:
        pytest.skip("takes minutes to compile")
    for package in PACKAGES.get(contender.options.get("opened_by", contender.engine), ()):
        pytest.importorskip(package, reason="in the environment of make bench-peers")
    if contender.engine == "vla_cpp":
        pytest.skip("vla.cpp has only the published size")
    task = task_of(release, work, contender.options)
    built = importlib.import_module(f"benches.peers.engines.{contender.engine}").build(task)
    error, scale = difference(built.result(), task.arrays["expected"])
    assert 0.0 < error <= TOLERANCES.get(name.rpartition("-")[2], 0.04) * scale
    assert tuple(built.works) == task.case.works
    for call in built.works.values():
        call()


def test_what_is_not_built_says_how(work: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SACCADE_PEERS_VLA", str(work / "nowhere"))
    task = task_of("n1.5", work, {"weights": "BF16"})
    with pytest.raises(FileNotFoundError, match="make bench-peers VLA_SOURCE"):
        vla_cpp.build(task)


@pytest.mark.parametrize("release", RELEASES)
def test_one_view_and_two_are_different_questions(release: str, work: Path) -> None:
    arrays = policy_inputs.expected_of(SMALL[release], work)
    one, two = (policy_inputs.given(arrays, views) for views in policy_inputs.VIEWS)
    assert len(two.pixels) == 2 * len(one.pixels)
    np.testing.assert_array_equal(one.pixels, two.pixels[: len(one.pixels)])
    assert one.ids.shape[1] < two.ids.shape[1]
    assert arrays["expected"].shape == (2, *one.noise.shape[1:])
    assert np.abs(arrays["expected"][0] - arrays["expected"][1]).max() > 1e-3


def measured(path: Path) -> Results:
    """Two rounds of a few contenders on 2 threads."""
    results = Results(path)
    results.data["machine"] = {
        "cpu": "Some CPU",
        "name": "Some CPU",
        "family": "family 1, model 2",
        "isa": "avx512",
        "cores": 2,
        "memory_gb": 24,
        "kernel": "6.1",
        "flags": ["fma"],
        "versions": {"torch": "2"},
        "commit": "abc",
    }
    rates = {"avx512": {"float32": 1e11, "bfloat16": 2e11, "int8": 4e11}}
    results.data["peaks"] = [{"threads": 2, "macs_per_second": rates, "read_bytes_per_second": 2e10}]
    contenders = results.open(CASE)["contenders"]
    for name, first, error in (
        ("policy-saccade-bfloat16", 1.0, 0.01),
        ("policy-saccade-int8", 0.5, 0.1),
        ("policy-lerobot-bfloat16-pure", 2.0, 0.05),
        ("policy-lerobot-bfloat16", 1.9, 0.05),
        ("policy-accelerate-bfloat16", 1.1, 0.05),
    ):
        seconds = {"1 view": [first, 2 * first], "2 views": [2 * first, 4 * first]}
        contenders[name] = {"error": error, "scale": 4.0, "notes": "", "seconds": seconds}
    contenders["policy-lerobot-float32"] = {"failed": "MemoryError: no"}
    return results


def test_the_report_of_known_numbers(tmp_path: Path) -> None:
    results = measured(tmp_path / "policy.json")
    rows = [row.split(" | ") for row in policy_report.goals(results).splitlines()[2:]]
    autocast = CONTENDERS["policy-lerobot-bfloat16"].label
    assert [(row[0], *row[1:]) for row in rows if "1 view" in row[0]] == [
        (
            "| images + instruction to a chunk, int8, 1 view",
            autocast,
            "2",
            "3.0 x (4.5 x)",
            "3.80 x (3.80 to 3.80)",
            "yes |",
        ),
        (
            "| images + instruction to a chunk, bfloat16, 1 view",
            autocast,
            "2",
            "1.7 x (2.5 x)",
            "1.90 x (1.90 to 1.90)",
            "yes |",
        ),
        (
            "| accelerate(policy, backbone=True), bfloat16, 1 view",
            autocast,
            "2",
            "1.6 x (2.3 x)",
            "1.73 x (1.73 to 1.73)",
            "yes |",
        ),
    ]
    policy_report.write(results, tmp_path)
    page = (tmp_path / "policy-report-n1.5.md").read_text()
    assert (
        "| saccade int8 | 750.0 (625.0 to 875.0) | 3.80 x | 1500 (1250 to 1750) | 3.80 x | 2.5e-02 |" in page
    )
    assert "- lerobot float32 could not run: MemoryError: no" in page
    assert "Peaks of 2 threads: float32 100, bfloat16 200, int8 400 GMAC/s, 20 GB/s." in page


def test_a_wrong_result_is_not_compared_with(tmp_path: Path) -> None:
    results = measured(tmp_path / "policy.json")
    for entry in results.entries(CASE, "policy-lerobot-bfloat16"):
        entry["error"] = 1.0
    for entry in results.entries(CASE, "policy-saccade-int8"):
        entry["error"] = 1.0
    rows = policy_report.goals(results).splitlines()[2:]
    assert all("no autocast" in row for row in rows)
    assert [row.endswith("**not correct** |") for row in rows] == [True, True, False, False, False, False]
    assert "2.5e-01, **not correct**" in "\n".join(policy_report.section(results, CASE))


@pytest.mark.parametrize(("seconds", "said"), [(1.8, True), (3.0, False)])
def test_it_is_said_where_lerobot_is_faster_in_float32(seconds: float, said: bool, tmp_path: Path) -> None:
    results = measured(tmp_path / "policy.json")
    results.open(CASE)["contenders"]["policy-lerobot-float32"] = {
        "error": 1e-6,
        "scale": 4.0,
        "notes": "",
        "seconds": {"1 view": [seconds] * 2, "2 views": [2 * seconds] * 2},
    }
    sentence = policy_report.faster_in_float32(results, CASE)
    assert bool(sentence) == said
    if said:
        assert "(1 view and 2 views): saccade bfloat16 ~1.35 x and ~1.35 x; saccade int8 ~2.70 x" in sentence
        assert sentence in policy_report.page([results])


def test_the_page_contains_what_was_measured() -> None:
    measured = policy_report.recorded()
    assert measured
    for results in measured:
        assert results.path.name == f"{results.slug}.json"
        assert results.path.parent.name == policy_report.release_of(results)
    assert policy_report.PAGE.read_text() == policy_report.page(measured)


def test_readme_has_the_table_of_the_records() -> None:
    measured = [results for results in policy_report.recorded() if results.cpu == "Zen 4"]
    assert [policy_report.release_of(results) for results in measured] == list(RELEASES)
    assert policy_report.overview(measured) in (ROOT / "README.md").read_text()


def test_frames_of_patches() -> None:
    """vla.cpp is given frames: what N1.7's patches were cut from, two by two, every value twice in time."""
    side, rows, columns = 16, 4, 6
    frames = np.random.default_rng(0).standard_normal((2, 3, rows * side, columns * side)).astype(np.float32)
    patches = [
        np.stack([frame[:, y : y + side, x : x + side]] * 2, axis=1).ravel()
        for frame in frames
        for top in range(0, rows * side, 2 * side)
        for left in range(0, columns * side, 2 * side)
        for y in (top, top + side)
        for x in (left, left + side)
    ]
    grids = np.array([[1, rows, columns]] * 2)
    np.testing.assert_array_equal(vla_cpp.unpatched(np.array(patches), grids), frames)


def test_what_matters_most_is_measured_together_and_first(tmp_path: Path) -> None:
    args = command.parse(["--only", "policy"])
    assert args.results == Path("out/peers/policy-n1.5.json")
    assert args.record == policy_report.RECORDS
    assert 2 in args.threads
    args.memory = 19.0
    found = command.batches(Results(tmp_path / "policy.json"), CASE, args, args.contenders)
    names = [goal.ours for goal in policy_report.GOALS] + list(policy_report.LEROBOT_BF16)
    assert set(names) <= set(found[0])
    for batch in found:
        assert command.gigabytes(CASE, batch) <= args.memory
    assert {name for batch in found for name in batch} == {
        name for group in POLICY_GROUPS.values() for name in group
    }
    for wrong in (["head"], ["--steps", "8"], ["--num-vl-tokens", "74"]):
        with pytest.raises(SystemExit):
            command.parse(["--only", "policy", *wrong])
    assert "policy" not in command.parse(["--full"]).only


def test_contenders_of_one_process_share_it() -> None:
    together = ("policy-lerobot-bfloat16-pure", "policy-lerobot-bfloat16")
    assert sharing([together[0], "policy-saccade-int8", together[1]]) == {
        together[0]: together,
        "policy-saccade-int8": ("policy-saccade-int8",),
    }


def test_shared_weights_count_once_and_for_whoever_is_left() -> None:
    pure, autocast, int8 = "policy-lerobot-bfloat16-pure", "policy-lerobot-bfloat16", "policy-saccade-int8"
    alone = [command.gigabytes(CASE, [name]) for name in (pure, autocast, int8)]
    assert min(alone[:2]) > PROCESSES["lerobot-bfloat16"]
    together = command.gigabytes(CASE, [pure, autocast, int8])
    assert together == pytest.approx(sum(alone) - PROCESSES["lerobot-bfloat16"])
    assert {one.process for one in CONTENDERS.values()} == {"", *PROCESSES}


def test_objects_of_files_of_the_same_name_are_kept_apart(tmp_path: Path) -> None:
    clone, environment, tools = tmp_path / "clone", tmp_path / "environment", tmp_path / "tools"
    sources = ("model.cpp", "modules/head.cpp", "models/head.cpp")
    for source in sources:
        (clone / "src" / source).parent.mkdir(parents=True, exist_ok=True)
        (clone / "src" / source).touch()
    for folder in (clone / "scripts", environment / "ggml" / "source/vendor/llama.cpp/gguf-py", tools):
        folder.mkdir(parents=True)
    # A compiler that writes nothing but what it was asked for.
    (tools / "c++").write_text(
        '#!/bin/sh\nall="$*"\nuntil [ "$1" = -o ]; do shift; done\necho "$all" > "$2"\n'
    )
    (tools / "c++").chmod(0o755)
    script = Path(command.__file__).with_name("build_vla.sh")
    path = f"{tools}:{os.environ['PATH']}"
    subprocess.run(["sh", script, environment, clone], check=True, env={"PATH": path})
    objects = list((environment / "vla" / "objects").iterdir())
    found = {source for source in sources for one in objects if f"src/{source}" in one.read_text()}
    assert found == set(sources)


def test_it_runs_and_goes_on_where_it_stopped(tmp_path: Path, known_peaks: None) -> None:
    pytest.importorskip("lerobot")
    names = ["policy-saccade-int8", "policy-lerobot-float32", "policy-lerobot-default"]
    chosen = ["--only", "policy", "--contenders", *names, "--rounds", "1"]
    chosen += ["--record", str(tmp_path / "record")]
    done = run(tmp_path, *chosen)
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "policy-n1.5.json").read_text())["records"]
    assert len(found) == 2
    assert command.main([*small(tmp_path), *chosen]) == 0
    assert json.loads((tmp_path / "policy-n1.5.json").read_text())["records"] == found
    entries: dict[str, Any] = {name: one for record in found for name, one in record["contenders"].items()}
    assert set(entries) == set(names)
    for entry in entries.values():
        assert {work: len(seconds) for work, seconds in entry["seconds"].items()} == {
            "1 view": 1,
            "2 views": 1,
        }
    assert (tmp_path / "policy-report-n1.5.md").exists()
    assert not (tmp_path / "record").exists()  # small sizes are not kept
