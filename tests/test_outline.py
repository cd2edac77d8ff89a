"""What a sensor shows of windows, by rays of its border and of tiles: against blocks, pixels and quadrilaterals, one by one."""

from __future__ import annotations

import numpy as np
import pytest
from scenes import AIRPORT, PAPER, STRIP
from test_lens import FISHEYE, WIDE
from test_sensor_map import OFF, seen_through

from runtime.outline import TILE_PX, Outline, Window
from runtime.painting import Painted, View, what_pixels_show
from runtime.sensor_map import SensorMap

SENSORS = {
    name: SensorMap.of(scene)
    for name, scene in (
        ("paper", PAPER),
        ("airport", AIRPORT),
        ("paper, wide", seen_through(PAPER, WIDE, None)),
        ("paper, wide, off", seen_through(PAPER, WIDE, OFF)),
        ("strip, fisheye", seen_through(STRIP, FISHEYE, None)),
    )
}
BY_NAME = pytest.mark.parametrize("name", SENSORS)


def drawn(name: str, rng: np.random.Generator) -> tuple[SensorMap, Window]:
    """The sensor turned by up to 10 degrees, known exactly or not, and a window of the ideal frame; some are all of it."""
    sensor, half = SENSORS[name], float(rng.choice([1e-13, 0.002]))
    a, b = rng.uniform(-0.17, 0.17, 2).tolist()
    sides = [np.sort(rng.integers(0, size + 1, 2)).tolist() if rng.random() < 0.8 else [0, size] for size in sensor.ideal.shape]
    rows, columns = (slice(low, max(high, low + 1) + int(rng.integers(0, 3))) for low, high in sides)
    return sensor.turned(((a - half, a + half), (b - half, b + half))), (rows, columns)


@BY_NAME
def test_what_is_shown_of_a_window_is_what_blocks_and_pixels_tell(name: str) -> None:
    """A window that the sensor shows all of is told so, if it is not near the border; and never another one."""
    rng, outline, whole = np.random.default_rng(1), Outline.of(SENSORS[name]), 0
    for _ in range(60):
        sensor, window = drawn(name, rng)
        alone, told = View.of(sensor), outline.seen(sensor, window)
        shown = alone.shown[window]
        assert not told[1] or shown.all()
        view = View.of(sensor, outline, window)
        assert (view.shown == shown).all()
        whole += told[1]
        grown = tuple(slice(max(side.start - 8, 0), side.stop + 8) for side in window)
        inside = all(side.start >= 8 and side.stop + 8 <= size for side, size in zip(window, sensor.ideal.shape, strict=True))
        if inside and min(shown.shape) > 40 and alone.shown[grown].all():
            assert told[1]
    assert whole > 5


@BY_NAME
def test_no_pixel_that_shows_some_of_a_window_is_left_out(name: str) -> None:
    """What is painted of a window is what is painted of it with all of the ideal frame, to the last pixel."""
    rng, outline, fewer = np.random.default_rng(2), Outline.of(SENSORS[name]), 0
    for _ in range(6):
        sensor, window = drawn(name, rng)
        frame = rng.random(sensor.camera.shape) < 0.05
        some, every = Painted.of(frame, sensor, outline, window), Painted.of(frame, sensor, outline)
        assert (some.ideal[window] == every.ideal[window]).all()
        beyond = np.ones(sensor.ideal.shape, dtype=bool)
        beyond[window] = False
        assert some.ideal[beyond].all()
        fewer += len(some.rows) < 0.7 * len(every.rows)
        mask = np.zeros(sensor.ideal.shape, dtype=bool)
        mask[window] = rng.random(mask[window].shape) < 0.1
        assert (some.within(mask, frame.view(np.uint8)) == every.within(mask, frame.view(np.uint8))).all()
    assert fewer > 1


@BY_NAME
def test_tiles_that_show_nothing_beyond_the_ideal_frame_are_told(name: str) -> None:
    rng, outline, told = np.random.default_rng(3), Outline.of(SENSORS[name]), 0
    for _ in range(3):
        sensor, _ = drawn(name, rng)
        within = ~outline.not_within(sensor)
        rows, columns = np.nonzero(within)
        told += len(rows)
        if len(rows) == 0:
            continue
        u, v = sensor.corners(rows + np.array([[0], [0], [1], [1]]), columns + np.array([[0], [1], [1], [0]]))
        assert min(u[0].min(), v[0].min()) >= -1e-9
        assert (u[1] <= sensor.ideal.width + 1e-9).all()
        assert (v[1] <= sensor.ideal.height + 1e-9).all()
    assert told > 20 * TILE_PX**2


def test_a_window_behind_the_sensor_is_not_told_of() -> None:
    """Nothing is left out there, and nothing is taken for shown."""
    sensor = SENSORS["paper"].turned(((0.0, 0.0), (1.5, 1.5)))
    outline = Outline.of(sensor)
    (rows, columns), whole = outline.seen(sensor, (slice(0, 480), slice(0, 640)))
    assert (rows, columns, whole) == (slice(0, 480), slice(0, 640), False)
    assert outline.not_within(sensor).all()
    assert what_pixels_show(sensor, np.array([100]), np.array([100])).everything.shape == (1,)
