"""The flags that commands share: one name, one meaning, one way to be read."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest

from saccade import InputError, cli
from saccade._internal import flags as arguments
from saccade._internal.flags import UsageError
from saccade_lab.flags import indices


@pytest.mark.parametrize("command", ["act", "inspect", "convert", "quantize", "resize", "serve"])
def test_a_command_that_needs_a_checkpoint_takes_it_first(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        cli.main([command])
    assert "arguments are required: CHECKPOINT" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["bench", "rollout", "attention", "parity"])
def test_a_command_with_a_default_takes_a_flag(command: str) -> None:
    parser = cli.build_parser(command)
    assert parser.parse_args([command]).checkpoint is None
    assert parser.parse_args([command, "--checkpoint", "policy"]).checkpoint == Path("policy")


@pytest.mark.parametrize("command", [*cli.COMMANDS, *cli.LAB_COMMANDS])
def test_the_help_has_examples(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit, match="0"):
        cli.main([command, "--help"])
    _, found, examples = capsys.readouterr().out.partition("\nexamples:\n")
    assert found
    assert f"  saccade {command}" in examples


def parsed(*words: str) -> argparse.Namespace:
    parser = argparse.ArgumentParser()
    arguments.add_list(parser, "--tasks", help="tasks")
    arguments.add_list(parser, "--blocks", item=int, metavar="N", minimum=0, help="blocks")
    arguments.add_integer(parser, "--episodes", default=4, help="episodes")
    arguments.add_number(parser, "--share", minimum=0.0, below=1.0, help="share")
    return parser.parse_args(words)


@pytest.mark.parametrize(
    "words",
    [["reach,push,fork"], ["reach", "push", "fork"], ["reach,push", "fork,reach"], [" reach, push,fork "]],
)
def test_lists_take_commas_and_spaces(words: list[str]) -> None:
    assert parsed("--tasks", *words).tasks == ("reach", "push", "fork")
    assert parsed("--blocks", "3,0", "3", "--tasks", *words).blocks == (3, 0)
    assert parsed().tasks is None


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--tasks", ","], "--tasks: expected at least one name"),
        (["--blocks", ""], "--blocks: expected at least one number"),
        (["--blocks", "1,x"], "--blocks: given 'x', expected numbers"),
        (["--blocks", "2", "-1"], "--blocks: given 2, -1, expected numbers from 0 on"),
        (["--episodes", "0"], "--episodes: given 0, expected at least 1"),
        (["--share", "1"], "--share: given 1.0, expected 0 to below 1"),
        (["--share", "nan"], "--share: given nan, expected 0 to below 1"),
    ],
)
def test_what_is_out_of_range_is_refused(words: list[str], message: str) -> None:
    with pytest.raises(UsageError, match="^" + message):
        parsed(*words)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--num-future-tokens", "-3"), "--num-future-tokens: given -3, expected at least 0"),
        (
            ("--num-future-tokens", "3", "--perturbation", "nan"),
            "--perturbation: given nan, expected at least 0",
        ),
    ],
)
def test_resize_names_the_flag(
    options: tuple[str, ...], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["resize", "checkpoint", "--out", "out", *options]) == 2
    assert capsys.readouterr().err == f"saccade: {message}\n"


def test_indices() -> None:
    assert indices("--blocks", None, 3) == (0, 1, 2)
    with pytest.raises(InputError, match="--blocks: given 0, 4, expected 0 to 3"):
        indices("--blocks", (4, 0), 4)


def test_the_help_of_a_default() -> None:
    parser = argparse.ArgumentParser()
    arguments.add_out(parser, "out/here")
    arguments.add_seed(parser, "seed of the noise")
    text = " ".join(parser.format_help().split())
    assert "(default: out/here)" in text
    assert "seed of the noise (default: 0)" in text
    assert parser.parse_args([]).out == Path("out/here")


def test_the_default_number_of_jobs() -> None:
    parser = argparse.ArgumentParser()
    arguments.add_processes(parser, "episodes")
    assert arguments.processes(parser.parse_args([])) == {"backend": "loky", "jobs": 1, "address": None}
    cluster = parser.parse_args(["--backend", "ray", "--address", "first:6379"])
    assert arguments.processes(cluster) == {"backend": "ray", "jobs": -1, "address": "first:6379"}
