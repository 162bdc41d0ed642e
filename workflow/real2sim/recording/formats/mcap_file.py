"""MCAP files: every message in file order, in bounded memory, with or without chunks, index and summary.

The data section is read from its start, as a recovery tool does: nothing depends on an index that may be
missing or wrong. Checksums are verified where they are there (0 means that none was computed).
https://mcap.dev/spec
"""

from __future__ import annotations

import contextlib
import json
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, Protocol

from real2sim.errors import InputError
from real2sim.recording.formats.recordings import Finding
from real2sim.recording.formats.ros2_definition import parse_definition, stripped_text

MAGIC = b"\x89MCAP0\r\n"
_HEADER, _FOOTER, _SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = 1, 2, 3, 4, 5, 6
_STATISTICS, _DATA_END = 11, 15
_LARGEST = 1 << 28  # bytes of one record or chunk; rosbag2 writes chunks of 1 MB
_PIECE = 1 << 20
_LARGEST_JSON = 1 << 20  # bytes of one message
_LARGEST_SCHEMA = 1 << 16  # bytes of one definition; that of an odometry has two thousand
# Chunks may unpack to so many times the file's size, or so many bytes if that is more: logs of robots reach 7 times
_MOST_UNPACKED, _SMALL = 20, 1 << 23
# A message takes so many bytes of the file at least, where there are more than a few: joint states take thirty packed
_LEAST_BYTES, _FEW = 6, 100_000
_UNPACK = "if the log is sound, unpack it: `mcap decompress`"
_RECORD = "record it again with `ros2 bag record --storage mcap`, or leave it out"
_RECOVER = "copy it again, or repair it with `mcap recover` and check what is left"


@dataclass(frozen=True)
class Channel:
    """A topic as the file describes it; ``schema_name`` is empty for a channel without a schema."""

    id: int
    topic: str
    message_encoding: str
    schema_id: int = 0
    schema_name: str = ""
    schema_encoding: str = ""
    schema_data: bytes = b""


@dataclass
class Contents:
    """Description of a file by itself, complete once all messages were read."""

    profile: str = ""
    library: str = ""
    channels: dict[int, Channel] = field(default_factory=dict)
    messages: int = 0
    backwards: int = 0
    findings: list[Finding] = field(default_factory=list)


class RawMessage(NamedTuple):
    """One message: times [ns], not decoded."""

    channel: Channel
    sequence: int
    log_time: int
    publish_time: int
    data: bytes


def is_mcap(raw: bytes) -> bool:
    """Return whether a file starts as an MCAP does."""
    return raw.startswith(MAGIC[:5])


def read_messages(path: Path, contents: Contents | None = None) -> Iterator[RawMessage]:
    """Messages in file order, which need not be that of time; ``contents`` is filled on the way.

    Raises InputError where the file breaks off, a checksum is wrong, or a record cannot be what it says.
    """
    contents = Contents() if contents is None else contents
    try:
        with Path(path).open("rb") as stream:
            size = _check_ends(path, stream)
            yield from _Section(path, stream, size, contents).messages()
    except OSError as error:
        found = f"{error.strerror or error}"
        raise InputError(path, "", found, "an MCAP log", _RECORD, "unreadable") from error


def _check_ends(path: Path, stream: BinaryIO) -> int:
    """Size of a file that starts and ends as an MCAP does."""
    size = stream.seek(0, 2)
    stream.seek(0)
    start = stream.read(len(MAGIC))
    if not size:
        raise InputError(path, "", "an empty file", "an MCAP log", _RECORD, "empty")
    if not is_mcap(start):
        found = f"a file that starts with {start!r}"
        raise InputError(path, "", found, "an MCAP log", _RECORD, "header")
    stream.seek(max(size - len(MAGIC), 0))
    end = stream.read()
    if size < 2 * len(MAGIC) or end != MAGIC or start != MAGIC:
        found = "a file that breaks off (no closing MCAP magic)"
        raise InputError(path, f"byte {size}", found, "a complete MCAP log", _RECOVER, "truncated")
    return size


class _Section:
    """The walk through one file's records."""

    def __init__(self, path: Path, stream: BinaryIO, size: int, contents: Contents):
        self.path, self.stream, self.size, self.contents = path, stream, size, contents
        self.schemas: dict[int, tuple[str, str, bytes]] = {}
        self.crc = 0
        self.last = -1
        self.unpacked = self.cost = 0

    def messages(self) -> Iterator[RawMessage]:
        self.stream.seek(0)
        self._take(len(MAGIC))
        while True:
            start, before = self.stream.tell(), self.crc
            head = self._take(9)
            opcode, length = struct.unpack("<BQ", head)
            if length > self.size - self.stream.tell():
                found = f"a record of {length} bytes where {self.size - self.stream.tell()} are left"
                self._refuse(start, found, "truncated", _RECOVER)
            if opcode in (_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _HEADER, _DATA_END):
                if length > _LARGEST:
                    self._refuse(start, f"a record of {length} bytes", "too_large")
                body = self._take(length)
                if opcode == _DATA_END:
                    self._data_end(start, body, before)
                    return
                yield from self._record(start, opcode, body)
            elif opcode == _FOOTER or opcode == 0:
                self._refuse(start, f"record {opcode} before the end of the data", "damaged")
            else:
                self._skip(length)

    def _take(self, count: int) -> bytes:
        data = self.stream.read(count)
        if len(data) < count:
            self._refuse(self.stream.tell(), "a file that breaks off", "truncated", _RECOVER)
        self.crc = zlib.crc32(data, self.crc)
        return data

    def _skip(self, count: int) -> None:
        while count:
            count -= len(self._take(min(count, _PIECE)))

    def _refuse(self, at: int, found: str, code: str, remedy: str = _RECORD) -> None:
        raise InputError(self.path, f"byte {at}", found, "a complete MCAP log", remedy, code)

    def _record(self, at: int, opcode: int, body: bytes) -> Iterator[RawMessage]:
        try:
            if opcode == _HEADER:
                self.contents.profile, rest = _string(body, 0)
                self.contents.library, _ = _string(body, rest)
            elif opcode == _SCHEMA:
                self._schema(body)
            elif opcode == _CHANNEL:
                self._channel(body)
            elif opcode == _MESSAGE:
                yield self._message(body)
            elif opcode == _CHUNK:
                yield from self._chunk(at, body)
        except (struct.error, ValueError, IndexError, UnicodeDecodeError) as error:
            self._refuse(at, f"a damaged record ({error})", "damaged")

    def _schema(self, body: bytes) -> None:
        (number,) = struct.unpack_from("<H", body, 0)
        name, at = _string(body, 2)
        encoding, at = _string(body, at)
        (length,) = struct.unpack_from("<I", body, at)
        data = body[at + 4 : at + 4 + length]
        if len(data) < length:
            raise ValueError("a schema shorter than it says")
        if self.schemas.setdefault(number, (name, encoding, data)) != (name, encoding, data):
            raise ValueError(f"two schemas of number {number}")

    def _channel(self, body: bytes) -> None:
        number, schema = struct.unpack_from("<HH", body, 0)
        topic, at = _string(body, 4)
        encoding, at = _string(body, at)
        if schema and schema not in self.schemas:
            raise ValueError(f"channel {topic} of an unknown schema {schema}")
        channel = Channel(number, topic, encoding, schema, *self.schemas.get(schema, ("", "", b"")))
        if self.contents.channels.setdefault(number, channel) != channel:
            raise ValueError(f"two channels of number {number}")

    def _message(self, body: bytes) -> RawMessage:
        number, sequence, log_time, publish_time = struct.unpack_from("<HIQQ", body, 0)
        channel = self.contents.channels.get(number)
        if channel is None:
            raise ValueError(f"a message of an unknown channel {number}")
        self.contents.messages += 1
        self.cost += 1 if channel.message_encoding == "cdr" else 2  # JSON and protobuf are decoded one by one
        if self.cost > max(self.size // _LEAST_BYTES, _FEW):
            found = f"more than {self.contents.messages - 1} messages in a file of {self.size} bytes"
            self._refuse(self.stream.tell(), found, "too_large", _UNPACK)
        self.contents.backwards += log_time < self.last
        self.last = log_time
        return RawMessage(channel, sequence, log_time, publish_time, body[22:])

    def _chunk(self, at: int, body: bytes) -> Iterator[RawMessage]:
        _, _, size, crc = struct.unpack_from("<QQQI", body, 0)
        compression, begin = _string(body, 28)
        (length,) = struct.unpack_from("<Q", body, begin)
        data = body[begin + 8 : begin + 8 + length]
        if len(data) < length:
            raise ValueError("a chunk shorter than it says")
        if size > _LARGEST:
            self._refuse(at, f"a chunk of {size} bytes", "too_large")
        self.unpacked += size
        if self.unpacked > max(_MOST_UNPACKED * self.size, _SMALL):
            found = f"chunks of more than {self.unpacked} bytes in a file of {self.size}"
            self._refuse(at, found, "too_large", _UNPACK)
        records = self._decompressed(at, compression, data, size)
        if crc and zlib.crc32(records) != crc:
            self._refuse(at, "a chunk whose checksum is wrong", "checksum", _RECOVER)
        inside = 0
        while inside < len(records):
            opcode, count = struct.unpack_from("<BQ", records, inside)
            inside += 9
            if count > len(records) - inside:
                raise ValueError("a record longer than its chunk")
            if opcode == _MESSAGE:
                yield self._message(records[inside : inside + count])
            elif opcode in (_SCHEMA, _CHANNEL):
                yield from self._record(at, opcode, records[inside : inside + count])
            inside += count

    def _decompressed(self, at: int, compression: str, data: bytes, size: int) -> bytes:
        if compression in ("", "none"):
            out = data
        elif compression == "zstd":
            out = self._unpack(at, _zstd, data, size)
        elif compression == "lz4":
            out = self._unpack(at, _lz4, data, size)
        else:
            self._refuse(at, f"a chunk compressed by {compression!r}", "compression")
        if len(out) != size:
            self._refuse(at, f"a chunk of other than its {size} bytes", "damaged", _RECOVER)
        return out

    def _unpack(self, at: int, unpack: Callable[[bytes, int], bytes], data: bytes, size: int) -> bytes:
        try:
            return unpack(data, size)
        except Exception as error:  # each library has its own kinds
            found = f"a chunk that does not decompress ({error})"
            raise InputError(
                self.path, f"byte {at}", found, "a complete MCAP log", _RECOVER, "damaged"
            ) from error

    def _data_end(self, at: int, body: bytes, before: int) -> None:
        if len(body) < 4:
            self._refuse(at, "a damaged end of the data", "damaged")
        (crc,) = struct.unpack_from("<I", body, 0)
        if crc and crc != before:
            self._refuse(at, "data whose checksum is wrong", "checksum", _RECOVER)
        self._summary(self.stream.read(min(_LARGEST, self.size - self.stream.tell())))

    def _summary(self, rest: bytes) -> None:
        """Take the topics without messages and compare the statistics; messages do not need the summary."""
        at, declared, footer = 0, None, False
        try:
            while at + 9 <= len(rest) - len(MAGIC):
                opcode, count = struct.unpack_from("<BQ", rest, at)
                body = rest[at + 9 : at + 9 + count]
                if opcode == _STATISTICS:
                    (declared,) = struct.unpack_from("<Q", body)
                elif opcode == _SCHEMA:
                    self._schema(body)
                elif opcode == _CHANNEL:
                    self._channel(body)
                footer = footer or opcode == _FOOTER
                at += 9 + count
        except (struct.error, ValueError, IndexError, UnicodeDecodeError):
            footer = False
        if at != len(rest) - len(MAGIC) or not footer:
            self._note("summary", "a summary that is damaged", "not needed: the data are read from the start")
        if declared is not None and declared != self.contents.messages:
            message = f"{declared} messages declared, {self.contents.messages} there"
            self._note("count", message, "the data are used")

    def _note(self, code: str, message: str, action: str) -> None:
        self.contents.findings.append(Finding(code, "warning", self.path.name, "summary", message, action))


def _string(body: bytes, at: int) -> tuple[str, int]:
    (length,) = struct.unpack_from("<I", body, at)
    text = body[at + 4 : at + 4 + length]
    if len(text) < length:
        raise ValueError("a string longer than its record")
    return text.decode(), at + 4 + length


def _zstd(data: bytes, size: int) -> bytes:
    import zstandard

    with zstandard.ZstdDecompressor().stream_reader(data, read_across_frames=True) as stream:
        return stream.read(size + 1)


def _lz4(data: bytes, size: int) -> bytes:
    import lz4.frame

    plain: bytes = lz4.frame.LZ4FrameDecompressor().decompress(data, max_length=size + 1)
    return plain


# -------------------- writing


class _Writer(Protocol):
    def finish(self) -> None: ...


def finish_file(writer: _Writer) -> None:
    """Write the index and summary of a file written by ``mcap.writer.Writer``; its stream stays open."""
    writer.finish()


# -------------------- decoding


class Undecodable(ValueError):
    """A payload that is not what its channel says; ``code`` names the refusal."""

    def __init__(self, message: str, code: str = "payload"):
        super().__init__(message)
        self.code = code


def decoder(channel: Channel) -> Callable[[bytes], Any]:
    """Function that decodes the payloads of a channel: JSON, protobuf, or ROS 2 messages in CDR.

    Raises Undecodable where the channel's encodings are not among these or its schema cannot be read; so does
    the function where a payload is not what the schema says, to its last byte.
    """
    kind = channel.message_encoding, channel.schema_encoding
    if channel.message_encoding == "json":
        return _json
    if kind[0] == "cdr" and len(channel.schema_data) > _LARGEST_SCHEMA:
        raise Undecodable(f"its definition has more than {_LARGEST_SCHEMA} bytes", "schema")
    if kind not in (("cdr", "ros2msg"), ("protobuf", "protobuf")):
        named = f"encoding {kind[0]!r} with schema {kind[1]!r}"
        raise Undecodable(f"{named} is not read", "encoding")
    try:
        # the parser of definitions prints what it raises
        with contextlib.redirect_stdout(None), contextlib.redirect_stderr(None):
            return _cdr(channel) if kind[0] == "cdr" else _protobuf(channel)
    except ImportError:  # a package is missing: no fault of the file
        raise
    except Exception as error:  # both libraries raise many kinds, by what is odd
        raise Undecodable(f"its definition cannot be read: {error}"[:200], "schema") from error


def _schema_record(channel: Channel, data: bytes) -> Any:
    from mcap.records import Schema

    return Schema(
        id=channel.schema_id or 1,
        name=channel.schema_name,
        encoding=channel.schema_encoding,
        data=data,
    )


def _json(payload: bytes) -> Any:
    if len(payload) > _LARGEST_JSON:  # a list of lists takes twenty times its text
        raise Undecodable(f"JSON of {len(payload)} bytes, no more than {_LARGEST_JSON} are read")
    try:
        return json.loads(payload)
    except (ValueError, RecursionError) as error:
        raise Undecodable(f"not JSON: {error}") from error


def _cdr(channel: Channel) -> Callable[[bytes], Any]:
    from mcap_ros2.decoder import DecoderFactory

    definition = parse_definition(channel.schema_name, channel.schema_data.decode())
    # without the names of constants, over which the parser's pattern can take for ever
    text = stripped_text(definition).encode()
    decode = DecoderFactory().decoder_for("cdr", _schema_record(channel, text))
    assert decode is not None

    def exactly(payload: bytes) -> Any:
        if payload[:2] != b"\x00\x01":
            raise Undecodable("not little-endian CDR")
        try:
            size = definition.end(payload)
            message = decode(payload)
        except Exception as error:
            raise Undecodable(f"not a {channel.schema_name}: {error}"[:200]) from error
        # The end may be filled up to a multiple of four.
        if len(payload) > size + 3:
            raise Undecodable(f"{len(payload)} bytes where a {channel.schema_name} takes {size}")
        return message

    return exactly


def _protobuf(channel: Channel) -> Callable[[bytes], Any]:
    from mcap_protobuf.decoder import DecoderFactory

    decode = DecoderFactory().decoder_for("protobuf", _schema_record(channel, channel.schema_data))
    assert decode is not None

    def known(payload: bytes) -> Any:
        try:
            message = decode(payload)
        except Exception as error:
            raise Undecodable(f"not a {channel.schema_name}: {error}"[:200]) from error
        whole = message.ByteSize()
        message.DiscardUnknownFields()
        if message.ByteSize() != whole:
            raise Undecodable(f"fields that {channel.schema_name} does not have")
        return message

    return known
