"""How large the certified box of a finished model is on frames without clutter: what the paper's bound is printed beside."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from runtime.estimator import Estimator
from runtime.image import runway_image

CLEAN_FRAMES = 50


def clean_half_widths(estimator: Estimator, count: int = CLEAN_FRAMES, seed: int = 0) -> NDArray[np.float64]:
    """Half-widths of the refined boxes of `count` random states of the domain, each from its own exact image: (count, 4), rad and m.

    Such a frame has no dark pixel of the runway and no clutter, so Theorems A and B both promise a box.
    """
    scene = estimator.scene
    states = scene.domain.uniform(np.random.default_rng(seed), count)
    boxes = (estimator.estimate(runway_image(scene, state)).box for state in states)
    return np.array([box.half_widths for box in boxes if box is not None])
