"""The text at the start of Prophesee's RAW and DAT files: lines `% keyword value`, up to `% end` or to the first line of
another form."""

from __future__ import annotations

import re
from pathlib import Path

from runtime.recordings.packet import RecordingError

LONGEST_HEADER_BYTES = 65_536
LONGEST_SIDE_DIGITS = 9
"""Digits of a height or width in a header; more are no size."""
LONGEST_TIME_DIGITS = 18
"""Digits of a time, us; more are no int64."""


def read_header(path: Path) -> tuple[dict[str, str], int]:
    """The values by keyword, in lower case, and how many bytes the header takes. Raises `RecordingError` if the file ends within it.

    What `format EVT3;height=480;width=640` says is there under `format`, `height` and `width`.
    """
    with path.open("rb") as file:
        start = file.read(LONGEST_HEADER_BYTES)
    header, size = {}, 0
    for line in start.split(b"\n"):
        if not line.startswith(b"%") or not line.rstrip(b"\r").isascii():
            break
        size += len(line) + 1
        if size > len(start):
            raise RecordingError(f"{path}: the file ends in its header; it was cut short, record or copy it again")
        keyword, _, value = line.decode().removeprefix("%").strip().partition(" ")
        if keyword.lower() == "end":
            break
        header[keyword.lower()] = value.strip()
    name, *settings = header.get("format", "").split(";")
    for setting in settings:
        keyword, _, value = setting.partition("=")
        header[keyword.strip().lower()] = value.strip()
    return header | ({"format": name.strip()} if name.strip() else {}), size


def header_shape(header: dict[str, str]) -> tuple[int, int] | None:
    """(height, width) from `geometry 640x480`, or from a height and a width."""
    if match := re.fullmatch(r"(\d+)x(\d+)", header.get("geometry", "")):
        return shape_of(match[2], match[1])
    return shape_of(header.get("height", ""), header.get("width", ""))


def start_us(header: dict[str, str]) -> int:
    """What `t0 1000000` says must be added to the file's times, us; 0 if it does not."""
    value = header.get("t0", "")
    return int(value) if value.isdecimal() and len(value) <= LONGEST_TIME_DIGITS else 0


def shape_of(height: str, width: str) -> tuple[int, int] | None:
    """The two sides as numbers, or None if they are not."""
    usable = all(side.isdecimal() and len(side) <= LONGEST_SIDE_DIGITS for side in (height, width))
    return (int(height), int(width)) if usable else None
