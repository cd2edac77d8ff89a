"""What is watched: it ends in time, without a warning; and where an exception came from."""

from __future__ import annotations

import contextlib
import signal
import traceback
import types
import warnings
from collections.abc import Iterator
from pathlib import Path


class OutOfTimeError(BaseException):
    """What was watched has not ended in time. No `except Exception` of the watched takes it for its own."""


@contextlib.contextmanager
def watched(seconds: float) -> Iterator[None]:
    """Raises `OutOfTimeError` in the block after so many seconds of the process's own time, so that a busy machine makes no finding.

    Any warning is an exception there. Only in a process's main thread.
    """

    def ring(_signal: int, _frame: types.FrameType | None) -> None:
        raise OutOfTimeError

    before = signal.signal(signal.SIGPROF, ring)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def described(error: BaseException) -> str:
    """An exception, and where it was raised."""
    file, line = raised_in(error)
    return f"{type(error).__name__}: {error} ({file}:{line})"


def raised_in(error: BaseException) -> tuple[str, int]:
    """File and line of this project in which an exception came up last."""
    steps = [(Path(step.filename), step.lineno or 0) for step in traceback.extract_tb(error.__traceback__)]
    own = [(path.name, line) for path, line in steps if path != Path(__file__) and "site-packages" not in path.parts]
    return own[-1] if own else ("", 0)
