"""Certified boxes have the same digits on every machine: with numpy's vector units and without, and with every libm.

The frames are run in fresh interpreters, since numpy chooses its loops and libm its functions when a process starts.
"""

from __future__ import annotations

import importlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
PROGRAM = """
import hashlib
import numpy as np
from runtime import Estimator
from runtime.image import runway_image

rng = np.random.default_rng(14)
for missed, extra in ((0, -1), (2, -1), (8, -1), (0, 40)):
    estimator = Estimator.load("models/paper.onnx", missed_budget=missed, extra_budget=extra)
    scene, digest = estimator.scene, hashlib.sha256()
    for clutter in (0.0, 0.0, 0.01, 0.01, 0.05):
        frame = runway_image(scene, rng.uniform(scene.domain.lower, scene.domain.upper))
        frame.ravel()[rng.permutation(np.flatnonzero(frame))[:missed]] = 0
        frame |= rng.random(frame.shape) < (clutter if extra < 0 else 0)
        for box in estimator.estimate(frame).regions:
            digest.update(np.stack([box.lower, box.upper]).astype("<f8").tobytes())
    print(missed, extra, digest.hexdigest()[:16])
"""
BOXES = """
0 -1 2200b55c3cd5d106
2 -1 ac7aeb3b083120c3
8 -1 6d36c81504ecb5cd
0 40 2968fd1814da6b3e
"""
"""What the program prints: the same in every environment of `make evidence`. It changes with the refinement, and with the paper's model."""

numpy_core = importlib.import_module(f"numpy.{'core' if np.__version__ < '2' else '_core'}._multiarray_umath")
VECTOR_UNITS = [name for name in numpy_core.__cpu_dispatch__ if numpy_core.__cpu_features__[name]]
"""Those of this machine that numpy has loops for, beside the ones that every machine must have; the wider ones last."""
NO_FUSED_ADD = {"GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA,-AVX2_Usable,-FMA_Usable"}
"""glibc's libm takes other digits of sin and cos then; other systems know nothing of it."""


def without(units: list[str]) -> dict[str, str]:
    """What makes numpy do without these vector units."""
    return {"NPY_DISABLE_CPU_FEATURES": " ".join(units)} if units else {}


def printed(program: str, environment: dict[str, str]) -> str:
    """What a fresh interpreter prints, started in the repository's root; a failure shows its stderr."""
    done = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, env=os.environ | environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.parametrize(
    "environment",
    [{}, without(VECTOR_UNITS), without(VECTOR_UNITS[1:]), without(VECTOR_UNITS) | NO_FUSED_ADD],
    ids=["as it is", "no vector units", "the first vector units alone", "no fused additions"],
)
def test_boxes_have_the_same_digits(environment: dict[str, str]) -> None:
    assert printed(PROGRAM, environment).strip() == BOXES.strip()


def test_vector_units_make_a_difference_to_numpy() -> None:
    """Or the test above would compare a thing with itself: numpy's own tan has other digits without them, where it has loops for them."""
    program = "import numpy as np; print(np.tan(np.arange(100_000) * 2.0**-16).tobytes().hex())"
    if {"AVX512_SKX", "X86_V4"} & set(VECTOR_UNITS):
        assert printed(program, without(VECTOR_UNITS)) != np.tan(np.arange(100_000) * 2.0**-16).tobytes().hex() + "\n"
