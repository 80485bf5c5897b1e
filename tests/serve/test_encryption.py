"""CURVE: who may connect to an encrypted server."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import zmq.auth

from saccade.errors import InputError
from saccade.serve import Client
from saccade.serve.keys import read_pair, read_public, read_server_keys
from tests.helpers.serve_cases import PONG, observation, serving, wait_until


@pytest.fixture
def keys(tmp_path: Path) -> Path:
    """A folder with the key files of a server, a client that may connect, and a stranger."""
    (tmp_path / "clients").mkdir()
    for name in ("server", "robot", "stranger"):
        zmq.auth.create_certificates(tmp_path, name)
    (tmp_path / "robot.key").rename(tmp_path / "clients" / "robot.key")
    return tmp_path


def test_clients_with_a_known_key_are_served(keys: Path) -> None:
    server = read_server_keys(keys / "server.key_secret", keys / "clients")
    with serving(keys=server) as running:
        given: dict[str, Any] = {"server_key": keys / "server.key", "secret_key": keys / "robot.key_secret"}
        with Client(port=running.port, **given) as client:
            assert client.call("ping") == PONG
            assert client.get_action(observation(), {"seed": 1})[0]["arm"].shape[0] == 1
        assert running.log.warnings() == []


def test_strangers_and_unencrypted_clients_are_refused_and_logged(keys: Path) -> None:
    server = read_server_keys(keys / "server.key_secret", keys / "clients")
    strangers: list[dict[str, Any]] = [
        {},
        {"server_key": keys / "server.key"},
        {"server_key": keys / "server.key", "secret_key": keys / "stranger.key_secret"},
        {"server_key": keys / "stranger.key", "secret_key": keys / "robot.key_secret"},
    ]
    with serving(keys=server) as running:
        for number, given in enumerate(strangers):
            before = len(running.log.warnings())
            with Client(port=running.port, timeout=0.5, **given) as client, pytest.raises(TimeoutError):
                client.call("ping")
            wait_until(lambda before=before: len(running.log.warnings()) > before)
            assert ("not one of the clients' keys" in running.log.warnings()[-1]) == (number in (1, 2))
        assert not running.log.requests()


def test_without_client_keys_any_client_is_served_that_knows_the_servers(keys: Path) -> None:
    with serving(keys=read_server_keys(keys / "server.key_secret")) as running:
        with Client(port=running.port, server_key=keys / "server.key") as client:
            assert client.call("ping") == PONG
        with Client(port=running.port, timeout=0.5) as client, pytest.raises(TimeoutError):
            client.call("ping")


def test_key_files_that_cannot_be_read_are_named(keys: Path) -> None:
    (keys / "empty.key").write_text("")
    (keys / "short.key").write_text('curve\n    public-key = "abc"\n')
    for path, message in (
        ("missing.key", "expected a key file"),
        ("empty.key", "expected a key file"),
        ("short.key", "expected a key of 40 characters, found 3"),
    ):
        with pytest.raises(InputError, match=f"{path}: {message}"):
            read_public(keys / path)
    with pytest.raises(InputError, match="found a public key only"):
        read_pair(keys / "server.key")
    with pytest.raises(InputError, match="found none"):
        read_server_keys(keys / "server.key_secret", keys / "missing")
    with pytest.raises(InputError, match="expected a server_key"):
        Client(secret_key=keys / "robot.key_secret")
