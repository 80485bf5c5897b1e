"""What a request asks for, in each of the released wire formats, and the answers in the same one.

GR00T N1.5 sends the observation itself as `data`, and gets the actions. N1.6 and N1.7 send `observation` and
`options`, and get `[actions, info]`. N1.7's arrays have another format than the others'; see `npy`.
"""

from __future__ import annotations

import hashlib
import hmac
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from saccade._internal.arrays import integer
from saccade.errors import InputError
from saccade.head.chunking import RELEASED, Chunking, check_ramp_rate, from_released
from saccade.head.options import check_guidance

ENDPOINTS = ("ping", "get_action", "reset", "get_modality_config", "kill")
#: What the released servers answer, word for word.
PING = {"status": "ok", "message": "Server is running"}
UNAUTHORIZED = "Unauthorized: Invalid API token"

#: How a chunk continues the last one of its session: in saccade's words, or in ``RELEASED`` ones.
CHUNKING = ("executed", "frozen", "ramp_rate")
#: The keys of `options` that this server reads.
OPTIONS = ("seed", "num_steps", "guidance", "session", *CHUNKING, *RELEASED)
LONGEST_SESSION = 256
#: Names of options that were not read, as an answer lists them.
MOST_IGNORED = 8


@dataclass(frozen=True)
class Options:
    """How the actions of a request are sampled."""

    seed: int | None = None
    num_steps: int | None = None
    guidance: float | None = None
    session: str | int | None = None
    #: Number of actions of the session's last chunk that the robot has executed at the observation, if said.
    executed: int | None = None
    frozen: int = 0
    ramp_rate: float = 6.0
    #: The same in the released names, which count the last chunk's actions to ``horizon``, not to its end.
    chunking: Chunking | None = None
    stated: Mapping[str, Any] = field(default_factory=dict)  # the options that are read
    ignored: tuple[str, ...] = ()  # the others: unknown ones, and released ones that need a session


@dataclass(frozen=True, eq=False)
class Call:
    """What a request asks for."""

    endpoint: str
    is_bare: bool = False  # `data` is the observation itself, as N1.5's clients send it
    observation: Mapping[str, Any] = field(default_factory=dict)
    options: Options = Options()


def parse(value: Any, num_timestep_buckets: int, seed: int | None = None) -> Call:
    """What an unpacked message asks for; the seed is that of a request that brings none.

    Raises:
        InputError: It is no request, or an option is out of range.
    """
    if not isinstance(value, dict):
        raise InputError(f"request: expected a map with an endpoint, got {type(value).__name__}")
    endpoint = value.get("endpoint", "get_action")
    if endpoint not in ENDPOINTS:
        raise InputError(f"endpoint: expected one of {', '.join(ENDPOINTS)}, got {endpoint!r:.100}")
    data = value.get("data")
    if endpoint == "reset":
        given = data.get("options") if isinstance(data, dict) else None
        return Call(endpoint, options=_options(given, num_timestep_buckets))
    if endpoint != "get_action":
        return Call(endpoint)
    if not isinstance(data, dict):
        raise InputError(f"data: expected a map with the observation, got {type(data).__name__}")
    if "observation" not in data:
        return Call(endpoint, is_bare=True, observation=data, options=Options(seed))
    unknown = [key for key in data if key not in ("observation", "options")]
    if unknown:
        raise InputError(
            f"data: expected observation and options, got also {', '.join(map(str, unknown)):.200}"
        )
    observation = data["observation"]
    if not isinstance(observation, dict):
        raise InputError(f"observation: expected a map, got {type(observation).__name__}")
    options = _options(data.get("options"), num_timestep_buckets)
    if options.seed is None:
        options = replace(options, seed=seed)
    return Call(endpoint, observation=observation, options=options)


def check_num_steps(name: str, value: int, num_timestep_buckets: int) -> int:
    """A number of Euler steps, which is from 1 to ``num_timestep_buckets``."""
    number = integer(name, value)
    if number > num_timestep_buckets:
        raise InputError(
            f"{name}: expected at most {num_timestep_buckets} (num_timestep_buckets), got {number}"
        )
    return number


def is_allowed(value: Any, secret: str | None) -> bool:
    """Whether a message contains the secret, if there is one. The time that this takes says nothing about it.

    Example:
        >>> is_allowed({"endpoint": "ping", "api_token": "guess"}, "secret"), is_allowed({}, None)
        (False, True)
    """
    if secret is None:
        return True
    given = value.get("api_token") if isinstance(value, dict) else None
    # Digests are of one length, so the length of the secret does not show either.
    both = (
        hashlib.sha256(text.encode("utf-8", "surrogatepass")).digest()
        for text in (given if isinstance(given, str) else "", secret)
    )
    return hmac.compare_digest(*both) and isinstance(given, str)


def _options(given: Any, num_timestep_buckets: int) -> Options:
    if given is None:
        return Options()
    if not isinstance(given, dict):
        raise InputError(f"options: expected a map, got {type(given).__name__}")
    found = {name: given[name] for name in OPTIONS if given.get(name) is not None}
    session = found.get("session")
    if session is not None and (type(session) not in (str, int) or len(str(session)) > LONGEST_SESSION):
        raise InputError(
            f"options: session: expected text of at most {LONGEST_SESSION} characters or a number, got "
            f"{session!r:.100}"
        )
    if session is None and any(name in found for name in CHUNKING):
        raise InputError("options: executed, frozen and ramp_rate: expected a session with them, got none")
    unread = () if session is not None else RELEASED
    read: dict[str, Any] = {}
    for name, value in found.items():
        if name in RELEASED or name == "session":
            continue
        if name == "num_steps":
            read[name] = check_num_steps(f"options: {name}", value, num_timestep_buckets)
        elif name == "ramp_rate":
            read[name] = check_ramp_rate(f"options: {name}", value)
        elif name == "guidance":
            check_guidance(value, f"options: {name}")
            read[name] = float(value)
        else:
            read[name] = integer(f"options: {name}", value, least=0)
    ignored = [str(key)[:LONGEST_SESSION] for key in given if key not in OPTIONS or key in unread]
    released = {name: found[name] for name in RELEASED if name in found and name not in unread}
    chunking = _chunking(read, released)
    if chunking is not None:
        values = (chunking.horizon, chunking.overlap, chunking.frozen, chunking.ramp_rate)
        released = dict(zip(RELEASED, values, strict=True))
    return Options(
        **read,
        session=session,
        chunking=chunking,
        stated=read if session is None else {"session": session, **read, **released},
        ignored=tuple(ignored[:MOST_IGNORED]),
    )


def _chunking(read: Mapping[str, Any], released: Mapping[str, Any]) -> Chunking | None:
    """Real-time chunking in the released names; None if it was not asked for by them."""
    if not released:
        return None
    own = [name for name in CHUNKING if name in read]
    if own:
        raise InputError(
            f"options: expected real-time chunking by saccade's options ({', '.join(CHUNKING)}) or by "
            f"Isaac-GR00T's ({', '.join(RELEASED)}), got {', '.join([*own, *released])}"
        )
    return from_released(released)
