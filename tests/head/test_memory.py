"""Memory that the system refuses: each call ends in an error that says how much was asked for.

Each case runs in a process of its own, with little more address space than it has taken already.
"""

from __future__ import annotations

import subprocess
import sys

import pytest

PREPARE = """
import importlib.resources, json, pathlib, resource
import numpy as np
import saccade
from saccade._saccade import tensor_shapes

demo = saccade.demo_checkpoint()
head = saccade.ActionHead.from_pretrained(demo, num_threads=1)
config = head.config
state = np.zeros((1, config.state_dim), np.float32)

def context(batch=1, tokens=16):
    return head.encode(np.zeros((batch, tokens, config.context_dim), np.float32))

def tensors(width, context_dim):
    weights = {"to_q": (width, width), "to_k": (width, context_dim), "to_v": (width, context_dim)}
    weights["to_out.0"] = (width, width)
    named = {f"{name}.weight": np.zeros(shape, np.float32) for name, shape in weights.items()}
    return named | {f"{name}.bias": np.zeros(shape[0], np.float32) for name, shape in weights.items()}

def wide_head():
    # Tensors and config of a head of some 120 MB.
    text = json.loads((pathlib.Path(str(demo)) / "config.json").read_text())["action_head_cfg"]
    text |= {"input_embedding_dim": 768, "hidden_size": 128}
    text["diffusion_model_cfg"] |= {"num_attention_heads": 8, "attention_head_dim": 96}
    shapes = tensor_shapes(json.dumps(text))
    return {name: np.zeros(shape, np.float32) for name, shape in shapes}, text

def limit(megabytes):
    with open("/proc/self/statm") as file:
        used = int(file.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + megabytes * 2**20, resource.RLIM_INFINITY))

def refused(call):
    try:
        call()
    except MemoryError as error:
        expected = ("bytes", "does not fit in memory", "Unable to allocate")
        assert any(words in str(error) for words in expected), error
    except saccade.InputError as error:
        assert "memory" in str(error) or "bytes" in str(error), error
    else:
        raise AssertionError("it was not refused")
"""

# What is prepared before memory is limited, the limit in MB above what is in use, the call that is refused.
CASES = {
    "encode a large batch": (
        "features = np.zeros((2000, 64, config.context_dim), np.float32)",
        60,
        "head.encode(features)",
    ),
    "encode many tokens": (
        "features = np.zeros((1, 60000, config.context_dim), np.float32)",
        60,
        "head.encode(features)",
    ),
    "encode and record": (
        "features = np.zeros((1, 3000, config.context_dim), np.float32)",
        80,
        "head.encode(features, record=('attention', 'hidden'))",
    ),
    "encode with a mask of dropped tokens": (
        "features = np.zeros((2000, 64, config.context_dim), np.float32)\n"
        "drop = np.zeros((2000, 64), bool)\ndrop[:, 3] = True",
        60,
        "head.encode(features, drop_vl=drop)",
    ),
    "many samples": (
        "kept = context()\n"
        "noise = np.zeros((1, 4000, config.action_horizon, config.encoder_action_dim), np.float32)",
        60,
        "head.sample(kept, state, 0, noise=noise, num_samples=4000)",
    ),
    "many samples with noise of their own": (
        "kept = context()",
        40,
        "head.sample(kept, state, 0, seed=0, num_samples=10**6)",
    ),
    "a batch of samples": (
        "kept = context(500)\n"
        "states = np.zeros((500, config.state_dim), np.float32)\n"
        "noise = np.zeros((500, 8, config.action_horizon, config.encoder_action_dim), np.float32)",
        40,
        "head.sample(kept, states, 0, noise=noise, num_samples=8)",
    ),
    "samples with refreshed future rows": (
        "kept = context()\n"
        "noise = np.zeros((1, 3000, config.action_horizon, config.encoder_action_dim), np.float32)",
        60,
        "head.sample(kept, state, 0, noise=noise, num_samples=3000, future_refresh=2)",
    ),
    "the velocity of a batch": (
        "kept = context(4000, 2)\n"
        "states = np.zeros((4000, config.state_dim), np.float32)\n"
        "actions = np.zeros((4000, config.action_horizon, config.encoder_action_dim), np.float32)",
        60,
        "head.velocity(kept, states, 0, actions, 0)",
    ),
    "warm up for many tokens": ("", 60, "head.warmup(10**6)"),
    "warm up for a large batch": ("", 60, "head.warmup(64, batch=10**4)"),
    "warm up for many samples": ("", 60, "head.warmup(8, num_samples=10**5)"),
    "many future tokens": (
        "kept = context()\n"
        "tokens = saccade.Intervention(future_tokens=np.zeros((300_000, config.width), np.float32))",
        200,
        "head.sample(kept, state, 0, seed=0, intervention=tokens)",
    ),
    "many future tokens with a cut": (
        "kept = context()\n"
        "tokens = saccade.Intervention(future_tokens=np.zeros((8_000, config.width), np.float32),\n"
        "    cut=[('action', 'future')])",
        60,
        "head.sample(kept, state, 0, seed=0, intervention=tokens)",
    ),
    "a trace": (
        "kept = context(1, 4000)",
        40,
        "head.trace(kept, state, 0, seed=0, num_steps=200, record=('attention', 'hidden'))",
    ),
    "copies of vl_embs": (
        "kept = head.encode(np.zeros((4000, 30, config.context_dim), np.float32))",
        2,
        "[kept.vl_embs for _ in range(20)]",
    ),
    "a head from tensors": (
        "named, wide = wide_head()",
        40,
        "saccade.ActionHead.from_tensors(named, config=wide)",
    ),
    "a head from a file": (
        "import tempfile\nfrom safetensors.numpy import save_file\n"
        "named, wide = wide_head()\ndirectory = tempfile.TemporaryDirectory()\n"
        "path = directory.name + '/model.safetensors'\nsave_file(named, path)",
        40,
        "saccade.ActionHead.from_pretrained(path, config=wide)",
    ),
    "a cross-attention": ("named = tensors(2048, 2048)", 20, "saccade.CrossAttention(named, 16)"),
    "keys and values": (
        "layer = saccade.CrossAttention(tensors(256, 64), 4)\nrows = np.zeros((4, 20_000, 64), np.float32)",
        40,
        "layer.project(rows)",
    ),
    "queries": (
        "layer = saccade.CrossAttention(tensors(256, 64), 4)\n"
        "kept = layer.project(np.zeros((1, 10, 64), np.float32))\n"
        "rows = np.zeros((1, 60_000, 256), np.float32)",
        80,
        "layer(rows, kept)",
    ),
}


@pytest.mark.skipif(sys.platform != "linux", reason="address space is limited as Linux does")
@pytest.mark.parametrize("name", CASES)
def test_memory_that_is_refused_is_an_error(name: str) -> None:
    prepare, megabytes, call = CASES[name]
    script = "\n".join(
        [
            PREPARE,
            prepare,
            f"limit({megabytes})",
            f"refused(lambda: {call})",
            "resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY,) * 2)",
            "assert np.isfinite(head.sample(context(1, 4), state, 0, seed=1)).all()",
        ]
    )
    command = [sys.executable, "-c", script]
    run = subprocess.run(command, check=False, capture_output=True, text=True, timeout=120)
    assert run.returncode == 0, f"{name}: {run.returncode}\n{run.stderr[-2000:]}"
