"""The released N1.5 head from lerobot 0.4.4, without the rest of lerobot.

The packages of lerobot import datasets, cameras and robots, whereas the head needs only torch, diffusers and
transformers. Therefore its three files are imported under their own names inside empty packages, which are
removed afterwards.

Install it with ``pip install --no-deps lerobot==0.4.4`` and `pip install "diffusers~=0.35.0"
"transformers~=4.57.0"`.
"""

# Calls of torch modules are untyped.
# mypy: disable-error-code="no-any-return, operator"

import contextlib
import importlib
import importlib.util
import io
import sys
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest import mock

import torch
from torch import Tensor, nn

from saccade._internal.extras import pip_install
from saccade.errors import MissingExtraError

HEAD = "lerobot.policies.groot.action_head.flow_matching_action_head"


def build(config: Mapping[str, Any], *, device: str = "cpu") -> nn.Module:
    """A ``FlowmatchingActionHead`` in evaluation mode, initialised by the released code.

    Args:
        config: The config of a head in the released names, or of a whole checkpoint.
        device: Where it is created. On ``"meta"`` no time is spent on weights that are replaced later.

    Raises:
        MissingExtraError: Lerobot is not installed.
        ModuleNotFoundError: Diffusers or transformers is not installed.
    """
    module = import_head()
    head_config = dict(config.get("action_head_cfg", config))
    checked_beta = torch.distributions.Beta
    # It prints what it trains, and checks the values of its time distribution, which meta tensors do not
    # have.
    with (
        contextlib.redirect_stdout(io.StringIO()),
        mock.patch.object(module, "Beta", partial(checked_beta, validate_args=False)),
        torch.device(device),
    ):
        head = module.FlowmatchingActionHead(module.FlowmatchingActionHeadConfig(**head_config))
    return head.eval()


def get_action(
    head: nn.Module, backbone_features: Tensor, state: Tensor, embodiment_id: Tensor, noise: Tensor
) -> Tensor:
    """Calls ``get_action`` of the head with the given noise.

    Args:
        head: The head that ``build`` returned.
        backbone_features: ``(batch, T_vl, context_dim)``.
        state: ``(batch, 1, state_dim)``.
        embodiment_id: ``(batch,)`` long.
        noise: ``(batch, horizon, action_dim)``, used in place of the noise that it would draw.

    Returns:
        ``(batch, horizon, action_dim)``.
    """
    batch_feature = import_head().BatchFeature
    backbone = batch_feature(data={"backbone_features": backbone_features})
    inputs = batch_feature(data={"state": state, "embodiment_id": embodiment_id})

    def given_noise(size: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> Tensor:
        if tuple(size) != tuple(noise.shape):
            raise ValueError(f"noise: given {tuple(noise.shape)}, the head draws {tuple(size)}")
        return noise.to(dtype=dtype, device=device)

    with mock.patch.object(torch, "randn", given_noise):
        return head.get_action(backbone, inputs).action_pred


def import_head() -> ModuleType:
    """The module of ``FlowmatchingActionHead``."""
    if HEAD in sys.modules:
        return sys.modules[HEAD]
    spec = importlib.util.find_spec("lerobot")
    if spec is None or not spec.submodule_search_locations:
        command = pip_install("--no-deps", "lerobot==0.4.4")
        raise MissingExtraError(f"lerobot is not installed. Install with: {command}", name="lerobot")
    with empty_packages(Path(spec.submodule_search_locations[0])):
        return importlib.import_module(HEAD)


@contextlib.contextmanager
def empty_packages(root: Path) -> Iterator[None]:
    """Replaces the packages of lerobot by empty ones with the same paths, and restores them at the end."""
    stubs = {}
    package = HEAD.rpartition(".")[0]
    while package:
        stubs[package] = ModuleType(package)
        stubs[package].__path__ = [str(root.joinpath(*package.split(".")[1:]))]
        package = package.rpartition(".")[0]
    stubs["lerobot.utils"] = ModuleType("lerobot.utils")
    stubs["lerobot.utils.import_utils"] = ModuleType("lerobot.utils.import_utils")
    stubs["lerobot.utils.import_utils"]._transformers_available = True  # type: ignore[attr-defined]
    with replaced_modules(stubs):
        yield


@contextlib.contextmanager
def replaced_modules(stubs: Mapping[str, ModuleType]) -> Iterator[None]:
    """Replaces imported modules by others of the same names, and restores them at the end."""
    before = {name: sys.modules.get(name) for name in stubs}
    sys.modules.update(stubs)
    try:
        yield
    finally:
        for name, module in before.items():
            if module is None:
                del sys.modules[name]
            else:
                sys.modules[name] = module
