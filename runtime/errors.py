"""How every command ends that cannot do what it was asked: one line on stderr, and an exit code."""

from __future__ import annotations

import sys
from typing import NoReturn

USER_ERROR = 2
"""Exit code where something given cannot be used."""
INTERRUPTED = 130
"""Exit code after Ctrl-C, as shells have it."""


def one_line(message: object) -> str:
    """The message's text without line breaks."""
    return " ".join(str(message).split())


def complain(message: object) -> None:
    """Prints one line on stderr."""
    print(one_line(message), file=sys.stderr)


def fail(message: object, code: int = USER_ERROR) -> NoReturn:
    """Ends the program with one line on stderr and an exit code."""
    complain(message)
    raise SystemExit(code)
