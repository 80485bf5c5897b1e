"""Results of a rollout: summaries, the result file, the contact sheet."""

import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from statistics import fmean, median
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFont

import saccade
from saccade._internal.arrays import UInt8Array
from saccade._internal.files import write_atomically
from saccade_lab.intervals import wilson
from saccade_lab.machine import cpu_name
from saccade_lab.sim.policy import Policy
from saccade_lab.sim.rollout import PARTS, Episode

RECORDED_PACKAGES = ("numpy", "mujoco", "metaworld", "gymnasium")
TILE = 160  # pixels along each side of a picture in the contact sheet
LABEL_HEIGHT = 18
GREEN, RED, INK, PAPER = (46, 160, 67), (207, 34, 46), (240, 240, 240), (24, 26, 30)


@dataclass(frozen=True)
class Summary:
    """Episodes of one task, or of all.

    Attributes:
        task: Its name, or ``"all"``.
        episodes, successes: How many.
        interval: 95 % interval of the success rate.
        median_steps: Control steps to success; ``None`` without a success.
        milliseconds: Mean per chunk, by part of ``PARTS``.
    """

    task: str
    episodes: int
    successes: int
    interval: tuple[float, float]
    median_steps: float | None
    milliseconds: dict[str, float]


def summarize(task: str, episodes: Sequence[Episode]) -> Summary:
    """Summarises at least one episode."""
    steps = [episode.steps for episode in episodes if episode.success]
    chunks = sum(episode.chunks for episode in episodes)
    milliseconds = {
        part: sum(episode.milliseconds[part] * episode.chunks for episode in episodes) / chunks
        for part in PARTS
    }
    return Summary(
        task=task,
        episodes=len(episodes),
        successes=len(steps),
        interval=wilson(len(steps), len(episodes)),
        median_steps=median(steps) if steps else None,
        milliseconds={part: round(spent, 3) for part, spent in milliseconds.items()},
    )


def summarize_tasks(episodes: Sequence[Episode]) -> list[Summary]:
    """One summary per task, in the order in which they were run."""
    tasks = dict.fromkeys(episode.task for episode in episodes)
    return [summarize(task, [episode for episode in episodes if episode.task == task]) for task in tasks]


def result_record(
    episodes: Sequence[Episode],
    policy: Policy,
    *,
    seeds: range,
    tasks: Sequence[str],
    instruction_from: str | None,
) -> dict[str, Any]:
    """The content of the result file: enough to repeat the rollout and to compare the results.

    Args:
        episodes: Those that were completed.
        policy: The one that acted.
        seeds: Those that were requested, each for every task.
        tasks: Those that were requested.
        instruction_from: The task whose instruction the policy got, if not the task's own.
    """
    return {
        "complete": len(episodes) == len(seeds) * len(tasks),
        "checkpoint": {"path": str(policy.checkpoint), "sha256": policy.checkpoint_sha256()},
        "engine": policy.describe(),
        "machine": {"cpu": cpu_name(), "system": platform.platform(), "python": platform.python_version()},
        "packages": {"saccade": saccade.__version__, **{name: version(name) for name in RECORDED_PACKAGES}},
        "policy": {
            "num_future_tokens": policy.head.config.num_future_tokens,
            "num_steps": policy.head.config.num_steps,
            "action_horizon": policy.horizon,
            "execute_steps": policy.config.execute_steps,
            "num_vl_tokens": policy.num_vl_tokens(),
        },
        "tasks": list(tasks),
        "seeds": list(seeds),
        "instruction_from": instruction_from,
        "success_rate": fmean(episode.success for episode in episodes) if episodes else None,
        "summary": [asdict(summary) for summary in summarize_tasks(episodes)],
        "episodes": [asdict(episode) for episode in episodes],
    }


def tile(picture: UInt8Array) -> UInt8Array:
    """A picture ``(H, W, 3)`` as the contact sheet shows it, ``(TILE, TILE, 3)``."""
    return np.asarray(Image.fromarray(picture).resize((TILE, TILE), Image.Resampling.BOX))


def write_contact_sheet(pictures: Sequence[tuple[Episode, UInt8Array]], path: Path) -> None:
    """Writes the last picture of every episode, a row per task, framed green for success and red for failure.

    Args:
        pictures: Episodes, at least one, with what ``tile`` returned.
        path: Path of the PNG.
    """
    tasks = list(dict.fromkeys(episode.task for episode, _ in pictures))
    rows = {task: [pair for pair in pictures if pair[0].task == task] for task in tasks}
    columns = max(len(row) for row in rows.values())
    row_height = TILE + LABEL_HEIGHT
    sheet = Image.new("RGB", (columns * TILE, len(tasks) * row_height), PAPER)
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(size=12)
    for row, task in enumerate(tasks):
        for column, (episode, picture) in enumerate(rows[task]):
            left, top = column * TILE, row * row_height
            sheet.paste(Image.fromarray(picture), (left, top + LABEL_HEIGHT))
            colour = GREEN if episode.success else RED
            box = (left + 1, top + LABEL_HEIGHT, left + TILE - 2, top + row_height - 2)
            draw.rectangle(box, outline=colour, width=3)
            draw.text((left + 4, top + 2), f"{task} {episode.seed}", fill=INK, font=font)
    with write_atomically(path) as temporary:
        sheet.save(temporary)
