"""What `verify-model` proves of a lens's tables: true ones are proved, and one that is wrong in one place by a hair is refuted there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from flint import arb, ctx
from scenes import ONE_CELL, PAPER
from test_lens import FISHEYE, WIDE
from test_optics import BARREL, OFF

from build_model.verify.ball_lens import BallLens
from build_model.verify.counterexample import Refuted
from build_model.verify.lens_proof import UnfoldedDisc, check_rays
from build_model.verify.painting_proof import check_painting
from runtime.lens import Lens
from runtime.refine.optics import Optics
from runtime.scene import Axis, Calibration, Camera, Distortion, Domain, Marking, Runway
from runtime.sensor import Sensor

SMALL = replace(
    PAPER,
    camera=Camera(96, 72, focal_px=(103.0, 100.0), principal_point=(51.0, 33.0), distortion=BARREL),
    runway=Runway((Marking("L", -2.0, 0.0, 12.0), Marking("R", 2.0, 0.0, 12.0))),
    domain=ONE_CELL.domain,
)
STRIPES = replace(SMALL, runway=Runway(tuple(Marking(f"m{number}", 0.1 * number - 1, 0.0, 12.0) for number in range(20))))
SCENES = {
    "barrel": SMALL,
    "fisheye": replace(SMALL, camera=replace(SMALL.camera, distortion=FISHEYE)),
    "off": replace(SMALL, calibration=OFF),
    "fisheye off": replace(SMALL, camera=replace(SMALL.camera, distortion=FISHEYE), calibration=OFF),
    "stripes": STRIPES,
    "cut": replace(SMALL, camera=replace(SMALL.camera, principal_point=(5.0, 70.0))),
}


@pytest.fixture(scope="module", params=SCENES)
def sensor(request: pytest.FixtureRequest) -> Sensor:
    return Sensor.of(SCENES[request.param])


def painted(sensor: Sensor, **changes: object) -> int:
    """What `check_painting` says of the sensor's painting, or of one that is changed."""
    count = changes.pop("count", sensor.pixels_a_pixel)
    assert isinstance(count, int)
    assert sensor.painting is not None
    assert sensor.map is not None
    return check_painting(sensor.scene, sensor.ideal.camera, replace(sensor.painting, **changes), count, sensor.map.rays)  # pyright: ignore[reportArgumentType]


def test_the_tables_of_a_lens_are_proved(sensor: Sensor) -> None:
    assert sensor.map is not None
    assert sensor.painting is not None
    camera = sensor.scene.camera
    assert check_rays(camera, sensor.scene.calibration, sensor.map.rays) == np.isfinite(sensor.map.rays[2]).sum() > 0
    for part in Optics.parts_of(sensor.scene):
        s, t, away = (side.reshape(sensor.map.rays[0].shape) for side in part.corners)
        assert check_rays(part.camera, Calibration(), (s, t, away)) > 0
    assert painted(sensor) == (~sensor.painting.unseen).sum() > 0


@pytest.mark.parametrize("change", [lambda s, away: (s + 2.5 * away, away), lambda s, away: (s, away * 0.4)], ids=["moved", "too near"])
def test_a_corner_whose_ray_is_elsewhere_is_refuted(sensor: Sensor, change: Callable[..., tuple[np.ndarray, np.ndarray]]) -> None:
    """By two and a half times what it may be off by; a bound of two fifths is too narrow where a plus-minus is most of it."""
    assert sensor.map is not None
    s, t, away = (side.copy() for side in sensor.map.rays)
    places = np.argwhere(np.isfinite(away))
    row, column = places[len(places) // 3].tolist()
    s[row, column], away[row, column] = change(s[row, column], away[row, column])
    if sensor.scene.calibration.exact and away[row, column] < sensor.map.rays[2][row, column]:
        away[row, column] = 0.0  # all of it is rounding, of which float64 needs less
        s[row, column] += 1e-12
    with pytest.raises(Refuted, match=rf"the ray of a corner .* pixel \(row {row}, column {column}\)"):
        check_rays(sensor.scene.camera, sensor.scene.calibration, (s, t, away))


def test_a_pixel_that_is_not_painted_is_refuted(sensor: Sensor) -> None:
    """One that the sensor certainly shows, by a pixel in whose middle it is."""
    painting, width = sensor.painting, sensor.ideal.camera.width
    assert painting is not None
    assert sensor.map is not None
    seen = np.flatnonzero(~painting.unseen)
    ideal = int(seen[len(seen) // 2])
    column, row = np.floor(sensor.map.project(np.array([ideal % width + 0.5, ideal // width + 0.5]))).astype(int)
    place = (row - painting.window[0].start) * (painting.window[1].stop - painting.window[1].start) + column - painting.window[1].start
    table = painting.table.copy()
    assert ideal in table[place]
    table[place][table[place] == ideal] = len(painting.unseen)
    with pytest.raises(Refuted, match=rf"not proved to cover .* pixel \(row {ideal // width}, column {ideal % width}\)"):
        painted(sensor, table=table)


def test_a_pixel_that_the_sensor_does_not_show_must_be_lit() -> None:
    sensor = Sensor.of(SCENES["cut"])
    assert sensor.painting is not None
    assert sensor.painting.unseen.any()
    unseen = sensor.painting.unseen.copy()
    unseen[np.flatnonzero(unseen)[0]] = False
    with pytest.raises(Refuted, match="not proved to cover"):
        painted(sensor, unseen=unseen)


def test_a_missed_pixel_takes_no_fewer_with_it(sensor: Sensor) -> None:
    """Of a line of which a pixel shows a stretch as long as the pixel two columns or two rows can be met: three pixels at least."""
    lines = 2 if sensor.scene is not STRIPES else 20
    assert painted(sensor, count=sensor.pixels_a_pixel) > 0
    with pytest.raises(Refuted, match="ideal_pixels_a_pixel is 2, and no more than"):
        painted(sensor, count=2)
    assert sensor.pixels_a_pixel <= 5 * lines


@pytest.mark.parametrize("distortion", [BARREL, WIDE, FISHEYE, Distortion("radial-tangential", (0.2, 0.0, -0.001, 0.001, 0.01))])
def test_the_verifiers_lens_is_the_runtimes(distortion: Distortion) -> None:
    """Two of one lens, written apart: D, its Jacobian, and bounds of which the verifier's are no looser than a hundredth."""
    ours, theirs = BallLens.of(distortion), Lens.of(distortion, 0.5)
    disc = UnfoldedDisc.of(Camera(100, 100, focal_px=(100 / 0.7, 100 / 0.7), distortion=distortion), Calibration())
    rng = np.random.default_rng(1)
    with ctx.workprec(64):
        for x, y in [(0.0, 0.0), (1e-5, -1e-5), *rng.uniform(-0.3, 0.3, (30, 2)).tolist()]:
            place, jacobian = ours.shown(arb(x), arb(y))
            (shown_x, shown_y), entries = theirs.distorted_and_jacobian(np.array(x), np.array(y))
            for ball, number in zip((*place, *jacobian), (shown_x, shown_y, *entries), strict=True):
                assert abs(float(ball.mid()) - float(number)) < 1e-9
                assert float(ball.rad()) < 1e-9
        bend, stretch = disc.bend_up_to(theirs.radius), disc.stretch_up_to(theirs.radius)
        assert bend is not None
        assert stretch is not None
        assert abs(float(bend.mid()) / theirs.largest_bend - 1) < 0.02
        assert abs(float(stretch.mid()) / theirs.stretch - 1) < 0.01


def test_a_pixel_that_paints_everything_may_take_much_with_it() -> None:
    """A fisheye lens of more than 80 degrees, the runway in view up to there: what its last pixels show has no bound but the disc's."""
    scene = replace(
        SMALL,
        camera=Camera(37, 1029, focal_px=(61.7, 59.8), principal_point=(12.6, 447.6), distortion=FISHEYE),
        calibration=Calibration(roll_rad=0.0006, yaw_rad=0.0005, focal_relative=0.0006, principal_px=0.5),
        domain=Domain(Axis((0.0,), 0.02), Axis((0.0,), 0.05), Axis((4.0,), 0.1), Axis((0.6,), 0.1)),
    )
    sensor = Sensor.of(scene)
    assert sensor.painting is not None
    assert sensor.painting.everything.any()
    assert sensor.pixels_a_pixel > 100
    assert painted(sensor) > 0
    with pytest.raises(Refuted, match="ideal_pixels_a_pixel is 20, and no more than"):
        painted(sensor, count=20)
