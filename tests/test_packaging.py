"""The embedded runtime stays small, and the repository and the wheel hold what they should."""

from __future__ import annotations

import fnmatch
import re
import subprocess
import sys
import tomllib
import zipfile
from email.parser import HeaderParser
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
TOP_LEVEL = {
    *("pyproject.toml", "build_model", "runtime", "models", "tests", "scripts"),
    *("README.md", "LICENSE", "CHANGELOG.md", "Makefile", "constraints.txt", "docs", ".gitignore", ".ci"),
}


def requirement_names(requirements: list[str]) -> set[str]:
    return {re.split(r"[\[<>=!~; ]", requirement, maxsplit=1)[0] for requirement in requirements}


# --- the repository ---


def test_the_top_level_is_the_documented_one() -> None:
    ignored = [".git", *(line.rstrip("/") for line in (ROOT / ".gitignore").read_text(encoding="utf-8").split())]
    present = {path.name for path in ROOT.iterdir() if not any(fnmatch.fnmatch(path.name, pattern) for pattern in ignored)}
    assert present == TOP_LEVEL


def test_constraints_pin_every_direct_dependency_to_a_public_release() -> None:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = [line for line in lines if line and not line.startswith("#")]
    assert [pin for pin in pins if not re.fullmatch(r"[A-Za-z0-9._-]+==[0-9][0-9a-z.]*", pin)] == []
    wanted = set(PROJECT["dependencies"]).union(*(PROJECT["optional-dependencies"][extra] for extra in ("build", "recordings", "dev")))
    assert requirement_names(list(wanted)) - {PROJECT["name"]} <= {pin.partition("==")[0] for pin in pins}
    assert "torch==2.13.0" in pins


# --- the wheel ---


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> zipfile.ZipFile:
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    (path,) = folder.glob("*.whl")
    return zipfile.ZipFile(path)


def test_the_wheel_holds_both_packages_and_the_papers_model(wheel: zipfile.ZipFile) -> None:
    files = {name for name in wheel.namelist() if ".dist-info/" not in name}
    sources = {path.relative_to(ROOT).as_posix() for folder in ("runtime", "build_model") for path in (ROOT / folder).rglob("*.py")}
    typed = {f"{folder}/py.typed" for folder in ("runtime", "build_model")}
    assert files == sources | typed | {"runtime/models/paper.onnx", "runtime/models/paper.toml"}
    for name in ("paper.onnx", "paper.toml"):
        assert wheel.read(f"runtime/models/{name}") == (ROOT / "models" / name).read_bytes()


def test_the_wheel_requires_numpy_and_onnxruntime_and_nothing_else(wheel: zipfile.ZipFile) -> None:
    (name,) = (name for name in wheel.namelist() if name.endswith(".dist-info/METADATA"))
    requirements = HeaderParser().parsestr(wheel.read(name).decode("utf-8")).get_all("Requires-Dist", [])
    assert requirement_names([text for text in requirements if "extra ==" not in text]) == {"numpy", "onnxruntime"}
