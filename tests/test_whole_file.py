"""What is written replaces what was there only when it is whole and on the disk; of what fails nothing is left. An error is one line."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
from pathlib import Path

import pytest

from runtime.errors import USER_ERROR, fail, one_line
from runtime.whole_file import OutputError, OutputFolder, replacing, write_whole, writing


def test_a_block_that_ends_well_replaces_the_file(tmp_path: Path) -> None:
    path = tmp_path / "new" / "film.mp4"
    for content in (b"first", b"second"):
        with replacing(path) as part:
            assert part.parent == path.parent
            assert part.suffix == ".mp4"
            part.write_bytes(content)
            assert not path.exists() or path.read_bytes() == b"first"
        assert path.read_bytes() == content
    assert list(path.parent.iterdir()) == [path]


def test_a_block_that_fails_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "table.csv"
    write_whole(path, b"good")

    def write_half() -> None:
        with replacing(path) as part:
            part.write_bytes(b"ha")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_half()
    assert path.read_bytes() == b"good"
    assert list(tmp_path.iterdir()) == [path]


def test_a_block_that_writes_nothing_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), replacing(tmp_path / "table.csv"):
        pass


@pytest.mark.parametrize("write", ["alone", "in a folder"])
def test_what_a_killed_process_has_left_is_removed_by_a_later_one(tmp_path: Path, write: str) -> None:
    """Nothing else is: of a process that runs, of one that may run elsewhere, of another file, nor what only looks like it."""
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    stale = tmp_path / f"ta.ble.{gone.pid}.part.csv"
    names = [
        f"ta.ble.{os.getppid()}.part.csv",
        f"ta.ble.{gone.pid}.part.png",
        f"other.{gone.pid}.part.csv",
        "ta.ble.mine.part.csv",
        "ta.ble.csv.part",
    ]
    kept = [tmp_path / name for name in names]
    young = tmp_path / f"ta.ble.{gone.pid}1.part.csv"
    for path in (stale, young, *kept):
        path.write_text("begun")
        os.utime(path, (0, 0))
    os.utime(young)
    if write == "alone":
        write_whole(tmp_path / "ta.ble.csv", b"whole")
    else:
        folder = OutputFolder(tmp_path)
        folder.write("ta.ble.csv", b"whole")
        folder.replace()
    assert sorted(tmp_path.iterdir()) == sorted([tmp_path / "ta.ble.csv", young, *kept])


@pytest.fixture
def full_disk(monkeypatch: pytest.MonkeyPatch) -> None:
    """The disk's last word comes when a file is flushed onto it, as over a network or with a quota."""

    def fails(_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", fails)


def contents(folder: Path) -> dict[str, str]:
    return {path.name: path.read_text() for path in folder.iterdir()}


def test_a_file_is_written_whole(tmp_path: Path) -> None:
    write_whole(tmp_path / "a.csv", b"old")
    write_whole(tmp_path / "a.csv", b"new")
    assert contents(tmp_path) == {"a.csv": "new"}


@pytest.mark.usefixtures("full_disk")
def test_on_a_full_disk_the_old_file_stays(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("old")
    with pytest.raises(OSError, match="No space left"):
        write_whole(tmp_path / "a.csv", b"new")
    assert contents(tmp_path) == {"a.csv": "old"}


def test_files_of_a_folder_get_their_names_together(tmp_path: Path) -> None:
    for name in ("a.csv", "b.mp4", "stale.png", "foreign.png"):
        (tmp_path / name).write_text("old")
    outputs = OutputFolder(tmp_path)
    outputs.begin("b.mp4").write_text("new b")
    assert outputs.begin("c.mp4").suffix == ".mp4"
    outputs.begin("c.mp4").write_text("new c")
    outputs.write("a.csv", b"new a")
    assert (tmp_path / "a.csv").read_text() == "old"
    outputs.replace(stale=["stale.png", "a.csv", "never.png"])
    assert contents(tmp_path) == {"a.csv": "new a", "b.mp4": "new b", "c.mp4": "new c", "foreign.png": "old"}


@pytest.mark.usefixtures("full_disk")
def test_if_one_file_is_not_on_the_disk_none_replaces_an_old_one(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("old")
    outputs = OutputFolder(tmp_path)
    outputs.write("a.csv", b"new")
    outputs.write("b.csv", b"new")
    with pytest.raises(OutputError, match=r"a\.csv: cannot be written \(No space left on device\); free some space there"):
        outputs.replace(stale=["a.csv"])
    outputs.discard()
    assert contents(tmp_path) == {"a.csv": "old"}


def test_what_is_read_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "estimates.csv").write_text("events")
    (tmp_path / "link.csv").symlink_to(tmp_path / "estimates.csv")
    outputs = OutputFolder(tmp_path, inputs=[tmp_path / "missing.csv", tmp_path / "link.csv"])
    with pytest.raises(OutputError, match=r"estimates\.csv: is read and would be replaced; give another folder"):
        outputs.begin("estimates.csv")
    outputs.begin("other.csv")


def test_a_link_stays_one_and_the_file_it_leads_to_is_replaced(tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    for name in ("a.csv", "b.csv"):
        (elsewhere / name).write_text("old")
        (tmp_path / name).symlink_to(elsewhere / name)
    (tmp_path / "new.csv").symlink_to(elsewhere / "new.csv")
    write_whole(tmp_path / "a.csv", b"new")
    write_whole(tmp_path / "new.csv", b"new")
    outputs = OutputFolder(tmp_path)
    outputs.write("b.csv", b"new")
    outputs.replace(stale=["b.csv"])
    assert all((tmp_path / name).is_symlink() for name in ("a.csv", "b.csv", "new.csv"))
    assert contents(elsewhere) == {"a.csv": "new", "b.csv": "new", "new.csv": "new"}


def test_a_device_or_a_pipe_is_never_replaced(tmp_path: Path) -> None:
    """As root, a rename would put a file in the place of /dev/null."""
    os.mkfifo(tmp_path / "pipe.csv")
    (tmp_path / "null.csv").symlink_to("/dev/null")
    outputs = OutputFolder(tmp_path)
    for name in ("pipe.csv", "null.csv"):
        with pytest.raises(OSError, match="a device or a pipe"):
            write_whole(tmp_path / name, b"new")
        with pytest.raises(OutputError, match=rf"{name}: cannot be written \(it is no file but a device or a pipe\); give another"):
            outputs.write(name, b"new")
    assert (tmp_path / "pipe.csv").is_fifo()
    assert Path("/dev/null").is_char_device()
    assert {path.name for path in tmp_path.iterdir()} == {"pipe.csv", "null.csv"}


def test_a_folder_of_a_files_name_is_found_before_anything_is_replaced(tmp_path: Path) -> None:
    """As the last of several files it would be found when the others have replaced the old ones."""
    (tmp_path / "a.csv").write_text("old")
    (tmp_path / "film.mp4").mkdir()
    (tmp_path / "link.csv").symlink_to(tmp_path / "film.mp4")
    outputs = OutputFolder(tmp_path)
    outputs.write("a.csv", b"new")
    for name in ("film.mp4", "link.csv"):
        with pytest.raises(OutputError, match=rf"{name}: cannot be written \(it is a folder\); give another folder"):
            outputs.begin(name)
        with pytest.raises(OSError, match="it is a folder"), replacing(tmp_path / name):
            pass
    outputs.discard()
    assert (tmp_path / "a.csv").read_text() == "old"
    assert {path.name for path in tmp_path.iterdir()} == {"a.csv", "film.mp4", "link.csv"}


def test_a_file_is_made_with_the_rights_that_any_other_has(tmp_path: Path) -> None:
    (tmp_path / "other").write_bytes(b"")
    write_whole(tmp_path / "a.csv", b"new")
    assert (tmp_path / "a.csv").stat().st_mode == (tmp_path / "other").stat().st_mode


def test_two_processes_write_to_files_of_their_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    first = OutputFolder(tmp_path).begin("a.csv")
    monkeypatch.setattr(os, "getpid", lambda: 12345)
    assert OutputFolder(tmp_path).begin("a.csv") != first


def test_a_folder_that_cannot_be_is_an_error_of_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for place in ("file", "file/below"):
        with pytest.raises(OutputError, match=rf"{place}: cannot be written \((File exists|Not a directory)\); give another folder"):
            OutputFolder(tmp_path / place)


def test_other_faults_are_passed_on(tmp_path: Path) -> None:
    with pytest.raises(KeyError), writing(tmp_path):
        raise KeyError("not the system's")


def test_an_error_is_one_line_and_an_exit_code(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        fail(ValueError("scene.toml: camera.width:\n  found 0"))
    assert ended.value.code == USER_ERROR
    assert capsys.readouterr().err == "scene.toml: camera.width: found 0\n"
    assert one_line(" a\r\n\tb ") == "a b"
