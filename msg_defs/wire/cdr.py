"""CDR read and written in place, for messages that come by the thousand.

Where a message's strings are known, all its numbers are at known places. What is not laid out as
expected is left to the general reader of `messages`, which is slower and tells what is wrong.
"""

import struct
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

LITTLE_ENDIAN = b"\x00\x01"
"""How a message begins; two more bytes follow that mean nothing."""

START = 4
"""Where what is aligned begins."""

MOST_TRAILING = 3
"""Bytes that may follow a message."""

NANOSECONDS = 10**9


class Found(NamedTuple):
    """What a message of a known layout holds."""

    seconds: int
    """Of the stamp, as `nanoseconds`."""
    nanoseconds: int
    numbers: tuple[float, ...]
    """Those that were wanted."""


class Layout:
    """A message of a header, strings, and float64 numbers.

    Parameters
    ----------
    texts : frame_id, and the strings that follow it.
    count : how many numbers follow them.
    wanted : which of these are read, ascending.

    """

    def __init__(self, texts: Sequence[str], count: int, wanted: Sequence[int]) -> None:
        form, size = "<2s2xiI", 12
        columns: dict[str, tuple[int, object]] = {
            "magic": (0, "S2"),
            "seconds": (4, "<i4"),
            "nanoseconds": (8, "<u4"),
        }
        self._texts: tuple[int | bytes, ...] = ()
        for text in texts:
            data, padding = text.encode() + b"\0", -size % 4
            form += f"{padding}xI{len(data)}s"
            columns[f"length {size}"] = size + padding, "<u4"
            columns[f"text {size}"] = size + padding + 4, f"V{len(data)}"
            size += padding + 4 + len(data)
            self._texts += (len(data), data)
        padding = -(size - START) % 8
        form += f"{padding}x"
        columns["numbers"] = size + padding, ("<f8", count)
        self.size = size + padding + 8 * count
        """Of a message [bytes]."""
        places, formats = zip(*columns.values(), strict=True)
        self._table = np.dtype(
            {
                "names": [*columns],
                "offsets": [*places],
                "formats": [*formats],
                "itemsize": self.size,
            }
        )
        self._wanted = list(wanted)
        self._numbers_from = 3 + len(self._texts)
        numbers = "".join("d" if i in wanted else "8x" for i in range(count))
        self._reader = struct.Struct(form + numbers)
        self._writer = struct.Struct(form + "d" * count)

    def read(self, data: bytes) -> Found | None:
        """What a message holds; None where it is laid out in another way."""
        if not 0 <= len(data) - self.size <= MOST_TRAILING:
            return None
        values = self._reader.unpack_from(data)
        if values[0] != LITTLE_ENDIAN or values[3 : self._numbers_from] != self._texts:
            return None
        return Found(values[1], values[2], values[self._numbers_from :])

    def read_all(self, messages: Sequence[bytes]) -> tuple[np.ndarray, np.ndarray] | None:
        """Stamps (n,) int64 [ns] and wanted numbers (n, wanted) float64 of n messages.

        None where one of them is laid out in another way, or its stamp is none.
        """
        if any(len(data) != self.size for data in messages):
            return None
        table = np.frombuffer(b"".join(messages), self._table)
        expected = (LITTLE_ENDIAN, *self._texts)
        strings = [name for name in self._table.names or () if name not in _NUMBERS]
        for name, value in zip(strings, expected, strict=True):
            column = table[name]
            if not (column == np.array(value, column.dtype)).all():
                return None
        if (table["nanoseconds"] >= NANOSECONDS).any():
            return None
        stamps = table["seconds"].astype(np.int64) * NANOSECONDS + table["nanoseconds"]
        return stamps, table["numbers"][:, self._wanted]

    def write(self, stamp_ns: int, numbers: Iterable[float]) -> bytes:
        """The message of a stamp and all numbers."""
        stamp = divmod(int(stamp_ns), NANOSECONDS)
        return self._writer.pack(LITTLE_ENDIAN, *stamp, *self._texts, *numbers)


_NUMBERS = ("seconds", "nanoseconds", "numbers")


class Writer:
    """Appends values to a message, each where CDR aligns it."""

    def __init__(self) -> None:
        self._data = bytearray(LITTLE_ENDIAN + b"\0\0")

    def numbers(self, form: str, *values: float) -> "Writer":
        """Values of one `struct` format such as `I`, or of several of the same size."""
        self._align(struct.calcsize(f"={form[-1]}"))
        self._data += struct.pack(f"<{form}", *values)
        return self

    def text(self, text: str) -> "Writer":
        """A string."""
        data = text.encode() + b"\0"
        self._align(4)
        self._data += len(data).to_bytes(4, "little") + data
        return self

    def header(self, stamp_ns: int, frame_id: str) -> "Writer":
        """A header of std_msgs."""
        return self.numbers("iI", *divmod(int(stamp_ns), NANOSECONDS)).text(frame_id)

    def rows(self, values: np.ndarray) -> "Writer":
        """A sequence of messages of float64 alone, one a row of `values` (n, k)."""
        self.numbers("I", len(values))
        if len(values):
            self._align(8)
            self._data += np.ascontiguousarray(values, "<f8").tobytes()
        return self

    def raw(self, data: bytes) -> "Writer":
        """Bytes that are aligned already."""
        self._data += data
        return self

    def done(self) -> bytes:
        """The message."""
        return bytes(self._data)

    def _align(self, size: int) -> None:
        self._data += bytes(-(len(self._data) - START) % size)
