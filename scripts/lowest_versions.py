"""Prints the lowest versions that pyproject.toml admits, as pip's constraints: of the package's own needs and of every extra.

    python scripts/lowest_versions.py > lowest.txt        used by `make setup-lowest`

What they need in turn is left to pip, which takes the newest: so installs a user who has an old release of one package only. Exit
code 2 if a requirement has no lower bound.
"""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

PYPROJECT = Path(__file__).parents[1] / "pyproject.toml"
REQUIREMENT = re.compile(r"([A-Za-z0-9._-]+)(?:\[[^\]]*\])?(?:>=([0-9][0-9a-z.]*))?")


def lowest_versions(pyproject: Path) -> dict[str, str]:
    """Lowest version by package. Raises ValueError for a requirement without one, or one that two lists put differently."""
    project = tomllib.loads(pyproject.read_text(encoding="utf-8"))["project"]
    requirements = [*project["dependencies"], *(text for extra in project["optional-dependencies"].values() for text in extra)]
    lowest: dict[str, str] = {}
    for text in requirements:
        found = REQUIREMENT.fullmatch(text)
        name, version = found.groups() if found else (text, None)
        if name == project["name"]:
            continue
        if version is None or lowest.setdefault(name, version) != version:
            raise ValueError(f"{pyproject}: found {text!r}; give every requirement one lower bound, as in {name}>=1.0")
    return lowest


if __name__ == "__main__":
    try:
        print(*(f"{name}=={version}" for name, version in sorted(lowest_versions(PYPROJECT).items())), sep="\n")
    except ValueError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
