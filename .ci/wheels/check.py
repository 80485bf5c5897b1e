"""Tests the wheel in an environment with NumPy and nothing else. `test.py` runs this program in it.

    python check.py OUT.npz

Stops with an error at the first failure. The bundled policy acts from images and an instruction, and its head
in each precision on fixed inputs; these actions are written to OUT.npz. Prints one line of JSON. Starts no
other process, so that it can run under an emulator.
"""

from __future__ import annotations

import importlib.metadata
import io
import json
import platform
import random
import sys
import tempfile
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

import saccade
from saccade import cli
from saccade.checkpoints import convert, resize

PACKAGE = Path(saccade.__file__).parent
DEMO = saccade.demo_checkpoint()
PRECISIONS = ("float32", "bfloat16", "int8", "int4")
RANDOM = random.Random(6)  # the same numbers under every NumPy


def uniform(*shape: int) -> npt.NDArray[np.float32]:
    """Numbers between -1 and 1."""
    values = [RANDOM.uniform(-1, 1) for _ in range(int(np.prod(shape)))]
    return np.array(values, np.float32).reshape(shape)


def check_import() -> None:
    """The package is the installed one, has its types, and imports nothing but NumPy."""
    assert Path(sys.prefix) in PACKAGE.parents, f"saccade was imported from {PACKAGE}"
    assert (PACKAGE / "py.typed").is_file()
    assert (PACKAGE / "_saccade.pyi").is_file()
    foreign = {"torch", "rich", "safetensors", "mujoco"} & set(sys.modules)
    assert not foreign, f"import saccade imported {foreign}"
    assert importlib.metadata.version("saccade-vla") == saccade.__version__


def check_cross_attention() -> float:
    """The largest difference from the formula in float64."""
    width, context_dim, heads = 48, 40, 4
    sizes = {"to_q": width, "to_k": context_dim, "to_v": context_dim, "to_out.0": width}
    weights: dict[str, Any] = {f"{name}.weight": uniform(width, size) / 4 for name, size in sizes.items()}
    weights |= {f"{name}.bias": uniform(width) for name in sizes}
    states, context = uniform(2, 7, width), uniform(2, 11, context_dim)
    attention = saccade.CrossAttention(weights, heads)
    output = attention(states, attention.project(context))

    def linear(name: str, x: npt.NDArray[np.floating]) -> Any:
        return x.astype(np.float64) @ weights[f"{name}.weight"].T.astype(np.float64) + weights[f"{name}.bias"]

    q, k, v = (
        linear(name, x).reshape(2, -1, heads, width // heads).transpose(0, 2, 1, 3)
        for name, x in (("to_q", states), ("to_k", context), ("to_v", context))
    )
    logits = q @ k.transpose(0, 1, 3, 2) / np.sqrt(width // heads)
    probabilities = np.exp(logits - logits.max(-1, keepdims=True))
    probabilities /= probabilities.sum(-1, keepdims=True)
    attended = (probabilities @ v).transpose(0, 2, 1, 3).reshape(2, -1, width)
    error = float(np.abs(output - linear("to_out.0", attended)).max())
    assert error < 1e-5, error
    return error


def sample(source: Path, precision: str) -> npt.NDArray[np.float32]:
    """Actions of a head on fixed inputs."""
    head = saccade.ActionHead.from_pretrained(source, precision=precision)
    config = head.config
    RANDOM.seed(7)
    features, state = uniform(2, 21, config.context_dim), uniform(2, config.state_dim)
    noise = uniform(2, config.action_horizon, config.encoder_action_dim)
    actions = np.asarray(head(features, state, 0, noise=noise))
    assert actions.shape == (2, config.action_horizon, config.action_dim)
    assert np.isfinite(actions).all()
    assert 0.01 < np.abs(actions).max() < 100
    return actions


def check_policy() -> None:
    """The bundled policy acts from images and an instruction, repeatably, and heeds the instruction."""
    policy = saccade.Policy.from_pretrained(DEMO)
    observation = policy.example_observation(seed=0)
    actions = policy.act(observation, seed=0)
    assert set(actions) == {"hand", "gripper"}, actions
    for name, chunk in actions.items():
        assert chunk.shape[:2] == (1, policy.head.config.action_horizon), chunk.shape
        assert np.isfinite(chunk).all()
        assert np.array_equal(policy.act(observation, seed=0)[name], chunk)
    (key,) = observation["language"]
    other = {**observation, "language": {key: [["open the drawer"]]}}
    assert not np.array_equal(policy.act(other, seed=0)["hand"], actions["hand"])


def check_files(actions: npt.NDArray[np.float32]) -> None:
    """Conversion to shards keeps the bits; more future tokens keep the actions."""
    with tempfile.TemporaryDirectory() as folder:
        shards, more = Path(folder, "shards"), Path(folder, "more")
        convert(DEMO, shards, max_shard_bytes=1_000_000)
        assert len(list(shards.glob("*.safetensors"))) > 1
        assert np.array_equal(sample(shards, "float32"), actions)
        resize(DEMO, more, num_future_tokens=40)
        assert np.abs(sample(more, "float32") - actions).max() < 1e-5


def run(*args: str) -> tuple[int, str, str]:
    """Exit status and output of a `saccade` command."""
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        try:
            status = cli.main(list(args))
        except SystemExit as stop:
            status = int(stop.code or 0)
    return status, out.getvalue(), err.getvalue()


def check_commands() -> list[str]:
    """Every command has `--help`, and works or says what to install; returns those that work."""
    status, text, _ = run("--help")
    assert status == 0
    assert all(name in text for name in cli.COMMANDS)
    works = []
    for name, expected in {"demo": "hand x", "info": saccade.__version__}.items():
        status, text, errors = run(name)
        assert status == 0, f"{name}: {errors}"
        assert expected in text, f"{name}: {text}"
        works.append(name)
    for name in cli.COMMANDS:
        status, text, errors = run(name, "--help")
        assert status == 0, f"{name} --help: {errors}"
        assert "examples:" in text, name
    for name, args in {
        "inspect": (str(DEMO), "--json"),
        "rollout": ("--episodes", "1"),
        "parity": (),
    }.items():
        status, text, errors = run(name, *args)
        if status == 0:
            json.loads(text)
            works.append(name)
        else:
            assert errors.count("\n") == 1, errors
            assert "pip install" in errors, errors
    return works


def check_torch_is_named() -> None:
    """Importing a part that needs torch fails with a message that names it."""
    for name in ("saccade.torch", "saccade.integrations"):
        missing = None
        try:
            importlib.import_module(name)
        except ModuleNotFoundError as error:
            missing = error.name
        assert missing == "torch", f"{name} missed {missing}"


def main() -> None:
    """Runs all checks."""
    check_import()
    error = check_cross_attention()
    actions = {precision: sample(DEMO, precision) for precision in PRECISIONS}
    check_policy()
    check_files(actions["float32"])
    check_torch_is_named()
    works = check_commands()
    np.savez(sys.argv[1], **actions)  # type: ignore[arg-type]
    config = saccade.show_config(mode="dicts")
    print(
        json.dumps(
            {
                "python": platform.python_version(),
                "numpy": np.__version__,
                "cpu": config["cpu"],
                "family": config["family"],
                "isa": config["isa"],
                "available_isas": config["available_isas"],
                "cross_attention_error": error,
                "commands": works,
            }
        )
    )


if __name__ == "__main__":
    main()
