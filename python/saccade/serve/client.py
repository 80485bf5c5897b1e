"""A small client of the server, for robots and tests that do without Isaac-GR00T."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any

import zmq

from saccade.errors import InputError, SaccadeError
from saccade.serve.keys import read_pair, read_public
from saccade.serve.limits import Limits
from saccade.serve.packing import pack, unpack


class ServerError(SaccadeError, RuntimeError):
    """The server answered with an error, which is the message."""


class Client:
    """Asks a server for actions, in the wire format of GR00T N1.7.

    Args:
        host: Name or address of the server.
        port: Its port.
        timeout: Seconds after which a request fails.
        api_token: The server's secret, or None.
        server_key: File with the public key of an encrypted server (``NAME.key``), or None for no encryption.
        secret_key: File with the keys of this client (``NAME.key_secret``), or None for new ones, which a
            server accepts that does not restrict its clients.

    Raises:
        InputError: A key file is missing or is none, or ``secret_key`` is given without ``server_key``.

    Example:
        >>> from saccade.serve import Client
        >>> def first_chunk(observation: dict) -> dict:
        ...     with Client("localhost", 5555) as client:
        ...         actions, info = client.get_action(observation, {"seed": 0})
        ...     return actions
    """

    def __init__(
        self,
        host: str = "127.0.0.1",
        port: int = 5555,
        *,
        timeout: float = 60.0,
        api_token: str | None = None,
        server_key: str | Path | None = None,
        secret_key: str | Path | None = None,
    ) -> None:
        if secret_key is not None and server_key is None:
            raise InputError("secret_key: expected a server_key with it, got None")
        self._server_key = None if server_key is None else read_public(server_key)
        self._keys = zmq.curve_keypair() if secret_key is None else read_pair(secret_key)
        self._address = f"tcp://{host}:{port}"
        self._timeout, self._api_token = timeout, api_token
        self._context = zmq.Context()
        self._socket: zmq.Socket[bytes] | None = None

    def get_action(
        self, observation: Mapping[str, Any], options: Mapping[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """The actions for an observation.

        Args:
            observation: In one of the formats that :meth:`saccade.Policy.act` takes.
            options: ``{"seed": 5}`` for actions that can be repeated, ``{"num_steps": 2}`` for another number
                of Euler steps. ``{"session": name, "executed": steps}`` to continue the session's last
                chunk, of which the robot has executed ``steps`` actions. ``docs/serve.md`` lists all.

        Returns:
            The actions as :meth:`saccade.Policy.act` returns them, and information about them: the
            ``applied_options``, and the ``latency_ms`` from receipt to answer.

        Raises:
            ServerError: The server refused the request.
            TimeoutError: There was no answer.
        """
        actions, info = self.call("get_action", {"observation": observation, "options": options})
        return actions, info

    def reset(self, options: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """Forgets a session, ``{"session": name}``; without a name, those that this client used.

        Raises:
            ServerError, TimeoutError: As :meth:`get_action`.
        """
        answer: dict[str, Any] = self.call("reset", {"options": options})
        return answer

    def call(self, endpoint: str, data: Mapping[str, Any] | None = None) -> Any:
        """The answer of any endpoint.

        Raises:
            ServerError, TimeoutError: As :meth:`get_action`.
        """
        fields = {"endpoint": endpoint, "data": data, "api_token": self._api_token}
        request = {name: value for name, value in fields.items() if value is not None}
        answer = unpack(self.exchange(pack(request)), Limits()).value
        if isinstance(answer, dict) and "error" in answer:
            raise ServerError(str(answer["error"]))
        return answer

    def exchange(self, message: bytes) -> bytes:
        """Sends the bytes of a request, and returns those of the answer.

        Raises:
            TimeoutError: There was no answer. The next request uses a new connection.
        """
        if self._socket is None:
            self._socket = self._context.socket(zmq.REQ)
            self._socket.linger = 0
            if self._server_key is not None:
                self._socket.curve_serverkey = self._server_key
                self._socket.curve_publickey, self._socket.curve_secretkey = self._keys
            self._socket.connect(self._address)
        self._socket.send(message)
        if not self._socket.poll(int(1e3 * self._timeout)):
            self._close_socket()
            raise TimeoutError(f"{self._address}: no answer within {self._timeout:g} s")
        return self._socket.recv()

    def close(self) -> None:
        """Closes the connection."""
        self._close_socket()
        self._context.term()

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def _close_socket(self) -> None:
        if self._socket is not None:
            self._socket.close(linger=0)
            self._socket = None
