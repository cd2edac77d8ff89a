"""Tables of what is known at times: CSV files with a header, read by the names of their columns."""

from __future__ import annotations

import csv
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

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
    if len(rows) == 0 or not np.isfinite(rows).all() or (np.diff(rows[:, 0]) <= 0).any():
        found = f"{len(rows)} lines, times that do not ascend, or numbers that are not finite"
        raise ValueError(f"{path}: found {found}; give finite numbers in order of time")
    return rows


def rows_with_plus_minus(path: str | Path, columns: Sequence[str]) -> NDArray[np.float64]:
    """`timed_rows` of three readings and their three plus-minus. Raises ValueError for a plus-minus below 0, too."""
    rows = timed_rows(path, columns)
    if (rows[:, 4:] < 0).any():
        found = f"{len(rows)} lines, times that do not ascend, numbers that are not finite, or a plus-minus below 0"
        raise ValueError(f"{path}: found {found}; give finite numbers in order of time")
    return rows
