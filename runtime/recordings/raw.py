"""Prophesee's RAW files: words of EVT2 (32 bits), EVT2.1 (64) or EVT3 (16), whose upper 4 bits tell their kind.

| kind | EVT2 | EVT2.1 | EVT3 |
|---|---|---|---|
| 0, 1 | event OFF, ON: low bits of its time, x, y | the same, with a mask of 32 columns from x on | 0: row y |
| 2 | | | event: polarity and column x |
| 3 | | | polarity and first column of the masks that follow |
| 4, 5 | | | mask of 12 and of 8 columns, each after the one before |
| 6 | | | low bits of the time |
| 8 | TIME_HIGH | TIME_HIGH | TIME_HIGH |

Other kinds (triggers, counters, padding) are skipped. Bytes come in the order that the header states: little, big, or for EVT2.1
legacy, the upper half of a word first; an EVT2.1 file that states none is tried both ways. Times are `runtime.recordings.time_words`.

What has no certain time, or no row or column since the file's start, is counted and dropped: "events without a time", "... a place".
Events outside the sensor are left to `runtime.frames`. The formats are specified at docs.prophesee.ai (Data Encoding Formats).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from runtime.recordings.header import header_shape, read_header, start_us
from runtime.recordings.packet import Notes, RecordingError, packet_of
from runtime.recordings.time_words import Blocks

CHUNK_WORDS = 2**16
"""Words read at once: what is made of them stays in a processor's cache."""
MOST_WORDS_IN_A_BLOCK = 2**22
"""More words without a TIME_HIGH are no recording: it would be hundreds of millions of events a second."""
TIME_HIGH = 8
LARGEST_RUN_PX = 2**30
"""More columns than the masks of a batch of words can cover."""
CONVERTER = "metavision_file_to_csv converts what Metavision reads"

Words = NDArray[Any]
Kinds = NDArray[np.uint8]


class Evt2:
    """Takes words, gives packets. `feed` is called with the file's words in order, the last time with `more` False."""

    dtype = np.dtype(np.uint32)
    low_bits, high_bits = 6, 28

    def __init__(self, notes: Notes) -> None:
        self._notes = notes
        self._blocks = Blocks(1 << self.low_bits, self.high_bits, notes.counts)
        self._kept = np.empty(0, dtype=self.dtype)

    def feed(self, words: Words, more: bool) -> NDArray[Any]:
        """The events of these words; those after the last TIME_HIGH wait for the next one, if there is `more`."""
        words = np.concatenate([self._kept, words])
        kinds = self.kinds(words)
        high = np.flatnonzero(kinds == TIME_HIGH)
        stop = len(words) if not more else int(high[-1]) if len(high) else 0
        self._kept = words[stop:]
        if len(self._kept) > MOST_WORDS_IN_A_BLOCK:
            raise ValueError(f"no time in {len(self._kept)} words")
        self._blocks.begin(self.high(words[high]), more and len(high) > 0)
        return self._events(words[:stop], kinds[:stop])

    @classmethod
    def kinds(cls, words: Words) -> Kinds:
        """The words' upper 4 bits."""
        return (words >> (8 * cls.dtype.itemsize - 4)).astype(np.uint8)

    @staticmethod
    def high(words: Words) -> NDArray[np.int64]:
        """What TIME_HIGH words count."""
        return (words & 0xFFF_FFFF).astype(np.int64)

    def _events(self, words: Words, kinds: Kinds) -> NDArray[Any]:
        places = np.flatnonzero(kinds <= 1)
        block = np.cumsum(kinds == TIME_HIGH)[places] - 1
        words = words[places]
        times, certain = self._blocks.dated(block, (words >> 22 & 0x3F).astype(np.int64))
        packet = packet_of(times, words >> 11 & 0x7FF, words & 0x7FF, kinds[places])
        return self._only(packet, certain, "events without a time")

    def _only(self, packet: NDArray[Any], good: NDArray[np.bool_], reason: str) -> NDArray[Any]:
        """The good events of a packet; the others are counted."""
        if good.all():
            return packet
        self._notes.counts[reason] += int(len(good) - np.count_nonzero(good))
        return packet[good]


class Evt21(Evt2):
    """EVT2.1: an event word has up to 32 neighbours in a row."""

    dtype = np.dtype(np.uint64)
    kinds_known = frozenset({0, 1, TIME_HIGH, 10, 14, 15})

    @staticmethod
    def high(words: Words) -> NDArray[np.int64]:
        """What TIME_HIGH words count."""
        return Evt2.high(words >> 32)

    def _events(self, words: Words, kinds: Kinds) -> NDArray[Any]:
        places = np.flatnonzero(kinds <= 1)
        block = np.cumsum(kinds == TIME_HIGH)[places] - 1
        words, kinds = words[places], kinds[places]
        times, certain = self._blocks.dated(block, (words >> 54 & 0x3F).astype(np.int64))
        word, column = _lit_bits((words & 0xFFFF_FFFF).astype("<u4"))
        x, y = (words >> 43 & 0x7FF).astype(np.int32), (words >> 32 & 0x7FF).astype(np.int32)
        packet = packet_of(times[word], x[word] + column, y[word], kinds[word])
        return self._only(packet, certain[word], "events without a time")


class Evt3(Evt2):
    """EVT3: time, row and first column hold until another word changes them."""

    dtype = np.dtype(np.uint16)
    low_bits, high_bits = 12, 12

    def __init__(self, notes: Notes) -> None:
        super().__init__(notes)
        self._time = np.array([0], dtype=np.int64)
        self._certain = np.array([False])
        self._row = np.array([-1], dtype=np.int32)
        self._column = np.array([-LARGEST_RUN_PX], dtype=np.int32)
        self._polarity = np.array([0], dtype=np.uint16)

    @staticmethod
    def high(words: Words) -> NDArray[np.int64]:
        """What TIME_HIGH words count."""
        return (words & 0xFFF).astype(np.int64)

    def _events(self, words: Words, kinds: Kinds) -> NDArray[Any]:
        masked = (kinds == 4) | (kinds == 5)
        event = (kinds == 2) | masked
        places = np.flatnonzero(event)
        # How many events came before each word: where a row, a time or a first column begins to hold.
        before = np.cumsum(event, dtype=np.int32)
        times, certain = self._times(words, kinds, before, len(places))
        rows = np.flatnonzero(kinds == 0)
        self._row, y = _held(self._row, (words[rows] & 0x7FF).astype(np.int32), before[rows], len(places))
        events = words[places]
        x, p = (events & 0x7FF).astype(np.int32), events >> 11 & 1
        if masked.any() or (kinds == 3).any():
            first, polarity = self._firsts(words, kinds, before, places)
            single, width = kinds[places] == 2, np.where(kinds[places] == 4, 0xFFF, 0xFF)
            source, column = _lit_bits(np.where(single, 1, events & width).astype("<u2"))
            x, p = np.where(single, x, first)[source] + column, np.where(single, p, polarity)[source]
            times, certain, y = times[source], certain[source], y[source]
        packet = self._only(packet_of(times, x, y, p), certain, "events without a time")
        return self._only(packet, (packet["x"] >= 0) & (packet["y"] >= 0), "events without a place")

    def _times(self, words: Words, kinds: Kinds, before: NDArray[np.int32], total: int) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Times of the events, and which are certain: that of the latest low bits, or of a TIME_HIGH that changed since."""
        high = np.flatnonzero(kinds == TIME_HIGH)
        marks = kinds == 6
        marks[high[self._blocks.changed]] = True
        marked = np.flatnonzero(marks)
        low = np.where(kinds[marked] == 6, words[marked] & 0xFFF, 0).astype(np.int64)
        block = np.repeat(np.arange(-1, len(high)), _lengths(np.searchsorted(marked, high), len(marked)))
        times, certain = self._blocks.dated(block, low)
        self._time, at = _held(self._time, times, before[marked], total)
        self._certain, certain_at = _held(self._certain, certain, before[marked], total)
        return at, certain_at

    def _firsts(
        self, words: Words, kinds: Kinds, before: NDArray[np.int32], places: NDArray[np.intp]
    ) -> tuple[NDArray[np.int32], NDArray[np.uint16]]:
        """First column and polarity of the masks at these words: each begins where the one before it ended."""
        bases = np.flatnonzero(kinds == 3)
        width = (12 * (kinds == 4) + 8 * (kinds == 5)).astype(np.int32)
        ends = np.cumsum(width, dtype=np.int32)
        # A first column, less the masks that the batch had before it: the masks up to any word of it can then be added.
        origin = (words[bases] & 0x7FF).astype(np.int32) - ends[bases]
        last, first = _held(self._column, origin, before[bases], len(places))
        self._column = last + ends[-1:]
        self._polarity, polarity = _held(self._polarity, words[bases] >> 11 & 1, before[bases], len(places))
        return first + ends[places] - width[places], polarity


def _lengths(starts: NDArray[Any], total: int) -> NDArray[Any]:
    """Of `total` things: how many there are before the first start, from each start to the next, and after the last."""
    return np.diff(starts, prepend=0, append=total)


def _held(state: NDArray[Any], values: NDArray[Any], starts: NDArray[Any], total: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """What holds after the last of `total` events, (1,), and at each: `state` before the first start, then each start's value."""
    values = np.concatenate([state, values])
    return values[-1:], np.repeat(values, _lengths(starts, total))


def _lit_bits(masks: NDArray[Any]) -> tuple[NDArray[np.intp], NDArray[np.int32]]:
    """The lit bits of little-endian masks, in order: which mask, and which bit from the lowest."""
    width = 8 * masks.dtype.itemsize
    lit = np.flatnonzero(np.unpackbits(masks.view(np.uint8), bitorder="little"))
    return lit // width, (lit % width).astype(np.int32)


FORMATS = {"2": Evt2, "2.0": Evt2, "2.1": Evt21, "21": Evt21, "3": Evt3, "3.0": Evt3}
"""Decoders by what a header says after `evt` or `format EVT`."""


def sensor_shape(path: Path) -> tuple[int, int] | None:
    """(height, width) that the header tells."""
    return header_shape(read_header(path)[0])


def packets(path: Path, notes: Notes) -> Iterator[NDArray[Any]]:
    """The file's events. Raises `RecordingError`: at once for a format that is not read, at the end where the file was cut."""
    header, size = read_header(path)
    name = header.get("evt") or header.get("format", "")
    decoder = FORMATS.get(name.upper().removeprefix("EVT").strip())
    if decoder is None:
        found = f"found {f'format {name}' if name else 'no format'} in the header"
        raise RecordingError(f"{path}: {found}; convert it to EVT2 or EVT3 ({CONVERTER})")
    order = _byte_order(path, header, size, decoder)
    return _packets(path, size, decoder(notes), order, start_us(header))


def _packets(path: Path, size: int, decoder: Evt2, order: str, start: int) -> Iterator[NDArray[Any]]:
    with path.open("rb") as file:
        file.seek(size)
        more, left = True, 0
        while more:
            content = file.read(CHUNK_WORDS * decoder.dtype.itemsize)
            more = len(content) == CHUNK_WORDS * decoder.dtype.itemsize
            left = len(content) % decoder.dtype.itemsize
            try:
                packet = decoder.feed(_words(content[: len(content) - left], decoder.dtype, order), more)
            except ValueError as error:
                raise RecordingError(f"{path}: damaged here: {error}; all events before it are kept") from error
            packet["t"] += start
            yield packet
    if left:
        raise RecordingError(f"{path}: the file ends inside an event ({left} bytes of it); it was cut short, all events before it are kept")


def _words(content: bytes, dtype: np.dtype[Any], order: str) -> Words:
    if order == "legacy":
        return np.frombuffer(content, dtype="<u4").reshape(-1, 2)[:, ::-1].copy().view("<u8").reshape(-1).astype(dtype)
    return np.frombuffer(content, dtype=dtype.newbyteorder("<" if order == "little" else ">")).astype(dtype, copy=False)


def _byte_order(path: Path, header: dict[str, str], size: int, decoder: type[Evt2]) -> str:
    """ "little", "big" or "legacy". Raises `RecordingError` if it is another, or not stated and not to be told from the words."""
    stated = header.get("endianness", "").lower()
    possible = ("little", "big", "legacy") if decoder is Evt21 else ("little", "big")
    if stated in possible:
        return stated
    if stated:
        raise RecordingError(f"{path}: found endianness {stated} in the header; known are {', '.join(possible)}")
    if decoder is not Evt21:
        return "little"
    return _tried_byte_order(path, size)


def _tried_byte_order(path: Path, size: int) -> str:
    """The order in which an EVT2.1 file's words are all of known kinds, and some of them times. Raises `RecordingError`."""
    with path.open("rb") as file:
        file.seek(size)
        content = file.read(CHUNK_WORDS)
    content = content[: len(content) - len(content) % 8]
    kinds = {order: set(Evt21.kinds(_words(content, Evt21.dtype, order)).tolist()) for order in ("little", "legacy")}
    fitting = [order for order, found in kinds.items() if found <= Evt21.kinds_known and TIME_HIGH in found]
    if content and len(fitting) != 1:
        raise RecordingError(f"{path}: the order of its bytes is not clear; add the line `% endianness little` or `% endianness legacy`")
    return fitting[0] if content else "little"
