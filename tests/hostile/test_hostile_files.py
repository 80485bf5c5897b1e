"""Files that nobody should have made: pipes, devices, loops, holes of terabytes, names that drive a terminal.

Whatever reads a checkpoint says what is wrong, once, and writes nothing.
"""

from __future__ import annotations

import functools
import json
import math
import os
import struct
import subprocess
import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import pytest

import saccade
from saccade import _saccade, cli
from saccade.checkpoints import describe, quantize, read_tensors
from saccade.errors import CheckpointError
from tests.helpers import hostile_cases
from tests.helpers.hostile_cases import TINY, WRITERS, limited, names, refused
from tests.helpers.lfs_pointer import POINTER
from tests.helpers.systems import IS_ROOT, linux, posix

# Fixtures.
good, no_hang = hostile_cases.good, hostile_cases.no_hang


# What takes the path of a checkpoint and writes nothing.
READERS: dict[str, Callable[[Path], object]] = {
    "load": saccade.ActionHead.from_pretrained,
    "read_tensors": read_tensors,
    "describe": describe,
}
# Commands with the path of a checkpoint and that of a new one.
COMMANDS: dict[str, Callable[[Path, Path], list[str]]] = {
    "inspect": lambda source, out: ["inspect", str(source)],
    "quantize": lambda source, out: ["quantize", str(source), "--out", str(out)],
    "convert": lambda source, out: ["convert", str(source), "--out", str(out), "--embodiment-ids", "1"],
    "resize": lambda source, out: ["resize", str(source), "--out", str(out), "--num-future-tokens", "6"],
}


def safetensors(header: str | dict[str, Any], data: bytes = b"") -> bytes:
    text = (header if isinstance(header, str) else json.dumps(header)).encode()
    return struct.pack("<Q", len(text)) + text + data


def tensor(begin: int, end: int, shape: list[int], dtype: str = "F32") -> dict[str, Any]:
    return {"dtype": dtype, "shape": shape, "data_offsets": [begin, end]}


def weights(content: bytes) -> Callable[[Path], object]:
    return lambda folder: (folder / "model.safetensors").write_bytes(content)


def config(content: str | bytes) -> Callable[[Path], object]:
    raw = content.encode() if isinstance(content, str) else content
    return lambda folder: (folder / "config.json").write_bytes(raw)


def index(weight_map: dict[str, Any] | str) -> Callable[[Path], object]:
    text = weight_map if isinstance(weight_map, str) else json.dumps({"weight_map": weight_map})
    return indexed(lambda folder: (folder / INDEX).write_text(text))


def indexed(change: Callable[[Path], object]) -> Callable[[Path], object]:
    """A change to an index that counts: model.safetensors beside one would count alone."""

    def apply(folder: Path) -> None:
        (folder / "model.safetensors").rename(folder / "weights.safetensors")
        change(folder)

    return apply


def pipe(name: str) -> Callable[[Path], object]:
    return instead(name, lambda path: os.mkfifo(path))  # looked up late: Windows has none


def link(name: str, target: str) -> Callable[[Path], object]:
    return instead(name, lambda path: path.symlink_to(target))


def directory(name: str) -> Callable[[Path], object]:
    return instead(name, Path.mkdir)


def instead(name: str, make: Callable[[Path], object]) -> Callable[[Path], object]:
    def change(folder: Path) -> None:
        (folder / name).unlink(missing_ok=True)
        make(folder / name)

    return change


def holes(dtype: str, shape: list[int], nbytes: int) -> Callable[[Path], object]:
    """A file as long as its header says, with nothing in it."""

    def change(folder: Path) -> None:
        content = safetensors({"action_head.a": tensor(0, nbytes, shape, dtype)})
        path = folder / "model.safetensors"
        path.write_bytes(content)
        os.truncate(path, len(content) + nbytes)

    return change


INDEX = "model.safetensors.index.json"
# The head's names and shapes are compared before anything is read.
TOO_LARGE = "cannot allocate|do not fit the config|disagree"
SUM_OVERFLOWS = {
    # Eight tensors of 2^61 - 1 bytes and one of 8: 2^64 together, which is 0 in 64 bits.
    f"t{i}": tensor(i * (2**61 - 1), (i + 1) * (2**61 - 1), [2**61 - 1], "U8")
    for i in range(8)
} | {"t8": tensor(8 * (2**61 - 1), 2**64 - 1, [7], "U8")}

#: What is done to a good checkpoint, and what is said of it; of weights that `read_tensors` reads too.
BROKEN_WEIGHTS: dict[str, tuple[Callable[[Path], object], str]] = {
    "pipe": (pipe("model.safetensors"), "not a regular file"),
    "device": (link("model.safetensors", "/dev/zero"), "not a regular file"),
    "directory": (directory("model.safetensors"), "not a regular file"),
    "dangling link": (link("model.safetensors", "nowhere"), "no such file.*model.safetensors"),
    "link to itself": (link("model.safetensors", "model.safetensors"), "model.safetensors cannot be read"),
    "index is a pipe": (indexed(pipe(INDEX)), "index.json cannot be read: not a regular file"),
    "index is a device": (
        indexed(link(INDEX, "/dev/zero")),
        "index.json cannot be read: not a regular file",
    ),
    "index is a directory": (indexed(directory(INDEX)), "index.json cannot be read: not a regular file"),
    "index is a dangling link": (indexed(link(INDEX, "nowhere")), "no such file.*index.json"),
    "index is no text": (indexed(lambda folder: (folder / INDEX).write_bytes(b'{"\xff": 1}')), "UTF-8"),
    "index is deep": (index("[" * 100_000), "index.json: "),
    "index with a name twice": (index('{"weight_map": {"a": "x", "a": "y"}}'), "a appears twice"),
    "index names a folder": (index({"a": "."}), "expected a file name in the same directory"),
    "index names the folder above": (index({"a": ".."}), "expected a file name in the same directory"),
    "index names nothing": (index({"a": ""}), "expected a file name in the same directory"),
    "index leads outside": (index({"a": "../good/model.safetensors"}), "expected a file name in the same"),
    "index leads to a device": (index({"a": "/dev/zero"}), "expected a file name in the same directory"),
    "index with a zero byte": (index({"a": "x\0.safetensors"}), "cannot be read"),
    "index to what is not there": (index({"a": "b.safetensors"}), r"no such file.*b\.safetensors"),
    "index to the config": (index({"a": "config.json"}), r"config\.json: not safetensors"),
    "index to itself": (index({"a": INDEX}), "not safetensors"),
    "index to a very long name": (index({"a": "x" * 5000}), "File name too long"),
    "index with a terminal's escape": (index({"\x1b[2J": "model.safetensors"}), "holds control characters"),
    "sizes that overflow together": (weights(safetensors(SUM_OVERFLOWS)), "the header promises"),
    "empty, of an overflowing shape": (
        weights(safetensors({"a": tensor(0, 0, [2**63, 2**63, 0])})),
        "header",
    ),
    "header of a terminal's escape": (
        weights(safetensors({"\x1b]0;owned\x07": tensor(0, 0, [0])})),
        "holds control characters",
    ),
    "header of many lines": (weights(safetensors({"a\nb": tensor(0, 0, [0])})), "holds control characters"),
    "header of numbers that are none": (weights(safetensors('{"a": NaN}')), "header"),
    "a Git LFS pointer": (
        weights(POINTER.encode()),
        "model.safetensors: it is a Git LFS pointer, not the file itself: run `git lfs pull` in .*good",
    ),
    "index is a Git LFS pointer": (index(POINTER), "index.json: it is a Git LFS pointer"),
    "a lone surrogate": (weights(safetensors('{"\\ud800": 1}')), "header"),
    "a name that is not UTF-8": (
        lambda folder: Path(os.fsdecode(bytes(folder) + b"/\xff.safetensors")).write_bytes(b""),
        "is not UTF-8",
    ),
    "float32 of terabytes": (holes("F32", [2**40], 2**42), TOO_LARGE),
    "bfloat16 of terabytes": (
        holes("BF16", [2, 2**40], 2**42),
        TOO_LARGE,
    ),
}

#: What a config that no head has says.
BROKEN_CONFIGS: dict[str, tuple[Callable[[Path], object], str]] = {
    "not there": (lambda folder: (folder / "config.json").unlink(), "no such file"),
    "pipe": (pipe("config.json"), "not a regular file"),
    "device": (link("config.json", "/dev/zero"), "not a regular file"),
    "directory": (directory("config.json"), "not a regular file"),
    "dangling link": (link("config.json", "nowhere"), "no such file"),
    "link to itself": (link("config.json", "config.json"), "cannot be read"),
    "terabytes": (lambda folder: os.truncate(folder / "config.json", 2**42), "more than 100000000 bytes"),
    "empty": (config(""), "config.json: not valid JSON"),
    "a Git LFS pointer": (
        config(POINTER),
        "config: .*config.json: it is a Git LFS pointer.*git lfs pull` in",
    ),
    "bytes that are no text": (config(b'{"\xff": 1}'), "UTF-8"),
    "deep": (config('{"a": ' * 100_000), "not valid JSON: recursion limit"),
    "a list": (config("[]"), "expected a JSON object"),
    "a number that is none": (
        config(json.dumps(TINY.config | {"action_dim": float("nan")})),
        "not valid JSON",
    ),
    "a number beyond numbers": (config('{"action_dim": 1e999}'), "not valid JSON: number out of range"),
    "a string of megabytes": (config(json.dumps(TINY.config | {"action_dim": "x" * 10**7})), "action_dim is"),
    "a terminal's escape": (
        config(json.dumps(TINY.config | {"action_dim": "\x9b2J"}, ensure_ascii=False)),
        r"action_dim is .\\u\{9b\}2J",
    ),
    "layers without end": (
        config(
            json.dumps(
                TINY.config
                | {"diffusion_model_cfg": TINY.config["diffusion_model_cfg"] | {"num_layers": 2**20}}
            )
        ),
        "num_layers",
    ),
}


#: Words in the names of cases that Windows does not have, or says in other words.
ON_POSIX = ("pipe", "device", "directory", "link", "long name", "terabytes")
#: macOS has no such names.
ON_LINUX = ("not UTF-8",)


def cases(listed: Iterable[str]) -> list[Any]:
    """Names of cases, of which those that this system cannot have are skipped."""

    def marks(name: str) -> list[pytest.MarkDecorator]:
        found = [(posix, ON_POSIX), (linux, ON_LINUX)]
        return [mark for mark, words in found if any(word in name for word in words)]

    return [pytest.param(name, marks=marks(name)) for name in listed]


@pytest.mark.parametrize("case", cases(BROKEN_WEIGHTS))
@pytest.mark.parametrize("entry", [*READERS, *WRITERS])
def test_broken_weights(entry: str, case: str, good: Path) -> None:
    change, message = BROKEN_WEIGHTS[case]
    change(good)
    out = good.parent / "out"
    if entry == "describe" and "terabytes" in case:
        describe(good)  # it reads no tensor, and says what is odd
        return
    refused(lambda: READERS[entry](good) if entry in READERS else WRITERS[entry](good, out), message)
    assert names(good.parent) == {"good"}


@pytest.mark.parametrize("case", cases(BROKEN_CONFIGS))
@pytest.mark.parametrize("entry", ["load", "describe", *WRITERS])
def test_broken_configs(entry: str, case: str, good: Path) -> None:
    change, message = BROKEN_CONFIGS[case]
    change(good)
    out = good.parent / "out"
    refused(lambda: READERS[entry](good) if entry in READERS else WRITERS[entry](good, out), message)
    assert names(good.parent) == {"good"}


@pytest.mark.parametrize("case", cases(case for case in BROKEN_CONFIGS if case != "not there"))
def test_broken_configs_given_by_path(case: str, good: Path) -> None:
    change, _ = BROKEN_CONFIGS[case]
    change(good)
    refused(lambda: saccade.HeadConfig.from_file(good / "config.json"), "config")
    refused(lambda: saccade.ActionHead.from_pretrained(good, config=good / "config.json"), "config")


def test_broken_configs_given_as_values() -> None:
    deep: dict[str, Any] = {}
    for _ in range(100_000):
        deep = {"a": deep}
    circular: dict[str, Any] = {}
    circular["a"] = circular
    given: list[dict[str, Any]] = [deep, circular, {"action_dim": float("nan")}, {"\ud800": 1}]
    for values in given:
        refused(functools.partial(saccade.HeadConfig.from_dict, values), "config")


@pytest.mark.parametrize("entry", [*READERS, *WRITERS])
@pytest.mark.parametrize(
    "source",
    [
        "",
        "a\0b",
        "x" * 300,
        "x/" * 3000,
        "/dev/zero",
        "/dev/null",
        "/proc/self/mem",
        "good/config.json/x",
        "\x1b[2J",
    ],
)
def test_sources_that_are_none(entry: str, source: str, good: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(good.parent)
    path = Path(source)
    refused(lambda: READERS[entry](path) if entry in READERS else WRITERS[entry](path, Path("out")), ".")
    assert names(good.parent) == {"good"}


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize(
    "case", cases(["pipe", "link to itself", "header of a terminal's escape", "float32 of terabytes"])
)
def test_commands_say_it_in_one_line(
    command: str, case: str, good: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    BROKEN_WEIGHTS[case][0](good)
    assert cli.main(COMMANDS[command](good, good.parent / "out")) == cli.EXIT_BAD_INPUT
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("saccade: ")
    assert line.isprintable()
    assert names(good.parent) == {"good"}


def test_very_many_tensors(good: Path) -> None:
    header = {f"action_head.{number}": tensor(0, 0, [0]) for number in range(100_000)}
    weights(safetensors(header))(good)
    refused(lambda: saccade.ActionHead.from_pretrained(good), "tensors do not fit the config")


def test_a_name_of_megabytes(good: Path) -> None:
    weights(safetensors({"action_head." + "x" * 10**7: tensor(0, 0, [0])}))(good)
    with pytest.raises(CheckpointError) as caught:
        saccade.ActionHead.from_pretrained(good)
    assert len(str(caught.value)) < 100_000


def test_tensors_without_elements(good: Path) -> None:
    weights(safetensors({"a": tensor(0, 0, [0, 2**40]), "b": tensor(0, 4, [])}, struct.pack("<f", 7)))(good)
    read = read_tensors(good)
    assert {name: array.shape for name, array in read.items()} == {"a": (0, 2**40), "b": ()}
    assert read["b"] == 7


@posix
def test_links_are_followed(good: Path, tmp_path: Path) -> None:
    # Like a cache of models.
    view = tmp_path / "view"
    view.mkdir()
    for path in good.iterdir():
        (view / path.name).symlink_to(path)
    (tmp_path / "again").symlink_to(view)
    expected = read_tensors(good, "action_head.")
    for source in (view, tmp_path / "again", view / "model.safetensors"):
        assert read_tensors(source, "action_head.").keys() == expected.keys()
        saccade.ActionHead.from_pretrained(source)


@linux
def test_names_of_folders_may_be_any_bytes(good: Path) -> None:
    odd = Path(os.fsdecode(bytes(good) + b"-\xff\n\x1b"))
    good.rename(odd)
    saccade.ActionHead.from_pretrained(odd)
    quantize(odd, odd / "int8")
    saccade.ActionHead.from_pretrained(odd / "int8")


def sharded(folder: Path, count: int) -> None:
    """The tensors of the file there, each in one of `count` files, without an index."""
    raw = (folder / "model.safetensors").read_bytes()
    begin = 8 + struct.unpack("<Q", raw[:8])[0]
    header = json.loads(raw[8:begin])
    header.pop("__metadata__", None)
    (folder / "model.safetensors").unlink()
    listed = sorted(header)
    for number in range(count):
        part, data = {}, b""
        for name in listed[number::count]:
            first, last = header[name]["data_offsets"]
            part[name] = header[name] | {"data_offsets": [len(data), len(data) + last - first]}
            data += raw[begin + first : begin + last]
        (folder / f"{number}.safetensors").write_bytes(safetensors(part, data))


@linux
@pytest.mark.parametrize("entry", [*READERS, *WRITERS])
def test_more_files_than_may_be_open(entry: str, good: Path) -> None:
    sharded(good, 40)
    out = good.parent / "out"
    with limited("RLIMIT_NOFILE", len(list(Path("/proc/self/fd").iterdir())) + 10):
        refused(
            lambda: READERS[entry](good) if entry in READERS else WRITERS[entry](good, out),
            "Too many open files",
        )
    assert names(good.parent) == {"good"}


def of_holes(folder: Path, shapes: Iterable[tuple[str, list[int]]], dtype: str) -> None:
    """Weights of these shapes that take no room on the disk."""
    header, end = {}, 0
    for name, shape in shapes:
        begin, end = end, end + math.prod(shape) * (4 if dtype == "F32" else 2)
        header["action_head." + name] = tensor(begin, end, list(shape), dtype)
    weights(safetensors(header))(folder)
    file = folder / "model.safetensors"
    os.truncate(file, file.stat().st_size + end)


@linux
@pytest.mark.parametrize("dtype", ["F32", "BF16", "F16"])
@pytest.mark.parametrize("entry", ["load", "read_tensors"])
def test_more_than_there_is_memory_for(entry: str, dtype: str, tmp_path: Path) -> None:
    """A checkpoint without a flaw, of holes: 8 GB and more of weights for a process that may have 6."""
    head = TINY.config["diffusion_model_cfg"] | {"num_attention_heads": 1024, "num_layers": 8}
    text = json.dumps(TINY.config | {"input_embedding_dim": 8192, "diffusion_model_cfg": head})
    (tmp_path / "config.json").write_text(text)
    # What is read one by one is one tensor, so that nothing is read before it is refused.
    shapes = _saccade.tensor_shapes(text) if entry == "load" else [("a", [2, 2**30])]
    of_holes(tmp_path, shapes, dtype)
    code = (
        "import resource, sys, saccade; from pathlib import Path\n"
        "from saccade.checkpoints import read_tensors\n"
        "resource.setrlimit(resource.RLIMIT_AS, (6 * 2**30,) * 2)\n"
        "calls = {'load': saccade.ActionHead.from_pretrained, 'read_tensors': read_tensors}\n"
        "try: calls[sys.argv[1]](Path())\n"
        "except MemoryError as error: print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, entry], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    assert "cannot allocate" in done.stdout


@pytest.mark.skipif(not IS_ROOT, reason="changing to a user who may not read needs root")
def test_files_that_may_not_be_read(good: Path) -> None:
    (good / "model.safetensors").chmod(0)
    code = (
        "import os, sys; import numpy, saccade; os.setgroups([]); os.setgid(65534); os.setuid(65534)\n"
        "try: saccade.ActionHead.from_pretrained(sys.argv[1])\n"
        "except saccade.CheckpointError as error: print(error)\n"
    )
    for parent in good.parents:
        if parent.stat().st_mode & 0o005 != 0o005 and parent != Path("/"):
            parent.chmod(parent.stat().st_mode | 0o005)
    done = subprocess.run([sys.executable, "-c", code, str(good)], capture_output=True, text=True, check=True)
    assert "model.safetensors cannot be read: Permission denied" in done.stdout
