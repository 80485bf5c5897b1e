"""The pages of ``saccade evaluate`` and ``saccade diagnose``: one file each, which needs no network."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2

from saccade import Policy
from saccade._internal import estimate_text
from saccade._internal.files import write_atomically
from saccade.diagnosis import Diagnosis, Verdict
from saccade.diagnosis.changes import camera_of, replacement
from saccade.diagnosis.report import episode_counts
from saccade.evaluation import Evaluation, Recordings
from saccade.evaluation.recordings import observation_at
from saccade_lab.extras import LAB
from saccade_lab.recordings import pictures
from saccade_lab.recordings.advice import advice

SHOWN = 12  # episodes whose curves are on the page; all are in curves/


def evaluation_page(report: Evaluation, about: Mapping[str, Any], folder: Path) -> None:
    """Writes ``index.html``, and ``curves/EPISODE.png`` of every episode.

    Raises:
        MissingExtraError: A package that draws is not installed.
        OSError: A file cannot be written.
    """
    LAB.require("matplotlib", "PIL", "jinja2")
    curves = folder / "curves"
    curves.mkdir(parents=True, exist_ok=True)
    shown: list[dict[str, Any]] = []
    for one in report.predictions:
        picture = pictures.png(pictures.curves(report, one))
        with write_atomically(curves / f"{one.episode:06d}.png") as temporary:
            temporary.write_bytes(picture)
        if len(shown) < SHOWN:
            shown.append({"episode": one.episode, "picture": pictures.data_url(picture)})
    _write(
        folder / "index.html",
        "evaluation.html.jinja",
        report=report,
        about=about,
        curves=shown,
        hidden=len(report.predictions) - len(shown),
        caution=estimate_text.caution([len(report.predictions)]),
        by_step=pictures.data_url(pictures.png(pictures.by_step(report))),
    )


def diagnosis_page(
    report: Diagnosis, about: Mapping[str, Any], policy: Policy, data: Recordings, folder: Path
) -> None:
    """Writes ``index.html``, with the frames at which each input matters most.

    Raises:
        MissingExtraError, OSError: As ``evaluation_page``.
    """
    LAB.require("matplotlib", "PIL", "jinja2")
    inputs = [
        {
            "name": name,
            "verdict": verdict,
            "advice": advice(name, verdict),
            "most": _most(verdict),
            "frames": _frames(name, verdict, policy, data, report),
            "texts": _texts(name, verdict, policy, data, report),
        }
        for name, verdict in report.inputs.items()
    ]
    effects = pictures.data_url(pictures.png(pictures.effects(report)))
    _write(
        folder / "index.html",
        "diagnosis.html.jinja",
        report=report,
        about=about,
        inputs=inputs,
        effects=effects,
        caution=estimate_text.caution(episode_counts(report)),
    )


def _most(verdict: Verdict) -> tuple[str, int, int] | None:
    """The main change, or the largest, and where it is largest; None if no change is possible."""
    if not verdict.changes:
        return None
    main = [name for name, one in verdict.changes.items() if one.kind == "main"]
    largest = max(verdict.changes, key=lambda name: verdict.changes[name].share.value)
    name = main[0] if main else largest
    return name, *verdict.changes[name].largest


def _texts(
    name: str, verdict: Verdict, policy: Policy, data: Recordings, report: Diagnosis
) -> tuple[str, str | None] | None:
    """The instruction at which it matters most, and what replaced it."""
    most = _most(verdict)
    if name != "instruction" or most is None:
        return None
    _, episode, step = most
    (text,) = observation_at(policy, data, episode, step).instructions
    return None if text is None else (text, replacement(text, report.plan.instructions))


def _frames(
    name: str, verdict: Verdict, policy: Policy, data: Recordings, report: Diagnosis
) -> list[dict[str, str]]:
    """The frames at which the change matters most; for a camera only its own, and the partner's."""
    most = _most(verdict)
    if most is None:
        return []
    change, episode, step = most
    seen = observation_at(policy, data, episode, step)
    (frames,) = seen.frames
    views = list(frames)
    chosen = [
        view
        for view in views
        if name in ("instruction", "state", "history", f"camera.{camera_of(view, views)}")
    ]
    found = [{"name": view, "picture": pictures.data_url(frames[view])} for view in chosen]
    partner = report.plan.partners.get(episode)
    if change == "swapped" and name.startswith("camera.") and partner is not None:
        length, theirs = (len(data.episodes[one].steps) for one in (episode, partner))
        other = observation_at(policy, data, partner, min(theirs - 1, step * theirs // length)).frames[0]
        found += [
            {"name": f"{view}, swapped", "picture": pictures.data_url(other[view])}
            for view in chosen
            if view in other
        ]
    return found


def _write(path: Path, template: str, **values: Any) -> None:
    source = (resources.files("saccade_lab.recordings") / template).read_text(encoding="utf-8")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    environment.globals.update(number=estimate_text.number, interval=estimate_text.interval)
    with write_atomically(path) as temporary:
        temporary.write_text(environment.from_string(source).render(**values), encoding="utf-8")
