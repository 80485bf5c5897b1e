"""Pictures of the pages: curves of joints, errors by step, effects with intervals; made without pyplot."""

from __future__ import annotations

import base64
import io

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure
from PIL import Image

from saccade.diagnosis import Diagnosis, Effect
from saccade.evaluation import Evaluation, Predicted
from saccade.evaluation.measures import executed
from saccade_lab.recordings.baselines import baselines_by_step

RECORDED, PREDICTED, SOFT = "#000000", "#d55e00", "#0072b2"
COLUMNS = 4  # joints side by side
BASELINES = {"hold": ":", "mean": "--", "noise": "-."}
KINDS = {"main": "#d55e00", "natural": "#0072b2", "removal": "#999999"}


def curves(report: Evaluation, one: Predicted) -> Figure:
    """The recorded and the predicted value of every joint over an episode; dots where chunks begin."""
    names = [
        key if where.stop - where.start == 1 else f"{key} {index - where.start}"
        for key, where in report.layout.keys.items()
        for index in range(where.start, where.stop)
    ]
    columns = min(COLUMNS, len(names))
    rows = -(-len(names) // columns)
    figure = Figure(figsize=(3.2 * columns, 1.9 * rows + 0.5), layout="constrained")
    path, time = executed(one, report.stride), np.arange(len(one.recorded))
    for index, name in enumerate(names):
        axes = figure.add_subplot(rows, columns, index + 1)
        axes.plot(time, one.recorded[:, index], color=RECORDED, linewidth=1.2, label="recorded")
        axes.plot(time, path[:, index], color=PREDICTED, linewidth=1.0, label="predicted")
        axes.plot(one.steps, path[one.steps, index], ".", color=PREDICTED, markersize=4)
        axes.set_title(name, fontsize=9)
        axes.tick_params(labelsize=7)
        axes.spines[["top", "right"]].set_visible(False)
        if not index:
            axes.legend(fontsize=7, frameon=False)
    return figure


def by_step(report: Evaluation) -> Figure:
    """The mean squared error of each step of the horizon with its interval, and that of the baselines."""
    figure = Figure(figsize=(6.4, 2.6), layout="constrained")
    axes = figure.add_subplot()
    known = [(step, one) for step, one in enumerate(report.by_step) if one.intervals]
    steps = [step for step, _ in known]
    axes.fill_between(
        steps,
        [one.intervals["mse"][0] for _, one in known],
        [one.intervals["mse"][1] for _, one in known],
        color=SOFT,
        alpha=0.2,
        linewidth=0,
    )
    axes.plot(steps, [one.mse for _, one in known], color=SOFT, label="policy")
    for name, errors in baselines_by_step(report).items():
        baseline = [errors[step] for step in steps]
        axes.plot(steps, baseline, color="0.35", linewidth=0.9, linestyle=BASELINES[name], label=name)
    axes.legend(fontsize=7, frameon=False, ncols=4, loc="lower right", bbox_to_anchor=(1, 1))
    axes.set_xlabel("step of the horizon")
    axes.set_ylabel("MSE")
    axes.set_ylim(bottom=0)
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def effects(report: Diagnosis) -> Figure:
    """The effect of every change with its interval, and the limits of the verdicts."""
    from saccade.diagnosis.verdicts import IGNORED, USED

    rows: list[tuple[str, Effect]] = [
        (f"{name}, {change}", one)
        for name, verdict in report.inputs.items()
        for change, one in verdict.changes.items()
    ]
    figure = Figure(figsize=(7.0, 0.9 + 0.26 * len(rows)), layout="constrained")
    axes = figure.add_subplot()
    for limit in (IGNORED, USED):
        axes.axvline(limit, color="0.6", linewidth=0.8, linestyle=":")
    for row, (_, one) in enumerate(rows):
        colour = KINDS[str(one.kind)]
        axes.plot([one.share.low, one.share.high], [row, row], color=colour, linewidth=2)
        axes.plot([one.share.value], [row], "o", color=colour, markersize=4)
    axes.set_yticks(range(len(rows)), [label for label, _ in rows], fontsize=8)
    axes.set_ylim(len(rows) - 0.5, -0.5)
    axes.set_xlim(left=0)
    axes.set_xlabel("effect: share of what another observation changes")
    axes.spines[["top", "right"]].set_visible(False)
    return figure


def png(figure: Figure) -> bytes:
    """A figure as PNG."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=110)
    return stream.getvalue()


def data_url(picture: bytes | npt.NDArray[np.uint8]) -> str:
    """A PNG, or a frame as PNG, in a data URL."""
    if not isinstance(picture, bytes):
        stream = io.BytesIO()
        Image.fromarray(picture).save(stream, "PNG", optimize=True)
        picture = stream.getvalue()
    return "data:image/png;base64," + base64.b64encode(picture).decode("ascii")
