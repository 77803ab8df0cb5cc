"""ROS 2 bags in SQLite (`.db3`), as `ros2 bag record` wrote them before it took MCAP."""

import sqlite3
from collections.abc import Collection, Iterator
from pathlib import Path
from urllib.parse import quote

from madoc.data.logs.mcap_reader import LARGEST_CHUNK
from madoc.data.logs.messages import Kind, Message, run_of
from madoc.data.logs.tables import Run
from madoc.errors import MadocError

_MESSAGES = """
SELECT topics.name, topics.type, topics.serialization_format, messages.timestamp, messages.data
FROM messages JOIN topics ON messages.topic_id = topics.id ORDER BY messages.timestamp, messages.id
"""
_DEFINITIONS = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"


def read(path: Path, wanted: Collection[str]) -> list[Run]:
    """One run with a table for each topic, as `messages.run_of` makes them; a bag knows one time of a message."""
    return [run_of(path, _messages(path), wanted)]


def _messages(path: Path) -> Iterator[Message]:
    """The messages in the order of their times; the file is only read, and no journal beside it."""
    try:
        connection = sqlite3.connect(f"file:{quote(str(path.absolute()))}?mode=ro&immutable=1", uri=True)
        try:
            connection.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, LARGEST_CHUNK)
            tables = {name for (name,) in connection.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
            rows = connection.execute(_DEFINITIONS) if "message_definitions" in tables else ()
            defined = {name: (text, encoding == "ros2idl") for name, encoding, text in rows}
            for topic, name, encoding, time, data in connection.execute(_MESSAGES):
                yield Message(topic, Kind(encoding, name, *defined.get(name, ())), data, time, time)
        finally:
            connection.close()
    except (sqlite3.Error, OverflowError) as error:
        raise MadocError(
            f"cannot read {path.name} as a ROS 2 bag ({error}); it is damaged, was cut short or is packed: "
            "`ros2 bag convert` may save or unpack it"
        ) from error
