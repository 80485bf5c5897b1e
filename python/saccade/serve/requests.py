"""What a request asks for, in each of the released wire forms, and the answers in the same form.

GR00T N1.5 sends the observation itself as `data`, and gets the actions. N1.6 and N1.7 send `observation` and
`options`, and get `[actions, info]`. N1.7's arrays are in another form than the others'; see `npy`.
"""

from __future__ import annotations

import hashlib
import hmac
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from saccade._arrays import integer
from saccade.errors import InputError

ENDPOINTS = ("ping", "get_action", "reset", "get_modality_config", "kill")
#: What the released servers answer, word for word.
PING = {"status": "ok", "message": "Server is running"}
UNAUTHORIZED = "Unauthorized: Invalid API token"

#: The keys of `options` that this server reads.
OPTIONS = ("seed", "session", "executed", "frozen", "ramp_rate")
LONGEST_SESSION = 256
#: Names of options that were not read, as an answer lists them.
MOST_IGNORED = 8


@dataclass(frozen=True)
class Options:
    """How the actions of a request are sampled.

    Attributes:
        seed: Seed of the noise, or None for noise that is different each time.
        session: The id of the session whose last chunk is continued, or None.
        executed: Number of actions of the session's last chunk that the robot has executed when the
            observation was taken, or None if it was not said.
        frozen: Number of further actions that it executes before the answer arrives. They do not change.
        ramp_rate: See :class:`saccade.Chunking`.
        ignored: Names of options that are not known.
    """

    seed: int | None = None
    session: str | int | None = None
    executed: int | None = None
    frozen: int = 0
    ramp_rate: float = 6.0
    ignored: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Call:
    """What a request asks for.

    Attributes:
        endpoint: One of `ENDPOINTS`.
        is_bare: Whether `data` is the observation itself, as N1.5's clients send it.
        observation: The observation of ``get_action``, else empty.
        options: The options of ``get_action`` and ``reset``.
    """

    endpoint: str
    is_bare: bool = False
    observation: Mapping[str, Any] = field(default_factory=dict)
    options: Options = Options()


def parse(value: Any, seed: int | None = None) -> Call:
    """What a request asks for.

    Args:
        value: The unpacked message.
        seed: The seed of a request that brings none.

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
        return Call(endpoint, options=_options(given))
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
    options = _options(data.get("options"))
    if options.seed is None:
        options = replace(options, seed=seed)
    return Call(endpoint, observation=observation, options=options)


def action_answer(call: Call, actions: Any, info: Mapping[str, Any]) -> Any:
    """The answer to ``get_action`` in the form of the request."""
    return actions if call.is_bare else [actions, dict(info)]


class Token:
    """The secret that every request must contain, if there is one.

    Args:
        secret: The secret, or None.
    """

    def __init__(self, secret: str | None) -> None:
        self._digest = None if secret is None else _digest(secret)

    def allows(self, value: Any) -> bool:
        """Whether a request contains the secret. The time that this takes says nothing about it.

        Args:
            value: The unpacked message.

        Example:
            >>> Token("secret").allows({"endpoint": "ping", "api_token": "guess"}), Token(None).allows({})
            (False, True)
        """
        if self._digest is None:
            return True
        given = value.get("api_token") if isinstance(value, dict) else None
        digest = _digest(given if isinstance(given, str) else "")
        return hmac.compare_digest(digest, self._digest) and isinstance(given, str)


def _digest(text: str) -> bytes:
    # Digests are of one length, so the length of the secret does not show either.
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).digest()


def _options(given: Any) -> Options:
    if given is None:
        return Options()
    if not isinstance(given, dict):
        raise InputError(f"options: expected a map, got {type(given).__name__}")
    seed, session, executed = given.get("seed"), given.get("session"), given.get("executed")
    frozen, ramp_rate = given.get("frozen"), given.get("ramp_rate")
    if session is not None and (type(session) not in (str, int) or len(str(session)) > LONGEST_SESSION):
        raise InputError(
            f"options: session: expected text of at most {LONGEST_SESSION} characters or a number, got "
            f"{session!r:.100}"
        )
    if session is None and not (executed is None and frozen is None and ramp_rate is None):
        raise InputError("options: executed, frozen and ramp_rate: expected a session with them, got none")
    if ramp_rate is not None and not (
        type(ramp_rate) in (int, float) and math.isfinite(ramp_rate) and ramp_rate > 0
    ):
        raise InputError(f"options: ramp_rate: expected a finite number above 0, got {ramp_rate!r:.100}")
    return Options(
        seed=None if seed is None else integer("options: seed", seed, least=0),
        session=session,
        executed=None if executed is None else integer("options: executed", executed, least=0),
        frozen=0 if frozen is None else integer("options: frozen", frozen, least=0),
        ramp_rate=6.0 if ramp_rate is None else float(ramp_rate),
        ignored=tuple(str(key)[:LONGEST_SESSION] for key in given if key not in OPTIONS)[:MOST_IGNORED],
    )
