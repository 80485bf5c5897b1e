"""Speed-up of a lerobot policy's head by `saccade.integrations.accelerate`.

    python -m benches.accelerate                    N1.5's size, 2 threads; three minutes
    python -m benches.accelerate --size small       one second, to check that it runs

A chunk is one call of `get_action`. Calls of the released head and of the same head accelerated alternate;
medians are printed. lerobot's head has float32 weights and runs in float32, and under autocast to bfloat16,
its policy's default. The weights are random, for two embodiments; their number does not affect the time.
`check` is the time that an accelerated call spends on checking whether weights have changed.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
from torch import nn

from saccade.integrations import Accelerated, accelerate
from saccade_lab.reference import lerobot_head
from saccade_lab.reference.random_weights import random_tensor, sized_config, small_config

PRECISIONS = ("float32", "bfloat16", "int8")


def released_head(size: str) -> nn.Module:
    """lerobot's N1.5 head with random weights."""
    config = sized_config("n1.5", num_embodiments=2) if size == "n1.5" else small_config()
    head = lerobot_head.build(config, device="meta")
    generator = torch.Generator().manual_seed(0)
    shapes = {name: tensor.shape for name, tensor in head.state_dict().items()}
    tensors = {name: random_tensor(name, shape, generator) for name, shape in shapes.items()}
    head.load_state_dict(tensors, assign=True)
    return head


def chunk(head: Any, num_vl_tokens: int, autocast: bool) -> Callable[[], Any]:
    """One call of `get_action`, with new inputs each time, because the head writes into them."""
    feature = lerobot_head.import_head().BatchFeature
    features = torch.randn(1, num_vl_tokens, head.config.backbone_embedding_dim)
    state = torch.randn(1, 1, head.config.max_state_dim)
    dtype = torch.bfloat16 if autocast else torch.float32

    def run() -> Any:
        backbone_output = feature(data={"backbone_features": features.to(dtype)})
        action_input = feature(
            data={"state": state.to(dtype), "embodiment_id": torch.zeros(1, dtype=torch.long)}
        )
        with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=autocast):
            return head.get_action(backbone_output, action_input)

    return run


def seconds(work: Callable[[], Any]) -> float:
    """Seconds of one call."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def interleaved(head: Any, handle: Accelerated, work: Callable[[], Any], rounds: int) -> tuple[float, float]:
    """Medians in seconds of the original's and the accelerated calls, which alternate."""
    theirs, ours = [], []
    for turn in range(rounds + 1):
        del head.get_action
        original = seconds(work)
        head.get_action = handle
        accelerated = seconds(work)
        if turn:  # the first call of each warms up
            theirs.append(original)
            ours.append(accelerated)
    return statistics.median(theirs), statistics.median(ours)


def main() -> None:
    """Prints a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--size", choices=("n1.5", "small"), default="n1.5")
    parser.add_argument("--num-vl-tokens", type=int, default=296)
    parser.add_argument("--num-threads", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--precisions", nargs="+", choices=PRECISIONS, default=PRECISIONS)
    options = parser.parse_args()
    torch.set_num_threads(options.num_threads)
    head = released_head(options.size)
    print("| saccade | lerobot | lerobot, ms | accelerated, ms | ratio | check, ms | accelerate(), s |")
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for precision in options.precisions:
        start = time.perf_counter()
        handle = accelerate(head, precision=precision, num_threads=options.num_threads, embodiment_ids=[0])
        loading = time.perf_counter() - start
        check = statistics.median(seconds(partial(getattr, handle, "head")) for _ in range(50))
        for autocast in (False, True):
            work = chunk(head, options.num_vl_tokens, autocast)
            theirs, ours = interleaved(head, handle, work, options.rounds)
            setting = f"float32{', autocast to bfloat16' if autocast else ''}"
            times = f"{1e3 * theirs:.0f} | {1e3 * ours:.0f} | {theirs / ours:.2f}"
            print(f"| {precision} | {setting} | {times} | {1e3 * check:.2f} | {loading:.1f} |", flush=True)
        handle.restore()


if __name__ == "__main__":
    main()
