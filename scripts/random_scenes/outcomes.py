"""What comes of a campaign's scenes: counts by kind of scene and of frame, scenes that were refused, and findings."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

Kinds = tuple[str, ...]


@dataclass(frozen=True)
class Finding:
    """What must not be, and where: `random_scenes --replay PLACE`."""

    place: str
    """SEED/SCENE.DRAW#FRAME, or SEED/SCENE.DRAW of what concerns the scene as a whole."""
    fault: str
    """Its kind, in few words."""
    detail: str
    kinds: Kinds
    """Of the scene and the frame."""


@dataclass
class Outcomes:
    """What came of one scene, or of all. `counts`: by kind, how many frames were drawn, judged, and so on."""

    counts: dict[str, Counter[str]] = field(default_factory=dict)
    refused: Counter[str] = field(default_factory=Counter)
    findings: list[Finding] = field(default_factory=list)

    @staticmethod
    def read(tables: dict[str, Any]) -> Outcomes:
        """Outcomes from the tables of JSON."""
        findings = [Finding(**{**each, "kinds": tuple(each["kinds"])}) for each in tables["findings"]]
        return Outcomes({kind: Counter(numbers) for kind, numbers in tables["counts"].items()}, Counter(tables["refused"]), findings)

    def tables(self) -> dict[str, Any]:
        """The same for JSON."""
        return {**vars(self), "findings": [vars(finding) for finding in self.findings]}

    def add(self, other: Outcomes) -> None:
        """Adds what came of another scene."""
        for kind, numbers in other.counts.items():
            self.count((kind,), numbers)
        self.refused.update(other.refused)
        self.findings += other.findings

    def count(self, kinds: Kinds, numbers: Counter[str]) -> None:
        """Adds numbers to each of the kinds."""
        for kind in kinds:
            self.counts.setdefault(kind, Counter()).update(numbers)
