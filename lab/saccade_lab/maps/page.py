"""The HTML page: one file that needs no network, to choose block, step, head, token and camera."""

from __future__ import annotations

import base64
import io
from importlib import resources
from pathlib import Path
from typing import Any

import jinja2
import numpy as np
import numpy.typing as npt
from PIL import Image

from saccade._internal.files import write_atomically
from saccade_lab.maps.notes import GROUP_COLOURS, KIND_COLOURS, NO_FUTURE, NO_IMAGES, NO_PICTURES
from saccade_lab.maps.record import MEAN, Maps

TEMPLATE = "page.html.j2"
LEVELS = 65535  # probabilities are stored relative to the largest of their row, in 16 bits


def write_page(maps: Maps, path: Path) -> None:
    """Writes the page."""
    with write_atomically(path) as temporary:
        temporary.write_text(render_page(maps), encoding="utf-8")


def render_page(maps: Maps) -> str:
    """The page as text. Nothing in it refers to another file or host."""
    source = (resources.files("saccade_lab.maps") / TEMPLATE).read_text(encoding="utf-8")
    environment = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined)
    environment.policies["json.dumps_kwargs"] = {"sort_keys": False}  # groups keep their order
    # `tojson` escapes what would end the script element; token strings such as </img> are common here.
    return environment.from_string(source).render(
        title=maps.view.title, caveat=maps.caveat, notes=notes(maps), data=page_data(maps)
    )


def notes(maps: Maps) -> list[str]:
    """Notes on what is missing, and why."""
    found = []
    if not maps.num_future_tokens:
        found.append(NO_FUTURE)
    if not maps.view.layout.cameras:
        found.append(NO_IMAGES)
    elif not maps.view.images:
        found.append(NO_PICTURES)
    if not maps.selection.shown_heads:
        found.append(
            f"This page shows only the mean over {len(maps.selection.heads)} heads; choose single heads with "
            "--heads."
        )
    return found


def page_data(maps: Maps) -> dict[str, Any]:
    """The data of the page's script."""
    selection = maps.selection
    return {
        "checkpoint": maps.checkpoint,
        "numFuture": maps.num_future_tokens,
        "layout": maps.view.layout.to_dict(),
        "rows": {name: [rows.start, rows.stop] for name, rows in maps.rows.items()},
        "blocks": [{"block": block, "readsVl": maps.reads_vl(block)} for block in selection.blocks],
        "steps": list(selection.steps),
        "heads": [MEAN, *selection.shown_heads],
        "maps": {
            f"{step},{block}": _packed(_shown(maps, attention))
            for (step, block), attention in maps.attention.items()
        },
        "images": {name: _data_url(picture) for name, picture in maps.view.images.items()},
        "occlusion": None if maps.occlusion is None else maps.occlusion.to_dict(),
        "summaries": [
            {
                key: entry[key]
                for key in ("step", "block", "head", "group", "overlap", "shuffled", "redrawn", "per_head")
                if key in entry
            }
            for entry in maps.summaries
        ],
        "colours": {**GROUP_COLOURS, **KIND_COLOURS},
    }


def _shown(maps: Maps, attention: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """The mean over the chosen heads, then those that are shown one by one, ``(1 + shown, rows, keys)``."""
    places = [maps.selection.heads.index(head) for head in maps.selection.shown_heads]
    return np.concatenate((attention.mean(axis=0, keepdims=True), attention[places]))


def _packed(maps: npt.NDArray[np.float32]) -> dict[str, Any]:
    """Each row's largest probability as float32, and all probabilities as shares of it, little-endian."""
    largest = maps.max(axis=-1)
    shares = maps / np.where(largest > 0, largest, 1.0)[..., None]
    return {
        "keys": maps.shape[-1],
        "largest": _base64(largest.astype("<f4")),
        "shares": _base64(np.rint(shares * LEVELS).astype("<u2")),
    }


def _base64(array: npt.NDArray[Any]) -> str:
    return base64.b64encode(np.ascontiguousarray(array).tobytes()).decode("ascii")


def _data_url(picture: npt.NDArray[np.uint8]) -> str:
    """The picture as a PNG in a data URL."""
    stream = io.BytesIO()
    Image.fromarray(picture).save(stream, "PNG", optimize=True)
    return "data:image/png;base64," + base64.b64encode(stream.getvalue()).decode("ascii")
