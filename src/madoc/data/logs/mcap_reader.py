"""MCAP: topics of JSON or ROS 2 messages."""

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from madoc.data.logs.messages import EXTRA, Kind, Message, run_of
from madoc.data.logs.tables import Run
from madoc.errors import MadocError

if TYPE_CHECKING:
    from mcap.records import Chunk

LARGEST_CHUNK = 200_000_000
"""Largest size of a chunk, bytes when unpacked; recorders write chunks of a million or less."""
_MOST_OF_LZ4 = 255
"""Largest ratio by which LZ4 packs."""


def read(path: Path, wanted: Collection[str]) -> list[Run]:
    """One run with a table for each topic, as `messages.run_of` makes them."""
    return [run_of(path, _messages(path), wanted)]


def _messages(path: Path) -> Iterator[Message]:
    try:
        from mcap.reader import make_reader
    except ImportError as error:
        raise MadocError(f"MCAP logs need the library mcap: {EXTRA} ({error})") from error
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
