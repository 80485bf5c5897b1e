"""Random weights and inputs, the same for every contender, and the result of the reference.

Weights are rounded to bfloat16, so that storing them in bfloat16 loses nothing. Checkpoints and expected
results are kept under a folder between runs.
"""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benches.peers.cases import LINEAR_SHAPES, NUM_BLOCKS, WHOLE, Case
from saccade import HeadConfig
from saccade_lab.published import sized_config, small_config

Arrays = dict[str, NDArray[Any]]
EMBODIMENT = 1
NUM_EMBODIMENTS = 2  # affects memory, not the work


def config_of(case: Case) -> dict[str, Any]:
    """Config, in the published names, of the head that contains the case's piece.

    "Four blocks" is a head without VL self-attention and with a narrow output, so that an engine that only
    has whole heads does almost nothing except the blocks.
    """
    full = case.size != "small"
    config = sized_config("n1.5", num_embodiments=NUM_EMBODIMENTS) if full else small_config()
    config["num_target_vision_tokens"] = case.num_future_tokens
    if case.piece == "blocks":
        config["diffusion_model_cfg"] |= {"num_layers": NUM_BLOCKS, "output_dim": 64}
    if case.piece not in WHOLE:
        config |= {"use_vlln": False, "hidden_size": 64}
    config["diffusion_model_cfg"]["output_dim"] = config["hidden_size"]
    return config


def checkpoint(case: Case, folder: Path, dtype: str = "float32") -> Path:
    """The checkpoint of the piece under `folder`, `float32` or `bfloat16`; written if it is not there."""
    piece = "head" if case.piece in WHOLE else "cross" if case.piece == "linear" else case.piece
    path = folder / f"{case.size}-{piece}-n{case.num_future_tokens}-{dtype}"
    if not path.exists():
        import torch

        from saccade_lab.reference import random_weights

        part = path.with_name(path.name + ".part")
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        stored = getattr(torch, dtype)
        random_weights.write_checkpoint(part, config_of(case), 0, dtype=stored, through=torch.bfloat16)
        part.rename(path)
    return path


def inputs_of(case: Case, config: HeadConfig) -> Arrays:
    """Standard normal inputs: `features (batch, T_vl, context_dim)`, `state (batch, state_dim)`,
    `noise (batch, samples, horizon, action_dim)`, `rows (batch, samples, 1 + N + horizon, width)`, or of the
    linear layers `x0`, `w0`, ...
    """
    generator = np.random.default_rng(0)

    def normal(*shape: int) -> NDArray[np.float32]:
        return generator.standard_normal(shape, dtype=np.float32)

    if case.piece == "linear":
        arrays = {}
        for index, (rows, inputs, outputs) in enumerate(LINEAR_SHAPES):
            arrays[f"x{index}"] = normal(rows, inputs)
            arrays[f"w{index}"] = normal(outputs, inputs) / np.float32(np.sqrt(inputs))
        return arrays
    rows = 1 + config.num_future_tokens + config.action_horizon
    arrays = {
        "features": normal(case.batch, case.num_vl_tokens, config.context_dim),
        "state": normal(case.batch, config.state_dim),
        "noise": normal(case.batch, case.samples, config.action_horizon, config.encoder_action_dim),
    }
    if case.piece == "cross":
        arrays["rows"] = normal(case.batch, case.samples, rows, config.width)
    return arrays


def expected_of(case: Case, folder: Path) -> Arrays:
    """The inputs of the case, and as `expected` what `saccade_lab.reference` in float32 makes of them.

    With the arrays of `times_of`. torch is imported only if they are not there yet: a contender's process has
    what it needs itself. Of four blocks `rows` is what enters the first one; the noise is that of
    one Euler step.
    """
    path = folder / f"expected-{_slug(case)}.npz"
    if path.exists():
        with np.load(path) as held:
            return dict(held)
    import torch

    from saccade_lab.reference import ActionHead

    source = checkpoint(case, folder)  # also of the linear layers, which need nothing of it but its sizes
    arrays = inputs_of(case, HeadConfig.from_file(source / "config.json"))
    with torch.inference_mode():
        head: Any = ActionHead.from_pretrained(source)
        arrays |= times_of(head, case.steps)
        if case.piece == "linear":
            products = [arrays[f"x{i}"] @ arrays[f"w{i}"].T for i in range(len(LINEAR_SHAPES))]
            arrays["expected"] = np.concatenate([product.ravel() for product in products])
        elif case.piece == "cross":
            rows = torch.from_numpy(arrays["rows"]).flatten(1, 2)
            features = torch.from_numpy(arrays["features"])
            blocks = list(head.model.transformer_blocks)[::2]
            arrays["expected"] = np.stack([block.attn1(rows, features)[0].numpy() for block in blocks])
        elif case.piece == "blocks":
            vl_embs = head.encode(arrays["features"])
            trace_of = head.model.transformer_blocks[0].register_forward_pre_hook(
                lambda _, given: arrays.__setitem__("rows", given[0].numpy().copy())
            )
            traced = head.trace(
                vl_embs,
                arrays["state"],
                EMBODIMENT,
                noise=arrays["noise"][:, 0],
                num_steps=1,
                record=("hidden",),
                blocks=NUM_BLOCKS - 1,
            )
            trace_of.remove()
            arrays["expected"] = traced.hidden[0, NUM_BLOCKS - 1].numpy()
        else:
            vl_embs = head.encode(arrays["features"]).repeat_interleave(case.samples, dim=0)
            state = np.repeat(arrays["state"], case.samples, axis=0)
            noise = arrays["noise"].reshape(-1, *arrays["noise"].shape[2:])
            actions = head.sample(vl_embs, state, EMBODIMENT, noise=noise, num_steps=case.steps)
            arrays["expected"] = actions.numpy().reshape(case.batch, case.samples, *actions.shape[1:])
    part = path.with_suffix(".part.npz")
    np.savez(part, allow_pickle=False, **arrays)
    part.rename(path)
    return arrays


def times_of(head: Any, steps: int, embodiment: int = EMBODIMENT) -> Arrays:
    """What depends on the time alone: `time0`, `modulations0`, ..., as `pieces.times` gives it for a
    reference head.
    """
    from benches.peers.pieces import times

    arrays: Arrays = {}
    for step, (time, modulations) in enumerate(times(head, embodiment, steps)):
        arrays |= {f"time{step}": time.detach().numpy(), f"modulations{step}": modulations.detach().numpy()}
    return arrays


def _slug(case: Case) -> str:
    """The case without its threads, as a file name."""
    return "-".join(str(value) for name, value in case.as_dict().items() if name != "threads")
