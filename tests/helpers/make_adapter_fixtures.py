"""Writes tests/data/adapters: LoRA adapters of a small head and what PEFT makes of it with them.

PEFT is not needed by the tests. Install it to write the files again, then run this in the repository's root:

    pip install --no-deps peft==0.17.1 accelerate==1.10.1
    pip install psutil
    HF_HUB_OFFLINE=1 PYTHONPATH=. python tests/helpers/make_adapter_fixtures.py
"""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import peft
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from saccade_lab.reference import ActionHead
from tests.helpers.released import load_released

DATA = Path(__file__).parents[1] / "data" / "adapters"
TINY = load_released("n15_tiny")
BLOCK = r"action_head.model.transformer_blocks"

#: By the name of the folder: dtype of the base, dtype of the adapter's file, arguments of PEFT's config.
CASES: dict[str, tuple[torch.dtype, torch.dtype, dict[str, Any]]] = {
    # Ends of names; a rank and an alpha of their own; an embedding, a convolution, a module trained whole.
    "float32": (
        torch.float32,
        torch.float32,
        {
            "r": 4,
            "lora_alpha": 6,
            "target_modules": ["to_q", "0.attn1.to_k", "position_embedding", "patch_embedding"],
            "rank_pattern": {rf"{BLOCK}.0.attn1.to_q": 3},
            "alpha_pattern": {r"attn1\.to_k": 5},
            "modules_to_save": ["state_encoder"],
            "lora_dropout": 0.1,
        },
    ),
    # A regular expression; the scaling of rsLoRA.
    "bfloat16": (
        torch.bfloat16,
        torch.float32,
        {
            "r": 5,
            "lora_alpha": 7,
            "use_rslora": True,
            "target_modules": rf".*{BLOCK}\.[01]\.ff\.net\.2",
        },
    ),
    # Layers by their indices; a file of an adapter in 16 bits.
    "float16": (
        torch.float16,
        torch.bfloat16,
        {
            "r": 8,
            "lora_alpha": 16,
            "target_modules": ["to_v"],
            "exclude_modules": ["vl_self_attention.transformer_blocks.0.attn1.to_v"],
            "layers_to_transform": [0],
            "layers_pattern": "transformer_blocks",
        },
    ),
}


class Whole(nn.Module):
    """A model with the names of a whole checkpoint: a head, and one layer of a backbone."""

    def __init__(self) -> None:
        super().__init__()
        self.action_head = ActionHead.from_pretrained(TINY.path, config=TINY.config)
        self.backbone = nn.ModuleDict({"patch_embedding": nn.Conv2d(3, 6, 2)})


def main() -> None:
    """Writes a folder for each case."""
    torch.manual_seed(0)
    whole = Whole()
    DATA.mkdir(exist_ok=True)
    backbone = {name: value for name, value in whole.state_dict().items() if name.startswith("backbone.")}
    save_file(backbone, DATA / "backbone.safetensors")
    for name, (dtype, adapter_dtype, options) in CASES.items():
        folder = DATA / name
        base = copy.deepcopy(whole).to(dtype)
        before = {key: value.clone() for key, value in base.state_dict().items()}
        adapted = peft.get_peft_model(copy.deepcopy(base), peft.LoraConfig(**options))
        adapted.peft_config["default"].base_model_name_or_path = "someone/base"
        with torch.no_grad():
            for key, parameter in adapted.named_parameters():
                if "lora_" in key or "modules_to_save" in key:
                    parameter.copy_(torch.randn(parameter.shape))
        adapted.save_pretrained(folder)
        weights = folder / "adapter_model.safetensors"
        save_file({key: value.to(adapter_dtype) for key, value in load_file(weights).items()}, weights)
        (folder / "README.md").unlink()
        loaded = peft.PeftModel.from_pretrained(copy.deepcopy(base), folder)
        merged: dict[str, Tensor] = loaded.merge_and_unload().state_dict()
        changed = {key: value for key, value in merged.items() if not torch.equal(value, before[key])}
        assert changed.keys() <= before.keys()
        save_file(changed, folder / "merged.safetensors")
        about = json.loads((folder / "adapter_config.json").read_text())
        print(name, about["peft_type"], len(changed), "tensors")


if __name__ == "__main__":
    main()
