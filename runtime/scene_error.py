"""A fault of a scene, and how it is told: one line with the key, what was found, and what to do."""

from __future__ import annotations

LONGEST_FOUND = 200
"""Characters of a faulty value that an error quotes."""


class SceneError(ValueError):
    """A scene file, or a value in it, that cannot be used. One line: the key, what was found, what to do."""


def demand(holds: bool, key: str, found: object, advice: str) -> None:
    """Raises `SceneError` unless something holds of the value found under a key."""
    if not holds:
        text = str(found)
        quoted = text if len(text) <= LONGEST_FOUND else f"{text[:LONGEST_FOUND]}..."
        raise SceneError(f"{key}: found {quoted}; {advice}")
