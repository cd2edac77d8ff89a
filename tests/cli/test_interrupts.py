"""Ctrl-C in a command's first moments, at any of them: one line and exit code 130, never a traceback."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from build_model import commands
from runtime.errors import INTERRUPTED

ROOT = Path(__file__).parents[2]
START = """
import importlib, sys
from build_model import commands
def telling(*names, real=importlib.import_module):
    importlib.import_module = real
    print("up", flush=True)
    return real(*names)
importlib.import_module = telling
sys.argv[0] = {name!r}
commands.{function}()
"""
"""A command that says when it begins to import: what comes before is Python's own start."""
LATEST_S = 0.5


def interrupted(name: str, after_s: float, *arguments: str) -> tuple[int, str]:
    """Exit code and stderr of a command that gets SIGINT so long after its start."""
    program = START.format(name=name, function=name.replace("-", "_"))
    command = [sys.executable, "-c", program, *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "up\n"
        try:
            process.wait(after_s)
        except subprocess.TimeoutExpired:
            os.kill(process.pid, signal.SIGINT)
        _, errors = process.communicate(timeout=120)
    return process.returncode, errors


@pytest.mark.parametrize("name", ["export-model", "verify-model", "run-model", "bench-model"])
def test_an_early_interrupt_ends_a_command_in_a_line(name: str, tmp_path: Path) -> None:
    """With a model that is missing, a command that is not interrupted in time ends with a line, too."""
    chosen = random.Random(name)
    for after_s in (0.0, *(chosen.uniform(0, LATEST_S) for _ in range(3))):
        code, errors = interrupted(name, after_s, str(tmp_path / "none"), *([str(tmp_path / "none.raw")] if name == "run-model" else []))
        assert code in (INTERRUPTED, 2, -signal.SIGINT), errors  # by the signal itself, as the process ends
        assert errors.count("\n") <= 1, errors  # typer says nothing where it is interrupted as it reads the arguments
        assert code == INTERRUPTED or "none" in errors
    code, errors = interrupted(name, 0.0, "none")
    assert (code, errors) == (INTERRUPTED, f"{name}: interrupted\n")


def test_an_interrupt_that_the_shell_has_ignored_stays_ignored() -> None:
    program = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)" + START.format(name="verify-model", function="verify_model")
    with subprocess.Popen([sys.executable, "-c", program, "none"], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        process.stdout.readline()
        os.kill(process.pid, signal.SIGINT)
        _, errors = process.communicate(timeout=120)
    assert process.returncode == 2, errors
    assert "none" in errors


def test_every_console_script_starts_here() -> None:
    scripts = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["scripts"]
    for name, place in scripts.items():
        assert place == f"build_model.commands:{name.replace('-', '_')}"
        assert callable(getattr(commands, name.replace("-", "_")))
