"""Tables of what is known at times: CSV files with a header, read by the names of their columns."""

from __future__ import annotations

import csv
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from runtime.errors import one_line


def timed_rows(path: str | Path, columns: Sequence[str]) -> NDArray[np.float64]:
    """The named columns of a CSV file, (rows, columns), the first of which are the times. Raises ValueError, one line that names the file.

    Refused are a file that cannot be read or lacks a column or a line, numbers that are not finite, and times that do not ascend.
    """
    try:
        with Path(path).open(encoding="utf-8", newline="") as file:
            names = next(csv.reader(file), [])
        if lacking := [name for name in columns if name not in names]:
            raise ValueError(f"no column {', '.join(lacking)}")
        wanted = [names.index(name) for name in columns]
        with warnings.catch_warnings(action="ignore"):  # of a file without a line, which is refused below
            rows = np.loadtxt(path, delimiter=",", skiprows=1, usecols=wanted, ndmin=2)
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or one_line(error)
        raise ValueError(f"{path}: {reason}; give a CSV file with the columns {', '.join(columns)}") from error
    if len(rows) == 0:
        raise ValueError(f"{path}: found no line; give finite numbers in order of time")
    _demand_of_rows(path, np.isfinite(rows).all(axis=1), "a number that is not finite", "give finite ones")
    _demand_of_rows(path, np.diff(rows[:, 0], prepend=-np.inf) > 0, "a time that is not after the line's before", "give them in order")
    return rows


def rows_with_plus_minus(path: str | Path, columns: Sequence[str]) -> NDArray[np.float64]:
    """`timed_rows` of three readings and their three plus-minus. Raises ValueError for a plus-minus below 0, too."""
    rows = timed_rows(path, columns)
    _demand_of_rows(path, (rows[:, 4:] >= 0).all(axis=1), "a plus-minus below 0", "give 0 or more")
    return rows


def _demand_of_rows(path: str | Path, holds: ArrayLike, found: str, expected: str) -> None:
    """Raises ValueError with the first row of numbers of which something does not hold."""
    faults = np.flatnonzero(~np.asarray(holds))
    if len(faults):
        raise ValueError(f"{path}: found {found} in row {faults[0] + 1} of its numbers; {expected}")
