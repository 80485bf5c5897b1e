"""Runs the pages for owners of a checkpoint, in a folder with the checkpoints that they name."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.helpers.published import published

DOCS = Path(__file__).resolve().parents[2] / "docs"
TOKENIZER = Path(__file__).resolve().parents[1] / "data" / "backbone" / "tiny_tokenizer.json"
PAGES = (
    *("quickstart", "checkpoints", "checkpoint-tools", "lerobot", "robots"),
    *("interpretability", "protocol"),
)
#: Names on the pages, and the layouts of these checkpoints.
CHECKPOINTS = {
    "GR00T-N1.5-3B": "nvidia",
    "GR00T-N1.7": "n17",
    "my-lerobot-policy": "lerobot",
    "my-finetune": "isaac",
    "my-fork": "fork",
}

#: What the Python blocks of a page begin with. lerobot's policy needs packages and a backbone that the tests
#: do not have: its class is replaced by one that holds lerobot's own head, small, with random weights.
FIRST = {
    "lerobot": """\
import sys, types
import torch
from saccade_lab.reference import lerobot_head
from saccade_lab.reference.random_weights import small_config

HEAD = lerobot_head.build(small_config())

class GrootPolicy(torch.nn.Module):
    @classmethod
    def from_pretrained(cls, name):
        policy = cls()
        policy._groot_model = torch.nn.Module()
        policy._groot_model.action_head = HEAD
        return policy

name = "lerobot.policies.groot.modeling_groot"
for end in (7, 16, 22, None):  # the module and the packages that it is in
    sys.modules[name[:end]] = types.ModuleType(name[:end])
sys.modules[name].GrootPolicy = GrootPolicy
""",
}


def commands(page: Path) -> list[list[str]]:
    """The commands of a page, from top to bottom.

    The Python blocks of a page are one program. Blocks between two shell blocks run together, after all
    earlier Python blocks.
    """
    found: list[list[str]] = []
    program = FIRST.get(page.stem, "")
    for language, text in re.findall(
        r"^```(bash|python)\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL
    ):
        if language == "bash":
            found.append(["bash", "-euo", "pipefail", "-c", text])
            continue
        program += text
        if found and found[-1][0] == sys.executable:
            found.pop()
        found.append([sys.executable, "-c", program])
    return found


@pytest.mark.parametrize("name", PAGES)
def test_page_runs_from_top_to_bottom(name: str, tmp_path: Path) -> None:
    page = DOCS / f"{name}.md"
    asked = commands(page)
    assert asked
    for folder, layout in CHECKPOINTS.items():
        if folder in page.read_text():
            shutil.copytree(published(layout), tmp_path / folder)
    if "tokenizer.json" in page.read_text():
        shutil.copy(TOKENIZER, tmp_path / "tokenizer.json")
    # Commands of the test's own environment take precedence.
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    for command in asked:
        done = subprocess.run(
            command,
            cwd=tmp_path,
            env={**os.environ, "PATH": path},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, f"{command[-1]}\n{done.stdout}\n{done.stderr}"
    # Only files that the page names were written.
    unknown = [found.name for found in tmp_path.iterdir() if found.name not in page.read_text()]
    assert unknown == []
