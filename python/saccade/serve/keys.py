"""Key files of CURVE, ZeroMQ's encryption, in the format of `zmq.auth.create_certificates`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import zmq.auth

from saccade.errors import InputError


@dataclass(frozen=True)
class ServerKeys:
    """The server's secret key, and the public keys of the clients that may connect (None: any client)."""

    secret: bytes
    clients: frozenset[bytes] | None = None

    def callback(self, domain: str, key: bytes) -> bool:
        """Whether a client may connect; the name is that of `zmq.auth`."""
        return self.clients is None or key in self.clients


def read_server_keys(secret_key: str | Path, client_keys: str | Path | None = None) -> ServerKeys:
    """Reads the keys of an encrypted server.

    Args:
        secret_key: The server's file ``NAME.key_secret``.
        client_keys: A folder with one file ``NAME.key`` for each client that may connect, or None for any
            client that knows the server's public key.

    Raises:
        InputError: A file is missing or is not a key file, or the folder contains none.

    Example:
        >>> import zmq.auth
        >>> from saccade.serve import read_server_keys
        >>> public, secret = zmq.auth.create_certificates(".", "server")
        >>> keys = read_server_keys(secret)
        >>> keys.clients is None  # any client that knows the public key may connect
        True
    """
    _, secret = read_pair(secret_key)
    if client_keys is None:
        return ServerKeys(secret)
    clients = frozenset(read_public(file) for file in Path(client_keys).glob("*.key"))
    if not clients:
        raise InputError(f"{client_keys}: expected a folder with key files (*.key) of clients, found none")
    return ServerKeys(secret, clients)


def read_pair(path: str | Path) -> tuple[bytes, bytes]:
    """The public and the secret key in a file ``NAME.key_secret``."""
    public, secret = _read(path)
    if secret is None:
        raise InputError(f"{path}: expected a file with a secret key (*.key_secret), found a public key only")
    return public, secret


def read_public(path: str | Path) -> bytes:
    """The public key in a file ``NAME.key``."""
    return _read(path)[0]


def _read(path: str | Path) -> tuple[bytes, bytes | None]:
    try:
        public, secret = zmq.auth.load_certificate(path)
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: expected a key file of zmq.auth.create_certificates: {error}") from None
    for key in (public, secret):
        if key is not None and len(key) != 40:  # as Z85 text
            raise InputError(f"{path}: expected a key of 40 characters, found {len(key)}")
    return public, secret
