"""`saccade evaluate`: compares a checkpoint's actions with recorded ones."""

from __future__ import annotations

import argparse
import csv
from pathlib import Path
from typing import TYPE_CHECKING, Any

from saccade._internal import flags as arguments
from saccade._internal.files import write_atomically, write_json
from saccade.cli import EXIT_OK, output, recorded, require
from saccade.cli.output import Section
from saccade.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from saccade.evaluation.prediction import Predicted
    from saccade.evaluation.report import Comparison, Evaluation

HELP = "compare a checkpoint's actions with recorded ones"
EPILOG = """\
Every --stride steps of an episode, a chunk of actions is predicted from the recorded observation and compared
with the recorded actions. The error is Isaac-GR00T's, and is compared with those of holding still, of the
mean action, and of the checkpoint itself with other noise. docs/evaluate.md has the rules.

DIR receives results.json, errors.csv (a row for each episode, step and key) and episodes/ (the actions); with
the lab also index.html and curves/. A run that was interrupted goes on where it stopped.

examples:
  saccade evaluate my-policy/ my-recordings/ --out out/evaluate
  saccade evaluate my-policy/ my-recordings/ --out out/eight --stride 8 --episodes 0,1,2 --jobs -1
  saccade evaluate my-policy/ my-recordings/ --out out/int8 --precision int8 --against out/evaluate
  saccade evaluate my-policy/ my-recordings/ --out out/evaluate --certify certificate.json
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.epilog = EPILOG
    recorded.add_run(parser, "episodes to predict, counted from 0 (default: all)")
    arguments.add_integer(
        parser, "--stride", help="steps between two predictions (default: the actions in a chunk)"
    )
    arguments.add_num_steps(parser)
    parser.add_argument(
        "--against",
        type=Path,
        metavar="DIR",
        help="results of an earlier run on the same recordings: another checkpoint, precision or number of "
        "steps",
    )
    parser.add_argument(
        "--certify", type=Path, metavar="FILE", help="write what `saccade certify` checks on another machine"
    )


def run(args: argparse.Namespace) -> int:
    """Predicts, compares, writes and prints."""
    recorded.check_processes(args)
    require("evaluate")
    from saccade.evaluation.certificate import certify
    from saccade.evaluation.episode_files import EpisodeFiles
    from saccade.evaluation.layout import Layout
    from saccade.evaluation.open_loop import checked_stride
    from saccade.evaluation.prediction import Predicted
    from saccade.evaluation.recordings import chosen_episodes
    from saccade.evaluation.report import summarised
    from saccade.evaluation.work import PredictEpisode

    source = recorded.source_of(args)
    with output.progress_bar("loading", transient=True):
        policy, data = source.policy, source.data
        episodes = chosen_episodes(data, args.episodes)
        stride = checked_stride(policy, args.stride)
        identity = source.identity()
    sampling = {} if args.num_steps is None else {"num_steps": args.num_steps}
    settings = {"command": "evaluate", **identity, "stride": stride, "seed": args.seed, "sampling": sampling}
    before = None if args.against is None else earlier(args.against, settings, episodes)
    files = EpisodeFiles(args.out, Predicted)
    files.begin(settings)
    layout = Layout.of(policy.normalizer)
    del policy  # a certificate loads others
    work = PredictEpisode(source, stride, args.seed, sampling)
    predictions = recorded.computed(work, episodes, files, args, source, "evaluate")
    report = summarised(predictions, layout, stride, args.seed)
    comparison = None if before is None else report.compare(summarised(before, layout, stride, args.seed))
    written = {
        **settings,
        **report.to_json(),
        "against": None if comparison is None else comparison.to_json(),
    }
    write_json(args.out / "results.json", written)
    write_table(args.out / "errors.csv", report.table)
    if args.certify is not None:
        write_json(args.certify, certify(source, episodes, stride, args.seed, sampling).to_json())
    drawn = recorded.write_page("evaluation_page", report, written, args.out)
    recorded.print_results(args, written, tables(report, comparison), drawn)
    return EXIT_OK


def earlier(folder: Path, settings: Mapping[str, Any], episodes: Sequence[int]) -> list[Predicted]:
    """The predictions of an earlier run, checked before anything is computed.

    Raises:
        FileNotFoundError: There are no results.
        InputError: They are of other recordings, stride or seed, or an episode is missing.
    """
    from saccade.evaluation.episode_files import EpisodeFiles
    from saccade.evaluation.prediction import Predicted

    files = EpisodeFiles(folder, Predicted)
    about = files.settings()
    for name in ("command", "recordings", "stride", "seed"):
        one, other = (
            given.get("sha256") if isinstance(given, dict) else given
            for given in (about.get(name), settings[name])
        )
        if one != other:
            raise InputError(f"--against: {folder}: expected the {name} of this run, {other}, got {one}")
    found = [(episode, files.load(episode)) for episode in episodes]
    missing = [str(episode) for episode, one in found if one is None]
    if missing:
        raise InputError(
            f"--against: {folder}: expected the episodes of this run, {', '.join(missing)} "
            f"{'is' if len(missing) == 1 else 'are'} missing"
        )
    return [one for _, one in found if one is not None]


def write_table(path: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Writes rows as CSV."""
    with write_atomically(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def tables(report: Evaluation, comparison: Comparison | None) -> list[Section]:
    """The errors, their baselines, and the comparison."""
    named = {
        "policy": report.errors,
        **{f"  {key}": one for key, one in report.by_key.items()},
        **{f"{name} (baseline)": one for name, one in report.baselines.items()},
    }
    rows = []
    for name, one in named.items():
        low, high = one.intervals["mse"]
        normalized = "" if one.normalized_mse != one.normalized_mse else f"{one.normalized_mse:.6f}"
        rows.append([name, f"{one.mse:.6g}", f"{low:.4g} to {high:.4g}", f"{one.mae:.6g}", normalized])
    title = (
        f"Errors of {report.num_chunks} chunks in {len(report.predictions)} episodes, in the robot's units"
    )
    found = [Section(title, ["", ">MSE", ">95 %", ">MAE", ">normalised MSE"], rows)]
    if comparison is not None:
        differences = [
            [name, f"{one.value:.6g}", f"{one.low:.4g} to {one.high:.4g}"]
            for name, one in (("MSE", comparison.mse), ("MAE", comparison.mae))
        ]
        differences += [
            [f"actions apart, {key}", f"{mean:.6g}", f"at most {comparison.largest[key]:.4g}"]
            for key, mean in comparison.mean.items()
        ]
        found.append(Section("This run minus the earlier one", ["", ">difference", ">95 %"], differences))
    return found
