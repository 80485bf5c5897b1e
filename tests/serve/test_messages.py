"""Messages of the server: what is decoded, what is refused, and that nothing is built or unpickled before."""

from __future__ import annotations

import io
import pickle
import subprocess
import sys
import tracemalloc
from typing import Any

import msgpack
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from saccade.errors import DtypeError, InputError, SaccadeError, ShapeError
from saccade.serve.limits import Limits
from saccade.serve.npy import from_npy, to_npy
from saccade.serve.packing import MOST_ITEMS, is_pickle, pack, refusal, unpack
from tests.helpers.serve_cases import decoded, packed

LIMITS = Limits()
ARRAYS = [
    np.zeros((1, 2, 3, 3), np.uint8),
    np.arange(6, dtype=np.float32).reshape(2, 3),
    np.asfortranarray(np.arange(6.0).reshape(2, 3)),
    np.arange(5, dtype=">f4"),
    np.array(3.5),
    np.array([], np.float32),
    np.zeros((3, 0, 2), np.int64),
    np.array([True, False]),
    np.array(["push the button", "ü"]),
    np.array([1.5], np.float16),
]


def npy(header: bytes, data: bytes = b"") -> bytes:
    """A .npy file with any header."""
    return b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + data


def nested(depth: int) -> Any:
    value: Any = 1
    for _ in range(depth):
        value = {"a": value}
    return value


@pytest.mark.parametrize("array", ARRAYS, ids=lambda array: f"{array.dtype}{array.shape}")
def test_arrays_are_numpys(array: Any) -> None:
    found = unpack(packed({"a": array}), LIMITS).value["a"]
    np.testing.assert_array_equal(found, array)
    assert found.dtype == array.dtype.newbyteorder("=")
    back = msgpack.unpackb(pack({"a": array}), object_hook=decoded)["a"]
    np.testing.assert_array_equal(back, array)


@pytest.mark.parametrize("array", ARRAYS, ids=lambda array: f"{array.dtype}{array.shape}")
def test_arrays_of_msgpack_numpy(array: Any) -> None:
    # As the package msgpack-numpy, which N1.7 clients use, writes them: keys are bytes.
    fields = {
        b"nd": True,
        b"type": array.dtype.str,
        b"kind": b"",
        b"shape": array.shape,
        b"data": array.tobytes(),
    }
    found = unpack(msgpack.packb({"a": fields}), LIMITS)
    assert found.is_msgpack_numpy
    np.testing.assert_array_equal(found.value["a"], array)
    written = unpack(pack({"a": array}, as_msgpack_numpy=True), LIMITS)
    assert written.is_msgpack_numpy
    np.testing.assert_array_equal(written.value["a"], array)
    number = {b"nd": False, b"type": "<f4", b"data": np.float32(2.5).tobytes()}
    assert unpack(msgpack.packb({"a": number}), LIMITS).value["a"] == 2.5


@pytest.mark.parametrize(
    ("data", "error", "match"),
    [
        (b"", InputError, "npy file"),
        (b"\x93NUMPY\x03\x00" + bytes(100), InputError, "version 1 or 2"),
        (b"\x93NUMPY\x01", InputError, "npy file"),
        (b"\x93NUMPY\x09\x00\x00\x00", InputError, "npy file"),
        (npy(b"{'descr': '<f4', 'fortran_order': False, 'shape': (2,), }", b"\0" * 7), ShapeError, "8 bytes"),
        (
            npy(b"{'descr': '<f4', 'fortran_order': False, 'shape': (-1,), }"),
            ShapeError,
            "sizes of at least 0",
        ),
        (
            npy(b"{'descr': '<f4', 'fortran_order': False, 'shape': (1000000, 1000000), }"),
            InputError,
            "at most 16000000 elements",
        ),
        (npy(b"{'descr': '|O', 'fortran_order': False, 'shape': (1,), }", b"x"), DtypeError, "never loaded"),
        (
            npy(b"{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (), }"),
            DtypeError,
            "got .*'a', '<f4'",
        ),
        (npy(b"{'descr': '<M8[ns]', 'fortran_order': False, 'shape': (), }"), DtypeError, "numbers"),
        (npy(b"{'descr': '<c8', 'fortran_order': False, 'shape': (), }", b"\0" * 8), DtypeError, "numbers"),
        (npy(b"{'descr': '<f3', 'fortran_order': False, 'shape': (), }"), InputError, "npy file"),
        (
            npy(b"{'descr': '<f4', 'fortran_order': False, 'shape': (" + b"9" * 900 + b",), }"),
            InputError,
            "at most",
        ),
        (npy(b"[" * 1000), InputError, "npy file"),
        (npy(b"-" * 1000 + b"1"), InputError, "npy file"),
        (npy(b"{'descr': '<f4', 'fortran_order': False, 'shape': ()}" + b" " * 2000), InputError, "npy file"),
        (b"\x93NUMPY\x02\x00\xff\xff\xff\xff", InputError, "npy file"),
        (
            npy(b"{'descr': '<f4', 'fortran_order': False, 'shape': (" + b"1, " * 40 + b"), }", b"\0" * 4),
            ShapeError,
            "32",
        ),
        ("text", InputError, "expected bytes"),
    ],
)
def test_hostile_arrays_are_refused(data: Any, error: type[Exception], match: str) -> None:
    with pytest.raises(error, match=match):
        unpack(msgpack.packb({"a": {"__ndarray_class__": True, "as_npy": data}}), LIMITS)


def test_hostile_headers_are_refused_at_once() -> None:
    start = b"{'descr': '<f4', 'fortran_order': False, 'shape': ("
    headers = [
        start + text
        for text in (
            b"1" * 60 + b"x",
            b"1" + b" " * 9000 + b"x",
            b"," * 9000,
            b"1 , " * 2400 + b"x",
            b"1 " * 4000,
        )
    ]
    headers += [
        b"(" * 900,
        b"[" * 150 + b"]" * 150,
        b"{1:" * 300,
        b"~" * 1020,
        b"1" + b"+1" * 500,
    ]
    # In a process of its own, since a parser that does not end or overflows its stack cannot be interrupted.
    program = """
import sys
from saccade.errors import SaccadeError
from saccade.serve.npy import from_npy

for data in map(bytes.fromhex, sys.argv[1:]):
    try:
        from_npy(data, 100)
    except SaccadeError:
        print("refused")
"""
    done = subprocess.run(
        [sys.executable, "-c", program, *(npy(header, b"\0" * 4).hex() for header in headers)],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    assert done.stdout.split() == ["refused"] * len(headers)


@pytest.mark.parametrize("shape", [(), (0,), (7,), (2, 3), (1, 0, 4), (1,) * 32], ids=str)
@pytest.mark.parametrize("dtype", ["<f4", ">i8", "|u1", "|b1", "<U0", ">U3"])
@pytest.mark.parametrize("version", [(1, 0), (2, 0)])
def test_headers_that_numpy_writes(shape: tuple[int, ...], dtype: str, version: tuple[int, int]) -> None:
    for order in ("C", "F"):
        array = np.zeros(shape, dtype, order=order)
        output = io.BytesIO()
        np.lib.format.write_array(output, array, version)
        found = from_npy(output.getvalue(), 100)
        assert (found.shape, found.dtype) == (shape, array.dtype.newbyteorder("="))
        assert found.flags.f_contiguous == array.flags.f_contiguous


def test_arrays_of_objects_are_not_unpickled() -> None:
    output = io.BytesIO()
    np.save(output, np.array([{"a": 1}], object), allow_pickle=True)
    with pytest.raises(DtypeError, match="objects"):
        from_npy(output.getvalue(), 100)
    forged = {b"nd": True, b"type": "|O", b"kind": b"O", b"shape": [1], b"data": pickle.dumps([1])}
    for changed in (forged, forged | {b"kind": b""}, {key.decode(): value for key, value in forged.items()}):
        with pytest.raises(DtypeError, match="never loaded"):
            unpack(msgpack.packb(changed), LIMITS)


@given(st.binary(max_size=200))
def test_any_bytes_are_refused_or_decoded_as_msgpack_does(data: bytes) -> None:
    try:
        value = unpack(data, LIMITS).value
    except SaccadeError:
        return
    assert value == msgpack.unpackb(data) or value != value


@given(st.binary(max_size=120))
def test_any_header_is_refused_or_read_as_numpy_reads_it(header: bytes) -> None:
    data = npy(
        b"{'descr': '<f4', 'fortran_order': False, 'shape': (1,), }"[: len(header)] + header, b"\0" * 4
    )
    try:
        found = from_npy(data, 100)
    except SaccadeError:
        return
    np.testing.assert_array_equal(found, np.load(io.BytesIO(data)))


MESSAGES = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1) | st.floats() | st.text() | st.binary(),
    lambda inner: st.lists(inner, max_size=20) | st.dictionaries(st.text(), inner, max_size=20),
    max_leaves=50,
)


@given(MESSAGES)
def test_messages_are_decoded_as_msgpack_does(value: Any) -> None:
    data = msgpack.packb(value)
    assert msgpack.packb(unpack(memoryview(data), LIMITS).value) == data
    for end in range(0, len(data), max(1, len(data) // 10)):
        with pytest.raises(InputError, match=r"incomplete|exceeds"):
            unpack(memoryview(data)[:end], LIMITS)


def test_nesting() -> None:
    assert unpack(msgpack.packb(nested(300)), LIMITS).value == nested(300)
    for deep in (b"\x91", b"\x81\xa1a"):
        with pytest.raises(InputError, match="nested too deeply"):
            unpack(deep * 1_000_000 + b"\x01", LIMITS)


def test_numbers_of_items_and_values() -> None:
    for many in ([0] * (MOST_ITEMS + 1), dict.fromkeys(map(str, range(MOST_ITEMS + 1)))):
        with pytest.raises(InputError, match=f"{MOST_ITEMS + 1} exceeds"):
            unpack(msgpack.packb(many), LIMITS)
    assert unpack(msgpack.packb([[0] * 9] * 9), Limits(objects=100)).value == [[0] * 9] * 9
    nested_lists: list[Any] = [[[0] * 9] * 9, [{"a": {}}] * 22, [[]] * 50]
    for values in nested_lists:
        with pytest.raises(InputError, match="at most 99 values"):
            unpack(msgpack.packb(values), Limits(objects=99))


@pytest.mark.parametrize(
    "data",
    [
        b"\xdd\xff\xff\xff\xff",  # a list of 4 G values
        b"\xdf\xff\xff\xff\xff",
        b"\xdb\xff\xff\xff\xff",
        b"\xc6\xff\xff\xff\xff" + bytes(100),
        b"\xdd\x00\xff\xff\xff" + b"\xc0" * 0xFFFFFF,  # 16 M empty values, 128 MB as a list
        b"\x91" * 60_000_000,
        b"\xdc\x10\x00" * 20_000_000,  # lists of 4096 lists of ...
        (b"\xdc\x10\x00" + b"\x90" * 4096) * 1000,  # 4 M empty lists, which would be 290 MB
        (b"\xdc\x10\x00" + b"\x80" * 4096) * 1000,
    ],
    ids=range(9),
)
def test_hostile_sizes_allocate_little(data: bytes) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(InputError, match="message"):
            unpack(data, LIMITS)
        assert tracemalloc.get_traced_memory()[1] < 50_000_000
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize(
    ("data", "match"),
    [
        (b"", "incomplete"),
        (b"\x80\x80", "extra data"),
        (b"\xc1", "not msgpack"),
        (b"\xd4\x05\x00", "max_ext_len"),
        (b"\xc7\x00\x05", "no msgpack extension, got type 5"),
        (b"\xa2\xff\xfe", "utf-8"),
        (msgpack.packb({1: 2}), "int"),
        (b"GET / HTTP/1.1\r\n\r\n", "extra data"),
    ],
)
def test_other_garbage_is_named(data: bytes, match: str) -> None:
    with pytest.raises(InputError, match=match):
        unpack(data, LIMITS)


def test_pickles_are_recognised_and_answered_in_their_form() -> None:
    saved = io.BytesIO()
    torch.save({"endpoint": "ping"}, saved)
    assert is_pickle(saved.getvalue())
    # As the released client of N1 and early N1.5 reads its answers.
    answer = torch.load(io.BytesIO(refusal(saved.getvalue())), weights_only=False)
    assert "Isaac-GR00T N1.5 with pull request 329" in answer["error"]
    for protocol in range(2, 6):
        data = pickle.dumps({"endpoint": "ping"}, protocol)
        assert is_pickle(data)
        assert msgpack.unpackb(refusal(data)) == answer
    assert not is_pickle(b"\x80")  # an empty map
    assert not is_pickle(packed({"endpoint": "ping"}))


def test_a_class_in_a_pickle_is_not_made() -> None:
    class Hostile:
        def __reduce__(self) -> Any:
            return (pytest.fail, ("unpickled",))

    assert is_pickle(pickle.dumps(Hostile.__reduce__(Hostile())))


def test_npy_is_written_as_numpy_does() -> None:
    array = np.arange(4, dtype=np.float32)
    np.testing.assert_array_equal(np.load(io.BytesIO(to_npy(array))), array)
