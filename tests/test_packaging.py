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
from lowest_versions import lowest_versions

ROOT = Path(__file__).parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
TOP_LEVEL = {
    *("pyproject.toml", "build_model", "runtime", "models", "tests", "scripts"),
    *("README.md", "LICENSE", "CHANGELOG.md", "CONTRIBUTING.md", "Makefile", "constraints.txt", "docs"),
    *(".gitignore", ".pre-commit-config.yaml", ".ci"),
}


def requirement_names(requirements: list[str]) -> set[str]:
    return {re.split(r"[\[<>=!~; ]", requirement, maxsplit=1)[0] for requirement in requirements}


# --- the user's own ---


def test_an_estimator_leaves_nothing_in_the_users_home_and_prints_nothing(tmp_path: Path) -> None:
    """onnxruntime would record its use there."""
    program = "import numpy, runtime; e = runtime.Estimator.load(); e.estimate(numpy.zeros(e.scene.camera.shape, numpy.uint8))"
    for home in (tmp_path, tmp_path / "missing" / "home"):
        environment = {"HOME": str(home), "PYTHONPATH": str(ROOT)}
        done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=False)
        assert (done.returncode, done.stdout, done.stderr) == (0, "", "")
    assert list(tmp_path.iterdir()) == []


# --- the repository ---


def test_the_top_level_is_the_documented_one() -> None:
    ignored = [".git", *(line.rstrip("/") for line in (ROOT / ".gitignore").read_text(encoding="utf-8").split())]
    present = {path.name for path in ROOT.iterdir() if not any(fnmatch.fnmatch(path.name, pattern) for pattern in ignored)}
    assert present == TOP_LEVEL


def test_constraints_pin_every_direct_dependency_to_a_public_release() -> None:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pins = [line for line in lines if line and not line.startswith("#")]
    assert [pin for pin in pins if not re.fullmatch(r"[A-Za-z0-9._-]+==[0-9][0-9a-z.]*", pin)] == []
    extras = ("build", "pictures", "recordings", "dev")
    wanted = set(PROJECT["dependencies"]).union(*(PROJECT["optional-dependencies"][extra] for extra in extras))
    assert requirement_names(list(wanted)) - {PROJECT["name"]} <= {pin.partition("==")[0] for pin in pins}
    assert "torch==2.13.0" in pins


def test_every_requirement_has_a_lowest_version_that_the_tested_one_is_not_below() -> None:
    lowest = lowest_versions(ROOT / "pyproject.toml")
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    tested = dict(line.split("==") for line in lines if line and not line.startswith("#"))

    def ordered(version: str) -> list[int]:
        return [int(part) for part in re.findall(r"\d+", version)]

    assert set(lowest) <= set(tested)
    assert [name for name, version in lowest.items() if ordered(version) > ordered(tested[name])] == []
    assert lowest["torch"] == tested["torch"]


@pytest.mark.parametrize("requirement", ["numpy", "numpy<3", "numpy>=1.26,<3", "numpy==1.26"])
def test_a_requirement_without_a_lower_bound_of_its_own_is_refused(tmp_path: Path, requirement: str) -> None:
    (tmp_path / "p.toml").write_text(f'[project]\nname = "a"\ndependencies = ["{requirement}"]\noptional-dependencies = {{}}\n')
    with pytest.raises(ValueError, match="give every requirement one lower bound"):
        lowest_versions(tmp_path / "p.toml")


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
