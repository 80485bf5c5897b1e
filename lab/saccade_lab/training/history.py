"""Plots the losses of a run."""

from pathlib import Path
from typing import Any

from saccade._internal.files import write_atomically


def plot_history(history: list[dict[str, Any]], path: Path) -> None:
    """Plots the losses over the steps on a logarithmic scale."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    figure, axes = pyplot.subplots(figsize=(7, 4), layout="constrained")
    names = {
        "loss": "velocity, training",
        "validation_loss": "velocity, held out",
        "target_loss": "positions, training",
        "validation_target_loss": "positions, held out",
        "alignment_loss": "1 - cosine of the future rows, training",
        "validation_alignment_loss": "1 - cosine of the future rows, held out",
    }
    for key, label in names.items():
        if all(key in entry for entry in history):
            axes.plot([entry["step"] for entry in history], [entry[key] for entry in history], label=label)
    axes.set(xlabel="step", ylabel="mean squared error", yscale="log")
    axes.legend()
    with write_atomically(path) as temporary:
        figure.savefig(temporary, dpi=120)
    pyplot.close(figure)
