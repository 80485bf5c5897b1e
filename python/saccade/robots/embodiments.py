"""Embodiment tags: the released tables of ids, and how a request names a robot.

Ids belong to a release. ``robocasa_panda_omron`` is 13 in N1.6 and 10 in N1.7. An argument ``embodiment`` is
a tag or an id; ``embodiment_id`` is always a number, and ``embodiment_ids`` are several.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path

from saccade._internal.arrays import integer
from saccade.errors import InputError

_RELEASED = json.loads(Path(__file__).with_name("released_embodiments.json").read_text(encoding="utf-8"))

#: The ids of N1 and N1.5 by tag. There ``genie1_gripper`` is an old name of ``agibot_genie1``.
N15_IDS: Mapping[str, int] = _RELEASED["ids"]["n1.5"]
#: The ids of N1.6 by tag.
N16_IDS: Mapping[str, int] = _RELEASED["ids"]["n1.6"]
#: The ids of N1.7 by tag.
N17_IDS: Mapping[str, int] = _RELEASED["ids"]["n1.7"]
#: The ids of lerobot's own table for N1.5, where a step has none.
LEROBOT_N15_IDS: Mapping[str, int] = _RELEASED["ids"]["lerobot n1.5"]

#: Released ids by version of the model.
IDS: Mapping[str, Mapping[str, int]] = {"n1": N15_IDS, "n1.5": N15_IDS, "n1.6": N16_IDS, "n1.7": N17_IDS}

#: Names of N1.7 that differ from their tag in more than case. A name takes precedence over a tag:
#: ``unitree_g1`` is another robot in N1.6.
N17_NAMES: Mapping[str, str] = _RELEASED["names"]["n1.7"]

#: Robots whose keys an error lists.
MOST_LISTED = 4


def resolved(text: str, version: str | None, tags: Iterable[str]) -> str:
    """The tag that a text names, as the release resolves it: without case, names before tags.

    The tag need not be one of ``tags``, those of a checkpoint, of which one is also found by its exact text.

    Example:
        >>> resolved(" XDOF ", "n1.7", ()), resolved("GR1", "n1.6", ()), resolved("my_arm", "n1.6", ())
        ('xdof_relative_eef_relative_joint', 'gr1', 'my_arm')
    """
    known = IDS.get(version or "", {})
    plain = text.strip().lower()
    named = N17_NAMES.get(plain) if version == "n1.7" else None
    if named is not None:
        return named
    if plain in known:
        return plain
    listed = list(tags)
    return text if text in listed else text.strip()


def choose(
    wanted: str | int | None,
    tags: Iterable[str],
    ids: Mapping[str, int],
    version: str | None,
    where: str,
    needs: Mapping[str, str],
) -> str:
    """The tag of the robot that a tag, a name of the release, an id, or None for the only robot, requests.

    An id may be given for the only robot if that has none: a fine-tune may name a robot that the released
    code does not know. The id then selects the head's embodiment. A message lists what each robot ``needs``.
    """
    listed = list(tags)
    if wanted is None:
        found = listed if len(listed) == 1 else []
    elif isinstance(wanted, str):
        # A name of the release counts first; the exact text of a tag of the file, if that robot is not there.
        names = (resolved(wanted, version, listed), wanted.strip())
        found = [tag for tag in names if tag in listed][:1]
    else:
        asked = integer("embodiment", wanted, least=0)
        alone = len(listed) == 1
        found = [tag for tag in listed if ids.get(tag, asked if alone else None) == asked]
    if len(found) != 1:
        shown = ", ".join(f"{tag} ({ids[tag]})" if tag in ids else tag for tag in listed)
        keys = "; ".join(f"{tag} needs {needs[tag]}" for tag in listed[:MOST_LISTED] if needs.get(tag))
        raise InputError(
            f"embodiment: expected one of those in {where} ({shown}), got {wanted!r}"
            f"{'; ' if keys else ''}{keys}"
        )
    return found[0]
