"""Commands outlast the readers of what they print, keep their exit codes, and print names as they are."""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

pytest.importorskip("typer", reason="the extra 'recordings' is not installed")

LINES = 3_000
COMMAND = f"""
    import os, pathlib
    from runtime import terminal
    from runtime.errors import fail
    def work(code: int = 0):
        console = terminal.console()
        for number in range({LINES}):
            console.print(f"line {{number}} of the table")
            print(f"line {{number}}")
        pathlib.Path("done").write_text("all of it")
        if code:
            fail("a fault\\nof two lines", code)
    terminal.run(work)
"""


def started(shell: str, folder: Path, program: str = COMMAND) -> subprocess.CompletedProcess[str]:
    """Runs a shell's line in the folder, in which `$RUN` is the program."""
    (folder / "program.py").write_text(textwrap.dedent(program))
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1]), "RUN": f"{sys.executable} {folder / 'program.py'}"}
    return subprocess.run(["bash", "-c", shell], cwd=folder, env=environment, capture_output=True, text=True, timeout=60, check=False)


def test_what_a_command_prints_and_its_code_are_its_own(tmp_path: Path) -> None:
    done = started("$RUN --code 7", tmp_path)
    assert (done.returncode, done.stderr) == (7, "a fault of two lines\n")
    assert done.stdout.count("\n") == 2 * LINES


@pytest.mark.parametrize("code", [0, 1, 7])
@pytest.mark.parametrize("redirected", ["| head -1", ">&-", "2>&- >&-", ">&- <&-"])
def test_a_reader_that_has_gone_takes_nothing_from_the_work_and_its_code(tmp_path: Path, redirected: str, code: int) -> None:
    done = started(f"$RUN --code {code} {redirected}; exit ${{PIPESTATUS[0]}}", tmp_path)
    assert (tmp_path / "done").read_text() == "all of it"
    assert done.returncode == code
    assert done.stderr == ("a fault of two lines\n" if code and "2>&-" not in redirected else "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="the system has no /dev/full")
@pytest.mark.parametrize(("code", "expected"), [(0, 2), (1, 1)])
def test_a_full_disk_under_stdout_is_told(tmp_path: Path, code: int, expected: int) -> None:
    done = started(f"$RUN --code {code} > /dev/full", tmp_path)
    assert (tmp_path / "done").read_text() == "all of it"
    assert done.returncode == expected
    assert "stdout: cannot be written (No space left on device); what was printed is incomplete\n" in done.stderr
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_signal_to_end_is_taken_as_ctrl_c(tmp_path: Path, name: str) -> None:
    """As from `timeout`, a container that stops or a terminal that closes: what was done is kept."""
    program = f"""
        import os, pathlib, signal
        from runtime import terminal
        from runtime.errors import INTERRUPTED, fail
        def work():
            try:
                os.kill(os.getpid(), signal.{name})
                signal.pause()
            except KeyboardInterrupt:
                pathlib.Path("done").write_text("so far")
                fail("interrupted", INTERRUPTED)
        terminal.run(work)
    """
    done = started("$RUN", tmp_path, program)
    assert (done.returncode, done.stderr) == (130, "interrupted\n")
    assert (tmp_path / "done").read_text() == "so far"


def test_an_interrupt_that_a_command_does_not_handle_ends_it_in_a_line(tmp_path: Path) -> None:
    program = """
        import os, signal
        from typing import Annotated
        import typer
        from runtime import terminal
        def work(times: Annotated[int, typer.Option(min=2)] = 3):
            print(times)
            os.kill(os.getpid(), signal.SIGINT)
            signal.pause()
        signal.signal(signal.SIGINT, signal.default_int_handler)  # which a shell's background jobs do without
        terminal.run(work)
    """
    done = started("$RUN --times 4", tmp_path, program)
    assert (done.returncode, done.stdout, done.stderr) == (130, "4\n", "program.py: interrupted\n")
    assert started("$RUN --times 1", tmp_path, program).returncode == 2  # the options and their limits are still the command's


def test_a_signal_that_is_ignored_stays_so(tmp_path: Path) -> None:
    program = """
        import os, signal
        signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
        from runtime import terminal
        def work():
            os.kill(os.getpid(), signal.SIGHUP)
            print("goes on")
        terminal.run(work)
    """
    assert started("$RUN", tmp_path, program).stdout == "goes on\n"


@pytest.mark.parametrize("closed", [1, 2])
def test_no_file_takes_the_number_of_a_closed_stream(tmp_path: Path, closed: int) -> None:
    """A library that prints by the number, as FFmpeg does, would write into it."""
    program = f"""
        import contextlib, os
        from runtime import terminal
        for number in (0, {closed}):
            with contextlib.suppress(OSError):
                os.close(number)  # some versions of onnxruntime open it
        def work():
            with open("table.csv", "wb") as file:
                os.write({closed}, b"a library's warning")
                file.write(b"1,2,3")
        terminal.run(work)
    """
    assert started(f"$RUN <&- {closed}>&-", tmp_path, program).returncode == 0
    assert (tmp_path / "table.csv").read_bytes() == b"1,2,3"


@pytest.mark.parametrize("name", ["run[/]x", "[bold red]x", "[/]", ":cat:", "a\\[b]", "gr\u00fc\u00df"])
def test_a_name_is_no_markup(tmp_path: Path, name: str) -> None:
    program = f"""
        from rich.table import Table
        from runtime import terminal
        def work():
            table = Table(title={name!r}, show_header=False)
            table.add_row({name!r})
            terminal.console().print({name!r}, table)
        terminal.run(work)
    """
    done = started("$RUN", tmp_path, program)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.count(name) == 3


def test_a_name_that_is_no_text_is_printed_all_the_same(tmp_path: Path) -> None:
    program = """
        import os
        from runtime import terminal
        from runtime.errors import fail
        def work():
            print(os.fsdecode(b"a\\xffb"))
            fail(os.fsdecode(b"a\\xffb"))
        terminal.run(work)
    """
    done = started("PYTHONUTF8=1 $RUN", tmp_path, program)
    assert done.returncode == 2
    assert done.stdout == done.stderr == "a\\udcffb\n"
