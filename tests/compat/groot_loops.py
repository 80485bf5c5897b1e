"""Isaac-GR00T's released open loop and `saccade.evaluate`; `groot_open_loop` starts it.

    python groot_loops.py RELEASE FOLDER

Prints a JSON list of cases: how they were computed, and the errors of both. FOLDER receives the pictures that
the released code draws.
"""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

import saccade
from tests.helpers.recorded_cases import Recorded, demo_policy, made_up

LENGTHS = (9, 5, 16)  # with a tail; shorter than a chunk; whole chunks
STRIDES = (3, 16)
SEED = 2


class Asked:
    """The bundled policy as the released code calls it: once for each chunk of an episode, in order."""

    def __init__(self, episode: int, stride: int) -> None:
        self.episode, self.stride, self.calls = episode, stride, 0

    def chunk(self, observation: Any) -> Any:
        """What the documentation of `evaluate` says that a prediction is."""
        step, self.calls = self.calls * self.stride, self.calls + 1
        return demo_policy().act(observation, seed=(SEED, self.episode, step))


class FlatPolicy(Asked):
    """As N1.5 calls a policy."""

    def get_action(self, point: dict[str, Any]) -> Any:
        """From a data point, which has the recorded actions too."""
        return self.chunk({key: value for key, value in point.items() if not key.startswith("action.")})


class NestedPolicy(Asked):
    """As N1.6 and N1.7 call a policy."""

    def get_action(self, observation: dict[str, Any]) -> Any:
        """With an empty dictionary of what else it says."""
        return self.chunk(observation), {}


class Points:
    """Recordings as N1.5's data set."""

    def __init__(self, data: Recorded, stride: int) -> None:
        self.data, self.stride = data, stride

    def get_step_data(self, episode: int, step: int) -> dict[str, Any]:
        """A data point: what was seen, and the recorded actions from there on."""
        seen = self.data.observation(episode, step)
        actions = self.data.actions(episode, step, self.stride)
        return {
            **{f"video.{key}": frames[0] for key, frames in seen["video"].items()},
            **{f"state.{key}": values[0] for key, values in seen["state"].items()},
            **{key: texts[0][0] for key, texts in seen["language"].items()},
            **{f"action.{key}": values for key, values in actions.items()},
        }


class Episodes:
    """Recordings as the loader of N1.6 and N1.7."""

    def __init__(self, data: Recorded) -> None:
        types: Any = importlib.import_module("gr00t.data.types")
        self.data, seen = data, data.observation(0, 0)
        self.modality_configs = {
            part: types.ModalityConfig(delta_indices=[0], modality_keys=list(seen[part]))
            for part in ("video", "state", "language")
        }
        self.modality_configs["action"] = types.ModalityConfig(
            delta_indices=list(range(16)), modality_keys=list(data.done)
        )

    def __getitem__(self, episode: int) -> pd.DataFrame:
        """The steps of an episode, one in a row."""
        steps = self.data.seen[episode]
        columns: dict[str, list[Any]] = {
            f"action.{key}": list(one[episode]) for key, one in self.data.done.items()
        }
        for part in ("video", "state"):
            columns |= {f"{part}.{key}": [one[part][key][0, 0] for one in steps] for key in steps[0][part]}
        columns |= {
            f"language.{key}": [one["language"][key][0][0] for one in steps] for key in steps[0]["language"]
        }
        return pd.DataFrame(columns)


def by_n15(data: Recorded, stride: int, folder: Path) -> Iterator[tuple[Any, ...]]:
    """The MSE of each episode by N1.5's function."""
    released: Any = importlib.import_module("gr00t.utils.eval")
    for episode, length in enumerate(LENGTHS):
        yield (
            released.calc_mse_for_single_trajectory(
                FlatPolicy(episode, stride),
                Points(data, stride),
                episode,
                modality_keys=list(data.done),
                steps=length,
                action_horizon=stride,
            ),
        )


def by_later(data: Recorded, stride: int, folder: Path) -> Iterator[tuple[Any, ...]]:
    """MSE and MAE of each episode by the function of N1.6 and N1.7."""
    released: Any = importlib.import_module("gr00t.eval.open_loop_eval")
    tags: Any = importlib.import_module("gr00t.data.embodiment_tags")
    for episode in range(len(LENGTHS)):
        yield released.evaluate_single_trajectory(
            NestedPolicy(episode, stride),
            Episodes(data),
            episode,
            tags.EmbodimentTag.NEW_EMBODIMENT,
            steps=max(LENGTHS) + 1,
            action_horizon=stride,
            save_plot_path=str(folder / "curves.png"),
        )


def main(release: str, folder: Path) -> None:
    """Compares all types and strides."""
    loop = by_n15 if release == "n1.5" else by_later
    cases = []
    for dtype in (np.float32, np.float64):
        data = made_up(LENGTHS, dtype)
        for stride in STRIDES:
            columns = list(zip(*loop(data, stride, folder), strict=True))
            report = saccade.evaluate(demo_policy(), data, stride=stride, seed=SEED)
            cases.append(
                {
                    "recorded": np.dtype(dtype).name,
                    "computed": sorted({value.dtype.name for column in columns for value in column}),
                    "released": [float(np.mean(np.array(column))) for column in columns],
                    "saccade": [report.mse, report.mae][: len(columns)],
                }
            )
    print(json.dumps(cases))


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
