"""The pilots of the study, one policy at a time: trains what is not there and judges it.

    saccade demos --out out/pilots/demos --tasks reach,stereo-reach,two-goals --episodes 500 --jobs 2
    python studies/why-32/pilots.py out/pilots --num-future-tokens 32 --seed 102 --steps 1200
    python studies/why-32/pilots.py out/pilots --num-future-tokens 32 --seed 102 --steps 1200 --blind

The settings are those of `why_32.plan`, with the backbone in OUT/backbone. With --blind, the
policy is judged on grey pictures.
"""

from __future__ import annotations

import argparse
import functools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from saccade_lab.sim.policy import Policy
from saccade_lab.sim.rollout import environment_for, run_episode
from saccade_lab.training.train import train
from why_32.plan import BACKBONE, BASE

FIRST_SEED, EPISODES = 500_000, 30
GREY = 128


def grey(observe: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """An observation whose pictures are grey."""
    seen = observe()
    pictures = {name: np.full_like(image, GREY) for name, image in seen["images"].items()}
    return {**seen, "images": pictures}


def main() -> None:
    """Prints the number of successes of each task."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--num-future-tokens", type=int, default=32)
    parser.add_argument("--seed", type=int, default=100)
    parser.add_argument("--steps", type=int, default=BASE.steps)
    parser.add_argument("--category-std", type=float, default=BASE.category_std)
    parser.add_argument("--blind", action="store_true")
    args = parser.parse_args()
    torch.set_num_threads(1)
    demos, backbone = args.out / "demos", args.out / "backbone"
    varied = {name: getattr(args, name) for name in ("num_future_tokens", "seed", "steps", "category_std")}
    settings = replace(BASE, **varied)
    directory = args.out / "-".join(f"{name}-{value}" for name, value in varied.items())
    if not (backbone / "model.safetensors").exists():
        train(demos, backbone, BACKBONE, lambda progress: None)
    train(demos, directory, settings, lambda progress: None, start=backbone)
    policy = Policy.from_pretrained(directory, num_threads=1)
    for task in policy.config.tasks:
        environment = environment_for(policy, task)
        if args.blind:
            environment.observe = functools.partial(grey, environment.observe)  # type: ignore[method-assign]
        episodes = [run_episode(environment, policy, FIRST_SEED + number) for number in range(EPISODES)]
        environment.close()
        print(f"{directory.name} {task}: {sum(one.success for one in episodes)} of {EPISODES}", flush=True)


if __name__ == "__main__":
    main()
