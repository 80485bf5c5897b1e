"""Writes the seeds of the fuzzers to fuzz/corpus: pieces of the files in tests/data and small checkpoints in
every published layout.

Usage: python fuzz/seeds.py, in the environment of the tests.
"""

from __future__ import annotations

import json
import struct
import sys
import tempfile
from pathlib import Path
from typing import Any, TypeAlias

HERE = Path(__file__).resolve().parent
TESTS = HERE.parent / "tests"
DATA = TESTS / "data"
sys.path.insert(0, str(HERE.parent))
from tests.helpers import layout_heads, layouts, reference_cases  # noqa: E402

#: Name to dtype, shape and bytes.
Tensors: TypeAlias = dict[str, tuple[str, list[int], bytes]]

CONFIG = json.loads((HERE / "config.json").read_text())
BETWEEN = b"\n====\n"  # what the target `index` cuts its input at


def safetensors(tensors: Tensors, metadata: dict[str, str] | None = None) -> bytes:
    """A file of `tensors`."""
    header: dict[str, Any] = {} if metadata is None else {"__metadata__": metadata}
    begin = 0
    for name, (dtype, shape, data) in tensors.items():
        header[name] = {"dtype": dtype, "shape": shape, "data_offsets": [begin, begin + len(data)]}
        begin += len(data)
    text = json.dumps(header, separators=(",", ":")).encode()
    return struct.pack("<Q", len(text)) + text + b"".join(data for _, _, data in tensors.values())


def read(path: Path) -> Tensors:
    """The tensors of a file."""
    raw = path.read_bytes()
    begin = 8 + struct.unpack("<Q", raw[:8])[0]
    header = json.loads(raw[8:begin])
    return {
        name: (
            info["dtype"],
            info["shape"],
            raw[begin + info["data_offsets"][0] : begin + info["data_offsets"][1]],
        )
        for name, info in header.items()
        if name != "__metadata__"
    }


def cut(tensors: Tensors, nbytes: int) -> Tensors:
    """The tensors of at most `nbytes`."""
    return {name: tensor for name, tensor in tensors.items() if len(tensor[2]) <= nbytes}


def headers() -> dict[str, bytes]:
    """Files: cuts of a released head in each dtype, and what is odd but allowed."""
    seeds = {}
    for path in sorted(DATA.glob("n1*.safetensors")):
        small = cut(read(path), 160)
        seeds[path.stem] = safetensors(dict(list(small.items())[:40]))
        seeds[f"{path.stem}_few"] = safetensors(dict(list(small.items())[:3]))
    four = struct.pack("<4f", 1, -2, 0.5, 0)
    seeds["metadata"] = safetensors({"a": ("F32", [2, 2], four)}, {"format": "pt"})
    seeds["kept"] = safetensors({"a": ("F32", [2, 2], four)}, {"saccade_embodiment_ids": "3,31"})
    seeds["nothing"] = safetensors({})
    seeds["empty_and_scalar"] = safetensors({"a": ("F32", [0, 5], b""), "b": ("BF16", [], b"\0\x3f")})
    seeds["halves"] = safetensors(
        {"a": ("F16", [3], b"\0\x3c\0\xbc\1\0"), "b": ("BF16", [1, 1], b"\x80\x3f")}
    )
    scales = struct.pack("<2f", 0.5, 0)
    seeds["int8"] = safetensors({"x_scale": ("F32", [2], scales), "x": ("I8", [2, 2], b"\1\x7f\0\0")})
    name = "vlln.weight"
    for prefix in ("", "action_head.", "_groot_model.action_head."):
        seeds[f"prefix_{len(prefix)}"] = safetensors({prefix + name: ("F32", [4], four)})
    return seeds


def indexes(files: dict[str, bytes]) -> dict[str, bytes]:
    """Indexes with their shards behind them."""
    seeds = {}
    for shards in (["prefix_12"], ["metadata", "halves"], ["int8", "empty_and_scalar", "n15_tiny_few"]):
        weight_map = {}
        for shard, file in zip(shards, "abc", strict=False):
            raw = files[shard]
            for name in json.loads(raw[8 : 8 + struct.unpack("<Q", raw[:8])[0]]):
                if name != "__metadata__":
                    weight_map[name] = f"{file}.safetensors"
        index = json.dumps({"metadata": {"total_size": 16}, "weight_map": weight_map}).encode()
        seeds["_".join(shards)] = BETWEEN.join([index, *(files[shard] for shard in shards)])
    return seeds


def configs() -> dict[str, bytes]:
    """Configs as released, inside a checkpoint's config, with what changes the head; whole checkpoints."""
    whole = {"model_type": "gr00t_n1_5", "action_head_cfg": CONFIG}
    changes = [{"use_vlln": False}, {"num_target_vision_tokens": 0}, {"add_pos_embed": False}]
    seeds = [CONFIG, whole, *(CONFIG | change for change in changes)]
    return {f"{number}": json.dumps(seed).encode() for number, seed in enumerate(seeds)} | checkpoints()


def checkpoints() -> dict[str, bytes]:
    """`config.json` and the header of the weights in every published layout; two layers and no backbone make
    them small.
    """
    seeds = {}
    with tempfile.TemporaryDirectory() as folder:
        for layout in layouts.LAYOUTS:
            head = layout_heads.head_config(layout)
            head["diffusion_model_cfg"]["num_layers"] = 2
            layouts.write(Path(folder) / layout, layout, config=head)
            seeds[layout] = BETWEEN.join(checkpoint(Path(folder) / layout))
    return seeds


def resizes() -> dict[str, bytes]:
    """Small heads in three layouts: more tokens, fewer, as many and none."""
    seeds = {}
    small = reference_cases.small_config(num_layers=1, num_future_tokens=3)
    # lerobot's config says no sizes: heads are as wide as those of the published checkpoints, chunks as long.
    wide = reference_cases.small_config(
        num_layers=1,
        num_future_tokens=3,
        action_horizon=16,
        num_heads=1,
        head_dim=48,
        context_dim=64,
        vl_num_heads=1,
    )
    with tempfile.TemporaryDirectory() as folder:
        # The number of tokens, and what the weights' bytes are.
        counts = {7: b"\x3f\x80\0", 2: b"\1\2\3\4\5\6\7", 3: b"", 0: b"\x3f"}
        for layout, sizes in {"nvidia": small, "saccade": small, "lerobot": wide}.items():
            layouts.write(Path(folder) / layout, layout, config=layout_heads.head_config(layout) | sizes)
            config, header = checkpoint(Path(folder) / layout)
            for count, data in counts.items():
                pieces = [struct.pack("<H", count) + config, header, data]
                seeds[f"{layout}_{count}"] = BETWEEN.join(pieces)
    return seeds


def tokenizers() -> dict[str, bytes]:
    """A small tokenizer as one file, as four, and with old merges."""
    value = json.loads((DATA / "backbone" / "tiny_tokenizer.json").read_text())
    model, added = value["model"], value["added_tokens"]
    slow = [
        json.dumps(model["vocab"]),
        "#version: 0.2\n" + "\n".join(map(" ".join, model["merges"])),
        json.dumps({token["content"]: token["id"] for token in added}),
        json.dumps({"added_tokens_decoder": {str(token["id"]): token for token in added}}),
    ]
    old = value | {"model": model | {"merges": [" ".join(pair) for pair in model["merges"]]}}
    seeds = {"json": json.dumps(value), "old": json.dumps(old)}
    for count in range(2, 5):
        seeds[f"slow_{count}"] = BETWEEN.decode().join(slow[:count])
    return {name: text.encode() for name, text in seeds.items()}


def processors() -> dict[str, bytes]:
    """Options as checkpoints have them, with instructions."""
    options: list[dict[str, Any]] = [
        {},
        {"shortest_image_edge": 64, "crop_fraction": 0.95, "min_pixels": 4096, "use_albumentations": True},
        {"image_crop_size": [58, 58], "image_target_size": [64, 64], "use_albumentations": False},
        {"shortest_image_edge": None, "image_target_size": None, "letter_box_transform": True},
        {"processor_kwargs": {"formalize_language": False, "modality_configs": {}}},
        {"size": {"shortest_edge": 65536, "longest_edge": 16777216}, "image_mean": [0.5, 0.5, 0.5]},
        {"steps": [{"registry_name": "groot_n1_7_vlm_encode_v1", "config": {"crop_fraction": 0.9}}]},
    ]
    texts = ["open the drawer", "Don't <|im_end|> <image-2>!", "<|image_pad|>", "\u0130\u03a3 '\"\\\t"]
    seeds = {}
    for number, option in enumerate(options):
        pieces = [json.dumps(option).encode(), texts[number % len(texts)].encode()]
        seeds[str(number)] = BETWEEN.join(pieces)
    return seeds


def checkpoint(folder: Path) -> tuple[bytes, bytes]:
    """`config.json` and the header of the head's tensors."""
    tensors: Tensors = {}
    for file in sorted(folder.glob("model*.safetensors")):
        tensors |= read(file)
    raw = safetensors({name: tensor for name, tensor in tensors.items() if "action_head." in name})
    return (folder / "config.json").read_bytes(), raw[8 : 8 + struct.unpack("<Q", raw[:8])[0]]


def main() -> None:
    """Writes all seeds under distinct names and prints their number."""
    files = headers()
    targets = {
        "header": files,
        "index": indexes(files),
        "config": configs(),
        "resize": resizes(),
        "tokenizer": tokenizers(),
        "processor": processors(),
    }
    for target, seeds in targets.items():
        folder = HERE / "corpus" / target
        folder.mkdir(parents=True, exist_ok=True)
        for name, seed in seeds.items():
            (folder / f"seed_{name}").write_bytes(seed)
        print(f"{target}: {len(seeds)} seeds, at most {max(map(len, seeds.values()))} bytes")


if __name__ == "__main__":
    main()
