"""A piece of the campaign's work, and the digest of all that its result depends on."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from import_graph import all_imports_of

import runtime
from coverage.judge import Tally, Violation, judge_frame
from coverage.scenarios import Scenario
from coverage.states import Stage


@dataclass(frozen=True)
class Chunk:
    """Frames `first` to `first + frames - 1` of a scenario."""

    scenario: Scenario
    path: str
    recording: str | None
    seed: int
    first: int
    frames: int
    campaign: str
    """Digest of all that the frames and their estimates depend on."""

    @property
    def key(self) -> tuple[str, str, int, int]:
        """What a finished chunk is found again by."""
        return self.campaign, self.scenario.name, self.first, self.frames

    def run(self) -> tuple[Chunk, Tally, list[Violation]]:
        """Judges the frames."""
        stage = Stage.of(self.path, self.recording)
        tally, violations = Tally(), []
        for number in range(self.first, self.first + self.frames):
            counts, found = judge_frame(stage, self.scenario, self.seed, number)
            tally += counts
            violations += found
        return self, tally, violations


def digest(paths: Iterable[Path]) -> str:
    """One sha256 of the contents of files, in order."""
    return hashlib.sha256("".join(hashlib.sha256(path.read_bytes()).hexdigest() for path in paths).encode()).hexdigest()


def code() -> list[Path]:
    """The files that decide what a frame is and what is said of it: this module's, and those of all that it imports."""
    roots = Path(runtime.__file__).parents[1], Path(__file__).parents[1]
    return list(all_imports_of(["coverage.chunk"], roots).values())
