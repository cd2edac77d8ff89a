"""Shared by all tests: the paper's scene, random states of a domain, Hypothesis's profiles, one thread a worker.

Hypothesis runs its "quick" profile, the same examples every time; `--hypothesis-profile=long` draws new and many more.
"""

from __future__ import annotations

import fcntl
import os
from collections.abc import Callable
from pathlib import Path

import h5py  # noqa: F401  imported before codac, whose own copy of HDF5 makes a later import of h5py crash
import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from numpy.typing import NDArray

from runtime.estimator import Estimator
from runtime.scene import Scene

os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is imported: pytest runs one worker a core

settings.register_profile("quick", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
settings.register_profile("long", deadline=None, max_examples=2000, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("quick")


@pytest.fixture(scope="session")
def repository() -> Path:
    """The repository's root."""
    return Path(__file__).parents[1]


@pytest.fixture(scope="session")
def paper_scene(repository: Path) -> Scene:
    """The paper's experiment, models/paper.toml."""
    return Scene.load(repository / "models" / "paper.toml")


@pytest.fixture(scope="session")
def random_states() -> Callable[[Scene, int, int], NDArray[np.float64]]:
    """`random_states(scene, count, seed)`: (count, 4) states, uniform over the scene's domain."""

    def draw(scene: Scene, count: int, seed: int) -> NDArray[np.float64]:
        return np.random.default_rng(seed).uniform(scene.domain.lower, scene.domain.upper, (count, 4))

    return draw


@pytest.fixture(scope="session")
def model_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    """`model_of(name)`: the model of a scene of `scenes`, exported once for all workers when it is first asked for."""
    own = tmp_path_factory.getbasetemp()
    folder = (own.parent if "PYTEST_XDIST_WORKER" in os.environ else own) / "models"
    folder.mkdir(exist_ok=True)

    def model(name: str) -> Path:
        from scenes import SCENES, WINDOWED

        from build_model.export import export_model

        path = folder / f"{name.replace(', ', '-').replace(' ', '-')}.onnx"
        with path.with_suffix(".lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not path.exists():
                export_model((SCENES | WINDOWED)[name], path, seed=1)
        return path

    return model


@pytest.fixture(scope="session")
def estimator_of(model_of: Callable[[str], Path]) -> Callable[..., Estimator]:
    """`estimator_of(name, missed_budget=None)`: the loaded model of a shared scene, loaded once a worker and budget."""
    loaded: dict[tuple[str, int | None], Estimator] = {}

    def estimator(name: str, missed_budget: int | None = None) -> Estimator:
        key = name, missed_budget
        if key not in loaded:
            loaded[key] = Estimator.load(model_of(name), missed_budget=missed_budget)
        return loaded[key]

    return estimator
