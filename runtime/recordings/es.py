"""Event Stream files, read by faery. The last event of a file that was cut is lost silently, as the format does not
say how many there are."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import faery
from numpy.typing import NDArray

from runtime.errors import one_line
from runtime.recordings.packet import Notes, RecordingError, packet_of


def sensor_shape(path: Path) -> tuple[int, int] | None:
    """(height, width) that the file tells."""
    width, height = _decoder(path).dimensions()
    return height, width


def packets(path: Path, notes: Notes) -> Iterator[NDArray[Any]]:  # noqa: ARG001  every reader has the same signature
    """The file's events. Raises `RecordingError`: at once for another file, while reading where it is damaged."""
    return _packets(path, _decoder(path))


def _packets(path: Path, decoder: Any) -> Iterator[NDArray[Any]]:
    try:
        for packet in decoder:
            yield packet_of(packet["t"], packet["x"], packet["y"], packet["p"])
    except RuntimeError as error:
        raise RecordingError(f"{path}: damaged here: {one_line(error)}; all events before it are kept") from error


def _decoder(path: Path) -> Any:
    try:
        return faery.events_stream_from_file(path)
    except Exception as error:  # faery raises bare Exception for a damaged file
        raise RecordingError(f"{path}: {one_line(error)}; it is damaged, or not of this kind") from error
