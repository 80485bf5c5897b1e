"""The vocabulary of flags: one name, one meaning, one way to be read, over all commands and studies."""

from __future__ import annotations

import argparse
from pathlib import Path

import pytest

from saccade import InputError, cli
from saccade._internal import flags as arguments
from saccade._internal.flags import UsageError
from saccade_lab.study.study import STUDIES

#: Flags that say what another one says.
OLD = ("--threads", "--vl-tokens", "--count", "--inputs", "--bf16", "--size", "--sizes", "--model")
NEED_A_CHECKPOINT = ("inspect", "convert", "quantize", "resize")
HAVE_A_DEFAULT = ("rollout", "attention", "bench", "parity")


def parser_of(*words: str) -> argparse.ArgumentParser:
    """The parser of a command, or of one study."""
    parser = cli.build_parser(words[0])
    for word in words:
        found = next(a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
        parser = found.choices[word]
    if isinstance(parser, cli.Parser) and getattr(parser, "study", None) is not None:
        with pytest.raises(SystemExit):
            parser.parse_known_args(["--help"])  # declares its arguments
    return parser


PARSERS = [*((name,) for name in cli.COMMANDS), *(("study", name) for name in (*STUDIES, "report"))]


def flags(parser: argparse.ArgumentParser) -> dict[str, argparse.Action]:
    return {flag: action for action in parser._actions for flag in action.option_strings}


@pytest.mark.parametrize("words", PARSERS, ids=" ".join)
def test_flags_of_a_command(words: tuple[str, ...], capsys: pytest.CaptureFixture[str]) -> None:
    parser = parser_of(*words)
    known = flags(parser)
    assert not known.keys() & set(OLD)
    for flag, action in known.items():
        assert action.help, flag
        assert not action.help.rstrip(")").endswith("."), flag
    if "--steps" in known:  # indices
        assert isinstance(known["--steps"], arguments.StoreList)
    for flag in {
        "--num-steps",
        "--num-threads",
        "--num-vl-tokens",
        "--training-steps",
        "--episodes",
    } & known.keys():
        assert isinstance(known[flag], arguments.StoreNumber), flag
        assert known[flag].type is int
    assert parser.epilog is not None
    assert "examples:" in parser.epilog
    assert "  saccade " + " ".join(words) in parser.epilog


def positionals(command: str) -> list[str]:
    return [action.dest for action in parser_of(command)._actions if not action.option_strings]


def test_a_checkpoint_is_an_argument_or_a_flag() -> None:
    for name in NEED_A_CHECKPOINT:
        assert positionals(name) == ["checkpoint"]
    for name in HAVE_A_DEFAULT:
        assert "--checkpoint" in flags(parser_of(name))
        assert positionals(name) == []


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
    assert arguments.indices("--blocks", None, 3) == (0, 1, 2)
    with pytest.raises(InputError, match="--blocks: given 0, 4, expected 0 to 3"):
        arguments.indices("--blocks", (4, 0), 4)


def test_the_help_of_a_default() -> None:
    parser = argparse.ArgumentParser()
    arguments.add_out(parser, "out/here")
    arguments.add_seed(parser, "seed of the noise")
    text = " ".join(parser.format_help().split())
    assert "(default: out/here)" in text
    assert "seed of the noise (default: 0)" in text
    assert parser.parse_args([]).out == Path("out/here")
