"""The flags of commands that load a whole checkpoint: what `Policy.from_pretrained` gets of them."""

from __future__ import annotations

import argparse
import json
import re
from pathlib import Path
from typing import Any

import pytest

import saccade
from saccade import cli
from saccade._internal.flags import UsageError, add_num_threads, add_policy_options, policy_options
from saccade.checkpoints import inspection
from saccade_lab.sim import episodes, policy
from tests.helpers.lfs_pointer import POINTER

#: The flags, and what is passed on of them.
FLAGS = [
    "--data-config",
    "so100",
    "--action-horizon",
    "8",
    "--processor-options",
    '{"letter_box_transform": true}',
]
OVERRIDES = {
    "data_config": "so100",
    "action_horizon": 8,
    "processor_options": {"letter_box_transform": True},
}


class Loaded(Exception):
    """Ends a command where it loads."""


def loading(module: Any, name: str, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Replaces a function; returns the keyword arguments of its call, once there was one."""
    given: dict[str, Any] = {}

    def load(*arguments: Any, **options: Any) -> Any:
        given.update(options)
        raise Loaded

    monkeypatch.setattr(module, name, load)
    return given


def options(*words: str) -> dict[str, Any]:
    parser = argparse.ArgumentParser()
    add_policy_options(parser)
    add_num_threads(parser)
    return policy_options(parser.parse_args(words))


def test_what_is_not_given_is_none() -> None:
    precision = {"backbone": "float32", "head": "float32"}
    names = ("embodiment", "preprocessing", "tokenizer", *OVERRIDES, "num_threads")
    assert options() == {"precision": precision, **dict.fromkeys(names)}
    assert options(*FLAGS, "--head-precision", "int8") == options() | OVERRIDES | {
        "precision": precision | {"head": "int8"}
    }


def test_processor_options_are_json_or_a_file_of_it(tmp_path: Path) -> None:
    file = tmp_path / "options.json"
    file.write_text('{"shortest_image_edge": 256}')
    assert options("--processor-options", str(file))["processor_options"] == {"shortest_image_edge": 256}
    assert options("--processor-options", " {}")["processor_options"] == {}
    for word in ("{", "[]", "true", str(tmp_path), str(tmp_path / "no"), "", "letter_box_transform=true"):
        message = f"--processor-options: given {word!r:.100}, expected a JSON object or a file with one"
        with pytest.raises(UsageError, match="^" + re.escape(message)):
            options("--processor-options", word)
    for text, problem in (
        ("[1]", "got list"),
        (POINTER, "it is a Git LFS pointer"),
        ("[" * 100_000, "cannot be read"),
    ):
        file.write_text(text)
        with pytest.raises(UsageError, match=rf"options.json: .*{problem}"):
            options("--processor-options", str(file))
    with pytest.raises(UsageError, match="expected a JSON object"):
        options("--processor-options", '{"a": ' * 100_000)


@pytest.mark.parametrize("command", ["act", "serve"])
def test_commands_pass_them_on(command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    given = loading(saccade.Policy, "from_pretrained", monkeypatch)
    words = [command, "checkpoint", *FLAGS, *(["--port", "0"] if command == "serve" else [])]
    with pytest.raises(Loaded):
        cli.main(words)
    assert given == options(*FLAGS)


def test_inspect_passes_them_on(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    given = loading(inspection, "inspect", monkeypatch)
    with pytest.raises(Loaded):
        cli.main(["inspect", "checkpoint", "--data-config", "so100"])
    assert given["data_config"] == "so100"
    given = loading(saccade.Policy, "from_pretrained", monkeypatch)
    with pytest.raises(Loaded):
        cli.main(["inspect", "checkpoint", "--precision-check", ".", *FLAGS])
    assert OVERRIDES.items() <= given.items()
    assert cli.main(["inspect", "checkpoint", *FLAGS]) == 2
    assert capsys.readouterr().err == (
        "saccade: --action-horizon, --processor-options: only with --precision-check\n"
    )


def test_rollout_passes_on_those_that_are_given(monkeypatch: pytest.MonkeyPatch) -> None:
    given = loading(saccade.Policy, "from_pretrained", monkeypatch)
    made = episodes.Episodes(
        str(policy.DEMO_CHECKPOINT),
        data_config="so100",
        action_horizon=8,
        processor_options=json.dumps(OVERRIDES["processor_options"]),
    )
    assert made.overrides == OVERRIDES
    with pytest.raises(Loaded):
        _ = made.policy
    assert given == OVERRIDES | {"num_threads": None}
    assert episodes.Episodes(str(policy.DEMO_CHECKPOINT)).overrides == {}
    with pytest.raises(saccade.InputError, match=r"^data_config: expected engine 'rust'"):
        policy.Policy.from_pretrained(engine="torch", data_config="so100")
