"""Messages of robot middleware, JSON or ROS 2, in MCAP or bags: a table for each topic, each with its own clock."""

import json
import sqlite3
from array import array
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO
from urllib.parse import quote

import numpy as np

from madoc.data.logs.tables import WIDEST, Run, Table
from madoc.data.validation import LARGEST, check_size
from madoc.errors import MadocError, needing

if TYPE_CHECKING:
    from mcap.records import Chunk

CLOCK = "log_time"
MOST_NAMES = 10_000
"""Number of columns of a topic that are known by name, beside those that are asked for."""
_OF_TIMES = 200
"""Size of the three times of a message, bytes in memory."""
EXTRA = "madoc-calibration[logs]"

Decoder = Callable[[bytes], object]

LARGEST_CHUNK = 200_000_000
"""Largest size of a chunk, bytes when unpacked; recorders write chunks of a million or less."""
_MOST_OF_LZ4 = 255
"""Largest ratio by which LZ4 packs."""
_ROWS_OF_BAG = """
SELECT topics.name, topics.type, topics.serialization_format, messages.timestamp, messages.data
FROM messages JOIN topics ON messages.topic_id = topics.id ORDER BY messages.timestamp, messages.id
"""
_DEFINITIONS = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"


@dataclass(frozen=True)
class Kind:
    """What messages of a topic are: in `json` or `cdr`, and of a ROS type as `sensor_msgs/msg/JointState`.

    Its definition has those of the types it is made of, in IDL or not; it is empty where the log has none.
    """

    encoding: str
    name: str = ""
    definition: str = ""
    idl: bool = False


@dataclass(frozen=True)
class Message:
    """A message, and the times in ns at which it was logged and published."""

    topic: str
    kind: Kind
    data: bytes
    logged: int
    published: int


@dataclass(frozen=True)
class _Topic:
    """Messages of one topic.

    Attributes:
        decode: The decoder of its messages.
        columns: The wanted numbers by path, NaN where a message lacks one.
        times: Times in ns at which each message was logged, published and measured; None for one without a stamp.
        names: Paths of the numbers of the first message.
    """

    decode: Decoder
    columns: dict[str, "array[float]"] = field(default_factory=dict)
    times: list[tuple[int, int, int | None]] = field(default_factory=list)
    names: list[str] = field(default_factory=list)

    def add(self, name: str, message: Message, wanted: Collection[str]) -> None:
        """Take over the wanted numbers of a message; those of the first are named all."""
        content, count = self.decode(message.data), len(self.times)
        for path, number in _flat(name, content):
            if not count and len(self.names) < MOST_NAMES:
                self.names.append(path)
            if path in wanted:
                self.columns.setdefault(path, array("d", [np.nan]) * count).append(number)
        for column in self.columns.values():
            column.extend([np.nan] * (count + 1 - len(column)))
            del column[count + 1 :]  # of a name that is there twice
        self.times.append((message.logged, message.published, _stamp(content)))

    @property
    def size(self) -> int:
        """Size of what was taken over, bytes in memory."""
        return sum(8 * len(column) for column in self.columns.values()) + _OF_TIMES * len(self.times)


def run_of(path: Path, messages: Iterable[Message], wanted: Collection[str]) -> Run:
    """A run of all messages, with a table for each topic. A column is named by topic and path of a field.

    As `/joints.position[0]`; where a message names its elements, as sensor_msgs/JointState does in `name`, the names
    are in the brackets: `/joints.position[shoulder]`. Each topic has `log_time`, `publish_time` and, where it is
    stamped, `header.stamp`, in s since the first message of the file. All messages of topics with a wanted column are
    decoded, and one message of every other topic, for the names of its columns.

    Raises:
        MadocError: No topic can be decoded, a message is damaged, or there is too much.
    """
    topics: dict[str, _Topic] = {}
    unknown: dict[str, str] = {}
    for message in messages:
        name = message.topic
        if name not in topics:
            decode = _decoder(name, message.kind)
            if decode is None:
                unknown[name] = message.kind.encoding or "no"
                continue
            topics[name] = _Topic(decode)
        topic = topics[name]
        if topic.times and not any(f"{column}.".startswith((f"{name}.", f"{name}[")) for column in wanted):
            continue
        try:
            topic.add(name, message, wanted)
        except Exception as error:  # decoders raise anything from KeyError to struct.error on a damaged message
            raise MadocError(
                f"cannot decode message {len(topic.times)} of {name} in {path.name} ({error}); it is damaged, "
                "record it again"
            ) from error
        if len(topic.times) % 1000 == 0:
            size = sum(topic.size for topic in topics.values())
            check_size(size, f"the columns of {path.name} that are asked for", LARGEST)
    if not topics:
        what = ", ".join(f"{topic} ({encoding} encoding)" for topic, encoding in unknown.items()) or "no messages"
        raise MadocError(f"expected topics of JSON or ROS 2 messages in {path.name}, got {what}; convert it to CSV")
    others = {topic: f"a topic of {encoding} encoding" for topic, encoding in unknown.items()}
    origin = min(topic.times[0][0] for topic in topics.values())
    return Run(path.name, tuple(_table(topic, origin, others) for topic in topics.values()))


def _decoder(topic: str, kind: Kind) -> Decoder | None:
    """The decoder of a topic's messages; None for an unknown encoding, and for a type that nothing defines."""
    if kind.encoding == "json":
        return json.loads
    if kind.encoding != "cdr":
        return None
    with needing(f"topic {topic} holds ROS 2 messages, which need:", EXTRA):
        from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
    store = get_typestore(Stores.LATEST)  # has the types of bags from before ROS 2 Iron, which hold no definitions
    name = kind.name if kind.name.count("/") > 1 else kind.name.replace("/", "/msg/")
    try:
        if kind.definition:
            given = get_types_from_idl(kind.definition) if kind.idl else get_types_from_msg(kind.definition, name)
            common = {key: part for key, part in store.fielddefs.items() if key.startswith("builtin_interfaces/")}
            store = get_typestore(Stores.EMPTY)
            store.register(common | given)
    except Exception as error:  # of a parser of somebody else's text
        raise MadocError(f"the definition of {name} in topic {topic} is damaged ({error}); record it again") from error
    return (lambda data: store.deserialize_cdr(data, name)) if name in store.types else None


def _flat(name: str, value: object, elements: list[str] | None = None) -> Iterator[tuple[str, float]]:
    """Numbers in a message by path; text and empty fields are left out."""
    if isinstance(value, bool | int | float):
        yield name, _float(value)
    elif isinstance(value, Sequence | np.ndarray) and not isinstance(value, str | bytes):
        if len(value) > WIDEST:
            return  # a picture
        labels = elements if elements is not None and len(elements) == len(value) else range(len(value))
        parts = value.tolist() if isinstance(value, np.ndarray) else value
        for label, part in zip(labels, parts, strict=True):
            yield from _flat(f"{name}[{label}]", part)
    elif not isinstance(value, str | bytes):
        fields = _parts(value)
        names = fields.get("name")
        inner = names if isinstance(names, list) and all(isinstance(text, str) for text in names) else None
        for key, part in fields.items():
            if key == "stamp" and {"sec", "nanosec"} <= _parts(part).keys():
                continue  # in whole nanoseconds, by `_stamp`
            yield from _flat(f"{name}.{key}", part, inner)


def _float(value: float) -> float:
    """A number as float; a whole number beyond its range is infinite."""
    try:
        return float(value)
    except OverflowError:
        return float("inf") if value > 0 else float("-inf")


def _parts(value: object) -> dict[str, object]:
    """Fields of a decoded message."""
    if value is None:
        return {}
    if isinstance(value, Mapping):
        return {str(key): part for key, part in value.items()}
    slots: Collection[str] = getattr(value, "__slots__", ())
    fields = getattr(value, "__dict__", None) or {key: getattr(value, key) for key in slots}
    return {key: part for key, part in fields.items() if not key.startswith("_")}


def _stamp(content: object) -> int | None:
    """Time in ns at which a ROS message says it was measured; None for a message without a stamp."""
    parts = _parts(_parts(_parts(content).get("header")).get("stamp"))
    seconds, nanoseconds = parts.get("sec"), parts.get("nanosec")
    if not isinstance(seconds, int | float) or not isinstance(nanoseconds, int | float):
        return None
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


def _table(topic: _Topic, origin: int, others: Mapping[str, str]) -> Table:
    """Messages as columns, in the order of logging."""
    columns = {key: np.array(values) for key, values in topic.columns.items()}
    for clock, times in zip((CLOCK, "publish_time", "header.stamp"), zip(*topic.times, strict=True), strict=True):
        if None not in times:
            columns[clock] = (np.array(times, dtype=np.int64) - origin) / 1e9
    return Table(columns, CLOCK, others=others, unread=[key for key in topic.names if key not in columns])


def read_mcap(path: Path, wanted: Collection[str]) -> list[Run]:
    """One run with a table for each topic, as `run_of` makes them."""
    return [run_of(path, _messages_of_mcap(path), wanted)]


def _messages_of_mcap(path: Path) -> Iterator[Message]:
    with needing("MCAP logs need the library mcap:", EXTRA):
        from mcap.reader import make_reader
    try:
        with path.open("rb") as file:
            _check_chunks(file)
            file.seek(0)
            for schema, channel, found in make_reader(file, validate_crcs=True).iter_messages():
                kind = Kind(channel.message_encoding)
                if schema is not None and kind.encoding == "cdr":
                    kind = Kind("cdr", schema.name, schema.data.decode(), schema.encoding == "ros2idl")
                yield Message(channel.topic, kind, found.data, found.log_time, found.publish_time)
    except Exception as error:  # the reader passes on what its decompressors and unpackers raise
        raise MadocError(
            f"cannot read {path.name} as MCAP ({type(error).__name__}: {error}); it is damaged or was cut short, "
            "`mcap recover` may save it"
        ) from error


def _check_chunks(file: BinaryIO) -> None:
    """Refuse, by a ValueError, a chunk that unpacks to more than any recorder writes."""
    from mcap.records import Chunk
    from mcap.stream_reader import StreamReader

    for record in StreamReader(file, emit_chunks=True, record_size_limit=LARGEST_CHUNK).records:
        if isinstance(record, Chunk) and _unpacked_size(record) > LARGEST_CHUNK:
            raise ValueError(f"a chunk unpacks to more than {LARGEST_CHUNK:,} bytes")


def _unpacked_size(chunk: "Chunk") -> int:
    """Size in bytes to which a chunk unpacks at most; no more than the bound is unpacked to know it."""
    if chunk.compression == "zstd":
        import zstandard

        told = zstandard.get_frame_parameters(chunk.data).content_size
        return chunk.uncompressed_size if told == zstandard.CONTENTSIZE_UNKNOWN else max(told, chunk.uncompressed_size)
    if chunk.compression == "lz4" and len(chunk.data) > LARGEST_CHUNK // _MOST_OF_LZ4:
        from lz4.frame import LZ4FrameDecompressor

        return len(LZ4FrameDecompressor().decompress(chunk.data, max_length=LARGEST_CHUNK + 1))
    return 0


def read_bag(path: Path, wanted: Collection[str]) -> list[Run]:
    """One run with a table for each topic, as `run_of` makes them; a bag knows one time of a message."""
    return [run_of(path, _messages_of_bag(path), wanted)]


def _messages_of_bag(path: Path) -> Iterator[Message]:
    """The messages in the order of their times; the file is only read, and no journal beside it."""
    try:
        connection = sqlite3.connect(f"file:{quote(str(path.absolute()))}?mode=ro&immutable=1", uri=True)
        try:
            connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LARGEST_CHUNK)
            tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
            rows = connection.execute(_DEFINITIONS) if "message_definitions" in tables else ()
            defined = {name: (text, encoding == "ros2idl") for name, encoding, text in rows}
            for topic, name, encoding, time, data in connection.execute(_ROWS_OF_BAG):
                yield Message(topic, Kind(encoding, name, *defined.get(name, ())), data, time, time)
        finally:
            connection.close()
    except (sqlite3.Error, OverflowError) as error:
        raise MadocError(
            f"cannot read {path.name} as a ROS 2 bag ({error}); it is damaged, was cut short or is packed: "
            "`ros2 bag convert` may save or unpack it"
        ) from error
