"""Where the commands start: Ctrl-C ends them in one line from their first moments on, while numpy and the rest are imported.

This module imports nothing of the kind itself, which is why runtime's commands start here, too: `runtime` imports numpy with its first
name. What a command does with Ctrl-C once it runs is its own affair (`runtime.terminal`).
"""

from __future__ import annotations

import importlib
import os
import signal
import sys
from types import FrameType
from typing import NoReturn

INTERRUPTED = 130
"""Exit code, as `runtime.errors` has it."""


def export_model() -> None:
    """Entry point of `export-model`."""
    _run("build_model.cli", "export_model_command")


def import_camera() -> None:
    """Entry point of `import-camera`."""
    _run("build_model.cli", "import_camera_command")


def verify_model() -> None:
    """Entry point of `verify-model`."""
    _run("build_model.verify.cli", "verify_model_command")


def run_model() -> None:
    """Entry point of `run-model`."""
    _run("runtime.recordings.cli", "run_model_command")


def bench_model() -> None:
    """Entry point of `bench-model`."""
    _run("runtime.recordings.cli", "bench_model_command")


def _run(module: str, name: str) -> None:
    """Imports a command and runs it. While it is imported an interrupt ends the process at once, as nothing is begun yet."""
    try:
        before = signal.getsignal(signal.SIGINT)
        interruptible = before is signal.default_int_handler  # not where the shell has it ignored
        if interruptible:
            signal.signal(signal.SIGINT, _end)
        command = getattr(importlib.import_module(module), name)
        if interruptible:
            signal.signal(signal.SIGINT, before)
        command()
    except KeyboardInterrupt:
        _end(signal.SIGINT, None)


def _end(_signal: int, _frame: FrameType | None) -> NoReturn:
    """Ends the process with one line. Modules half imported are not asked: they may print what became of them."""
    os.write(2, f"{os.path.basename(sys.argv[0])}: interrupted\n".encode())
    os._exit(INTERRUPTED)
