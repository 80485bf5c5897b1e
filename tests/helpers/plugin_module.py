"""Modules of the lerobot plugin by their paths, since the package imports lerobot."""

from __future__ import annotations

import importlib.util
from types import ModuleType

from tests.helpers.paths import ROOT


def plugin_module(name: str) -> ModuleType:
    """The module of that name."""
    path = ROOT / "plugins" / "lerobot" / "lerobot_policy_saccade" / f"{name}.py"
    spec = importlib.util.spec_from_file_location(f"plugin_{name}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module
