"""Pickles as plain data: equal to Python's own reader on data, and nothing that a file asks for is ever run."""

from __future__ import annotations

import gzip
import os
import pickle
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import write_pandaset
from refusals import Asks, refused

from mudg.base import plain_pickle
from mudg.base.errors import InputError
from mudg.base.plain_pickle import NUMPY_MAKERS, Array, as_list, read_pickle
from mudg.formats.importers import pandaset as pandas_frame

GOLDEN = Path(__file__).parent / "golden"


def made(rng: np.random.Generator, depth: int) -> Any:
    """Some plain value."""
    kind = int(rng.integers(0, 10 if depth else 7))
    flag, long, real = bool(rng.integers(2)), int(rng.integers(-(2**62), 2**62)) ** 3, float(rng.normal())
    leaves = (None, flag, long, real, "gr\u00fcn\U0001f697", b"\x00\xff", int(rng.integers(-300, 70000)))
    if kind < 7:
        return leaves[kind]
    inner = [made(rng, depth - 1) for _ in range(int(rng.integers(0, 4)))]
    return (inner, tuple(inner), {f"k{n}" if n % 2 else n: value for n, value in enumerate(inner)})[kind - 7]


def read(content: bytes) -> Any:
    return read_pickle(content, "file", NUMPY_MAKERS)


@pytest.mark.parametrize("protocol", [3, 4, 5])
def test_plain_values_are_read_as_they_were_written(protocol: int) -> None:
    rng = np.random.default_rng(protocol)
    for _ in range(60):
        value = [made(rng, 4) for _ in range(3)]
        assert read(pickle.dumps(value, protocol)) == value


@pytest.mark.parametrize("protocol", range(6))
def test_shared_and_nested_lists_in_every_protocol(protocol: int) -> None:
    inner = [1, 2.5, "three"]
    value = [inner, inner, {"key": (inner, None, True)}, -(2**70)]
    got = read(pickle.dumps(value, protocol))
    assert got == value and got[0] is got[1]


@pytest.mark.parametrize("protocol", [3, 4, 5])
@pytest.mark.parametrize("kind", ["<f8", "<f4", ">f4", "<i8", "u1", "?", "<U3", "O"])
def test_arrays_keep_type_order_and_values(protocol: int, kind: str) -> None:
    array = np.array([[1, 0, 3], [4, 5, 0]]).astype(kind)
    for given_array in (array, np.asfortranarray(array), array[:0]):
        got = read(pickle.dumps(given_array, protocol))
        assert isinstance(got, Array) and got.value is not None and got.value.dtype == given_array.dtype
        assert got.value.tolist() == given_array.tolist()
    assert as_list(read(pickle.dumps(np.arange(3.0), protocol)), "x") == [0.0, 1.0, 2.0]
    assert read(pickle.dumps([np.float64(2.5)], protocol)) == [2.5]


@pytest.mark.parametrize("version", ["024", "10", "22"])
def test_frames_that_pandas_wrote(version: str) -> None:
    points = pandas_frame.read_frame(GOLDEN / f"pandas_{version}_points.pkl.gz")
    n = np.arange(7)
    assert points["x"].tolist() == (n * 1.5).tolist()
    assert points["z"].tolist() == (n * 0.25).tolist()
    assert points["t"].tolist() == (1557539924.0 + n * 0.01).tolist()
    assert points["d"].tolist() == [0, 0, 0, 0, 1, 1, 1]
    boxes = pandas_frame.read_frame(GOLDEN / f"pandas_{version}_boxes.pkl.gz")
    assert boxes["label"].tolist() == ["Car", "Pedestrian", "Bus"]
    assert boxes["stationary"].tolist() == [False, True, False]
    assert boxes["dimensions.y"].tolist() == [4.5, 0.8, 12.0]
    assert boxes["attributes.object_motion"].tolist() == ["Moving", None, "Moving"]
    assert np.isnan(boxes["camera_used"][2])


@pytest.mark.parametrize("protocol", range(6))
def test_a_pickle_that_asks_for_a_command_is_refused_by_name(
    protocol: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ran: list[object] = []
    bait = tmp_path / "ran"
    content = pickle.dumps([1, Asks(os.system, f"touch {bait}")], protocol)
    monkeypatch.setattr(os, "system", lambda *words: ran.append(words))
    refused(r"asks for '(posix|nt)\.system'", read, content)
    assert not ran
    assert not bait.exists()
    refused("system", pandas_frame.parse_frame, content, "frame")


@pytest.mark.parametrize(
    "content",
    [
        b"cbuiltins\neval\n(S'1'\ntR.",
        b"c__builtin__\ngetattr\n.",
        b"cmudg.base.store\nwrite_bytes\n.",
        b"cnumpy\nload\n.",
        b"cnumpy.core.multiarray\nfromfile\n.",
        b"\x80\x04\x8c\x05numpy\x8c\x0ftesting.measure\x93.",
        b"cpandas.io.pickle\nread_pickle\n.",
    ],
)
def test_names_outside_the_table_are_refused(content: bytes) -> None:
    for reader in (read, lambda c: pandas_frame.parse_frame(c, "x")):
        refused("asks for", reader, content)


def test_allowed_names_cannot_be_bent_into_a_call() -> None:
    frame = b"\x80\x04\x8c\x11pandas.core.frame\x8c\x09DataFrame\x93"
    for content in (
        frame + b")\x81K\x01b.",  # a state that is no dict
        b"\x80\x04\x8c\x05numpy\x8c\x07ndarray\x93(K\x01tR.",  # the class itself, called
    ):
        refused("not a plain data frame", pandas_frame.parse_frame, content, "x")


def test_every_beginning_of_a_frame_is_refused() -> None:
    content = gzip.decompress((GOLDEN / "pandas_10_boxes.pkl.gz").read_bytes())
    for end in range(0, len(content) - 1, 11):
        refused(".", pandas_frame.parse_frame, content[:end], "x")


@pytest.mark.filterwarnings("ignore:invalid escape sequence")  # the disassembler's, on texts that the flips make
def test_flipped_bytes_give_a_table_or_an_error_in_words() -> None:
    content = bytearray(gzip.decompress((GOLDEN / "pandas_10_points.pkl.gz").read_bytes()))
    rng = np.random.default_rng(5)
    refused = 0
    for place, value in zip(rng.integers(0, len(content), 200), rng.integers(0, 256, 200), strict=True):
        changed = bytearray(content)
        changed[place] = value
        try:
            pandas_frame.parse_frame(bytes(changed), "x")
        except InputError:
            refused += 1
    assert 30 < refused < 200


def array_pickle(shape: bytes, kind: bytes, data: bytes) -> bytes:
    """An array in protocol 4 with any shape (as opcodes) and bytes."""
    head = (
        b"\x80\x04\x8c\x15numpy.core.multiarray\x8c\x0c_reconstruct\x93\x8c\x05numpy\x8c\x07ndarray\x93K\x00\x85C\x01b"
    )
    head += b"\x87R(K\x01" + shape + b"\x8c\x05numpy\x8c\x05dtype\x93\x8c\x02" + kind
    order = b"\x89\x88\x87R(K\x03\x8c\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb\x89C"
    return head + order + bytes([len(data)]) + data + b"tb."


@pytest.mark.parametrize(
    "content",
    [
        array_pickle(b"\x8a\x06\x00\x00\x00\x00\x00\x01\x85", b"f8", b"12345678"),  # 2**40 numbers in 8 bytes
        array_pickle(b"J\xff\xff\xff\xff\x85", b"f8", b"12345678"),  # -1 numbers
        array_pickle(b"K\x01\x85", b"O8", b"12345678"),  # objects from bytes
        array_pickle(b"(K\x01K\x01K\x01K\x01K\x01t", b"f8", b"12345678"),
        array_pickle(b"G?\xf0\x00\x00\x00\x00\x00\x00\x85", b"f8", b"12345678"),  # 1.0 numbers
        array_pickle(b"K\x01\x85", b"V8", b"12345678"),
        b"\x80\x04\x8e\xff\xff\xff\xff\xff\xff\xff\x0fabc.",  # 2**60 bytes declared
        b"\x80\x04\x8d\xff\xff\xff\xff\xff\xff\xff\x7fabc.",
        b"\x80\x04\x8b\xff\xff\xff\x7fabc.",
        b"\x80\x04h\x05.",  # a memo that was never set
        b"\x80\x04(t",  # no end
        b"\x80\x04t.",  # no mark
        *(b".", b"", b"(S'true'\nios\nsystem\n.", b"Pname\n.", b"I1\nQ.", b"\x82\x01.", b"(cnumpy\nndarray\no."),
        b"\x80\x05\x97.",
    ],
)
def test_absurd_sizes_broken_stacks_and_operations_that_plain_data_does_not_need(content: bytes) -> None:
    refused(r"malformed|cut off|operation", read, content)
    assert read(array_pickle(b"K\x02\x85", b"f8", struct.pack("<2d", 1, 2))).value.tolist() == [1.0, 2.0]


def test_deep_nesting_neither_recurses_nor_hashes() -> None:
    depth = 50_000
    assert isinstance(read(b"\x80\x04)" + b"\x85" * depth + b"."), tuple)
    refused("no plain value", read, b"\x80\x04})" + b"\x85" * depth + b"K\x01s.")
    refused("malformed", read, b"\x80\x04\x8c\x05numpy\x8c\x05dtype\x93)" + b"\x85" * depth + b"\x85R.")


def test_a_row_index_of_any_length_costs_nothing() -> None:
    table = write_pandaset.frame_bytes({"x": np.arange(3.0)}).replace(b"\x8c\x04stop", b"\x8c\x04stop", 1)
    assert b"stop\x94K\x03" in table
    for stop in (2**40, 10**30):
        long = pickle.encode_long(stop)
        changed = table.replace(b"stop\x94K\x03", b"stop\x94\x8a" + bytes([len(long)]) + long)
        changed = changed.replace(changed[2:11], b"", 1)  # without the frame's length
        refused("not a plain data frame", pandas_frame.parse_frame, changed, "x")


def test_gzip_is_bounded_and_checked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    good = (GOLDEN / "pandas_10_points.pkl.gz").read_bytes()
    path = tmp_path / "00.pkl.gz"
    for content, words in ((good[:-9], "cut off"), (good[:60] + b"\xff" + good[61:], "damaged|cut off")):
        path.write_bytes(content)
        assert "00.pkl.gz" in refused(words, pandas_frame.read_frame, path).where
    monkeypatch.setattr(pandas_frame, "MAX_BYTES", 1000)
    path.write_bytes(gzip.compress(bytes(10**6)))
    refused("too much", pandas_frame.read_frame, path)
    monkeypatch.setattr(plain_pickle, "MAX_BYTES", 10)
    refused("too large", read, pickle.dumps(list(range(20))))
