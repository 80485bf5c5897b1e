"""Seeds and sessions of the server."""

from __future__ import annotations

import numpy as np
import pytest

from saccade.errors import InputError
from saccade.serve import Client, ServerError
from saccade.serve.requests import Options
from saccade.serve.sessions import Chunk, Sessions
from tests.helpers.serve_cases import HORIZON, observation, serving


def test_noise_without_a_seed_is_different_each_time() -> None:
    with serving() as running, Client(port=running.port) as client:
        chunks = [client.get_action(observation())[0]["arm"] for _ in range(2)]
        assert not np.array_equal(*chunks)


def test_a_session_continues_its_last_chunk() -> None:
    with serving() as running, Client(port=running.port) as client:
        policy = running.policy
        first, info = client.get_action(observation(), {"session": "robot 1", "executed": 0})
        assert policy.chunkings[-1] is None
        assert (info["session"], info["continued"]) == ("robot 1", False)
        second, info = client.get_action(observation(), {"session": "robot 1", "executed": 5, "frozen": 2})
        assert (info["session"], info["continued"]) == ("robot 1", True)
        *_, chunking = policy.chunkings
        assert (chunking.overlap, chunking.frozen, chunking.ramp_rate) == (HORIZON - 5, 2, 6.0)
        np.testing.assert_array_equal(second["arm"][:, :2], first["arm"][:, 5:7])
        third, _ = client.get_action(observation(), {"session": "robot 1", "executed": 7, "frozen": 4})
        np.testing.assert_array_equal(third["arm"][:, :1], second["arm"][:, 7:])
        assert (
            client.get_action(observation(), {"session": "robot 1", "executed": HORIZON})[1]["continued"]
            is False
        )
        with pytest.raises(ServerError, match="executed: expected the number"):
            client.get_action(observation(), {"session": "robot 1"})
        with pytest.raises(ServerError, match="expected 1 rows, as session 'robot 1' began, got 2"):
            client.get_action(observation(rows=2), {"session": "robot 1", "executed": 1})
        assert client.get_action(observation(), {"session": 2, "executed": 1})[1]["continued"] is False


def test_reset_forgets_a_session_or_those_of_the_client() -> None:
    with serving() as running, Client(port=running.port) as client, Client(port=running.port) as other:

        def continues(name: str, who: Client) -> bool:
            return bool(who.get_action(observation(), {"session": name, "executed": 1})[1]["continued"])

        assert not any(continues(name, who) for name, who in (("a", client), ("b", client), ("c", other)))
        client.reset({"session": "a"})
        assert [continues(name, client) for name in ("a", "b")] == [False, True]
        client.reset()
        assert [continues(name, client) for name in ("a", "b")] == [False, False]
        assert continues("c", other)


def test_sessions_are_bounded_in_number_and_age() -> None:
    now = [0.0]
    sessions = Sessions(2, 10.0, lambda: now[0])
    owner = object()
    first = sessions.use("a", owner)
    sessions.use("b", owner)
    assert sessions.use("a", owner) is first
    sessions.use("c", owner)  # b was used least recently
    assert len(sessions) == 2
    assert sessions.use("a", owner) is first
    now[0] = 10.5
    assert sessions.use("a", owner) is not first
    assert len(sessions) == 1
    sessions.reset("nobody", owner)
    assert len(sessions) == 1


def test_a_late_answer_does_not_bring_a_session_back() -> None:
    sessions = Sessions(2, 10.0)
    session = sessions.use("a", "client")
    sessions.reset(None, "client")
    session.chunk = Chunk({}, 1, HORIZON)
    assert sessions.use("a", "client").chunk is None


def test_continuing_asks_for_what_was_executed() -> None:
    session = Sessions(1, 1.0).use("a", None)
    assert session.continued(Options(session="a"), 1) is None
    session.chunk = Chunk({}, 1, 8)
    with pytest.raises(InputError, match="reset starts a new chunk"):
        session.continued(Options(session="a"), 1)
    assert session.continued(Options(session="a", executed=8), 1) is None
    found = session.continued(Options(session="a", executed=6, frozen=5), 1)
    assert found is not None
    assert (found[1].overlap, found[1].frozen) == (2, 2)
