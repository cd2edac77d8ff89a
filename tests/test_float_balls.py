"""Balls of float64 against Arb's, and the curves behind a lens that are enclosed in them against Arb's one by one."""

from __future__ import annotations

import functools
from collections.abc import Callable
from fractions import Fraction

import numpy as np
import pytest
from coverage.models import LENSES
from curved_image import BallLens, CurvedCamera
from flint import arb, ctx
from float_balls import FloatBalls

Operation = Callable[[FloatBalls, FloatBalls], FloatBalls]
OPERATIONS: dict[str, tuple[Operation, Callable[[arb, arb], arb]]] = {
    "sum": (lambda a, b: a + b, lambda a, b: a + b),
    "difference": (lambda a, b: a - b, lambda a, b: a - b),
    "product": (lambda a, b: a * b, lambda a, b: a * b),
    "quotient": (lambda a, b: a / b, lambda a, b: a / b),
    "root": (lambda a, _: (a * a).sqrt(), lambda a, _: (a * a).sqrt()),
    "arctangent": (lambda a, _: a.atan(), lambda a, _: a.atan()),
}


def shown_by_arb(lens: BallLens, x: arb, y: arb) -> tuple[arb, arb]:
    """OpenCV's formulas."""
    square = x * x + y * y
    if lens.fisheye:
        r = square.sqrt()
        angle, power = r.atan(), r.atan() ** 2
        scale = angle / r * (1 + sum(arb(k) * power ** (place + 1) for place, k in enumerate(lens.coefficients)))
        return x * scale, y * scale
    k1, k2, p1, p2, k3 = [*map(arb, lens.coefficients), arb(0)][:5]
    scale = 1 + k1 * square + k2 * square**2 + k3 * square**3
    return x * scale + 2 * p1 * x * y + p2 * (square + 2 * x * x), y * scale + p1 * (square + 2 * y * y) + 2 * p2 * x * y


@pytest.mark.parametrize("name", OPERATIONS)
def test_balls_hold_what_arb_finds_and_little_more(name: str) -> None:
    rng, (ours, theirs) = np.random.default_rng(1), OPERATIONS[name]
    middles = rng.choice([-1, 1], (2, 200)) * 10.0 ** rng.uniform(-8, 8, (2, 200))
    radii = np.abs(middles) * rng.choice([0.0, 1e-12, 1e-3], (2, 200))
    found = ours(*(FloatBalls(middle, radius) for middle, radius in zip(middles, radii, strict=True)))
    with ctx.workprec(200):
        for place in range(200):
            ends = [
                [arb(float(m)) + sign * arb(float(r)) for sign in (-1, 0, 1)]
                for m, r in zip(middles[:, place], radii[:, place], strict=True)
            ]
            values = [theirs(one, other) for one in ends[0] for other in ends[1]]
            low, high = arb(float(found.low[place])), arb(float(found.high[place]))
            assert all(low <= value <= high for value in values)
            half = radii[0, place] if name == "arctangent" else float(functools.reduce(lambda a, b: a.union(b), values).rad())
            assert found.radius[place] <= 1.3 * half + 2.0**-49 * (abs(middles[:, place]).sum() + abs(found.middle[place]))


@pytest.mark.parametrize("name", LENSES)
def test_what_a_lens_shows_is_enclosed(name: str) -> None:
    rng, lens = np.random.default_rng(2), BallLens.of(vars(LENSES[name]))
    x, y = (FloatBalls(side, np.zeros(60)) for side in rng.uniform(-0.8, 0.8, (2, 60)) * 10.0 ** rng.uniform(-9, 0, 60))
    shown = lens.shown(x, y)
    with ctx.workprec(200):
        for place in range(60):
            exact = shown_by_arb(lens, arb(float(x.middle[place])), arb(float(y.middle[place])))
            for side, value in zip(shown, exact, strict=True):
                assert arb(float(side.low[place])) <= value <= arb(float(side.high[place]))
                assert side.radius[place] < 1e-14


@pytest.mark.parametrize("name", LENSES)
def test_a_curve_meets_the_pixels_of_its_points_and_stays_near_its_chords(name: str) -> None:
    """Segments of all lengths, also from far out of view: the disc that is followed leaves nothing out of the frame's part."""
    rng, lens = np.random.default_rng(3), BallLens.of(vars(LENSES[name]))
    camera = CurvedCamera(lens, 320, 240, (Fraction(250), Fraction(240)), (Fraction(170), Fraction(110)))
    seen = 0
    for number in range(40):
        far = 10.0 ** rng.uniform(-1, 6 if number % 2 else 0.3)
        ends = rng.normal(0, 0.3, 2), rng.normal(0, far, 2)
        start, stop = ((Fraction(float(one)), Fraction(float(other))) for one, other in ends)
        frame = np.zeros((240, 320), dtype=bool)
        frame[camera.met(start, stop)] = True
        assert (frame == met_again(camera, stop, start)).all()
        share = np.concatenate([np.linspace(0, 1, 40_001), np.linspace(0, min(1.0, 3 / far), 40_001)])
        points = ends[0] + share[:, None] * (ends[1] - ends[0])
        points = points[(points**2).sum(axis=1) < camera.disc**2]
        x, y = (side.middle for side in lens.shown(*(FloatBalls(side, np.zeros(len(points))) for side in points.T)))
        columns, rows = np.floor(170 + 250 * x).astype(int), np.floor(110 + 240 * y).astype(int)
        inside = (columns >= 0) & (columns < 320) & (rows >= 0) & (rows < 240)
        assert frame[rows[inside], columns[inside]].all()
        found = np.zeros_like(frame)
        found[rows[inside], columns[inside]] = True
        assert (frame & ~found).sum() <= 8  # corners that are met between two of the points
        seen += int(found.sum())
    assert seen > 2000


def met_again(camera: CurvedCamera, start: tuple[Fraction, Fraction], stop: tuple[Fraction, Fraction]) -> np.ndarray:
    """The segment the other way round."""
    frame = np.zeros((camera.height, camera.width), dtype=bool)
    frame[camera.met(start, stop)] = True
    return frame


@pytest.mark.parametrize("name", LENSES)
def test_an_images_bend_is_bounded(name: str) -> None:
    """Second differences along random lines of rays; and by how much a step is lengthened."""
    rng, lens, radius = np.random.default_rng(4), BallLens.of(vars(LENSES[name])), 0.9
    step = 2.0**-7
    angle, place, direction = rng.uniform(0, 2 * np.pi, 500), radius * np.sqrt(rng.random(500)), rng.uniform(0, 2 * np.pi, 500)
    middle = place * np.array([np.cos(angle), np.sin(angle)])
    way = step * np.array([np.cos(direction), np.sin(direction)])
    none = np.zeros(500)
    first, second, third = (
        np.array([side.middle for side in lens.shown(*(FloatBalls(part, none) for part in middle + share * way))]) for share in (-1, 0, 1)
    )
    bends = np.hypot(*(first - 2 * second + third)) / step**2
    assert bends.max() <= lens.bend(radius + step)
    assert bends.max() > 0.05 * lens.bend(radius + step)
    assert (np.hypot(*(third - second)) / step).max() <= lens.stretch(radius + step)
