"""The contenders: engines and their settings."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True)
class Contender:
    """One engine in one setting.

    Attributes:
        label: Its name in tables.
        engine: The module of `benches.peers.engines` that builds it.
        pieces: What it can run.
        gigabytes: Of memory while it runs the whole head or policy at full size, roughly; without what its
            process holds for all.
        options: What the engine's `build` reads.
        environment: Set in its process.
        usual: Whether it is part of a run that names nobody; the others are settings that were tried and
            that another setting of the same engine beats, or that take minutes to compile.
        process: Contenders of the same process, a key of `PROCESSES` if it is not empty, run in one and share
            the weights.
    """

    label: str
    engine: str
    pieces: tuple[str, ...]
    gigabytes: float
    options: Mapping[str, Any]
    environment: Mapping[str, str] = field(default_factory=dict)
    usual: bool = True
    process: str = ""


ALL = ("linear", "cross", "blocks", "head")
PARTS = ("cross", "blocks", "head")
MANY = (*ALL, "throughput")


def _saccade(
    precision: str, gigabytes: float, isa: str | None = None, refresh: int | None = None
) -> Contender:
    label = f"saccade {precision}"
    options: dict[str, Any] = {"precision": precision}
    pieces: tuple[str, ...] = (*PARTS, "throughput", "cost")
    if refresh is not None:
        options["future_refresh"] = refresh
        label += f", future_refresh={refresh}"
        pieces = ("head",)
    if isa is not None:
        label += f" ({isa})"
        pieces = (*PARTS, "throughput") if isa == "avx2" else ("throughput",)
    return Contender(
        label, "saccade_head", pieces, gigabytes, options, {} if isa is None else {"SACCADE_ISA": isa}
    )


GROUPS: Mapping[str, Mapping[str, Contender]] = {
    "float32": {
        "saccade-float32": _saccade("float32", 3.3),
        "lerobot-float32": Contender(
            "lerobot 0.4.4 float32", "lerobot", ("blocks", "head"), 3.6, {"arithmetic": "float32"}
        ),
        "saccade-float32-avx2": _saccade("float32", 3.3, "avx2"),
        "saccade-float32-avx512": _saccade("float32", 3.3, "avx512"),
        "torch-float32": Contender("torch float32", "pytorch", MANY, 3.6, {"arithmetic": "float32"}),
        "compile-float32": Contender(
            "torch.compile float32",
            "pytorch",
            ALL,
            6.5,
            {"arithmetic": "float32", "compiled": True},
            usual=False,
        ),
        "compile-float32-autotuned": Contender(
            "torch.compile float32, autotuned",
            "pytorch",
            ALL,
            6.5,
            {"arithmetic": "float32", "compiled": True, "autotuned": True},
            usual=False,
        ),
        "onnxruntime-float32": Contender(
            "ONNX Runtime float32", "onnx_runtime", ALL, 4.5, {"arithmetic": "float32"}
        ),
        "openvino-float32": Contender("OpenVINO float32", "open_vino", MANY, 4.5, {"arithmetic": "float32"}),
        "ggml-float32": Contender("ggml f32", "ggml", ("linear",), 1, {"arithmetic": "float32"}),
    },
    "narrow": {
        "saccade-bfloat16": _saccade("bfloat16", 1.8),
        "lerobot-bfloat16": Contender(
            "lerobot 0.4.4 bfloat16", "lerobot", ("blocks", "head"), 2.0, {"arithmetic": "autocast"}
        ),
        "lerobot-bfloat16-pure": Contender(
            "lerobot 0.4.4 bfloat16, no autocast",
            "lerobot",
            ("blocks", "head"),
            2.0,
            {"arithmetic": "bfloat16"},
        ),
        "openvino-bfloat16": Contender("OpenVINO bfloat16", "open_vino", MANY, 3, {"arithmetic": "bfloat16"}),
        "saccade-int8": _saccade("int8", 1.0),
        "saccade-int8-refresh2": _saccade("int8", 1.0, refresh=2),
        "saccade-int8-refresh4": _saccade("int8", 1.0, refresh=4),
        "saccade-bfloat16-avx2": _saccade("bfloat16", 1.8, "avx2"),
        "saccade-int8-avx2": _saccade("int8", 1.0, "avx2"),
        "saccade-bfloat16-avx512": _saccade("bfloat16", 1.8, "avx512"),
        "saccade-int8-avx512": _saccade("int8", 1.0, "avx512"),
        "torch-bfloat16": Contender("torch bfloat16", "pytorch", MANY, 2.2, {"arithmetic": "bfloat16"}),
        "compile-bfloat16": Contender(
            "torch.compile bfloat16",
            "pytorch",
            ALL,
            3.5,
            {"arithmetic": "bfloat16", "compiled": True},
            usual=False,
        ),
        "onnxruntime-int8": Contender(
            "ONNX Runtime int8, dynamic", "onnx_runtime", ALL, 1.8, {"arithmetic": "int8"}
        ),
        "ggml-float16": Contender("ggml f16", "ggml", ("linear",), 1, {"arithmetic": "float16"}),
        "ggml-bfloat16": Contender("ggml bf16", "ggml", ("linear",), 1, {"arithmetic": "bfloat16"}),
        "ggml-int8": Contender("ggml q8_0", "ggml", ("linear",), 1, {"arithmetic": "int8"}),
        "torch-autocast": Contender(
            "torch bfloat16 autocast", "pytorch", ALL, 2.2, {"arithmetic": "autocast"}, usual=False
        ),
        "compile-autocast": Contender(
            "torch.compile bfloat16 autocast",
            "pytorch",
            ALL,
            3.5,
            {"arithmetic": "autocast", "compiled": True},
            usual=False,
        ),
        "torch-int8": Contender(
            "torch int8, dynamic", "pytorch", PARTS, 1.8, {"arithmetic": "int8"}, usual=False
        ),
    },
}
"""By arithmetic, so that a batch fits into memory. Ratios are to the first of each group, within rounds. The
contenders of the targets come first, so that they share rounds.
"""


PROCESSES: Mapping[str, float] = {"lerobot-bfloat16": 4.9, "lerobot-float32": 11.5}
"""Gigabytes of the weights that the contenders of a process share, roughly."""


def _policy(label: str, engine: str, gigabytes: float, process: str = "", **options: Any) -> Contender:
    return Contender(label, engine, ("policy",), gigabytes, options, process=process)


def _saccade_policy(precision: str, gigabytes: float) -> Contender:
    return _policy(f"saccade {precision}", "saccade_policy", gigabytes, precision=precision)


def _lerobot(setting: str, arithmetic: str, gigabytes: float = 0.5, **options: Any) -> Contender:
    process = f"lerobot-{arithmetic}"
    return _policy(
        f"lerobot {setting}", "lerobot_policy", gigabytes, process, arithmetic=arithmetic, **options
    )


def _graphs(label: str, opened_by: str, gigabytes: float, arithmetic: str) -> Contender:
    return _policy(label, "policy_graphs", gigabytes, opened_by=opened_by, arithmetic=arithmetic)


POLICY_GROUPS: Mapping[str, Mapping[str, Contender]] = {
    "narrow": {
        "policy-saccade-bfloat16": _saccade_policy("bfloat16", 4.5),
        "policy-saccade-int8": _saccade_policy("int8", 2.6),
        "policy-lerobot-bfloat16-pure": _lerobot("bfloat16, no autocast", "bfloat16"),
        "policy-accelerate-bfloat16": _lerobot(
            "bfloat16, accelerate(policy, backbone=True)", "bfloat16", 4.8, accelerated="bfloat16"
        ),
        "policy-lerobot-bfloat16": _lerobot("bfloat16 weights, autocast", "bfloat16", autocast=True),
        "policy-compile-bfloat16": _policy(
            "lerobot bfloat16, torch.compile", "lerobot_policy", 10.0, arithmetic="bfloat16", compiled=True
        ),
        "policy-saccade-int4": _saccade_policy("int4", 1.6),
    },
    "float32": {
        "policy-saccade-float32": _saccade_policy("float32", 5.5),
        "policy-lerobot-default": _lerobot(
            "default: float32 weights, autocast to bfloat16", "float32", autocast=True
        ),
        "policy-lerobot-float32": _lerobot("float32", "float32"),
    },
    "graphs": {
        "policy-openvino-bfloat16": _graphs("OpenVINO bfloat16", "open_vino", 6.0, "bfloat16"),
        "policy-openvino-int8": _graphs("OpenVINO int8 weights (NNCF)", "open_vino", 4.0, "int8"),
        "policy-onnxruntime-int8": _graphs("ONNX Runtime int8, dynamic", "onnx_runtime", 6.0, "int8"),
    },
    "ggml": {
        "policy-vla-bfloat16": _policy("vla.cpp BF16", "vla_cpp", 5.5, weights="BF16"),
        "policy-vla-int8": _policy("vla.cpp Q8_0", "vla_cpp", 3.5, weights="Q8_0"),
        "policy-vla-int4": _policy("vla.cpp Q4_0", "vla_cpp", 3.0, weights="Q4_0"),
    },
    "float32 graphs": {
        "policy-openvino-float32": _graphs("OpenVINO float32", "open_vino", 9.0, "float32"),
        "policy-onnxruntime-float32": _graphs("ONNX Runtime float32", "onnx_runtime", 9.0, "float32"),
    },
}
"""Those that run the whole policy, in the same way. What matters most comes first."""

CONTENDERS: Mapping[str, Contender] = {
    name: contender
    for groups in (GROUPS, POLICY_GROUPS)
    for group in groups.values()
    for name, contender in group.items()
}


def able(names: Iterable[str], machine: Mapping[str, Any]) -> list[str]:
    """Those of the contenders whose instruction set the machine has and does not choose by itself anyway."""

    def fits(name: str) -> bool:
        isa = CONTENDERS[name].environment.get("SACCADE_ISA")
        return isa is None or (isa in machine["isas"] and isa != machine["isa"])

    return [name for name in names if fits(name)]
