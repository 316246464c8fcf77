"""The messages of a complete MCAP file, chunk by chunk, each read whole.

The library's own iterators build an object for each record, wanted or not. Here it opens and checks
the chunks, and their messages are found in place.
"""

import struct
from bisect import bisect_left
from collections.abc import Collection, Iterator, Mapping
from typing import IO, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.reader import SeekingReader, Summary
from mcap.records import Chunk, ChunkIndex
from mcap.stream_reader import get_chunk_data_stream

_RECORD = struct.Struct("<BQ")
"""Kind of a record and its length, which follows."""
_MESSAGE = struct.Struct("<H4xQ8x")
"""Channel and time of a message, without its sequence and when it was published; data follow."""
MESSAGE = int(Opcode.MESSAGE)


class Record(NamedTuple):
    """One message of a bag."""

    topic: str
    """Absolute, as recorded: `/robot_1/odom`."""
    type: str
    stamp_ns: int
    """When it was recorded."""
    data: bytes
    """CDR."""


_Placed = tuple[int, int, int, Record]
"""A record behind its place in the order: time, where its chunk is in the file, its number there.

No two records have the same place.
"""

_Channels = Mapping[int, tuple[str, str] | None]
"""Topic and type of each channel; None where it is not wanted."""


def records(
    stream: IO[bytes], summary: Summary | None, names: Collection[str] | None
) -> Iterator[Record]:
    """Those of the topics `names`, by default all, by time, then in the order written.

    Parameters
    ----------
    stream : an MCAP file that can be sought in.
    summary : what its summary section holds, if it has one.

    """
    if summary is None or not summary.chunk_indexes:
        yield from _unindexed(stream, names)
        return
    channels = _channels(summary, names)
    wanted = {number for number, channel in channels.items() if channel}
    waiting: list[_Placed] = []
    for index in sorted(summary.chunk_indexes, key=_place):
        # An index that lists no channels does not tell what is in its chunk.
        if index.message_index_offsets and wanted.isdisjoint(index.message_index_offsets):
            continue
        ready = bisect_left(waiting, _place(index))
        yield from (record for *_, record in waiting[:ready])
        waiting = sorted([*waiting[ready:], *_messages(stream, index, channels)])
    yield from (record for *_, record in waiting)


def _place(index: ChunkIndex) -> tuple[int, int]:
    return index.message_start_time, index.chunk_start_offset


def _channels(summary: Summary, names: Collection[str] | None) -> _Channels:
    types = {number: schema.name for number, schema in summary.schemas.items()} | {0: ""}
    return {
        number: (channel.topic, types[channel.schema_id])
        if names is None or channel.topic in names
        else None
        for number, channel in summary.channels.items()
    }


def _unindexed(stream: IO[bytes], names: Collection[str] | None) -> Iterator[Record]:
    stream.seek(0)
    for schema, channel, message in SeekingReader(stream, validate_crcs=True).iter_messages(names):
        yield Record(channel.topic, schema.name if schema else "", message.log_time, message.data)


def _messages(stream: IO[bytes], index: ChunkIndex, channels: _Channels) -> Iterator[_Placed]:
    """The wanted messages of one chunk."""
    stream.seek(index.chunk_start_offset + _RECORD.size)
    chunk = Chunk.read(ReadDataStream(stream))
    opened, size = get_chunk_data_stream(chunk, validate_crc=True)
    data = opened.read(size)
    end = number = 0
    while end < size:
        kind, length = _RECORD.unpack_from(data, end)
        begin = end + _RECORD.size
        end = begin + length
        if end > size:
            raise ValueError(f"a record of {length} bytes is longer than its chunk")
        if kind == MESSAGE:
            channel_number, stamp_ns = _MESSAGE.unpack_from(data, begin)
            channel = channels[channel_number]
            if channel:
                record = Record(*channel, stamp_ns, data[begin + _MESSAGE.size : end])
                yield stamp_ns, index.chunk_start_offset, number, record
        number += 1
