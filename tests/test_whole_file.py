"""A file is replaced by a whole one or not at all; an error is one line and an exit code."""

from __future__ import annotations

from pathlib import Path

import pytest

from runtime.errors import USER_ERROR, fail, one_line
from runtime.whole_file import replacing, write_whole


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


def test_an_error_is_one_line_and_an_exit_code(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        fail(ValueError("scene.toml: camera.width:\n  found 0"))
    assert ended.value.code == USER_ERROR
    assert capsys.readouterr().err == "scene.toml: camera.width: found 0\n"
    assert one_line(" a\r\n\tb ") == "a b"
