"""Files that are there whole or not at all: written beside their place, put onto the disk, then renamed.

A file that was there before stays as it is until every new one is on the disk; of those that were begun and not finished nothing is
left. A process that is killed outright leaves its own: whoever writes the same file later removes them. Links stay, and the file that they
lead to is replaced; a device or a pipe never is.
"""

from __future__ import annotations

import contextlib
import errno
import os
import re
import time
from collections.abc import Iterable, Iterator
from pathlib import Path

STALE_S = 3600
"""Whoever still writes a file writes more often than this."""


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A path beside `path`, of the same suffix, for the block to write to; it takes the place of `path` when the block has ended well.

    What was there before stays until then, and for good if the block fails. Folders are made as needed. Raises OSError.
    """
    path = _replaceable(path)
    part = _part_of(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove_stale_parts(path)
        yield part
        _onto_disk(part)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


def write_whole(path: Path, content: bytes) -> None:
    """Writes a file, whole also if the machine stops just after. Raises OSError; what was there is then untouched."""
    with replacing(path) as part:
        part.write_bytes(content)


class OutputError(Exception):
    """A file that cannot be written. One line: the file, what was found, what to do."""


@contextlib.contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turns the system's error within the block into an `OutputError` that names `path`."""
    try:
        yield
    except OSError as error:
        advice = "free some space there" if error.errno in (errno.ENOSPC, errno.EDQUOT) else "give another folder"
        raise OutputError(f"{path}: cannot be written ({error.strerror or error}); {advice}") from error


class OutputFolder:
    """A folder whose new files replace the old ones together. Raises `OutputError` for what cannot be written.

    `inputs`: files that are being read, none of which a new file may replace.
    """

    def __init__(self, folder: Path, inputs: Iterable[Path] = ()) -> None:
        self.folder = folder
        self._inputs = tuple(inputs)
        self._begun: dict[str, tuple[Path, Path]] = {}
        """By name: where a file is written, and the file that it will replace."""
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)

    def begin(self, name: str) -> Path:
        """Where to write a file that will have this name."""
        with writing(self.folder / name):
            path = _replaceable(self.folder / name)
        for given in self._inputs:
            if path.exists() and given.exists() and path.samefile(given):
                raise OutputError(f"{path}: is read and would be replaced; give another folder with -o")
        self._begun[name] = _part_of(path), path
        _remove_stale_parts(path)
        return self._begun[name][0]

    def write(self, name: str, content: bytes) -> None:
        """Writes a file's whole content."""
        part = self.begin(name)
        with writing(self.folder / name):
            part.write_bytes(content)

    @property
    def names(self) -> list[str]:
        """Names of the files so far."""
        return list(self._begun)

    def replace(self, stale: Iterable[str] = ()) -> None:
        """Gives all files their names, once all are on the disk, and removes those of an earlier run that have no new one."""
        for name, (part, _) in self._begun.items():
            with writing(self.folder / name):
                _onto_disk(part)
        for name, (part, path) in self._begun.items():
            with writing(self.folder / name):
                part.replace(path)
        for name in set(stale) - self._begun.keys():
            (self.folder / name).unlink(missing_ok=True)
        self._begun = {}

    def discard(self) -> None:
        """Removes what was begun; the files that were there before are untouched."""
        for part, _ in self._begun.values():
            with contextlib.suppress(OSError):
                part.unlink(missing_ok=True)
        self._begun = {}


def _replaceable(path: Path) -> Path:
    """The file that a name stands for, through links, which stay.

    Raises OSError for a folder, which could not be replaced once all is done, and for a device or a pipe: as root, renaming replaces it.
    """
    if path.is_dir():
        raise OSError(errno.EISDIR, "it is a folder", str(path))
    if path.exists() and not path.is_file():
        raise OSError(errno.EINVAL, "it is no file but a device or a pipe", str(path))
    return path.resolve() if path.is_symlink() else path


def _part_of(path: Path) -> Path:
    """Beside the file, with its suffix, by which OpenCV knows a format; of this process alone, as another may write there too."""
    return path.with_name(f"{path.stem}.{os.getpid()}.part{path.suffix}")


def _remove_stale_parts(path: Path) -> None:
    """Removes what processes that are no more have begun of this file, if for `STALE_S` nothing has been written to it.

    Of a process in another container, or on another machine, it can't be seen whether it is still there.
    """
    if os.name != "posix":
        return
    pattern = re.compile(rf"{re.escape(path.stem)}\.(\d{{1,9}})\.part{re.escape(path.suffix)}")
    with contextlib.suppress(OSError):
        parts = [(each, match) for each in path.parent.iterdir() if (match := pattern.fullmatch(each.name))]
        for part, match in parts:
            if not _is_running(int(match[1])) and time.time() - part.stat().st_mtime > STALE_S:
                part.unlink(missing_ok=True)


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)  # which sends nothing
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:  # somebody else's
        return True
    return True


def _onto_disk(path: Path) -> None:
    """Has the system write a file out: a full disk or an exceeded quota may be told only then."""
    with path.open("rb") as file:
        os.fsync(file.fileno())
