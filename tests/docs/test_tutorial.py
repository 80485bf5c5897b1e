"""The tutorial, as a reader follows it: its server runs in another process while its Python runs."""

from __future__ import annotations

import re
import socket
import subprocess
import sys
from pathlib import Path

import pytest

import saccade
from tests.docs.test_docs import code_blocks, command_lines
from tests.helpers.paths import ROOT

PAGE = ROOT / "docs" / "tutorial.md"
PORT = "5555"


@pytest.fixture
def port() -> str:
    """A port that is free, instead of the one on the page."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return str(free.getsockname()[1])


def test_what_it_shows_is_what_a_reader_sees(port: str, tmp_path: Path) -> None:
    (served,) = [block for block in code_blocks(PAGE, "bash") if "saccade serve" in block]
    ((_, *words),) = command_lines(served, "saccade")
    arguments = [{PORT: port, "$demo": str(saccade.demo_checkpoint())}.get(word, word) for word in words]
    python = "\n".join(code_blocks(PAGE, "python"))
    assert python.count(PORT) == 1
    server = subprocess.Popen([sys.executable, "-m", "saccade", "serve", *arguments], cwd=tmp_path)
    try:
        done = subprocess.run(
            [sys.executable, "-c", python.replace(PORT, port)],
            cwd=tmp_path,
            capture_output=True,
            text=True,
            check=False,
        )
    finally:
        server.kill()
        server.wait()
    assert done.returncode == 0, done.stderr
    shares = re.findall(r"^(state|future|action): (\d+)% of its attention is on images$", done.stdout, re.M)
    assert [name for name, _ in shares] == ["state", "future", "action"]
    assert all(0 < int(share) < 100 for _, share in shares)
    changes = re.findall(r"^(hand|gripper) \[([\d.\s]+)\]$", done.stdout, re.M)
    assert [name for name, _ in changes] == ["hand", "gripper"]
    for _, numbers in changes:
        assert len(numbers.split()) == 16
        assert len(set(numbers.split())) > 1
    assert "['gripper', 'hand'] " in done.stdout
