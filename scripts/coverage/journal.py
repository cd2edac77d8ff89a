"""A campaign's journal: what is finished is kept beside the output, so that a campaign goes on where it was stopped."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, Generic, TypeVar

from runtime.whole_file import write_whole

Result = TypeVar("Result")
Key = tuple[str | int, ...]


class ResultJournal(Generic[Result]):
    """Results by key, one line of JSON each; lines of other keys than `keys` are dropped.

    `read` makes a result of the tables that `written` made of it.
    """

    def __init__(
        self, path: Path, keys: Iterable[Key], read: Callable[[dict[str, Any]], Result], written: Callable[[Result], dict[str, Any]]
    ) -> None:
        self.path, self._written = path, written
        self.done: dict[Key, Result] = {}
        wanted = set(keys)
        kept = []
        for line in path.read_text(encoding="utf-8").splitlines() if path.exists() else ():
            try:
                entry = json.loads(line)
                key = tuple(entry["key"])
            except (ValueError, KeyError):  # the last line of a campaign that was killed, or that of an older version
                continue
            if key in wanted:
                self.done[key] = read(entry["result"])
                kept.append(line)
        write_whole(path, "".join(line + "\n" for line in kept).encode())

    def enter(self, key: Key, result: Result) -> None:
        """Appends what is finished."""
        with self.path.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"key": key, "result": self._written(result)}) + "\n")
        self.done[key] = result
