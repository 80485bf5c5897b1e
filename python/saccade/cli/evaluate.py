"""`saccade evaluate`: compares a checkpoint's actions with recorded ones."""

from __future__ import annotations

import argparse
import csv
from pathlib import Path
from typing import TYPE_CHECKING, Any

from saccade._internal import flags as arguments
from saccade._internal.estimate_text import caution, interval, number
from saccade._internal.files import write_atomically, write_json
from saccade.cli import EXIT_OK, against, output, recorded, require
from saccade.cli.output import Section

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from saccade.evaluation.prediction import Predicted
    from saccade.evaluation.report import Evaluation

HELP = "compare a checkpoint's actions with recorded ones"
EPILOG = """\
Every --stride steps of an episode, a chunk of actions is predicted from the recorded observation and compared
with the recorded actions. The error is Isaac-GR00T's, and is compared with those of holding still, of the
mean action, and of the checkpoint itself with other noise. docs/evaluate.md has the rules.

DIR receives results.json, errors.csv (a row for each episode, step and key) and episodes/ (the actions), with
--against CHECKPOINT also against/ (its actions); with the lab index.html and curves/. A run that was
interrupted goes on where it stopped.

examples:
  saccade evaluate my-policy/ my-recordings/ --out out/evaluate
  saccade evaluate my-policy/ my-recordings/ --out out/eight --stride 8 --episodes 0,1,2 --jobs -1
  saccade evaluate my-policy/ my-recordings/ --out out/tuned --against base/
  saccade evaluate my-policy/ my-recordings/ --out out/int8 --precision int8 --against my-policy/
  saccade evaluate my-policy/ my-recordings/ --out out/fast --num-steps 2 --against out/evaluate
  saccade evaluate my-policy/ my-recordings/ --out out/evaluate --certify certificate.json
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    from saccade.head.options import INTEGRATORS

    parser.epilog = EPILOG
    recorded.add_run(parser, "episodes to predict, counted from 0 (default: all)")
    arguments.add_integer(
        parser, "--stride", help="steps between two predictions (default: the actions in a chunk)"
    )
    arguments.add_num_steps(parser)
    parser.add_argument(
        "--integrator", choices=tuple(INTEGRATORS), help="of the velocity (default: euler, as released)"
    )
    arguments.add_integer(
        parser,
        "--future-refresh",
        help="recompute state and future rows at every N-th evaluation of the velocity (default: 1, exact)",
    )
    parser.add_argument(
        "--against",
        type=Path,
        metavar="CHECKPOINT|DIR",
        help="compare with another checkpoint or, if this run's precision or sampling is another, with the "
        "same one: it is run too, in float32 and as released. Or DIR: an earlier run on the same recordings",
    )
    parser.add_argument(
        "--certify", type=Path, metavar="FILE", help="write what `saccade certify` checks on another machine"
    )


def run(args: argparse.Namespace) -> int:
    """Predicts, compares, writes and prints."""
    recorded.check_processes(args)
    _check_paths(args)
    require("evaluate")
    from saccade.evaluation.certificate import SAMPLING, certify
    from saccade.evaluation.episode_files import EpisodeFiles
    from saccade.evaluation.layout import Layout
    from saccade.evaluation.open_loop import checked_stride
    from saccade.evaluation.pairing import interface_of
    from saccade.evaluation.prediction import Predicted, Shapes, noise_shape
    from saccade.evaluation.recordings import chosen_episodes
    from saccade.evaluation.report import summarised
    from saccade.evaluation.source import named
    from saccade.evaluation.work import PredictEpisode

    source = recorded.source_of(args)
    sampling = {name: value for name in SAMPLING if (value := getattr(args, name)) is not None}
    with output.progress_bar("loading", transient=True):
        policy, data = source.policy, source.data
        episodes = chosen_episodes(data, args.episodes)
        stride = checked_stride(policy, args.stride)
        settings = {
            "command": "evaluate",
            **source.identity(),
            **interface_of(policy),
            "language_key": data.language_key,
            "stride": stride,
            "seed": args.seed,
            "sampling": sampling,
        }
    layout, shapes, noise = Layout.of(policy.normalizer), Shapes.of(policy, stride), noise_shape(policy)
    del policy  # others are loaded
    work = PredictEpisode(source, stride, args.seed, sampling)
    other = None if args.against is None else against.chosen(args, work, settings, episodes, shapes)
    files = EpisodeFiles(args.out, Predicted, shapes.check)
    files.begin(settings)
    files.write_names(source.names())

    def summary(predictions: Sequence[Predicted]) -> Evaluation:
        return summarised(predictions, layout, stride, args.seed, noise)

    before = None
    if other is not None:
        other.begin()
        before = summary(other.predictions(episodes, args))
    report = summary(recorded.computed(work, episodes, files, args, source, "evaluate"))
    shown = tables(report)
    written = {**named(settings, source.names()), **report.to_json(), "against": None}
    if other is not None and before is not None:
        comparison = report.compare(before)
        written["against"] = against.beside(comparison, before, named(other.settings, other.names))
        shown += against.sections(report, comparison, before, written["against"]["name"])
    write_json(args.out / "results.json", written)
    write_table(args.out / "errors.csv", report.table)
    drawn = recorded.write_page("evaluation_page", args.out, report, written)
    if args.certify is not None:
        write_json(args.certify, certify(source, episodes, stride, args.seed, sampling).to_json())
    recorded.print_results(args, written, shown, drawn)
    return EXIT_OK


def _check_paths(args: argparse.Namespace) -> None:
    """Checks what the flags name before anything is computed.

    Raises:
        UsageError: The certificate cannot be written there, or a run is to be compared with itself.
    """
    if args.certify is not None:
        folder = args.certify.parent
        if args.certify.is_dir():
            raise arguments.UsageError(
                f"--certify: expected the name of a file, got the directory {args.certify}"
            )
        # DIR is made by this run.
        if not folder.is_dir() and not args.out.resolve().is_relative_to(folder.resolve()):
            raise arguments.UsageError(
                f"--certify: expected a file in a directory that exists, got {args.certify}"
            )
    if args.against is not None and args.against.resolve() == args.out.resolve():
        raise arguments.UsageError(f"--against: expected another run than that in --out, got {args.against}")


def write_table(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Writes rows as CSV."""
    with write_atomically(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def tables(report: Evaluation) -> list[Section]:
    """The errors, and their baselines."""
    named = {
        "policy": report.errors,
        **{f"  {key}": one for key, one in report.by_key.items()},
        **{f"{name} (baseline)": one for name, one in report.baselines.items()},
    }
    rows = []
    for name, one in named.items():
        normalized = number(one.normalized_mse, ".6f")
        bounds = interval(*one.intervals["mse"], ".4g")
        rows.append([name, f"{one.mse:.6g}", bounds, f"{one.mae:.6g}", normalized])
    title = (
        f"Errors of {report.num_chunks} chunks in {len(report.predictions)} episodes, in the robot's units"
    )
    head = ["", ">MSE", ">95 %", ">MAE", ">normalised MSE"]
    return [Section(title, head, rows, note=caution([len(report.predictions)]))]
