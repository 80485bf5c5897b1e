"""Writes the packed files of this study as its commands had written them.

    python studies/why-32/unpack.py --out out/why-32

OUT gets the table `answer.csv`, its provenance `answer.json`, a file for each cell in `answer/cells`, and in
`answer/policies` the policies of which the weights are kept. With OUT as `--out` the study continues from
there. Every file of a policy is compared with its SHA-256 in `trained.jsonl.xz`. Needs Python alone.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import lzma
import shutil
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
WEIGHTS, TOKENIZER, METADATA = "model.safetensors", "tokenizer.json", "__metadata__"


def records(path: Path) -> Iterator[dict[str, Any]]:
    """The values of a compressed file of JSON lines."""
    with lzma.open(path, "rt", encoding="utf-8") as file:
        yield from map(json.loads, file)


def json_text(value: Any) -> str:
    """A value as the commands write it: indented, with a final newline."""
    return json.dumps(value, indent=2, ensure_ascii=False) + "\n"


def cell_name(record: dict[str, Any]) -> str:
    """The name of a cell's file: the first 16 digits of the hash of its key and settings."""
    identity = {"key": record["key"], "settings": record["settings"]}
    text = json.dumps(identity, sort_keys=True, ensure_ascii=False)
    return hashlib.sha256(text.encode("utf-8")).hexdigest()[:16] + ".json"


def tensors(data: bytes) -> tuple[dict[str, str], dict[str, tuple[dict[str, Any], bytes]]]:
    """The metadata of a file in the format safetensors, and the description and content of each tensor."""
    (length,) = struct.unpack("<Q", data[:8])
    header, content = json.loads(data[8 : 8 + length]), data[8 + length :]
    metadata = header.pop(METADATA)
    return metadata, {name: (one, content[slice(*one["data_offsets"])]) for name, one in header.items()}


def joined(first: bytes, second: bytes) -> bytes:
    """One file in the format safetensors with the tensors of two, sorted by name."""
    (metadata, left), (_, right) = tensors(first), tensors(second)
    header: dict[str, Any] = {METADATA: metadata}
    content = b""
    for name, (one, data) in sorted({**left, **right}.items()):
        header[name] = {**one, "data_offsets": [len(content), len(content) + len(data)]}
        content += data
    text = json.dumps(header, separators=(",", ":")).encode("utf-8")
    text += b" " * (-len(text) % 8)
    return struct.pack("<Q", len(text)) + text + content


def write_policies(source: Path, out: Path) -> list[str]:
    """Writes the policies of which `source` has the head's weights; all share one frozen backbone.

    Args:
        source: Directory of the packed files.
        out: Directory that gets a directory for each policy.

    Returns:
        The names of the policies.

    Raises:
        ValueError: A file is not the one that was trained.
    """
    packed = {path.name: lzma.decompress(path.read_bytes()) for path in (source / "policies").glob("*.xz")}
    names = []
    for record in records(source / "trained.jsonl.xz"):
        kind, name = record["directory"].split("/")
        if kind != "policies" or f"{name}.safetensors.xz" not in packed:
            continue
        names.append(name)
        files = {file: json_text(value).encode("utf-8") for file, value in record["files"].items()}
        files[TOKENIZER] = packed[f"{TOKENIZER}.xz"]
        files[WEIGHTS] = joined(packed["backbone.safetensors.xz"], packed[f"{name}.safetensors.xz"])
        for file, expected in record["sha256"].items():
            found = hashlib.sha256(files[file]).hexdigest()
            if found != expected:
                raise ValueError(f"{name}/{file}: has the SHA-256 {found}, expected {expected}")
            path = out / name / file
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(files[file])
    return names


def unpack(out: Path, source: Path = HERE) -> list[str]:
    """Writes everything to `out` and returns the names of the policies; raises as `write_policies`."""
    cells = out / "answer" / "cells"
    cells.mkdir(parents=True, exist_ok=True)
    for record in records(source / "cells.jsonl.xz"):
        (cells / cell_name(record)).write_text(json_text(record), encoding="utf-8")
    with lzma.open(source / "answer.csv.xz") as packed, (out / "answer.csv").open("wb") as file:
        shutil.copyfileobj(packed, file)
    shutil.copyfile(source / "answer.json", out / "answer.json")
    return write_policies(source, out / "answer" / "policies")


def main() -> None:
    """Unpacks, and prints the names of the policies."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="directory to write to")
    out = parser.parse_args().out
    print(f"{out}: table, cells and the policies {', '.join(unpack(out))}")


if __name__ == "__main__":
    main()
