"""The map between sensor and ideal frame: against OpenCV, against mpmath's digits, and how tight it is."""

from __future__ import annotations

from dataclasses import replace

import cv2
import mpmath
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scenes import AIRPORT, PAPER, STRIP, examples
from test_lens import FISHEYE, LENSES, WIDE, PreciseLens

from runtime.camera import project
from runtime.scene import Calibration, Camera, Distortion, Scene, SceneError
from runtime.sensor_map import SensorMap, ideal_camera

Floats = NDArray[np.float64]
Turned = tuple[tuple[float, float], tuple[float, float]]


def seen_through(scene: Scene, distortion: Distortion, calibration: Calibration | None = None) -> Scene:
    """The scene with a lens, its pixels not square and its principal point off the centre."""
    camera = scene.camera
    focal_px = camera.focal_u_px * 1.02, camera.focal_v_px * 0.99
    centre = camera.width * 0.53, camera.height * 0.46
    lens = replace(camera, focal_length_m=None, pixel_pitch_m=None, focal_px=focal_px, principal_point=centre, distortion=distortion)
    return replace(scene, camera=lens, calibration=calibration or Calibration())


MAPS = {
    f"{place}, {lens}": SensorMap.of(seen_through(scene, LENSES[lens]))
    for place, scene in (("paper", PAPER), ("strip", STRIP), ("airport", AIRPORT))
    for lens in ("wide", "fisheye")
}
OFF = Calibration(roll_rad=0.001, yaw_rad=0.002, focal_relative=0.001, principal_px=0.3)


@pytest.fixture(autouse=True)
def _digits() -> None:
    mpmath.mp.dps = 30


def precise_sensor(sensor: SensorMap, point: Floats, a: float, b: float, zoom: float = 0.0, moved: float = 0.0) -> list[mpmath.mpf]:
    """(column, row) of a point of the ideal frame, in mpmath."""
    ideal, camera = sensor.ideal, sensor.camera
    x = (mpmath.mpf(float(point[0])) - ideal.u0) / mpmath.mpf(ideal.focal_u_px)
    y = (mpmath.mpf(float(point[1])) - ideal.v0) / mpmath.mpf(ideal.focal_v_px)
    right, down, depth = x * mpmath.cos(b) + mpmath.sin(b), y, mpmath.cos(b) - x * mpmath.sin(b)
    right, down = right * mpmath.cos(a) - down * mpmath.sin(a), right * mpmath.sin(a) + down * mpmath.cos(a)
    shown = PreciseLens(camera.distortion).shown(right / depth, down / depth) if camera.distortion else (right / depth, down / depth)
    focal = [mpmath.mpf(side) * (1 + mpmath.mpf(zoom)) for side in (camera.focal_u_px, camera.focal_v_px)]
    return [centre + moved + side * part for centre, side, part in zip((camera.u0, camera.v0), focal, shown, strict=True)]


def inside(interval: tuple[Floats, Floats], values: list[mpmath.mpf]) -> bool:
    return all(float(low) <= value <= float(high) for low, high, value in zip(*(side.ravel() for side in interval), values, strict=True))


# --- the sensor's frame is OpenCV's ---


@pytest.mark.parametrize("name", MAPS)
def test_markings_are_shown_where_opencv_shows_them(name: str) -> None:
    """cv2.projectPoints, whose pixel centres are at integers: half a pixel less than here."""
    sensor, scene = MAPS[name], {"paper": PAPER, "strip": STRIP, "airport": AIRPORT}[name.split(",")[0]]
    camera, rng = sensor.camera, np.random.default_rng(5)
    matrix = np.array([[camera.focal_u_px, 0, camera.u0 - 0.5], [0, camera.focal_v_px, camera.v0 - 0.5], [0, 0, 1]])
    assert camera.distortion is not None
    coefficients = np.array(camera.distortion.coefficients)
    for theta, x, y, z in rng.uniform(scene.domain.lower, scene.domain.upper, (20, 4)):
        turn = np.array([theta, 0.0, 0.0])
        shift = -cv2.Rodrigues(turn)[0] @ np.array([x, -y, -z])
        points = np.array([[[marking.x_m, 0.0, end]] for marking in scene.runway.markings for end in marking.ends_z_m])
        if camera.distortion.model == "fisheye":
            expected = cv2.fisheye.projectPoints(points, turn, shift, matrix, coefficients)[0]
        else:
            expected = cv2.projectPoints(points, turn, shift, matrix, coefficients)[0]
        ends = project(replace(scene, camera=sensor.ideal), [theta, x, y, z])
        assert np.abs(sensor.project(ends).reshape(-1, 2) - 0.5 - np.asarray(expected).reshape(-1, 2)).max() < 1e-9


@pytest.mark.parametrize("k1", [-0.4, -0.28, -0.1, 0.0, 0.1, 0.2])
def test_corners_are_where_opencv_undistorts_them(k1: float) -> None:
    """cv2.undistortPoints, iterated until it stands: to 0.001 px, and the intervals far narrower than that."""
    scene = seen_through(PAPER, Distortion("radial-tangential", (k1, k1**2, 0.001, -0.001, 0.0)))
    sensor, camera = SensorMap.of(scene), scene.camera
    rows, columns = (side.ravel() for side in np.meshgrid(np.arange(0, 481, 40), np.arange(0, 641, 40), indexing="ij"))
    matrix = np.array([[camera.focal_u_px, 0, camera.u0 - 0.5], [0, camera.focal_v_px, camera.v0 - 0.5], [0, 0, 1]])
    ideal = sensor.ideal
    back = np.array([[ideal.focal_u_px, 0, ideal.u0 - 0.5], [0, ideal.focal_v_px, ideal.v0 - 0.5], [0, 0, 1]])
    points = np.stack([columns, rows], axis=-1)[:, None] - 0.5
    assert camera.distortion is not None
    iterated = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)  # OpenCV 4 has it under a name of its own
    found = iterated(points, matrix, np.array(camera.distortion.coefficients), R=None, P=back, criteria=(3, 500, 1e-15))
    for interval, expected in zip(sensor.corners(rows, columns), np.asarray(found).reshape(-1, 2).T + 0.5, strict=True):
        assert np.abs((interval[0] + interval[1]) / 2 - expected).max() < 0.001
        assert (interval[1] - interval[0]).max() < 1e-8


def test_corners_of_a_fisheye_are_where_opencv_undistorts_them() -> None:
    sensor = SensorMap.of(seen_through(STRIP, FISHEYE))
    camera, ideal = sensor.camera, sensor.ideal
    rows, columns = (side.ravel() for side in np.meshgrid(np.arange(0, 261, 20), np.arange(0, 347, 30), indexing="ij"))
    matrix = np.array([[camera.focal_u_px, 0, camera.u0 - 0.5], [0, camera.focal_v_px, camera.v0 - 0.5], [0, 0, 1]])
    back = np.array([[ideal.focal_u_px, 0, ideal.u0 - 0.5], [0, ideal.focal_v_px, ideal.v0 - 0.5], [0, 0, 1]])
    points = np.stack([columns, rows], axis=-1)[:, None] - 0.5
    found = np.asarray(cv2.fisheye.undistortPoints(points, matrix, np.array(FISHEYE.coefficients), P=back)).reshape(-1, 2) + 0.5
    for interval, expected in zip(sensor.corners(rows, columns), found.T, strict=True):
        assert np.abs((interval[0] + interval[1]) / 2 - expected).max() < 0.001


# --- containment ---


def turns(largest: float) -> st.SearchStrategy[Turned]:
    angle = st.tuples(st.floats(-0.3, 0.3), st.sampled_from([0.0, 1e-4, 0.01, largest])).map(lambda one: (one[0] - one[1], one[0] + one[1]))
    return st.tuples(angle, angle)


def drawn(data: st.DataObject, interval: tuple[float, float]) -> float:
    return float(np.clip(interval[0] + data.draw(st.floats(0, 1)) * (interval[1] - interval[0]), *interval))


@pytest.mark.parametrize("name", ["paper, wide", "strip, fisheye", "airport, wide"])
@examples(60)
@given(data=st.data(), turn=turns(0.05), shares=st.lists(st.floats(0, 1), min_size=4, max_size=4), size=st.sampled_from([0.0, 1.0, 20.0]))
def test_boxes_of_the_ideal_frame_are_shown_within_what_is_said(
    name: str, data: st.DataObject, turn: Turned, shares: list[float], size: float
) -> None:
    sensor = MAPS[name].turned(turn)
    low = np.array([shares[0] * sensor.ideal.width, shares[1] * sensor.ideal.height])
    point = np.clip(low + size * np.array(shares[2:]), low, low + size)
    column, row = sensor.to_sensor((low[:1], low[:1] + size), (low[1:], low[1:] + size))
    assume(np.isfinite([*column, *row]).all())
    exact = precise_sensor(sensor, point, drawn(data, turn[0]), drawn(data, turn[1]))
    assert inside(column, exact[:1])
    assert inside(row, exact[1:])


@pytest.mark.parametrize("name", ["paper, wide", "strip, fisheye", "airport, fisheye"])
@examples(60)
@given(data=st.data(), turn=turns(0.05), column=st.integers(0, 346), row=st.integers(0, 260))
def test_corners_hold_what_a_rotation_shows_there(name: str, data: st.DataObject, turn: Turned, column: int, row: int) -> None:
    """The point of the ideal frame that is shown at the corner, by Newton's steps in 30 digits from the middle of what is said."""
    sensor = MAPS[name].turned(turn)
    a, b = drawn(data, turn[0]), drawn(data, turn[1])
    u, v = sensor.corners(np.array([row]), np.array([column]))
    assume(np.isfinite([*u, *v]).all())
    start = [float(u[0][0] + u[1][0]) / 2, float(v[0][0] + v[1][0]) / 2]

    def missed(x: mpmath.mpf, y: mpmath.mpf) -> list[mpmath.mpf]:
        ideal = sensor.ideal
        tangents = (x - ideal.u0) / mpmath.mpf(ideal.focal_u_px), (y - ideal.v0) / mpmath.mpf(ideal.focal_v_px)
        right, down, depth = tangents[0] * mpmath.cos(b) + mpmath.sin(b), tangents[1], mpmath.cos(b) - tangents[0] * mpmath.sin(b)
        right, down = right * mpmath.cos(a) - down * mpmath.sin(a), right * mpmath.sin(a) + down * mpmath.cos(a)
        assert sensor.camera.distortion is not None
        shown = PreciseLens(sensor.camera.distortion).shown(right / depth, down / depth)
        camera = sensor.camera
        return [camera.u0 + mpmath.mpf(camera.focal_u_px) * shown[0] - column, camera.v0 + mpmath.mpf(camera.focal_v_px) * shown[1] - row]

    found = mpmath.findroot(missed, start, tol=1e-40)
    assert inside(u, [found[0]])
    assert inside(v, [found[1]])


@examples(60)
@given(shares=st.lists(st.floats(-1, 1), min_size=4, max_size=4), at=st.lists(st.floats(0, 1), min_size=2, max_size=2))
def test_a_calibrations_plus_minus_is_held(shares: list[float], at: list[float]) -> None:
    """A ray that some camera of the calibration shows in a pixel lies in the quadrilateral of its corners' intervals, and back."""
    sensor = SensorMap.of(seen_through(PAPER, WIDE, OFF))
    point = np.array(at) * [sensor.ideal.width, sensor.ideal.height]
    a, b = shares[0] * OFF.roll_rad, shares[1] * OFF.yaw_rad
    exact = precise_sensor(sensor, point, a, b, shares[2] * OFF.focal_relative, shares[3] * OFF.principal_px)
    column, row = sensor.to_sensor((point[:1], point[:1]), (point[1:], point[1:]))
    assert inside(column, exact[:1])
    assert inside(row, exact[1:])
    pixel = [int(mpmath.floor(side)) for side in exact]
    assume(0 <= pixel[0] < 640 and 0 <= pixel[1] < 480)
    rows, columns = np.array([pixel[1], pixel[1], pixel[1] + 1, pixel[1] + 1]), np.array([pixel[0], pixel[0] + 1] * 2)
    u, v = sensor.corners(rows, columns)
    assert u[0].min() - sensor.bow_px <= point[0] <= u[1].max() + sensor.bow_px
    assert v[0].min() - sensor.bow_px <= point[1] <= v[1].max() + sensor.bow_px


@pytest.mark.parametrize("name", MAPS)
@pytest.mark.parametrize("turn", [None, ((0.1, 0.1), (-0.05, -0.05))], ids=["still", "turned"])
def test_edges_lie_within_the_bow_of_their_chords(name: str, turn: Turned | None) -> None:
    """Points on a pixel's edges, taken back by Newton's steps from the table: within `bow_px` of the segment, which is not half a pixel."""
    sensor = MAPS[name] if turn is None else MAPS[name].turned(turn)
    assert 0 < sensor.bow_px < 0.05
    camera, lens = sensor.camera, sensor.lens
    rng = np.random.default_rng(3)
    starts = rng.integers(0, [camera.width, camera.height - 1], (400, 2)) * 1.0
    a, b = (0.0, 0.0) if turn is None else (turn[0][0], turn[1][0])
    worst = 0.0
    for step in ([1.0, 0.0], [0.0, 1.0]):
        points = starts + np.array([0.0, 0.5, 1.0])[:, None, None] * step
        x, y, _ = lens.undistorted((points[..., 0] - camera.u0) / camera.focal_u_px, (points[..., 1] - camera.v0) / camera.focal_v_px)
        aside, down = x * np.cos(a) + y * np.sin(a), y * np.cos(a) - x * np.sin(a)
        depth = aside * np.sin(b) + np.cos(b)
        u, v = (aside * np.cos(b) - np.sin(b)) / depth * sensor.ideal.focal_u_px, down / depth * sensor.ideal.focal_v_px
        near = (u[1] + sensor.ideal.u0 > 0) & (u[1] + sensor.ideal.u0 < sensor.ideal.width) & (v[1] + sensor.ideal.v0 > 0)
        near &= v[1] + sensor.ideal.v0 < sensor.ideal.height
        chord = u[2] - u[0], v[2] - v[0]
        away = np.abs(chord[0] * (v[1] - v[0]) - chord[1] * (u[1] - u[0])) / np.hypot(*chord)
        worst = max(worst, float(away[near].max(initial=0)))
    assert worst <= sensor.bow_px + 1e-9


# --- tightness ---


def test_a_rotation_known_exactly_leaves_corners_as_sharp_as_before() -> None:
    sensor = MAPS["paper, wide"].turned(((0.03, 0.03), (-0.05, -0.05)))
    for low, high in sensor.corners(np.arange(0, 481, 20), np.arange(0, 481, 20)):
        assert (high - low).max() < 1e-7


def test_an_interval_of_rotations_widens_corners_by_what_it_moves_them() -> None:
    """Against the extremes over the interval's own corners: by 1 % and 0.05 px more at most, and never less."""
    still, half = MAPS["paper, wide"], 0.002
    rows, columns = (side.ravel() for side in np.meshgrid(np.arange(40, 480, 80), np.arange(40, 640, 80), indexing="ij"))
    around = [(0.03 + one, -0.05 + two) for one in (-half, half) for two in (-half, half)]
    ends = [still.turned(((a, a), (b, b))).corners(rows, columns) for a, b in around]
    wide = still.turned(((0.03 - half, 0.03 + half), (-0.05 - half, -0.05 + half))).corners(rows, columns)
    for axis, (low, high) in enumerate(wide):
        least, most = np.minimum.reduce([end[axis][0] for end in ends]), np.maximum.reduce([end[axis][1] for end in ends])
        assert ((low <= least + 1e-9) & (most <= high + 1e-9)).all()
        assert (high - low <= 1.01 * (most - least) + 0.05).all()


def test_the_forward_map_of_a_point_is_sharp() -> None:
    for name, sensor in MAPS.items():
        u, v = np.linspace(2, sensor.ideal.width - 2, 30), np.linspace(2, sensor.ideal.height - 2, 30)
        for turned in (sensor, sensor.turned(((0.02, 0.02), (-0.03, -0.03)))):
            for low, high in turned.to_sensor((u, u), (v, v)):
                seen = np.isfinite(high)
                assert seen.any(), name
                assert (high - low)[seen].max() < 1e-8


# --- the ideal frame ---


def test_the_ideal_frame_of_a_pinhole_is_its_own() -> None:
    assert ideal_camera(PAPER) == PAPER.camera
    none = replace(PAPER, camera=replace(PAPER.camera, distortion=Distortion("radial-tangential", (0.0, 0.0, 0.0, 0.0))))
    assert ideal_camera(none) == PAPER.camera
    sensor = SensorMap.of(PAPER)
    assert sensor.bow_px == 0
    u, v = sensor.corners(np.array([0, 480]), np.array([0, 640]))
    assert np.concatenate([*u, *v]) == pytest.approx([0, 640, 0, 640, 0, 480, 0, 480], abs=1e-9)


@pytest.mark.parametrize("name", MAPS)
def test_the_ideal_frame_holds_the_runway_that_the_sensor_shows(name: str) -> None:
    """Of every state: whatever point of a marking lies in the sensor's frame lies in the ideal one; and no side is wasted."""
    sensor, scene = MAPS[name], {"paper": PAPER, "strip": STRIP, "airport": AIRPORT}[name.split(",")[0]]
    states = np.random.default_rng(2).uniform(scene.domain.lower, scene.domain.upper, (3000, 4))
    ends = project(replace(scene, camera=sensor.ideal), states)
    points = (ends[..., :1, :] + np.linspace(0, 1, 9)[:, None] * (ends[..., 1:, :] - ends[..., :1, :])).reshape(-1, 2)
    shown = sensor.project(points)
    seen = ((shown >= 0) & (shown <= [sensor.camera.width, sensor.camera.height])).all(axis=1)
    size = np.array([sensor.ideal.width, sensor.ideal.height])
    assert ((points[seen] >= 0) & (points[seen] <= size)).all()
    assert sensor.ideal.focal_px == (sensor.camera.focal_u_px, sensor.camera.focal_v_px)
    assert size.max() < 1.6 * max(sensor.camera.shape)


def test_a_sensor_that_shows_no_runway_is_refused() -> None:
    scene = seen_through(PAPER, WIDE)
    with pytest.raises(SceneError, match="camera: found a sensor that shows nothing of the runway in any state"):
        ideal_camera(replace(scene, camera=replace(scene.camera, principal_point=(320.0, 1100.0))))


@pytest.mark.parametrize("turn", [((0.1, 0.0), (0.0, 0.0)), ((0.0, 2.0), (0.0, 0.0)), ((0.0, 0.0), (np.nan, 0.0))])
def test_a_turn_that_makes_no_sense_is_refused(turn: Turned) -> None:
    with pytest.raises(ValueError, match=r"turn: found [ab] from"):
        MAPS["paper, wide"].turned(turn)


def test_corners_beyond_the_disc_are_not_seen_whatever_the_plus_minus_of_roll_and_yaw() -> None:
    """A frame that is farther down than any lens is looked at: no number of its corners there is one, nor a warning."""
    scene = replace(
        PAPER,
        camera=Camera(37, 1029, focal_px=(61.7, 59.8), principal_point=(12.6, 447.6), distortion=FISHEYE),
        calibration=Calibration(roll_rad=0.0006, yaw_rad=0.0005, principal_px=0.5),
    )
    sensor = SensorMap.of(scene)
    rows, columns = np.mgrid[: scene.camera.height + 1, : scene.camera.width + 1]
    u, v = sensor.corners(rows, columns)
    seen = np.isfinite(u[1])
    assert 0 < seen.sum() < seen.size
    assert (seen == np.isfinite(sensor.rays[2])).all()
    assert (np.isfinite(v[1]) == seen).all()
    assert not np.isnan([*u, *v]).any()
