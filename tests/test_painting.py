"""Frames of a sensor painted onto the ideal frame: nothing of the runway is lost, and not much else is lit."""

from __future__ import annotations

import math
from dataclasses import replace
from fractions import Fraction

import mpmath
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scenes import AIRPORT, PAPER, STRIP, THREE_MARKINGS, examples
from test_lens import FISHEYE, WIDE, lenses
from test_sensor_map import OFF, precise_sensor, seen_through, turns

from runtime.camera import project
from runtime.image import runway_image
from runtime.outline import Outline
from runtime.painting import Painted, Painting, View, ideal_pixels_a_pixel, what_pixels_show
from runtime.scene import Calibration, Camera, Distortion, Scene, SceneError
from runtime.sensor import Sensor
from runtime.sensor_map import SensorMap

Bits = NDArray[np.bool_]
Turned = tuple[tuple[float, float], tuple[float, float]]
SMALL = replace(PAPER, camera=replace(PAPER.camera, width=160, height=120, pixel_pitch_m=60e-6))
SENSORS = {
    name: Sensor.of(seen_through(scene, lens, off))
    for name, scene, lens, off in (
        ("paper", PAPER, WIDE, None),
        ("paper, calibration", PAPER, WIDE, OFF),
        ("three markings", THREE_MARKINGS, WIDE, None),
        ("strip", STRIP, FISHEYE, None),
        ("airport", AIRPORT, WIDE, None),
    )
}
BY_NAME = pytest.mark.parametrize("name", SENSORS)


@pytest.fixture(autouse=True)
def _digits() -> None:
    mpmath.mp.dps = 30


def runway_points(scene: Scene, sensor: SensorMap, state: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Points of the markings, (n, 2) px of the ideal frame, those that are in it."""
    ends = project(replace(scene, camera=sensor.ideal), state)
    points = ends[:, :1] + np.linspace(0, 1, count)[:, None] * (ends[:, 1:] - ends[:, :1])
    points = points.reshape(-1, 2)
    return points[((points >= 0) & (points < [sensor.ideal.width, sensor.ideal.height])).all(axis=1)]


# --- nothing is lost ---


@examples(60)
@given(
    data=st.data(),
    distortion=lenses(),
    turn=st.one_of(st.none(), turns(0.02)),
    shares=st.lists(st.floats(0, 1), min_size=4, max_size=4),
    off=st.sampled_from([Calibration(), OFF]),
)
def test_no_pixel_of_the_runway_is_lost(
    data: st.DataObject, distortion: object, turn: Turned | None, shares: list[float], off: Calibration
) -> None:
    """Any lens, rotation of the interval and calibration of the plus-minus: where each point's own pixel of the sensor is lit, the ideal
    pixel that the point lies in is painted. Where the sensor shows the point is told in 30 digits."""
    scene = seen_through(SMALL, distortion, off)  # pyright: ignore[reportArgumentType]
    try:
        sensor = SensorMap.of(scene)
    except SceneError:
        assume(False)
        raise
    moved, zoom = data.draw(st.floats(-1, 1)) * off.principal_px, data.draw(st.floats(-1, 1)) * off.focal_relative
    a = b = 0.0
    if turn is not None:
        sensor = sensor.turned(turn)
        a, b = (float(np.clip(low + data.draw(st.floats(0, 1)) * (high - low), low, high)) for low, high in turn)
    elif sensor.turn is not None:
        a, b = (data.draw(st.floats(-1, 1)) * side for side in (off.roll_rad, off.yaw_rad))
    state = scene.domain.lower + np.array(shares) * (scene.domain.upper - scene.domain.lower)
    points = runway_points(scene, sensor, state, 25)
    frame, met = np.zeros(scene.camera.shape, dtype=bool), []
    for point in points:
        column, row = (int(mpmath.floor(side)) for side in precise_sensor(sensor, point, a, b, zoom, moved))
        if 0 <= row < frame.shape[0] and 0 <= column < frame.shape[1]:
            frame[row, column] = True
            met.append(point)
        else:
            assert not View.of(sensor).shown[int(point[1]), int(point[0])]
    canvas = Painted.of(frame, sensor, Outline.of(sensor)).ideal
    for u, v in points:
        assert canvas[int(v), int(u)], (u, v)
    if sensor.turn is None or turn is None:
        assert (Painting.of(sensor).painted(frame) == canvas).all()


@BY_NAME
def test_no_more_pixels_are_lost_than_are_counted(name: str) -> None:
    """One dark pixel of the sensor's image at a time: of the ideal image no more than c pixels stay dark."""
    sensor, rng = SENSORS[name], np.random.default_rng(4)
    scene = sensor.scene
    worst = 0
    for state in rng.uniform(scene.domain.lower, scene.domain.upper, (6, 4)):
        image, ideal = runway_image(scene, state), runway_image(sensor.ideal, state)
        assert not (ideal > sensor.painted(image)).any()
        rows, columns = np.nonzero(image)
        for place in rng.permutation(len(rows))[:40]:
            frame = image.copy()
            frame[rows[place], columns[place]] = 0
            worst = max(worst, int((ideal > sensor.painted(frame)).sum()))
    assert (0 if "calibration" in name else 1) <= worst <= sensor.pixels_a_pixel <= 10


# --- not much else is lit ---


@BY_NAME
@pytest.mark.parametrize("turn", [None, ((0.05, 0.05), (-0.06, -0.06)), ((0.02, 0.03), (-0.01, 0.01))], ids=["still", "turned", "interval"])
def test_what_a_pixel_paints_is_what_meets_its_quadrilateral(name: str, turn: Turned | None) -> None:
    """Beside clipping the quadrilateral to each ideal pixel in fractions: painted where anything is left, and where a hair more would
    leave something; nothing else, for a rotation that is known."""
    still = SENSORS[name].map
    assert still is not None
    sensor = still if turn is None else still.turned(turn)
    rows, columns = np.random.default_rng(8).integers(0, sensor.camera.shape, (60, 2)).T
    shown = what_pixels_show(sensor, rows, columns)
    table, everything = shown.table(sensor.ideal.height * sensor.ideal.width), shown.everything
    assert not everything.any()
    height, width = sensor.ideal.shape
    slack = 2 * (sensor.bow_px + 1e-5)
    exact = turn is None or turn[0][0] == turn[0][1]
    for row, column, found in zip(rows, columns, table, strict=True):
        around = [(row, column), (row, column + 1), (row + 1, column + 1), (row + 1, column)]
        (u_low, u_high), (v_low, v_high) = sensor.corners(*np.array(around).T)
        slack_here = slack + max(float((u_high - u_low).max()), float((v_high - v_low).max()))
        middle = list(zip(((u_low + u_high) / 2).tolist(), ((v_low + v_high) / 2).tolist(), strict=True))
        low, high = np.floor(np.min(middle, axis=0) - 2).astype(int), np.floor(np.max(middle, axis=0) + 2).astype(int)
        for v in range(max(low[1], 0), min(high[1], height - 1) + 1):
            for u in range(max(low[0], 0), min(high[0], width - 1) + 1):
                is_painted = v * width + u in found
                if meets(middle, u, v, 0.0):
                    assert is_painted
                elif is_painted and exact:
                    assert meets(middle, u, v, slack_here)


def meets(corners: list[tuple[float, float]], u: int, v: int, slack: float) -> bool:
    """Is something left of a quadrilateral that is clipped to a pixel, widened by `slack`? In fractions, after Sutherland and Hodgman."""
    points = [(Fraction(x), Fraction(y)) for x, y in corners]
    wide = Fraction(slack)
    for axis, limit, sign in ((0, u - wide, 1), (0, u + 1 + wide, -1), (1, v - wide, 1), (1, v + 1 + wide, -1)):
        kept = []
        for start, stop in zip(points, [*points[1:], *points[:1]], strict=True):
            inside, follows = sign * (start[axis] - limit) >= 0, sign * (stop[axis] - limit) >= 0
            if inside:
                kept.append(start)
            if inside != follows:
                share = (limit - start[axis]) / (stop[axis] - start[axis])
                kept.append((start[0] + share * (stop[0] - start[0]), start[1] + share * (stop[1] - start[1])))
        points = kept
    return bool(points)


@BY_NAME
def test_a_lit_pixel_paints_about_four(name: str) -> None:
    """A pixel that lies across a grid like its own meets 4 of it; a plus-minus of the calibration adds what it moves a corner by."""
    painting = SENSORS[name].painting
    assert painting is not None
    counts = (painting.table < len(painting.unseen)).sum(axis=1)
    assert 3.5 < counts.mean() < (20 if "calibration" in name else 4.5)
    assert SENSORS[name].pixels_a_pixel <= (9 if "calibration" in name else 5)


@BY_NAME
def test_only_the_border_of_what_the_sensor_shows_is_taken_for_lit(name: str) -> None:
    """An ideal pixel counts as not shown only if the sensor shows a point out of its frame within a few pixels of it."""
    sensor = SENSORS[name].map
    assert sensor is not None
    shown = View.of(sensor).shown
    rows, columns = np.nonzero(~shown)
    points = np.stack([columns + 0.5, rows + 0.5], axis=-1)
    near = np.stack([sensor.project(points + offset) for offset in [(a, b) for a in (-2, 0, 2) for b in (-2, 0, 2)]])
    out = ((near < 0) | (near > [sensor.camera.width, sensor.camera.height])).any(axis=2).any(axis=0)
    assert out.all()


def test_a_fisheye_of_more_than_a_half_space_paints_no_more() -> None:
    """Its frame's corners show what lies behind the camera; of the ideal frame, near the axis, pixels paint about four as ever."""
    camera = Camera(640, 480, focal_px=(200.0, 200.0), distortion=Distortion("fisheye", (0.0, 0.0, 0.0, 0.0)))
    sensor = Sensor.of(replace(PAPER, camera=camera))
    assert sensor.painting is not None
    assert not sensor.painting.unseen.any()
    assert not sensor.painting.everything.any()
    assert sensor.pixels_a_pixel <= 5
    for state in np.random.default_rng(6).uniform(PAPER.domain.lower, PAPER.domain.upper, (5, 4)):
        canvas = sensor.painted(runway_image(sensor.scene, state))
        assert not (runway_image(sensor.ideal, state) > canvas).any()
        assert canvas.sum() < 8 * runway_image(sensor.scene, state).sum()


# --- the sensor ---


def test_a_pinhole_paints_nothing() -> None:
    sensor, frame = Sensor.of(PAPER), np.zeros(PAPER.camera.shape, dtype=np.uint8)
    assert sensor.ideal is PAPER
    assert sensor.painted(frame) is frame
    assert sensor.pixels_a_pixel == 1


def test_pixels_that_fire_beside_their_place_are_looked_for_on_the_sensor() -> None:
    scene = seen_through(PAPER, WIDE)
    sensor = Sensor.of(replace(scene, tolerance=replace(scene.tolerance, line_px=1)))
    assert sensor.ideal.tolerance.line_px == 0
    state = (scene.domain.lower + scene.domain.upper) / 2
    beside = np.roll(runway_image(scene, state), (1, -1), axis=(0, 1))
    assert not (runway_image(sensor.ideal, state) > sensor.painted(beside)).any()


def test_budgets_of_the_ideal_frame() -> None:
    scene = seen_through(PAPER, WIDE)
    sensor = Sensor.of(replace(scene, tolerance=replace(scene.tolerance, missed_budget=2)))
    assert sensor.ideal.tolerance.missed_budget == 2 * sensor.pixels_a_pixel
    for change, message in (
        ({"extra_budget": 3}, "tolerance.extra_budget: found 3; behind a lens"),
        ({"missed_budget": 60000}, "give fewer"),
    ):
        with pytest.raises(SceneError, match=message):
            Sensor.of(replace(scene, tolerance=replace(scene.tolerance, **change)))


def test_lines_are_counted_by_how_close_they_come() -> None:
    """Markings a millimetre apart may all meet one pixel; those of the paper, 0.2 m apart, may not."""
    scene = seen_through(PAPER, WIDE)
    markings = scene.runway.markings
    close = replace(scene.runway, markings=(*markings, replace(markings[0], name="beside", x_m=markings[0].x_m + 1e-3)))
    sensor = SensorMap.of(scene)
    painting = Painting.of(sensor)
    alone = ideal_pixels_a_pixel(scene, sensor, painting)
    assert ideal_pixels_a_pixel(replace(scene, runway=close), sensor, painting) == 2 * alone
    assert math.isfinite(alone)
