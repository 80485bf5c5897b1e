"""A server for robots that speak Isaac-GR00T's protocol, and a small client. Needs the extra `serve`.

A request passes through these files: `transport` (ZeroMQ), `packing` with `npy` (bytes to values,
within the `limits`), `requests` (values to calls), `batching` (which are computed together), `engine` with
`sessions` (actions), and back. `server` joins them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from saccade._internal.extras import SACCADE
from saccade.serve.limits import Limits

if TYPE_CHECKING:
    from saccade.serve.client import Client, ServerError
    from saccade.serve.keys import read_server_keys
    from saccade.serve.logs import open_log
    from saccade.serve.server import Server
    from saccade.serve.transport import bind

__all__ = ["Client", "Limits", "Server", "ServerError", "bind", "open_log", "read_server_keys"]

# The limits are also shown by `saccade serve --help`, which needs no optional packages.
if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        if name not in __all__:
            raise AttributeError(f"module 'saccade.serve' has no attribute {name!r}")
        SACCADE.require("zmq", "msgpack")
        from saccade.serve import client, keys, logs, server, transport

        module = {"Server": server, "bind": transport, "open_log": logs, "read_server_keys": keys}
        return getattr(module.get(name, client), name)
