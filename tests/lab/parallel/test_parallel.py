"""Items of work in processes of this machine: those that die are repeated; and files for other machines."""

from __future__ import annotations

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from saccade._internal.arrays import UInt8Array
from saccade._internal.environment import arithmetic
from saccade.errors import InputError
from saccade_lab.files import path_text
from saccade_lab.parallel import ALONE, Lost, Workers, each, files
from saccade_lab.parallel.cluster import check_arithmetic
from tests.helpers.parallel_cases import Square

TWO = Workers(jobs=2)


def test_linked_directories_travel_and_circles_end(tmp_path: Path) -> None:
    (tmp_path / "policy" / ".cache").mkdir(parents=True)
    (tmp_path / "shared").mkdir()
    for name in ("policy/config.json", "policy/.cache/refs", "shared/metadata.json"):
        (tmp_path / name).write_text("{}")
    (tmp_path / "policy" / "experiment_cfg").symlink_to("../shared")
    (tmp_path / "shared" / "again").symlink_to("../shared")
    found = files.files_of(tmp_path / "policy")
    assert sorted(found) == ["policy/config.json", "policy/experiment_cfg/metadata.json"]


def test_a_machine_that_computes_other_bits_is_refused() -> None:
    here = arithmetic()
    check_arithmetic(here)
    check_arithmetic({**here, "library": "another build"})
    own = f"{here['instruction_set']} with dot products"
    for name, value, message in (
        (
            "saccade",
            "0.0.1",
            f"saccade: expected version 0.0.1 on every machine of the cluster, got {here['saccade']}",
        ),
        ("instruction_set", "sse9", "instructions: expected sse9 with dot products "),
        ("dot_products", [], f"instructions: expected {own} none on every machine of the cluster"),
        ("dot_products", ["vnni9"], f"instructions: expected {own} vnni9 on every machine of the cluster"),
    ):
        if here[name] == value:
            continue
        with pytest.raises(InputError) as error:
            check_arithmetic({**here, name: value})
        assert str(error.value).startswith(message)
        assert os.uname().nodename in str(error.value)


class Unreadable:
    """Cannot be unpickled in another process."""

    def __reduce__(self) -> tuple[Any, ...]:
        return (missing_file, ())

    def __call__(self, item: int) -> int:
        return item


def missing_file() -> None:
    """What `Unreadable` calls there."""
    raise FileNotFoundError("statistics are not on this machine")


def test_work_that_cannot_be_unpickled_is_no_death() -> None:
    with pytest.raises(Exception, match="un-serialize") as raised:
        list(each(Unreadable(), range(2), TWO))
    assert "statistics are not on this machine" in str(raised.value.__cause__)


def test_alone_is_in_this_process_and_in_order(tmp_path: Path) -> None:
    assert list(each(Square(tmp_path / "log"), [3, 1, 2], ALONE)) == [(3, 9), (1, 1), (2, 4)]
    assert {int(line.split()[0]) for line in (tmp_path / "log").read_text().splitlines()} == {os.getpid()}
    with pytest.raises(ValueError, match="cannot square 1"):
        list(each(Square(tmp_path / "log", fails=(1,)), [1], ALONE))


def test_no_piece_is_lost_when_processes_die(tmp_path: Path) -> None:
    work = Square(tmp_path / "log", dies_once=(2, 7))
    assert sorted(each(work, range(12), TWO)) == [(number, number**2) for number in range(12)]
    assert {work.attempts.count(number) for number in (2, 7)} == {2}


def test_a_piece_that_always_kills_its_process_is_given_up_and_no_other(tmp_path: Path) -> None:
    work = Square(tmp_path / "log", dies=(3,))
    found = dict(each(work, range(8), TWO))
    lost = found.pop(3)
    assert isinstance(lost, Lost)
    assert lost.reason.startswith("a worker process died in each of 4 attempts")
    assert work.attempts.count(3) == 4
    assert found == {number: number**2 for number in range(8) if number != 3}


def test_one_process_for_each_core_is_not_this_one_where_there_is_one_core(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("joblib.cpu_count", lambda: 1)
    work = Square(tmp_path / "log", dies_once=(2,))
    assert sorted(each(work, range(4), Workers(jobs=-1))) == [(number, number**2) for number in range(4)]
    processes = {int(line.split()[0]) for line in (tmp_path / "log").read_text().splitlines()}
    assert len(processes) == 2  # one at a time: the one that died, and the next
    assert os.getpid() not in processes


def test_a_caller_may_stop(tmp_path: Path) -> None:
    found: Any = each(Square(tmp_path / "log"), range(100), TWO)
    next(found)
    found.close()
    assert len(Square(tmp_path / "log").attempts) < 100
    assert sorted(each(Square(tmp_path / "other"), range(3), TWO)) == [(0, 0), (1, 1), (2, 4)]


def test_errors_of_the_work_are_raised(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="cannot square 1"):
        list(each(Square(tmp_path / "log", fails=(1,)), [0, 1], TWO))
    assert list(each(Square(tmp_path / "log"), [], TWO)) == []


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"backend": "dask"}, "backend: unknown name 'dask', expected one of loky, ray"),
        ({"jobs": 0}, "jobs: given 0, expected at least 1, or -1 for all cores"),
        ({"jobs": -2}, "jobs: given -2"),
        ({"address": "auto"}, "address: only with the backend ray, given loky"),
        ({"num_threads": 0}, "num_threads: given 0, expected at least 1"),
    ],
)
def test_bad_input(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Workers(**arguments)


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The cache of a machine, empty."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "machine"))
    (tmp_path / "machine").mkdir()
    return files.cache_directory()


def test_a_directory_arrives_as_it_was(tmp_path: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "CHUNK_BYTES", 5)
    source = tmp_path / "policy"
    (source / "more").mkdir(parents=True)
    contents = {"config.json": b"{}", "weights.bin": bytes(range(13)), "more/empty": b""}
    for name, content in contents.items():
        (source / name).write_bytes(content)
    (source / ".hidden").write_text("stays")
    sent: list[UInt8Array] = []

    def put(item: UInt8Array) -> int:
        sent.append(item)
        return len(sent) - 1

    shipment = files.pack(source, put)
    assert [len(item) for item in sent] == [2, 5, 5, 3]
    placed = files.place(shipment, sent.__getitem__)
    assert placed.name == "policy"
    assert placed.is_relative_to(cache)
    assert {
        path.relative_to(placed).as_posix(): path.read_bytes() for path in placed.rglob("*") if path.is_file()
    } == contents

    def nothing(reference: Any) -> UInt8Array:
        raise AssertionError("it is there already")

    assert files.place(shipment, nothing) == placed
    assert files.pack(source, lambda item: None).sha256 == shipment.sha256
    (source / "weights.bin").write_bytes(bytes(12) + b"x")
    assert files.pack(source, lambda item: None).sha256 != shipment.sha256


def test_what_arrives_damaged_or_half_is_not_kept(tmp_path: Path, cache: Path) -> None:
    source = tmp_path / "weights.bin"
    source.write_bytes(b"weights")
    shipment = files.pack(source, lambda item: item)
    with pytest.raises(OSError, match=r"weights\.bin: expected the hash"):
        files.place(shipment, lambda item: np.flip(item).copy())
    (cache / f"{shipment.sha256}.part" / "old").mkdir(parents=True, exist_ok=True)  # of a process that died
    assert files.place(shipment, lambda item: item).read_bytes() == b"weights"
    assert not list(cache.glob("*.part"))


def test_a_checkpoint_in_one_file_takes_its_config_along(tmp_path: Path, cache: Path) -> None:
    for name in ("model.safetensors", "config.json", "other.json"):
        (tmp_path / name).write_text(name)
    placed = files.place(files.pack(tmp_path / "model.safetensors", lambda item: item), lambda item: item)
    assert sorted(path.name for path in placed.parent.iterdir()) == ["config.json", "model.safetensors"]


def test_a_cache_of_someone_else_is_refused(cache: Path, tmp_path: Path) -> None:
    cache.rmdir()
    cache.symlink_to(tmp_path)
    with pytest.raises(PermissionError, match="expected a directory of user"):
        files.cache_directory()


@dataclass(frozen=True)
class Inner:
    """Holds a path as text."""

    checkpoint: str
    count: int = 1

    def method(self) -> str:
        return self.checkpoint


@dataclass(frozen=True)
class Outer:
    """Holds paths in all ways."""

    inner: Inner
    runs: dict[str, Path]
    several: tuple[str, ...]
    text: str = "see a/b"


def test_paths_are_replaced_wherever_they_are() -> None:
    places = {"/a/b": Path("/cache/b"), "/c": Path("/cache/c")}
    value = Outer(Inner("/a/b"), {"one": Path("/c"), "/a/b": Path("d")}, ("/c", "d"), "see /a/b")
    found = files.relocated(value, places)
    assert found == Outer(
        Inner("/cache/b"), {"one": Path("/cache/c"), "/a/b": Path("d")}, ("/cache/c", "d"), "see /a/b"
    )
    assert files.relocated(value.inner.method, places)() == "/cache/b"
    untouched = Outer(Inner("x"), {}, ())
    assert files.relocated(untouched, places) is untouched


def test_a_path_may_be_written_in_any_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "here" / "policy").mkdir(parents=True)
    (tmp_path / "here" / "reach").write_text("")
    (tmp_path / "link").symlink_to("here")
    monkeypatch.chdir(tmp_path / "here")
    policy = str(tmp_path / "here" / "policy")
    names = ("policy", "./policy", "../here/policy", str(tmp_path / "link" / "policy"), policy)
    for file in (*names, Path("policy")):
        value = Outer(Inner("../link/policy"), {"one": Path("policy")}, names[1:], "policies")
        sources, found = files.located(value, [file, "owner/name", "./policy"])
        assert sources == {policy: Path(policy)}
        assert found == Outer(Inner(policy), {"one": Path(policy)}, (policy,) * 4, "policies")
    # A word, such as the name of a task, is not a path, even if there is a file of that name.
    for file in ("reach", "./reach"):
        assert files.located(Inner("reach"), [file])[1] == Inner("reach")
        found = files.located(Inner(path_text(Path("reach"))), [file])[1]
        assert found == Inner(str(tmp_path / "here" / "reach"))
    assert files.located(Inner("a/b\0"), ["policy"])[1] == Inner("a/b\0")
    assert files.located(Inner("/" * 5000 + "a" * 300), ["policy"])[1].checkpoint.endswith("aaa")


def test_a_link_to_a_file_keeps_its_own_name(tmp_path: Path) -> None:
    (tmp_path / "blobs").mkdir()
    (tmp_path / "blobs" / "0123").write_text("weights")
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.json").write_text(name)
        (tmp_path / name / "model.safetensors").symlink_to("../blobs/0123")
    given = [str(tmp_path / name / "model.safetensors") for name in ("one", "two")]
    sources, _ = files.located((), given)
    assert list(sources) == given
    shipments = [files.pack(path, lambda item: item) for path in sources.values()]
    assert {shipment.name for shipment in shipments} == {"model.safetensors"}
    assert shipments[0].sha256 != shipments[1].sha256  # each has the config beside it
