"""A claim that does not hold, and the state that shows it."""

from __future__ import annotations

from dataclasses import dataclass

from runtime.scene import STATE_NAMES


@dataclass(frozen=True)
class Counterexample:
    """The first claim that does not hold: where, and a state that shows it, [theta, x, y, z] in rad and m."""

    claim: str
    cell: int | None = None
    entry: int | None = None
    pixel: tuple[int, int] | None = None
    """(row, column)."""
    state: tuple[float, ...] | None = None

    def __str__(self) -> str:
        """One line."""
        parts = [self.claim]
        if self.cell is not None:
            parts.append(f"cell {self.cell}")
        if self.entry is not None:
            parts.append(f"entry {self.entry}")
        if self.pixel is not None:
            parts.append(f"pixel (row {self.pixel[0]}, column {self.pixel[1]})")
        if self.state is not None:
            parts.append("state " + ", ".join(f"{name} {value!r}" for name, value in zip(STATE_NAMES, self.state, strict=True)))
        return "; ".join(parts)


class Refuted(Exception):  # noqa: N818 - it reports what the file is, not an error
    """Carries a counterexample to where it is reported."""

    def __init__(self, counterexample: Counterexample) -> None:
        super().__init__(str(counterexample))
        self.counterexample = counterexample


def demand(holds: bool, claim: str, cell: int | None = None, entry: int | None = None) -> None:
    """Raises `Refuted` with the claim that does not hold."""
    if not holds:
        raise Refuted(Counterexample(claim, cell, entry))
