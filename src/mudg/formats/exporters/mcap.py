"""Messages over time as an MCAP file (https://mcap.dev/spec): a header, chunks of messages in order of time, each with
an index, a summary.

What the messages hold is not known here: their bytes are made one after the other, when they are written.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Final

MAGIC: Final = b"\x89MCAP0\r\n"
CHUNK_BYTES: Final = 4 << 20
_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _INDEX, _CHUNK_INDEX, _STATISTICS, _OFFSET, _END = (
    1,
    2,
    3,
    4,
    5,
    6,
    7,
    8,
    0x0B,
    0x0E,
    0x0F,
)


@dataclass(frozen=True, slots=True)
class McapMessage:
    """One message: its topic, the name of its schema, nanoseconds, and what makes its bytes when it is written."""

    topic: str
    schema: str
    nanoseconds: int
    content: Callable[[], bytes]


@dataclass(frozen=True, slots=True)
class McapDialect:
    """How messages are encoded.

    Args:
        profile: of the file. schema_encoding, message_encoding: names of the specification. schemas: text of every
            schema by its name.
        beside: what the channel of a topic carries beside.
    """

    profile: str
    schema_encoding: str
    message_encoding: str
    schemas: Mapping[str, str]
    beside: Callable[[str], Mapping[str, str]] = lambda _topic: {}


def _text(value: str) -> bytes:
    return struct.pack("<I", len(value.encode())) + value.encode()


def _op(code: int, content: bytes) -> bytes:
    return struct.pack("<BQ", code, len(content)) + content


@dataclass
class _Chunk:
    """Messages that are written together."""

    records: list[bytes] = field(default_factory=list)
    size: int = 0
    index: dict[int, list[tuple[int, int]]] = field(default_factory=dict)

    def add(self, channel: int, moment: int, record: bytes) -> None:
        self.index.setdefault(channel, []).append((moment, self.size))
        self.records.append(record)
        self.size += len(record)


class McapBlocks:
    """The bytes of a file, block by block; no more than one chunk is in memory.

    Args:
        messages: in order of time. library: name of the program. dialect: how they are encoded.
    """

    def __init__(self, messages: Iterable[McapMessage], library: str, dialect: McapDialect) -> None:
        self._messages, self._library, self._dialect = messages, library, dialect
        self._place = 0
        self._channels: dict[str, tuple[int, str]] = {}
        self._counts: dict[int, int] = {}
        self._indexes: list[bytes] = []
        self._span = (0, 0)

    def __iter__(self) -> Iterator[bytes]:
        yield self._at(MAGIC + _op(_HEADER, _text(self._dialect.profile) + _text(self._library)))
        chunk = _Chunk()
        for message in self._messages:
            channel = self._channel(message)
            moment, content = message.nanoseconds, message.content()
            number = self._counts[channel] = self._counts.get(channel, 0) + 1
            chunk.add(
                channel, moment, _op(_MESSAGE, struct.pack("<HIQQ", channel, number - 1, moment, moment) + content)
            )
            if chunk.size >= CHUNK_BYTES:
                yield self._chunk(chunk)
                chunk = _Chunk()
        if chunk.records:
            yield self._chunk(chunk)
        yield self._at(_op(_END, struct.pack("<I", 0)))
        yield self._summary()

    @property
    def topics(self) -> dict[str, tuple[str, int]]:
        """Schema and number of messages of every topic; complete when all blocks were taken."""
        return {topic: (schema, self._counts[number]) for topic, (number, schema) in self._channels.items()}

    @property
    def span(self) -> tuple[int, int]:
        """Nanoseconds of the first and the last message; complete when all blocks were taken."""
        return self._span

    def _at(self, content: bytes) -> bytes:
        self._place += len(content)
        return content

    def _channel(self, message: McapMessage) -> int:
        if message.topic not in self._channels:
            self._channels[message.topic] = (len(self._channels) + 1, message.schema)
        return self._channels[message.topic][0]

    def _definitions(self) -> tuple[bytes, bytes]:
        """Schema and channel records of all that occurred so far."""
        names = list(self._dialect.schemas)
        used = {schema for _, schema in self._channels.values()}
        schemas = b"".join(
            _op(
                _SCHEMA,
                struct.pack("<H", names.index(name) + 1)
                + _text(name)
                + _text(self._dialect.schema_encoding)
                + _text(self._dialect.schemas[name]),
            )
            for name in names
            if name in used
        )
        channels = b"".join(
            _op(
                _CHANNEL,
                struct.pack("<HH", number, names.index(schema) + 1)
                + _text(topic)
                + _text(self._dialect.message_encoding)
                + self._beside(topic),
            )
            for topic, (number, schema) in self._channels.items()
        )
        return schemas, channels

    def _beside(self, topic: str) -> bytes:
        """The metadata of a channel."""
        pairs = b"".join(_text(key) + _text(value) for key, value in self._dialect.beside(topic).items())
        return struct.pack("<I", len(pairs)) + pairs

    def _chunk(self, chunk: _Chunk) -> bytes:
        """A chunk, with the definitions of its channels before its messages, and the index of each channel."""
        head = b"".join(self._definitions())
        records = head + b"".join(chunk.records)
        moments = [moment for entries in chunk.index.values() for moment, _ in entries]
        first, last = min(moments), max(moments)
        start = self._place
        self._span = (first if not self._indexes else min(self._span[0], first), max(self._span[1], last))
        body = _op(
            _CHUNK,
            struct.pack("<QQQI", first, last, len(records), zlib.crc32(records))
            + _text("")
            + struct.pack("<Q", len(records))
            + records,
        )
        offsets, index = b"", b""
        for channel, entries in chunk.index.items():
            offsets += struct.pack("<HQ", channel, start + len(body) + len(index))
            rows = b"".join(struct.pack("<QQ", moment, len(head) + offset) for moment, offset in entries)
            index += _op(_INDEX, struct.pack("<HI", channel, len(rows)) + rows)
        self._indexes.append(
            _op(
                _CHUNK_INDEX,
                struct.pack("<QQQQI", first, last, start, len(body), len(offsets))
                + offsets
                + struct.pack("<Q", len(index))
                + _text("")
                + struct.pack("<QQ", len(records), len(records)),
            )
        )
        return self._at(body + index)

    def _summary(self) -> bytes:
        schemas, channels = self._definitions()
        counts = b"".join(struct.pack("<HQ", channel, count) for channel, count in sorted(self._counts.items()))
        used = len({schema for _, schema in self._channels.values()})
        statistics = _op(
            _STATISTICS,
            struct.pack(
                "<QHIIIIQQI",
                sum(self._counts.values()),
                used,
                len(self._channels),
                0,
                0,
                len(self._indexes),
                *self._span,
                len(counts),
            )
            + counts,
        )
        parts = (
            (_SCHEMA, schemas),
            (_CHANNEL, channels),
            (_STATISTICS, statistics),
            (_CHUNK_INDEX, b"".join(self._indexes)),
        )
        groups, place = b"", self._place
        for code, content in parts:
            if content:
                groups += _op(_OFFSET, struct.pack("<BQQ", code, place, len(content)))
                place += len(content)
        body = b"".join(content for _, content in parts) + groups
        footer = struct.pack("<BQQQ", _FOOTER, 20, self._place, place)
        checksum = zlib.crc32(body + footer)
        return self._at(body + footer + struct.pack("<I", checksum) + MAGIC)
