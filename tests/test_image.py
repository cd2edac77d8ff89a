"""The supercover against a naive twin in exact rational arithmetic: pixel by pixel, borders, ties and clipping included.

A state whose tan(theta/2) is rational has a rational sine and cosine, and so a rational image. `runway_image` sees the nearest
float64 state. The two may differ only at near-ties: pixels that a segment moved by `NEAR_TIE_PX` could both meet and miss.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from runtime.camera import project
from runtime.image import lit_columns, runway_image
from runtime.scene import Axis, Bank, Camera, Domain, Marking, Runway, Scene

Point = tuple[Fraction, Fraction]
RandomStates = Callable[[Scene, int, int], NDArray[np.float64]]
NEAR_TIE_PX = Fraction(1, 10**9)
"""Far above what rounding a state and its projection to float64 moves a point by (some 1e-12 px), far below a pixel."""
DRAWN = [
    (("1/2", "1/2"), ("1/2", "1/2"), {(0, 0)}),
    (("1", "1"), ("1", "1"), {(1, 1)}),
    (("1", "0"), ("1", "1"), {(1, 0), (1, 1)}),
    (("0", "1"), ("1", "1"), {(0, 1), (1, 1)}),
    (("0", "0"), ("2", "2"), {(0, 0), (1, 1), (2, 2)}),
    (("2", "0"), ("0", "2"), {(2, 0), (1, 0), (1, 1), (0, 1), (0, 2)}),
    (("1/2", "1/2"), ("3/2", "3/4"), {(0, 0), (1, 0)}),
    (("1/2", "-9/2"), ("5/2", "7/2"), {(1, 0), (1, 1), (2, 1), (2, 2)}),
]
"""Segments that one can draw, and their lit pixels of rows 0 to 2 as (column, row)."""


# --- the naive twin ---


def cut(
    interval: tuple[Fraction, bool, Fraction, bool], constant: Fraction, slope: Fraction, strict: bool
) -> tuple[Fraction, bool, Fraction, bool] | None:
    """The part of an interval (low, low excluded, high, high excluded) where constant + slope s >= 0, or > 0 if strict."""
    low, low_open, high, high_open = interval
    if slope == 0:
        return interval if constant > 0 or (constant == 0 and not strict) else None
    root = -constant / slope
    if slope > 0 and (root > low or (root == low and strict)):
        low, low_open = root, strict
    if slope < 0 and (root < high or (root == high and strict)):
        high, high_open = root, strict
    empty = low > high or (low == high and (low_open or high_open))
    return None if empty else (low, low_open, high, high_open)


def meets(start: Point, stop: Point, column: int, row: int, widen: Fraction | None = None) -> bool:
    """True if a point of the closed segment lies in the half-open pixel; in the closed pixel widened by `widen` if it is given."""
    interval: tuple[Fraction, bool, Fraction, bool] | None = (Fraction(0), False, Fraction(1), False)
    margin = widen if widen is not None else Fraction(0)
    for axis, index in enumerate((column, row)):
        rise = stop[axis] - start[axis]
        for constant, slope, strict in (
            (start[axis] - index + margin, rise, False),
            (index + 1 + margin - start[axis], -rise, widen is None),
        ):
            interval = cut(interval, constant, slope, strict) if interval is not None else None
    return interval is not None


def exact_ends(scene: Scene, tangent: Fraction, x: Fraction, y: Fraction, z: Fraction) -> list[tuple[Point, Point]]:
    """Near and far end of each marking at the pitch with tan(theta/2) = tangent: the rigid camera in rational numbers."""
    cosine, sine = (1 - tangent**2) / (1 + tangent**2), 2 * tangent / (1 + tangent**2)
    focal, u0, v0 = (Fraction(value) for value in (scene.camera.focal_v_px, scene.camera.u0, scene.camera.v0))

    def end(p_x: float, p_z: float) -> Point:
        ahead = Fraction(p_z) + z
        depth, upward = y * sine + ahead * cosine, -y * cosine + ahead * sine
        return u0 + focal * (Fraction(p_x) - x) / depth, v0 - focal * upward / depth

    return [(end(marking.x_m, marking.ends_z_m[0]), end(marking.x_m, marking.ends_z_m[1])) for marking in scene.runway.markings]


def nearby_pixels(camera: Camera, start: Point, stop: Point) -> list[tuple[int, int]]:
    """(column, row) of all pixels of the frame in the segment's bounding box and two pixels around it."""
    columns, rows = (
        range(max(math.floor(min(start[axis], stop[axis])) - 2, 0), min(math.floor(max(start[axis], stop[axis])) + 3, size))
        for axis, size in enumerate((camera.width, camera.height))
    )
    return list(itertools.product(columns, rows))


def twin_image(scene: Scene, segments: list[tuple[Point, Point]]) -> NDArray[np.uint8]:
    frame = np.zeros(scene.camera.shape, dtype=np.uint8)
    for start, stop in segments:
        for column, row in nearby_pixels(scene.camera, start, stop):
            frame[row, column] |= meets(start, stop, column, row)
    return frame


def near_ties(segments: list[tuple[Point, Point]], frame: NDArray[np.uint8], twin: NDArray[np.uint8]) -> int:
    """Number of pixels in which the frames differ; each must be one that some segment meets widened and none meets narrowed."""
    rows, columns = np.nonzero(frame != twin)
    for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
        assert any(meets(*segment, column, row, NEAR_TIE_PX) for segment in segments), (row, column)
        assert not any(meets(*segment, column, row, -NEAR_TIE_PX) for segment in segments), (row, column)
    return len(rows)


def compare(scene: Scene, tangent: Fraction, x: float, y: float, z: float) -> tuple[int, int]:
    """(pixels that the image of a state lights, near-ties among the differences to the twin); other differences fail."""
    frame = runway_image(scene, [2 * math.atan(tangent), x, y, z])
    segments = exact_ends(scene, tangent, Fraction(x), Fraction(y), Fraction(z))
    return int(frame.sum()), near_ties(segments, frame, twin_image(scene, segments))


def rational_states(scene: Scene, count: int, seed: int) -> list[tuple[Fraction, float, float, float]]:
    """Random (tan(theta/2), x, y, z) of the scene's domain."""
    states = np.random.default_rng(seed).uniform(scene.domain.lower, scene.domain.upper, (count, 4))
    return [(Fraction(round(10**6 * math.tan(theta / 2)), 10**6), x, y, z) for theta, x, y, z in states.tolist()]


@pytest.mark.parametrize(("start", "stop", "lit"), DRAWN)
def test_the_twin_on_segments_that_one_can_draw(start: tuple[str, str], stop: tuple[str, str], lit: set[tuple[int, int]]) -> None:
    """Lit pixels as (column, row). A falling diagonal enters corners only, a rising one also the pixels it passes between them."""
    ends = [(Fraction(u), Fraction(v)) for u, v in (start, stop)]
    assert {pixel for pixel in itertools.product(range(3), range(3)) if meets(ends[0], ends[1], *pixel)} == lit


# --- generic states ---


FIXED_X = Axis((0.0,), 0.0)


def scene_of(camera: Camera, *markings: Marking, x: Axis = FIXED_X) -> Scene:
    """A scene of the paper's domain with another camera, other markings, another x."""
    return Scene(camera, Runway(markings), Domain(Axis((0.6,), 0.3), x, Axis((0.9,), 0.3), Axis((1.7,), 0.3)), Bank(1, 1, 1.0))


WIDE = Camera(width=640, height=480, focal_length_m=0.0024, pixel_pitch_m=15e-6)
"""160 px of focal length: sees 4 m to either side."""
STEEP = scene_of(WIDE, Marking("under", 0.0005, 0.0, 0.3), Marking("near", -0.01, 0.0, 0.3), x=Axis((0.0,), 0.05))
GENTLE = scene_of(WIDE, Marking("left", -3.0, 0.0, 0.3), Marking("right", 2.5, 0.1, 0.2), x=Axis((0.0,), 0.5))
MIXED = scene_of(
    WIDE, Marking("diagonal", 0.9, 0.0, 1.0), Marking("shallow", -1.8, 0.0, 0.7), Marking("dash", 0.3, 0.2, 0.001), x=Axis((0.0,), 0.5)
)


def test_the_papers_images_are_the_twins(paper_scene: Scene) -> None:
    results = [compare(paper_scene, *state) for state in rational_states(paper_scene, 40, 31)]
    assert min(lit for lit, _ in results) > 40
    assert sum(ties for _, ties in results) == 0


@pytest.mark.parametrize(("scene", "seed"), [(STEEP, 32), (GENTLE, 33), (MIXED, 34)], ids=["steep", "gentle", "mixed"])
def test_lines_of_all_directions_are_the_twins(scene: Scene, seed: int) -> None:
    results = [compare(scene, *state) for state in rational_states(scene, 15, seed)]
    assert min(lit for lit, _ in results) > 5
    assert sum(ties for _, ties in results) == 0


def test_gentle_lines_run_along_their_rows(random_states: RandomStates) -> None:
    """Where |p_x - x| > y a line passes more than one column a row; three here, so rows of four and five pixels are met."""
    first, last = lit_columns(GENTLE, random_states(GENTLE, 50, 35))
    assert (last - first).max() >= 3


BORDERS = {"left": (11.0, 240.0), "right": (625.0, 240.0), "top": (320.0, 40.0), "bottom": (320.0, 530.0), "corner": (10.5, 520.0)}


@pytest.mark.parametrize("border", BORDERS)
def test_what_leaves_the_frame_is_cut_at_its_border(border: str, paper_scene: Scene) -> None:
    """The principal point is moved so that every border of the frame cuts markings; the twin's frame is cut by its loop alone."""
    scene = dataclasses.replace(paper_scene, camera=dataclasses.replace(paper_scene.camera, principal_point=BORDERS[border]))
    cut_states, ties = 0, 0
    for state in rational_states(scene, 60, 36):
        lit, near = compare(scene, *state)
        ends = project(scene, [2 * math.atan(state[0]), *state[1:]])
        outside = (ends < 0) | (ends >= [scene.camera.width, scene.camera.height])
        cut_states += lit > 0 and bool(outside.any())
        ties += near
    assert cut_states >= 10
    assert ties == 0


def test_a_runway_outside_the_frame_lights_nothing(paper_scene: Scene, random_states: RandomStates) -> None:
    states = random_states(paper_scene, 20, 37)
    for centre in ((-200.0, 240.0), (900.0, 240.0), (320.0, -900.0), (320.0, 1500.0)):
        scene = dataclasses.replace(paper_scene, camera=dataclasses.replace(paper_scene.camera, principal_point=centre))
        assert runway_image(scene, states).sum() == 0


# --- exact ties: level flight over dyadic points, where float64 makes no error and no difference is excused ---


@st.composite
def tied_scenes(draw: st.DrawFn) -> tuple[Scene, list[float]]:
    """Level flight with F = 64 px over markings between dyadic distances: most ends and many crossings lie on pixel corners."""
    centre = (draw(st.integers(-8, 96)) / 2, draw(st.integers(-40, 40)) / 2)
    markings = []
    for name in "abc"[: draw(st.integers(1, 3))]:
        near, far = sorted(draw(st.lists(st.sampled_from([1.0, 2.0, 4.0, 8.0]), min_size=2, max_size=2, unique=True)))
        markings.append(Marking(name, draw(st.integers(-64, 64)) / 64, near - 1, far - near))
    altitude, x = draw(st.sampled_from([0.25, 0.5, 1.0])), draw(st.sampled_from([0.0, 0.125, -0.0625]))
    camera = Camera(width=48, height=40, focal_length_m=1.0, pixel_pitch_m=2.0**-6, principal_point=centre)
    domain = Domain(Axis((0.0,), 0.0), Axis((x,), 0.0), Axis((altitude,), 0.0), Axis((1.0,), 0.0))
    return Scene(camera, Runway(tuple(markings)), domain, Bank(1, 1, 1.0)), [0.0, x, altitude, 1.0]


@given(tied_scenes())
def test_ties_are_decided_exactly(case: tuple[Scene, list[float]]) -> None:
    scene, state = case
    _, x, y, z = (Fraction(value) for value in state)
    segments = exact_ends(scene, Fraction(0), x, y, z)
    assert [[[Fraction(value) for value in end] for end in ends] for ends in project(scene, state).tolist()] == [
        [list(end) for end in segment] for segment in segments
    ]
    assert (runway_image(scene, state) == twin_image(scene, segments)).all()


def test_an_end_on_a_pixels_corner_lights_that_pixel_whatever_the_slope() -> None:
    """The near end lies on an integer column and row; the far end and the slope are rounded, left of the frame by up to 190 px."""
    camera = Camera(width=512, height=256, focal_length_m=1.0, pixel_pitch_m=2.0**-6, principal_point=(-192.0, 64.0))
    for across, far in itertools.product(range(192, 292), (3.0, 5.0, 6.0, 7.0, 11.0, 13.0)):
        scene = scene_of(camera, Marking("a", across / 64, 0.0, far - 1))
        assert runway_image(scene, [0.0, 0.0, 1.0, 1.0])[128, across - 192] == 1


def test_a_marking_straight_ahead_lies_on_one_column_and_belongs_to_the_pixels_on_its_right() -> None:
    """x = p_x projects to u = u0 exactly; with u0 = 320 that is the border of columns 319 and 320."""
    scene = scene_of(Camera(640, 480, 0.008, 15e-6), Marking("centre line", 0.0, 0.0, 0.3))
    frame = runway_image(scene, [0.6, 0.0, 0.9, 1.7])
    (_, v_near), (_, v_far) = project(scene, [0.6, 0.0, 0.9, 1.7])[0]
    expected = np.zeros_like(frame)
    expected[math.floor(v_far) : math.floor(v_near) + 1, 320] = 1
    assert (frame == expected).all()


# --- properties ---


def test_the_image_is_symmetric_where_the_scene_is(paper_scene: Scene, random_states: RandomStates) -> None:
    """x = 0, p_x = -0.1 and 0.1, u0 = a/2: generic states light mirrored pixels."""
    frames = runway_image(paper_scene, random_states(paper_scene, 200, 38))
    assert (frames == frames[:, :, ::-1]).all()


def test_markings_are_joined_by_or(random_states: RandomStates) -> None:
    states = random_states(MIXED, 20, 39)
    alone = [runway_image(dataclasses.replace(MIXED, runway=Runway((marking,))), states) for marking in MIXED.runway.markings]
    assert (runway_image(MIXED, states) == np.bitwise_or.reduce(alone)).all()


def test_both_ends_and_the_middle_of_each_marking_are_lit(paper_scene: Scene, random_states: RandomStates) -> None:
    """A point of the marking falls into a lit pixel by the floor of Eq. (2). No tolerance: the ends are those of `project`."""
    for scene in (paper_scene, GENTLE, MIXED):
        states = random_states(scene, 300, 40)
        ends = project(scene, states)
        points = np.concatenate([ends, ends.mean(axis=-2, keepdims=True)], axis=-2)
        column, row = np.moveaxis(np.floor(points).astype(int), -1, 0)
        assert runway_image(scene, states)[np.arange(300)[:, None, None], row, column].all()


def test_states_of_any_shape_give_frames_of_that_shape(paper_scene: Scene, random_states: RandomStates) -> None:
    states = random_states(paper_scene, 6, 41)
    frames = runway_image(paper_scene, states)
    assert frames.dtype == np.uint8
    assert frames.shape == (6, 480, 640)
    assert (runway_image(paper_scene, states.reshape(2, 3, 4)) == frames.reshape(2, 3, 480, 640)).all()
    assert (runway_image(paper_scene, states[4]) == frames[4]).all()
