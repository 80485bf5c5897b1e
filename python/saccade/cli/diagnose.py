"""`saccade diagnose`: says which inputs a checkpoint uses, from recordings."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from saccade._internal.estimate_text import caution, interval, number
from saccade._internal.files import write_json
from saccade.cli import EXIT_OK, output, recorded, require
from saccade.cli.output import Section

if TYPE_CHECKING:
    from saccade.diagnosis.report import Diagnosis

HELP = "say which inputs a checkpoint uses"
EPILOG = """\
Changes one input of recorded observations at a time, and measures what that does to the actions. Each input
is used, barely used, ignored or undecided; docs/diagnose.md has the rules.

DIR receives results.json, episodes/ (what was measured) and, with the lab, index.html. A run that was
interrupted goes on where it stopped.

examples:
  saccade diagnose my-policy/ my-recordings/ --out out/diagnose
  saccade diagnose my-policy/ my-recordings/ --out out/diagnose --episodes 0,3,5,8,9 --jobs -1 --json
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declares the command's arguments."""
    parser.epilog = EPILOG
    recorded.add_run(parser, "episodes to observe, counted from 0 (default: at most 20, evenly spaced)")


def run(args: argparse.Namespace) -> int:
    """Measures, decides, writes and prints."""
    recorded.check_processes(args)
    require("diagnose")
    from saccade.diagnosis.effects import Measured
    from saccade.diagnosis.plan import default_episodes, planned
    from saccade.diagnosis.report import summarised
    from saccade.diagnosis.work import MeasureEpisode
    from saccade.evaluation.episode_files import EpisodeFiles
    from saccade.evaluation.recordings import chosen_episodes
    from saccade.evaluation.source import named

    source = recorded.source_of(args)
    with output.progress_bar("loading", transient=True):
        policy, data = source.policy, source.data
        episodes = chosen_episodes(data, args.episodes or default_episodes(len(data)))
        plan = planned(policy, data, episodes, args.seed)
        identity = source.identity()
    settings = {"command": "diagnose", **identity, "seed": args.seed, "episodes": list(episodes)}
    files = EpisodeFiles(args.out, Measured)
    files.begin(settings)
    measured = recorded.computed(MeasureEpisode(source, plan), episodes, files, args, source, "diagnose")
    report = summarised(measured, plan, list(policy.normalizer.action_slices))
    written = {**named(settings, source.names()), **report.to_json()}
    write_json(args.out / "results.json", written)
    drawn = recorded.write_page("diagnosis_page", args.out, report, written, policy, data)
    recorded.print_results(args, written, tables(report), drawn)
    return EXIT_OK


def tables(report: Diagnosis) -> list[Section]:
    """The verdicts, and the effect of every change."""
    from saccade.diagnosis.report import episode_counts

    verdicts = [
        [name, one.name, number(one.effect, ".2f"), interval(one.low, one.high, ".2f")]
        for name, one in report.inputs.items()
    ]
    effects = [
        [
            name,
            change,
            number(one.share.value, ".3f"),
            interval(one.share.low, one.share.high, ".3f"),
            number(one.of_noise.value, ".2f"),
            str(one.episodes),
            ", ".join(f"{key} {value:.4g}" for key, value in one.units.items()),
        ]
        for name, verdict in report.inputs.items()
        for change, one in verdict.changes.items()
    ]
    title = "Effects, as shares of what another observation and what another noise changes"
    head = ["input", "change", ">effect", ">95 %", ">of noise", ">episodes", "in the robot's units"]
    return [
        Section("What the policy listens to", ["input", "verdict", ">effect", ">95 %"], verdicts),
        Section(title, head, effects, note=caution(episode_counts(report))),
    ]
