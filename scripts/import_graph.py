"""Which modules import which, read from their sources: imports inside functions too, and the packages that a module lies in."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Sequence
from pathlib import Path


def source_of(module: str, roots: Sequence[Path]) -> Path | None:
    """The file of a module, or of a package's `__init__`, in the first of the folders that has it."""
    for root in roots:
        place = root.joinpath(*module.split("."))
        for path in (place.with_name(f"{place.name}.py"), place / "__init__.py"):
            if path.is_file():
                return path
    return None


def imports_of(path: Path, roots: Sequence[Path]) -> set[str]:
    """The modules in `roots` that a file imports. `from package import module` imports the module, not the package's own names."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            inner = {alias.name: f"{node.module}.{alias.name}" for alias in node.names}
            modules = {name: full for name, full in inner.items() if source_of(full, roots)}
            names |= set(modules.values()) | ({node.module} if len(modules) < len(inner) else set())
    return {name for name in names if source_of(name, roots)}


def packages_of(module: str) -> list[str]:
    """The packages that a module lies in, which Python imports first."""
    parts = module.split(".")
    return [".".join(parts[:count]) for count in range(1, len(parts))]


def all_imports_of(modules: Iterable[str], roots: Sequence[Path]) -> dict[str, Path]:
    """The modules themselves, and all modules in `roots` that are imported with them, with their files, sorted by name."""
    found: dict[str, Path] = {}
    waiting = list(modules)
    while waiting:
        module = waiting.pop()
        path = source_of(module, roots)
        if module not in found and path is not None:
            found[module] = path
            waiting += [*packages_of(module), *imports_of(path, roots)]
    return dict(sorted(found.items()))
