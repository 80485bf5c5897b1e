"""The tier of a test module, from what it imports: `core`, `torch` or `lab`.

`core` needs the wheel, NumPy, pytest and Hypothesis. `torch` also needs torch, the reference implementation
of the model, the packages of the server and of data sets, or programs that saccade is compared with. `lab`
needs the rest of saccade_lab, or the programs of `benches`. A module belongs to the highest tier of what it
and its helpers import, also inside functions, and of its folder: some tests run programs that import more.
"""

from __future__ import annotations

import ast
import functools
from collections.abc import Iterator
from pathlib import Path

from tests.helpers.paths import ROOT

TIERS = ("core", "torch", "lab")
#: The tier of imported packages; the others are core.
PACKAGES = {
    **dict.fromkeys(
        ("diffusers", "lerobot", "lerobot_policy_saccade", "safetensors", "scipy", "torch", "transformers"),
        "torch",
    ),
    **dict.fromkeys(("av", "pyarrow", "saccade.datasets"), "torch"),
    **dict.fromkeys(("griffe", "huggingface_hub", "msgpack", "saccade.serve", "tokenizers", "zmq"), "torch"),
    **dict.fromkeys(("saccade.integrations", "saccade.torch", "saccade_lab.reference"), "torch"),
    "saccade_lab.random_checkpoint": "core",
    **dict.fromkeys(("benches", "studies", "why_32", "saccade_lab"), "lab"),
    **dict.fromkeys(("gymnasium", "imageio", "joblib", "jinja2", "matplotlib", "mujoco", "pandas"), "lab"),
    **dict.fromkeys(("metaworld", "nox", "ray", "selenium", "sklearn"), "lab"),
}
#: The least tier of the modules of a folder, and of modules that start programs which import more.
FOLDERS = {
    **dict.fromkeys(("docs/", "lab/sim/", "lab/parallel/", "package/test_imports.py"), "lab"),
    **dict.fromkeys(("backbone/test_backbone_calls.py", "head/test_memory.py", "lab/"), "torch"),
    "checkpoints/test_hub_download.py": "torch",
}


@functools.cache
def tier_of(path: Path) -> str:
    """The tier of a Python file of the tests.

    Args:
        path: A test module or a helper.
    """
    folder = path.relative_to(ROOT / "tests").as_posix()
    floors = (tier for prefix, tier in FOLDERS.items() if folder.startswith(prefix))
    tiers = (*floors, *(_tier_of_import(name) for name in _imports(path)))
    return max(tiers, key=TIERS.index, default="core")


def _tier_of_import(name: str) -> str:
    """The tier of a dotted name; the longest entry of `PACKAGES` decides."""
    if name.startswith("tests."):
        path = ROOT.joinpath(*name.split(".")).with_suffix(".py")
        return tier_of(path) if path.is_file() else "core"
    parts = name.split(".")
    for length in range(len(parts), 0, -1):
        tier = PACKAGES.get(".".join(parts[:length]))
        if tier is not None:
            return tier
    return "core"


def _imports(path: Path) -> Iterator[str]:
    """Dotted names of what a file imports; a name imported from a package counts as its submodule."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)
