"""Requests of old clients, which are pickles: recognised by their first bytes, never loaded, and answered."""

from __future__ import annotations

import io
import pickle
import zipfile

from saccade.serve.npy import Bytes
from saccade.serve.packing import pack

#: How `torch.save` begins, which the clients of N1 and early N1.5 use: a zip file.
TORCH = b"PK\x03\x04"

REFUSAL = (
    "message: expected msgpack, got a pickle, which is never loaded: this client is of GR00T N1, or of N1.5 "
    "before 26 August 2025. Update it to Isaac-GR00T N1.5 with pull request 329 or later, N1.6 or N1.7"
)


def is_pickle(data: Bytes) -> bool:
    """Whether a message is a pickle of any protocol from 2 on, or a file of ``torch.save``.

    Example:
        >>> is_pickle(pickle.dumps({"endpoint": "ping"})), is_pickle(pack({"endpoint": "ping"}))
        (True, False)
    """
    start = bytes(memoryview(data)[:4])
    # As msgpack, a pickle would be an empty map with bytes after it.
    return start == TORCH or (len(data) > 2 and start[0] == 0x80 and 2 <= start[1] <= 5)


def refusal(data: Bytes) -> bytes:
    """The error for a client that sent a pickle, in a form that it can read.

    A client that uses ``torch.save`` gets what ``torch.load`` reads, so that its user sees the message.
    """
    error = {"error": REFUSAL}
    if bytes(memoryview(data)[:4]) != TORCH:
        return pack(error)
    output = io.BytesIO()
    with zipfile.ZipFile(output, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr("archive/data.pkl", pickle.dumps(error, protocol=2))
        archive.writestr("archive/version", "3\n")
    return output.getvalue()
