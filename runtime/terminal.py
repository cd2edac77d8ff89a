"""What the commands and scripts print on: streams that outlast their reader, names as they are.

`run` starts a command so that its work does not depend on who reads it: where stdout or stderr is closed, or its reader has gone, as
in `run-model ... | head -1`, what is left to print is dropped, the files are written all the same, and the exit code is the command's own.
A stdout that fails otherwise, as a file on a full disk, is told on stderr, with exit code 2. A signal to end (SIGTERM, SIGHUP) is taken as
Ctrl-C, after which a command that has nothing to say of its own ends in one line and exit code 130.

`console` is rich's, without its markup: a file called `run[/]x` or `:cat:` is printed under its name. rich and typer come with the extras,
and are imported when they are needed.
"""

from __future__ import annotations

import contextlib
import functools
import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TextIO

from runtime.errors import INTERRUPTED, USER_ERROR, complain, fail

if TYPE_CHECKING:
    from rich.console import Console

WIDTH_OF_A_FILE = 120
"""Columns of what is printed where there is no terminal."""


def console(width_of_a_file: int = WIDTH_OF_A_FILE, *, stderr: bool = False) -> Console:
    """A console on stdout or stderr, as wide as the terminal, that prints every text literally."""
    from rich.console import Console

    stream = sys.stderr if stderr else sys.stdout
    return Console(width=None if stream.isatty() else width_of_a_file, stderr=stderr, markup=False, emoji=False)


def run(command: Callable[..., None]) -> NoReturn:
    """Runs a function as a typer command, as all that its process does: the module's docstring says what becomes of its output."""
    _occupy_standard_numbers()
    _end_as_by_ctrl_c()
    streams = LastingStream(sys.stdout), LastingStream(sys.stderr)
    with contextlib.redirect_stdout(streams[0]), contextlib.redirect_stderr(streams[1]):
        code = _exit_code_of(command)
        for stream in streams:
            stream.flush()
        fault = streams[0].fault
        if fault is not None and not isinstance(fault, BrokenPipeError):
            complain(f"stdout: cannot be written ({fault.strerror}); what was printed is incomplete")
            code = code or USER_ERROR
    raise SystemExit(code)


def _exit_code_of(command: Callable[..., None]) -> int:
    """Runs the command with the process's arguments."""
    import typer

    try:
        typer.run(_interruptible(command))
    except SystemExit as end:
        return end.code if isinstance(end.code, int) else 0
    return 0


def _interruptible(command: Callable[..., None]) -> Callable[..., None]:
    """The command, of the same parameters, that tells an interrupt which it does not handle: typer would end it without a word."""

    @functools.wraps(command)
    def telling(*arguments: Any, **options: Any) -> None:
        try:
            command(*arguments, **options)
        except KeyboardInterrupt:
            fail(f"{Path(sys.argv[0]).name}: interrupted", INTERRUPTED)

    return telling


def _end_as_by_ctrl_c() -> None:
    """Lets a command that is told to end, by a system that shuts down or a terminal that closes, keep what it has done."""
    for name in ("SIGTERM", "SIGHUP"):
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, signal.default_int_handler)


def _occupy_standard_numbers() -> None:
    """Opens what is closed of stdin, stdout and stderr, so that no file of ours gets its number and with it what libraries print."""
    for number in range(3):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # the system gives the lowest number that is free: this one


class LastingStream:
    """A text stream that takes everything. Once the one below it cannot be written, what follows is dropped and `fault` is the reason."""

    def __init__(self, stream: TextIO | None) -> None:
        """`stream`: the one below; None, as Python has it where the system's is closed, drops everything."""
        self._stream: Any = open(os.devnull, "w", encoding="utf-8") if stream is None else stream  # noqa: SIM115  the process's own
        self.fault: OSError | None = None
        if hasattr(self._stream, "reconfigure"):
            self._stream.reconfigure(errors="backslashreplace")  # a name may hold bytes that are no text

    def write(self, text: str) -> int:
        """Writes what can be written."""
        try:
            return self._stream.write(text)
        except OSError as error:
            self._drop(error)
            return len(text)

    def flush(self) -> None:
        """Flushes what can be flushed."""
        try:
            self._stream.flush()
        except OSError as error:
            self._drop(error)

    def _drop(self, fault: OSError) -> None:
        """Lets the stream's number stand for nothing, so that what it still holds does not fail again as the process ends."""
        self.fault = self.fault or fault
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, self._stream.fileno())
        os.close(nowhere)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)
