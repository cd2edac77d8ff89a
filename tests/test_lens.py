"""The lens against OpenCV, its bounds against mpmath's digits, and its inverse, which is certified."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import mpmath
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from runtime.lens import LARGEST_RADIUS, Lens
from runtime.scene import Distortion, SceneError

Floats = NDArray[np.float64]
WIDE = Distortion("radial-tangential", (-0.28, 0.07, 0.001, -0.002, 0.003))
FISHEYE = Distortion("fisheye", (-0.013, 0.05, -0.045, 0.012))
LENSES = {
    "wide": WIDE,
    "barrel": Distortion("radial-tangential", (-0.4, 0.2, 0.0, 0.0)),
    "pincushion": Distortion("radial-tangential", (0.2, 0.0, 0.0, 0.0)),
    "tangential": Distortion("radial-tangential", (0.0, 0.0, 0.01, -0.015)),
    "fisheye": FISHEYE,
    "equidistant": Distortion("fisheye", (0.0, 0.0, 0.0, 0.0)),
}
CORNER = 0.75


@dataclass(frozen=True)
class PreciseLens:
    """OpenCV's formulas in mpmath, 40 digits."""

    distortion: Distortion

    def shown(self, x: float, y: float) -> tuple[mpmath.mpf, mpmath.mpf]:
        x, y = mpmath.mpf(x), mpmath.mpf(y)
        k = [mpmath.mpf(value) for value in self.distortion.coefficients]
        square = x**2 + y**2
        if self.distortion.model == "fisheye":
            r = mpmath.sqrt(square)
            angle = mpmath.atan(r)
            scale = angle * (1 + sum(value * angle ** (2 * place + 2) for place, value in enumerate(k))) / r if r else mpmath.mpf(1)
            return x * scale, y * scale
        k1, k2, p1, p2, k3 = [*k, mpmath.mpf(0)][:5]
        scale = 1 + k1 * square + k2 * square**2 + k3 * square**3
        return (
            x * scale + 2 * p1 * x * y + p2 * (square + 2 * x**2),
            y * scale + p1 * (square + 2 * y**2) + 2 * p2 * x * y,
        )


@pytest.fixture(autouse=True)
def _digits() -> None:
    mpmath.mp.dps = 40


def lenses() -> st.SearchStrategy[Distortion]:
    small = st.floats(-0.01, 0.01)
    radial = st.tuples(st.floats(-0.4, 0.2), st.floats(-0.1, 0.25), small, small, st.floats(-0.05, 0.05))
    fisheye = st.tuples(*[st.floats(-0.1, 0.1)] * 2, *[small] * 2)
    return st.one_of(radial.map(lambda k: Distortion("radial-tangential", k)), fisheye.map(lambda k: Distortion("fisheye", k)))


def unfolded(distortion: Distortion, corner: float) -> Lens:
    try:
        return Lens.of(distortion, corner)
    except SceneError:
        assume(False)
        raise


# --- forward ---


@pytest.mark.parametrize("name", LENSES)
def test_rays_are_shown_where_opencv_shows_them(name: str) -> None:
    distortion, rng = LENSES[name], np.random.default_rng(1)
    lens = Lens.of(distortion, CORNER)
    rays = rng.uniform(-0.6, 0.6, (500, 2))
    points, still = np.concatenate([rays, np.ones((500, 1))], axis=1)[:, None], np.zeros(3)
    project = cv2.fisheye.projectPoints if distortion.model == "fisheye" else cv2.projectPoints
    expected = np.asarray(project(points, still, still, np.eye(3), np.array(distortion.coefficients))[0]).reshape(-1, 2)
    assert np.abs(np.stack(lens.distorted(*rays.T), axis=-1) - expected).max() < 1e-13


@given(distortion=lenses(), x=st.floats(-0.7, 0.7), y=st.floats(-0.7, 0.7))
def test_rounding_is_bounded(distortion: Distortion, x: float, y: float) -> None:
    lens = unfolded(distortion, CORNER)
    assume(math.hypot(x, y) <= lens.radius)
    shown = [float(part) for part in lens.distorted(np.array(x), np.array(y))]
    assert mpmath.hypot(*(exact - part for exact, part in zip(PreciseLens(distortion).shown(x, y), shown, strict=True))) <= lens.rounding


# --- derivatives ---


@given(distortion=lenses(), angle=st.floats(0, 7), share=st.floats(0, 1), other=st.floats(0, 7), corner=st.floats(0.1, 1.0))
def test_no_two_rays_come_closer_than_the_stretch_says(
    distortion: Distortion, angle: float, share: float, other: float, corner: float
) -> None:
    lens = unfolded(distortion, corner)
    x, y = share * lens.radius * math.cos(angle), share * lens.radius * math.sin(angle)
    step = 1e-6
    near = x + step * math.cos(other), y + step * math.sin(other)
    assume(math.hypot(*near) <= lens.radius)
    precise = PreciseLens(distortion)
    moved = mpmath.hypot(*(one - two for one, two in zip(precise.shown(*near), precise.shown(x, y), strict=True)))
    distance = mpmath.hypot(mpmath.mpf(near[0]) - mpmath.mpf(x), mpmath.mpf(near[1]) - mpmath.mpf(y))
    place = min(int(share * len(lens.stretches)), len(lens.stretches) - 1)
    around = lens.stretches[max(place - 1, 0) : place + 2].min()
    assert moved >= distance * around >= distance * lens.stretch


@pytest.mark.parametrize("name", LENSES)
def test_the_stretch_is_no_looser_than_it_must_be(name: str) -> None:
    """Within 2 % of the smallest derivative along a radius, but for the tangential part, of which the direction is not looked at."""
    lens = Lens.of(LENSES[name], CORNER)
    r = np.linspace(0, lens.radius, 4001)
    shown = np.stack([lens.distorted(r * math.cos(a), r * math.sin(a)) for a in np.linspace(0, 6.3, 64)])
    along = np.linalg.norm(np.diff(shown, axis=-1), axis=1) / np.diff(r)
    across = np.linalg.norm(shown, axis=1)[:, 1:] / r[1:]
    bent = 12 * math.hypot(*lens.tangential) * lens.radius
    assert lens.stretch > min(along.min(), across.min()) * 0.98 - bent


@given(distortion=lenses(), points=st.lists(st.floats(-0.5, 0.5), min_size=2, max_size=2), angle=st.floats(0, 7))
def test_edges_bend_no_more_than_the_curvature_says(distortion: Distortion, points: list[float], angle: float) -> None:
    """The middle of a straight edge of the sensor, back from it: how far from the segment between its ends' rays."""
    lens = unfolded(distortion, CORNER)
    edge = 0.02
    at = np.array([-0.5, 0.0, 0.5]) * edge
    x, y, off = lens.undistorted(points[0] + at * math.cos(angle), points[1] + at * math.sin(angle))
    assert off.max() < 1e-9
    chord = np.array([x[2] - x[0], y[2] - y[0]])
    away = abs(chord[0] * (y[1] - y[0]) - chord[1] * (x[1] - x[0])) / np.linalg.norm(chord)
    assert away <= lens.curvature * edge**2 / 8 + 1e-9


# --- back ---


@given(distortion=lenses(), angle=st.floats(0, 7), share=st.floats(0, 1), off=st.sampled_from([0.0, 1e-6, 1e-3]), turn=st.floats(0, 7))
def test_the_inverse_holds_the_true_ray(distortion: Distortion, angle: float, share: float, off: float, turn: float) -> None:
    lens = unfolded(distortion, CORNER)
    x, y = share * lens.radius * math.cos(angle), share * lens.radius * math.sin(angle)
    assume(math.hypot(x, y) <= lens.radius)
    exact = PreciseLens(distortion).shown(x, y)
    told = np.array(float(exact[0]) + 0.999 * off * math.cos(turn)), np.array(float(exact[1]) + 0.999 * off * math.sin(turn))
    found_x, found_y, away = lens.undistorted(*told, off + 1e-15)
    assert mpmath.hypot(mpmath.mpf(float(found_x)) - x, mpmath.mpf(float(found_y)) - y) <= float(away)


@pytest.mark.parametrize("name", LENSES)
def test_the_inverse_of_a_frame_is_known_to_1e_9(name: str) -> None:
    lens = Lens.of(LENSES[name], CORNER)
    x, y = np.meshgrid(np.linspace(-0.6, 0.6, 101), np.linspace(-0.45, 0.45, 77))
    found_x, found_y, off = lens.undistorted(x, y)
    assert off.max() < 1e-9
    assert np.hypot(found_x, found_y).max() < lens.radius
    _, _, wide = lens.undistorted(x, y, 1e-3)
    assert (wide < 1e-3 / lens.stretch + 1e-9).all()
    assert wide.min() < 1.1e-3


@pytest.mark.parametrize("name", LENSES)
def test_what_the_disc_does_not_show_is_not_found(name: str) -> None:
    lens = Lens.of(LENSES[name], CORNER)
    _, _, off = lens.undistorted(np.array([0.0, 1.5, -3.0, 40.0]), np.array([1.2, 0.0, 2.0, 0.0]))
    assert (off > 0.05).all()


@given(
    distortion=lenses(),
    middle=st.lists(st.floats(-0.5, 0.5), min_size=2, max_size=2),
    sides=st.lists(st.floats(0, 0.05), min_size=2, max_size=2),
    shares=st.lists(st.floats(0, 1), min_size=2, max_size=2),
)
def test_boxes_of_rays_are_shown_within_their_range(
    distortion: Distortion, middle: list[float], sides: list[float], shares: list[float]
) -> None:
    lens = unfolded(distortion, 1.1)
    low, high = np.array(middle) - sides, np.array(middle) + sides
    assume(max(math.hypot(a, b) for a in (low[0], high[0]) for b in (low[1], high[1])) <= lens.radius)
    point = np.clip(low + np.array(shares) * (high - low), low, high)
    ranges = lens.shown_range((low[:1], high[:1]), (low[1:], high[1:]))
    for exact, (least, most) in zip(PreciseLens(distortion).shown(*point), ranges, strict=True):
        assert float(least[0]) <= exact <= float(most[0])


@pytest.mark.parametrize("name", LENSES)
def test_ranges_of_small_boxes_are_tight(name: str) -> None:
    """Against the extremes over each box's border: at most 4 % wider for boxes of a few pixels."""
    lens, half = Lens.of(LENSES[name], CORNER), 0.004
    x, y = (side.ravel() for side in np.meshgrid(np.linspace(-0.5, 0.5, 9), np.linspace(-0.4, 0.4, 9)))
    (low, high), _ = lens.shown_range((x - half, x + half), (y - half, y + half))
    around = np.linspace(-half, half, 9)
    border = [(a, b) for a in around for b in (-half, half)] + [(a, b) for a in (-half, half) for b in around]
    shown = np.stack([lens.distorted(x + a, y + b)[0] for a, b in border])
    bent = 13 * math.hypot(*lens.tangential) * 0.65
    assert ((high - low) <= (shown.max(axis=0) - shown.min(axis=0)) * (1.04 + 2 * bent)).all()


# --- refused ---


@pytest.mark.parametrize(
    ("coefficients", "corner"), [((-0.4, 0.0, 0.0, 0.0), 0.75), ((-1.0, 0.0, 0.0, 0.0), 0.5), ((0.0, 0.0, 0.3, 0.3), 0.75)]
)
def test_a_lens_that_folds_is_refused(coefficients: tuple[float, ...], corner: float) -> None:
    with pytest.raises(SceneError, match=r"camera.distortion: found a lens that folds within the frame, \d+\.\d degrees off its axis"):
        Lens.of(Distortion("radial-tangential", coefficients), corner)


def test_the_fold_is_where_the_derivative_vanishes() -> None:
    """r - 0.4 r^3 turns at r = 0.913, 42.4 degrees, where it shows 0.609: a frame up to 0.6 is taken, one up to 0.61 is not."""
    folding = Distortion("radial-tangential", (-0.4, 0.0, 0.0, 0.0))
    assert Lens.of(folding, 0.6).radius < 0.9
    with pytest.raises(SceneError, match=r"42\.\d degrees off its axis"):
        Lens.of(folding, 0.61)


def test_a_fisheye_that_shows_more_than_a_half_space_is_cut() -> None:
    lens = Lens.of(Distortion("fisheye", (0.0, 0.0, 0.0, 0.0)), 1.7)
    assert not lens.whole
    assert lens.radius == LARGEST_RADIUS
    assert lens.undistorted(np.array([1.3, 1.5]), np.zeros(2))[2] == pytest.approx([0, np.inf], abs=1e-8)
