"""The frames that every comparison sees: states drawn from the whole domain, their exact images, clutter. One seed, one set of frames."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from runtime import Scene
from runtime.image import runway_image
from runtime.whole_file import replacing


def draw_frames(scene: Scene, count: int, clutter: float, seed: int) -> Iterator[tuple[NDArray[np.float64], NDArray[np.uint8]]]:
    """`count` pairs of a state (4,), uniform over the domain, and its image under clutter, (height, width) uint8 of {0, 1}.

    Every pixel is clutter with probability `clutter`, independently. The states depend on the seed alone: they are the same at every
    density, and the clutter of a lower density is part of that of a higher one.
    """
    states = scene.domain.uniform(np.random.default_rng([seed, 0]), count)
    for number, state in enumerate(states):
        lit_by_chance = np.random.default_rng([seed, 1, number]).random(scene.camera.shape) < clutter
        yield state, runway_image(scene, state) | lit_by_chance.astype(np.uint8)


def write_csv(path: Path, header: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Writes a table of figures, one row a frame; folders are made as needed."""
    with replacing(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([header, *rows])
