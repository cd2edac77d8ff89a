"""A recording's video: pictures of some of its windows, in the recording's own time, small enough to keep and to send."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2

from runtime.recordings.draw import Picture
from runtime.whole_file import OutputError, OutputFolder

WIDTH = 640
"""Width of its pictures, px, whatever the sensor's is: their text can still be read."""
MOST_A_SECOND = 10
"""Most pictures a second of the recording; of more windows every second, third, ... is shown. Ten of random pixels take 0.9 MB."""

LEAST_A_SECOND = 0.1
"""Longer windows are shown for 10 s each: the encoder takes no slower video."""


class Video:
    """An MPEG-4 file that is written picture by picture, as OpenCV does without another library. Raises `OutputError`."""

    def __init__(self, outputs: OutputFolder, name: str, step_us: int) -> None:
        """`step_us`: from one window to the next."""
        self.every = max(1, -(-1_000_000 // (MOST_A_SECOND * step_us)))
        """One window in this many is shown."""
        self._outputs, self._name, self._step_us = outputs, name, step_us
        self._path = outputs.folder / name
        self._writer: Any = None

    def add(self, picture: Picture) -> None:
        """Takes the next picture; all have one size."""
        height, width = (side - side % 2 for side in picture.shape[:2])
        if self._writer is None:
            self._writer = self._opened((width, height))
        self._writer.write(picture[:height, :width])

    def _opened(self, size: tuple[int, int]) -> Any:
        # FFmpeg would take a name as "run:1/x.mp4" or "http:x/y.mp4" for a protocol's; an absolute one is always a file's.
        self._path = self._outputs.begin(self._name).absolute()
        rate = max(1e6 / (self._step_us * self.every), LEAST_A_SECOND)
        writer = cv2.VideoWriter(str(self._path), cv2.VideoWriter.fourcc(*"mp4v"), rate, size)
        if not writer.isOpened():
            raise OutputError(
                f"{self._outputs.folder / self._name}: OpenCV cannot write this video; free some space there, or use --no-video"
            )
        return writer

    def close(self) -> None:
        """Ends the file, which must be whole: OpenCV says nothing of a disk that is full."""
        if self._writer is None:
            return
        self._writer.release()
        if not is_whole(self._path):
            short = f"{self._outputs.folder / self._name}: the video was cut short, as by a full disk"
            raise OutputError(f"{short}; free some space there, or use --no-video")


def is_whole(path: Path) -> bool:
    """True if an MP4 file's boxes fill it, the table of its pictures among them (ISO 14496-12, 4.2): that one is written last."""
    kinds, position, size = set(), 0, path.stat().st_size
    with path.open("rb") as file:
        while position < size:
            file.seek(position)
            length, kind = int.from_bytes(file.read(4)), file.read(4)
            kinds.add(kind)
            length = int.from_bytes(file.read(8)) if length == 1 else length
            position += length or size
    return position == size and b"moov" in kinds
