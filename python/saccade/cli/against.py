"""`saccade evaluate --against`: an earlier run, or another checkpoint that is run too."""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any

from saccade._internal.estimate_text import interval
from saccade.cli import describe, output, recorded
from saccade.cli.output import Section
from saccade.errors import InputError, SaccadeError

if TYPE_CHECKING:
    from saccade._internal.bootstrap import Estimate
    from saccade.evaluation.episode_files import EpisodeFiles
    from saccade.evaluation.prediction import Predicted, Shapes
    from saccade.evaluation.report import Comparison, Evaluation
    from saccade.evaluation.work import PredictEpisode

#: Where in DIR the episodes of the other checkpoint are. It is itself the directory of a run.
FOLDER = "against"
#: How it is loaded, whatever the precision of this run.
EXACT = {"backbone": "float32", "head": "float32"}


@dataclass(frozen=True)
class Against:
    """What a run is compared with.

    Attributes:
        settings: Its settings.
        names: What readers call its checkpoint and recordings.
        files: Its episodes.
        work: What computes them; None for an earlier run.
        found: The episodes of an earlier run, all of them.
    """

    settings: Mapping[str, Any]
    names: Mapping[str, str]
    files: EpisodeFiles[Predicted]
    work: PredictEpisode | None
    found: Sequence[Predicted] = ()

    def begin(self) -> None:
        """Writes the settings, or checks that the directory has results of the same settings.

        Raises:
            InputError: It has results of others.
        """
        if self.work is not None:
            self.files.begin(self.settings)
            self.files.write_names(self.names)

    def predictions(self, episodes: Sequence[int], args: argparse.Namespace) -> Sequence[Predicted]:
        """The episodes, those that are missing computed now."""
        if self.work is None:
            return self.found
        return recorded.computed(self.work, episodes, self.files, args, self.work.source, "against")


def chosen(
    args: argparse.Namespace,
    work: PredictEpisode,
    settings: Mapping[str, Any],
    episodes: Sequence[int],
    shapes: Shapes,
) -> Against:
    """What ``--against`` names, checked before anything is computed.

    Args:
        args: The arguments of the command.
        work: What computes an episode of this run.
        settings: The settings of this run.
        episodes: Its episodes.
        shapes: The shapes of its arrays, which are those of the other.

    Raises:
        FileNotFoundError: There is neither a checkpoint nor a run.
        InputError: The chunks would be no pairs, or an earlier run lacks an episode or is damaged.
    """
    from saccade.evaluation.episode_files import EpisodeFiles
    from saccade.evaluation.prediction import Predicted

    files = EpisodeFiles(args.against, Predicted, shapes.check)
    if files.is_begun():
        return _earlier(files, settings, episodes)
    return _checkpoint(args, work, settings, EpisodeFiles(args.out / FOLDER, Predicted, shapes.check))


def _earlier(files: EpisodeFiles[Predicted], settings: Mapping[str, Any], episodes: Sequence[int]) -> Against:
    """An earlier run."""
    from saccade.evaluation.pairing import check_said, check_shared

    where, about = f"--against: {files.folder.parent}", files.settings()
    check_shared(about, settings, where)
    check_said(about, where)
    found = {episode: files.load(episode) for episode in episodes}
    missing = [str(episode) for episode, one in found.items() if one is None]
    if missing:
        raise InputError(
            f"{where}: expected the episodes of this run, {', '.join(missing)} "
            f"{'is' if len(missing) == 1 else 'are'} missing"
        )
    return Against(about, files.names(), files, None, [one for one in found.values() if one is not None])


def _checkpoint(
    args: argparse.Namespace,
    work: PredictEpisode,
    settings: Mapping[str, Any],
    files: EpisodeFiles[Predicted],
) -> Against:
    """A checkpoint, loaded as this run's, but exact: in float32, with the sampler of its config."""
    from saccade.evaluation.pairing import check_shared, interface_of
    from saccade.evaluation.source import Source

    where = f"--against: {args.against}"
    try:
        source = Source.of(args.against, work.source.recordings, {**work.source.options, "precision": EXACT})
        with output.progress_bar("loading", transient=True):
            about = {**settings, **source.checkpoint_identity(), "sampling": {}}
            about |= interface_of(source.policy)
    except (SaccadeError, FileNotFoundError, PermissionError) as error:
        raise InputError(
            f"{where}: expected the directory of an earlier run, or a checkpoint: {describe(error)}"
        ) from None
    check_shared(about, settings, where)
    try:  # only now, since the recordings need not have the keys of a policy that is refused
        about["language_key"] = source.data.language_key
    except SaccadeError as error:
        raise InputError(f"{where}: {describe(error)}") from None
    check_shared(about, settings, where)
    if about == settings:
        raise InputError(
            f"{where}: expected another checkpoint, precision or sampling than that of this run, got the same"
        )
    other = replace(work, source=source, sampling={})
    return Against(about, source.names(), files, other)


def beside(comparison: Comparison, other: Evaluation, settings: Mapping[str, Any]) -> dict[str, Any]:
    """What results.json has of a comparison: the differences, and the errors of the other."""
    from saccade.evaluation.pairing import SAID, described

    return {
        **comparison.to_json(),
        "name": described(settings),
        "other": {
            **{name: settings[name] for name in SAID},
            **asdict(other.errors),
            "by_key": {key: asdict(one) for key, one in other.by_key.items()},
            "seconds": other.seconds,
        },
    }


def sections(report: Evaluation, comparison: Comparison, other: Evaluation, name: str) -> list[Section]:
    """Both errors with their paired difference, and how far the actions are apart."""
    rows = [
        _row("MSE", report.mse, other.mse, comparison.mse),
        *(
            _row(f"  {key}", report.by_key[key].mse, other.by_key[key].mse, one)
            for key, one in comparison.mse_by_key.items()
        ),
        _row("MAE", report.mae, other.mae, comparison.mae),
    ]
    head = ["", ">this run", ">the other", ">difference", ">95 %"]
    apart = [[key, f"{mean:.6g}", f"{comparison.largest[key]:.6g}"] for key, mean in comparison.mean.items()]
    return [
        Section(f"Against {name}, on the same observations and noise", head, rows),
        Section("Actions of both apart, in the robot's units", ["", ">mean", ">largest"], apart),
    ]


def _row(name: str, own: float, other: float, difference: Estimate) -> list[str]:
    bounds = interval(difference.low, difference.high, ".4g")
    return [name, f"{own:.6g}", f"{other:.6g}", f"{difference.value:.6g}", bounds]
