"""Scene files: what is read, what is refused and how the refusal reads."""

from __future__ import annotations

import copy
import dataclasses
import functools
import itertools
import json
import math
import operator
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from flint import arb, ctx  # pyright: ignore[reportMissingModuleSource]
from hypothesis import given
from hypothesis import strategies as st

from runtime.camera import ground_scale, project, row_of_point
from runtime.rounding import OUTWARD_PX
from runtime.scene import Axis, Bank, Calibration, Camera, Domain, EstimatorTraining, Marking, Runway, Scene, SceneError, Tolerance

PAPER = Path(__file__).parents[1] / "models" / "paper.toml"
TABLES = tomllib.loads(PAPER.read_text(encoding="utf-8"))
ABSENT = object()
KeyPath = tuple[str | int, ...]


def replaced(path: KeyPath, value: Any) -> dict[str, Any]:
    """The paper's tables with the entry at `path` replaced, added, or deleted if `value` is ABSENT."""
    tables = copy.deepcopy(TABLES)
    *parents, last = path
    table: Any = tables
    for key in parents:
        table = table.setdefault(key, {}) if isinstance(key, str) else table[key]
    if value is ABSENT:
        del table[last]
    else:
        table[last] = value
    return tables


def refusal(tables: Any) -> str:
    """The message of the SceneError that `tables` give, checked to be one line of key, finding and advice."""
    with pytest.raises(SceneError) as caught:
        Scene.from_dict(tables)
    message = str(caught.value)
    assert len(message.splitlines()) == 1
    key, _, rest = message.partition(": found ")
    assert key
    assert "; " in rest
    return message


# --- what is read ---


def test_the_papers_scene_is_read(paper_scene: Scene) -> None:
    assert paper_scene.domain.cell_count == 27
    assert paper_scene.camera.shape == (480, 640)
    assert (paper_scene.camera.u0, paper_scene.camera.v0) == (320, 240)
    assert paper_scene.camera.focal_v_px == pytest.approx(1600 / 3, rel=1e-15)
    assert [marking.name for marking in paper_scene.runway.markings] == ["L", "R"]
    assert paper_scene.runway.x_m.tolist() == [-0.1, 0.1]
    assert paper_scene.runway.ends_z_m.tolist() == [[0.0, 0.3], [0.0, 0.3]]
    assert paper_scene.domain.lower == pytest.approx([0.45, 0, 0.75, 1.55], abs=1e-15)
    assert paper_scene.domain.upper == pytest.approx([0.75, 0, 1.05, 1.85], abs=1e-15)
    assert paper_scene.calibration.exact
    assert paper_scene.tolerance == Tolerance(line_px=0, missed_budget=0, extra_budget=-1)


def test_cells_of_an_axis_share_their_borders_and_a_fixed_axis_has_one_value(paper_scene: Scene) -> None:
    for axis in paper_scene.domain.axes:
        assert isinstance(axis, Axis)
        assert len(axis.borders) == len(axis.centres) + 1
        assert np.diff(axis.borders) == pytest.approx(np.full(len(axis.centres), axis.width), abs=1e-12)
    assert paper_scene.domain.x_m.borders.tolist() == [0.0, 0.0]


def test_the_smallest_scene_takes_every_default() -> None:
    scene = Scene.from_dict(
        {key: TABLES[key] for key in ("camera", "runway", "domain")} | {"bank": {"pitch_bins": 1, "distance_bins": 1, "column_px": 1.0}}
    )
    assert (scene.calibration, scene.tolerance, scene.estimator) == (Calibration(), Tolerance(), EstimatorTraining())


def test_whole_numbers_are_read_as_floats_where_a_float_is_meant() -> None:
    scene = Scene.from_dict(replaced(("runway", "markings", 0, "length_m"), 1))
    assert isinstance(scene.runway.markings[0].length_m, float)


def test_a_principal_point_replaces_the_frames_centre() -> None:
    camera = Scene.from_dict(replaced(("camera", "principal_point"), [300.5, 250])).camera
    assert (camera.u0, camera.v0) == (300.5, 250.0)


def test_scenes_are_immutable_and_comparable(paper_scene: Scene) -> None:
    assert paper_scene == Scene.load(PAPER)
    assert hash(paper_scene) == hash(Scene.load(PAPER))
    with pytest.raises(dataclasses.FrozenInstanceError):
        paper_scene.camera.width = 1  # pyright: ignore[reportAttributeAccessIssue]


def lengths(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_nan=False)


@st.composite
def axes(draw: st.DrawFn, low: float, high: float) -> Axis:
    """An axis of one to four cells, or a fixed one, with its centres in [low, high] and its cells at most 0.05 wide."""
    first, width = draw(lengths(low, high)), draw(st.one_of(st.just(0.0), lengths(1e-4, 0.05)))
    return Axis(tuple(first + width * cell for cell in range(draw(st.integers(1, 4)) if width else 1)), width)


@st.composite
def scenes(draw: st.DrawFn) -> Scene:
    """Scenes of all kinds: cameras, numbers of markings, free and fixed axes, every table given."""
    centre = st.none() | st.tuples(lengths(-500, 2000), lengths(-500, 2000))
    camera = Camera(
        draw(st.integers(1, 4000)), draw(st.integers(1, 4000)), draw(lengths(1e-3, 0.05)), draw(lengths(1e-6, 2e-5)), draw(centre)
    )
    marking = st.builds(Marking, st.text(), lengths(-30, 30), lengths(0, 10), lengths(1e-3, 3000))
    runway = Runway(tuple(draw(st.lists(marking, min_size=1, max_size=4, unique_by=lambda stripe: stripe.name))))
    domain = Domain(draw(axes(0.2, 0.7)), draw(axes(-5, 5)), draw(axes(0.5, 300)), draw(axes(0.5, 3000)))
    small = lengths(0, 0.4)
    return Scene(
        camera,
        runway,
        domain,
        draw(st.builds(Bank, st.integers(1, 1000), st.integers(1, 1000), lengths(0.01, 10), lengths(0.01, 10))),
        draw(st.builds(Calibration, small, small, small, lengths(0, 15))),
        draw(st.builds(Tolerance, st.integers(0, 16), st.integers(0, 2**16 - 1), st.integers(-1, 2**31 - 1))),
        draw(st.builds(EstimatorTraining, st.integers(1, 10**9), st.integers(1, 1000), st.integers(1, 1000), lengths(0, 1))),
    )


@given(scenes())
def test_tables_and_json_carry_a_scene_unchanged(scene: Scene) -> None:
    assert Scene.from_dict(scene.to_dict()) == scene
    assert Scene.from_dict(json.loads(json.dumps(scene.to_dict(), allow_nan=False))) == scene


def test_the_papers_tables_survive_the_round_trip(paper_scene: Scene) -> None:
    tables = paper_scene.to_dict()
    for name, table in TABLES.items():
        assert {key: tables[name][key] for key in table} == table


# --- what is refused ---

MARKING = ("runway", "markings", 0)
BAD_VALUES: list[tuple[KeyPath, Any, str]] = [
    # unknown and missing keys
    (("kamera",), {}, "kamera: found an unknown key"),
    (("camera", "fokal"), 1.0, "camera.fokal: found an unknown key"),
    ((*MARKING, "width_m"), 1.0, "runway.markings[0].width_m: found an unknown key"),
    (("domain", "z_m", "step"), 1.0, "domain.z_m.step: found an unknown key"),
    (("camera", "two\nlines"), 1.0, r"camera.'two\nlines': found an unknown key"),
    (("camera",), ABSENT, "camera: found nothing; this key is required"),
    (("camera", "width"), ABSENT, "camera.width: found nothing"),
    ((*MARKING, "length_m"), ABSENT, "runway.markings[0].length_m: found nothing"),
    (("domain", "y_m"), ABSENT, "domain.y_m: found nothing"),
    (("bank", "column_px"), ABSENT, "bank.column_px: found nothing"),
    (("bank", "set_px"), 30.0, "bank: found set_px in a table of the other kind; give { pitch_bins"),
    # wrong types
    (("camera",), 3, "camera: found 3; give a table"),
    (("camera", "width"), 640.0, "camera.width: found 640.0; give a whole number"),
    (("camera", "width"), True, "camera.width: found True; give a whole number"),
    (("camera", "height"), "480", "camera.height: found '480'; give a whole number"),
    (("camera", "focal_length_m"), True, "camera.focal_length_m: found True; give a finite number"),
    (("camera", "focal_length_m"), "8 mm", "camera.focal_length_m: found '8 mm'; give a finite number"),
    (("camera", "focal_length_m"), None, "camera.focal_length_m: found None"),
    (("camera", "principal_point"), 320.0, "camera.principal_point: found 320.0; give a list"),
    (("camera", "principal_point"), ["320", 240], "camera.principal_point[0]: found '320'"),
    (("runway", "markings"), {}, "runway.markings: found {}; give a list"),
    (("runway", "markings"), [7], "runway.markings[0]: found 7; give a table"),
    ((*MARKING, "name"), 1, "runway.markings[0].name: found 1; give a text"),
    (("domain", "theta_rad", "centres"), 0.5, "domain.theta_rad.centres: found 0.5; give a list"),
    (("tolerance", "line_px"), 0.5, "tolerance.line_px: found 0.5"),
    (("camera", "width"), 10**4000, "camera.width: found a whole number beyond 64 bits"),
    (("camera", "focal_length_m"), 10**400, "camera.focal_length_m: found a whole number beyond 64 bits"),
    # not a number, not finite
    (("camera", "pixel_pitch_m"), math.nan, "camera.pixel_pitch_m: found nan"),
    (("camera", "focal_length_m"), math.inf, "camera.focal_length_m: found inf"),
    (("camera", "principal_point"), [math.nan, 240.0], "camera.principal_point[0]: found nan"),
    ((*MARKING, "x_m"), -math.inf, "runway.markings[0].x_m: found -inf"),
    (("domain", "y_m", "centres"), [0.8, math.nan, 1.0], "domain.y_m.centres[1]: found nan"),
    (("bank", "column_px"), math.nan, "bank.column_px: found nan"),
    # out of range
    (("camera", "width"), 0, "camera.width: found 0"),
    (("camera", "height"), 16385, "camera.height: found 16385"),
    (("camera", "focal_length_m"), 0.0, "camera.focal_length_m: found 0.0"),
    (("camera", "pixel_pitch_m"), -15e-6, "camera.pixel_pitch_m: found -1.5e-05"),
    (("camera", "focal_length_m"), 1e308, "camera.focal_length_m / pixel_pitch_m: found inf"),
    (("camera", "focal_length_m"), 1e-9, "camera.focal_length_m / pixel_pitch_m: found 6.6"),
    (("camera", "focal_px"), [533.0, 533.0], "camera.focal_length_m and pixel_pitch_m: found given beside focal_px"),
    (("camera", "focal_px"), [533.0], "camera.focal_px: found [533.0]; give 2 values"),
    (("camera", "focal_length_m"), ABSENT, "camera.focal_length_m: found nothing; this key is required, or focal_px = [fx, fy]"),
    (
        ("camera", "distortion"),
        {"model": "fov", "coefficients": [1.0]},
        "camera.distortion.model: found fov; give one of radial-tangential",
    ),
    (("camera", "distortion"), {"model": "fisheye", "coefficients": [0.1] * 5}, "fisheye has 4 of them"),
    (("camera", "distortion"), {"model": "radial-tangential", "coefficients": [0.1] * 8}, "radial-tangential has 4 or 5 of them"),
    (("camera", "distortion"), {"model": "fisheye", "coefficients": [1e9] * 4}, "camera.distortion.coefficients: found"),
    (("camera", "mount"), {"roll_rad": 2.0}, "camera.mount.roll_rad: found 2.0"),
    (
        ("motion",),
        {name: [0, 0] for name in ("theta_rad_s", "x_m_s", "y_m_s", "z_m_s")} | {"yaw_rad_s": [1, 0]},
        "motion.yaw_rad_s: found [1",
    ),
    (("camera", "principal_point"), [320.0], "camera.principal_point: found [320.0]; give 2 values"),
    (("camera", "principal_point"), [320.0, 240.0, 1.0], "give 2 values"),
    (("camera", "principal_point"), [320.0, 1e9], "camera.principal_point: found (320.0, 1000000000.0)"),
    (("calibration", "roll_rad"), -0.01, "calibration.roll_rad: found -0.01"),
    (("calibration", "focal_relative"), 0.5, "calibration.focal_relative: found 0.5"),
    (("calibration", "principal_px"), 16.0, "calibration.principal_px: found 16.0"),
    ((*MARKING, "length_m"), 0.0, "runway.markings 'L' length_m: found 0.0"),
    ((*MARKING, "length_m"), -0.3, "runway.markings 'L' length_m: found -0.3"),
    ((*MARKING, "x_m"), 1e300, "runway.markings 'L' x_m: found 1e+300"),
    ((*MARKING, "name"), "R", "runway.markings name: found ['R', 'R']"),
    (("runway", "markings"), [], "runway.markings: found none"),
    (("runway", "markings"), [{}] * 5000, "runway.markings: found 5000 values; give 4096 or fewer"),
    (("domain", "z_m", "centres"), [1.0] * 5000, "domain.z_m.centres: found 5000 values"),
    (("bank", "pitch_bins"), 0, "bank.pitch_bins: found 0"),
    (("bank", "distance_bins"), 1001, "bank.distance_bins: found 1001"),
    (("bank", "lateral_px"), 0.0, "bank.lateral_px: found 0.0"),
    (("tolerance", "line_px"), -1, "tolerance.line_px: found -1"),
    (("tolerance", "missed_budget"), -1, "tolerance.missed_budget: found -1"),
    (("tolerance", "extra_budget"), -2, "tolerance.extra_budget: found -2"),
    (("estimator", "epochs"), 0, "estimator.epochs: found 0"),
    (("estimator", "largest_clutter"), 1.5, "estimator.largest_clutter: found 1.5"),
    # empty, inverted and gaping ranges
    (("domain", "theta_rad", "centres"), [], "domain.theta_rad.centres: found none"),
    (("domain", "theta_rad", "width"), -0.1, "domain.theta_rad.width: found -0.1"),
    (("domain", "theta_rad", "width"), 1e-7, "domain.theta_rad.width: found 1e-07"),
    (("domain", "theta_rad", "width"), 0.0, "domain.theta_rad.centres: found [0.5, 0.6, 0.7]; an axis of width 0"),
    (("domain", "y_m", "centres"), [1.0, 0.9, 0.8], "domain.y_m.centres: found 1.0 and 0.9; neighbours must ascend by 0.1"),
    (("domain", "y_m", "centres"), [0.8, 0.9, 1.1], "domain.y_m.centres: found 0.9 and 1.1"),
    (("domain", "z_m", "centres"), [1.6, 1.65], "domain.z_m.centres: found 1.6 and 1.65"),
    (("domain", "z_m", "centres"), [1.6, 1.6], "domain.z_m.centres: found 1.6 and 1.6"),
    (("domain", "x_m", "centres"), [1e308], "domain.x_m.centres: found 1e+308"),
    # states that make no sense
    (("domain", "theta_rad", "centres"), [1.55], "domain.theta_rad: found"),
    (("domain", "theta_rad", "centres"), [-1.55], "domain.theta_rad: found"),
    (("domain", "y_m", "centres"), [0.05], "domain.y_m: found"),
    (("domain", "y_m", "centres"), [-0.9], "domain.y_m: found"),
    # the runway behind the camera
    (("domain", "z_m", "centres"), [0.0], "domain.z_m: found -0.05; a marking starts beside or behind the camera"),
    ((*MARKING, "start_z_m"), -2.0, "domain.z_m: found 1.55"),
    (("domain", "theta_rad", "centres"), [-1.2], "domain: found a state with the runway behind the camera"),
]


@pytest.mark.parametrize(("path", "value", "expected"), BAD_VALUES, ids=[case[2][:60] for case in BAD_VALUES])
def test_a_bad_value_is_refused_by_name(path: KeyPath, value: Any, expected: str) -> None:
    assert expected in refusal(replaced(path, value))


@pytest.mark.parametrize("tables", [None, 3, "scene", [], [TABLES]])
def test_what_is_no_table_is_refused(tables: Any) -> None:
    assert refusal(tables).startswith("scene: ")


def test_a_long_value_is_quoted_in_part() -> None:
    message = refusal(replaced(("domain", "theta_rad", "width"), list(range(100_000))))
    assert "domain.theta_rad.width" in message
    assert len(message) < 400


def test_the_runway_is_ahead_up_to_the_last_angle_and_no_farther() -> None:
    """With y = d the ground lies at 45 degrees: a pitch of -45 degrees puts it beside the camera (Z = 0)."""
    domain = {"x_m": {"centres": [0.0], "width": 0.0}, "y_m": {"centres": [1.0], "width": 0.0}, "z_m": {"centres": [1.0], "width": 0.0}}

    def tables(theta: float) -> dict[str, Any]:
        return TABLES | {"domain": domain | {"theta_rad": {"centres": [theta], "width": 0.0}}}

    assert np.isfinite(project(Scene.from_dict(tables(-math.pi / 4 + 1e-5)), [-math.pi / 4 + 1e-5, 0, 1, 1])).all()
    assert "behind the camera" in refusal(tables(-math.pi / 4))


def one_marking(camera: Camera, shift: float, ahead: float, length: float, y: float, theta: float) -> Scene:
    """One state, `ahead` before a marking that starts at `shift`."""
    theta_rad, x_m, y_m, z_m = (Axis((centre,), 0.0) for centre in (theta, 0.0, y, ahead - shift))
    return Scene(camera, Runway((Marking("m", 1.0, shift, length),)), Domain(theta_rad, x_m, y_m, z_m), Bank(1, 1, 1.0))


@given(
    sides=st.tuples(st.integers(4, 14), st.integers(4, 14)),
    focal=st.floats(0, 19.9),
    logarithms=st.tuples(st.floats(-3, 6), st.floats(-5, 4), st.floats(-3, 6), st.floats(-6, 3)),
    view=st.floats(-1, 1),
    u_share=st.floats(0, 1),
)
def test_float64_keeps_half_the_margin_on_every_scene_that_is_taken(
    sides: tuple[int, int], focal: float, logarithms: tuple[float, ...], view: float, u_share: float
) -> None:
    """Rows of ends, and columns by the scale at these rows, against 200 bits; scenes of any size, the far ones right at the horizon."""
    width, height = (2**side for side in sides)
    camera = Camera(width, height, 2**focal * 1e-5, 1e-5)
    shift, ahead, length, y = (10.0**power for power in logarithms)
    theta = math.atan2(y, ahead) - view * math.atan(height / 2 / camera.focal_v_px)
    try:
        scene = one_marking(camera, shift, ahead, length, y, theta)
    except SceneError:
        return
    theta, _, y, z = scene.domain.lower.tolist()
    with ctx.workprec(200):
        focal_px, (sine, cosine) = arb(camera.focal_length_m) / arb(camera.pixel_pitch_m), arb(theta).sin_cos()
        for end, d in zip(scene.runway.ends_z_m[0].tolist(), (arb(shift) + arb(z), arb(shift) + arb(length) + arb(z)), strict=True):
            row = float(row_of_point(camera, theta, y, end + z))
            if 0 <= row < height:
                exact = arb(camera.v0) + focal_px * (arb(y) * cosine - d * sine) / (arb(y) * sine + d * cosine)
                assert abs(exact - arb(row)) < OUTWARD_PX / 2
                scale = focal_px * (sine + (arb(row) - arb(camera.v0)) / focal_px * cosine) / arb(y)
                across = (u_share * width - camera.u0) / float(scale)
                assert abs(arb(across) * scale - arb(across * float(ground_scale(camera, theta, y, row)))) < OUTWARD_PX / 2


def test_what_float64_would_round_beyond_the_margin_is_refused() -> None:
    camera = Camera(640, 480, 1.0, 1e-5)
    assert one_marking(camera, 1e6, 100.0, 100.0, 1.0, 0.01).domain.lower[3] == 100 - 1e6
    with pytest.raises(
        SceneError, match=r"domain\.z_m: found coordinates along the runway of up to 1e\+06 m where a metre spans up to 7.07e\+08 px"
    ):
        one_marking(camera, 1e6, 1e-4, 1.0, 1e-4, math.pi / 4)
    with pytest.raises(SceneError, match=r"domain: found an end 5\.33e-07 px below the horizon, too near"):
        one_marking(Camera(640, 480, 8e-3, 15e-6), 0.0, 1.0, 1e6, 1e-3, 0.0)


@pytest.mark.parametrize(
    "build",
    [
        lambda: Camera(640, 480, math.nan, 15e-6),
        lambda: Camera(640, 480, 8e-3, math.nan),
        lambda: Camera(640, 480, 8e-3, 15e-6, (320.0, math.nan)),
        lambda: Calibration(roll_rad=math.nan),
        lambda: Marking("L", math.nan, 0.0, 1.0),
        lambda: Marking("L", 0.0, 0.0, math.nan),
        lambda: Domain(Axis((0.5,), 0.1), Axis((math.nan,), 0.0), Axis((1.0,), 0.1), Axis((1.0,), 0.1)),
        lambda: Domain(Axis((0.5,), math.nan), Axis((0.0,), 0.0), Axis((1.0,), 0.1), Axis((1.0,), 0.1)),
        lambda: Bank(1, 1, math.nan),
        lambda: EstimatorTraining(largest_clutter=math.nan),
    ],
)
def test_values_given_in_code_are_checked_too(build: Any) -> None:
    with pytest.raises(SceneError, match="nan"):
        build()


# --- files ---


def file_refusal(path: Path) -> str:
    with pytest.raises(SceneError) as caught:
        Scene.load(path)
    message = str(caught.value)
    assert len(message.splitlines()) == 1
    assert message.startswith(f"{path}: ")
    return message


def test_a_missing_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    assert "cannot be read" in file_refusal(tmp_path / "none.toml")
    assert "cannot be read" in file_refusal(tmp_path)


@pytest.mark.parametrize(
    "content",
    [b"[camera\nwidth = 3", b"width = ", b"a = 1\na = 2", b"\xff\xfe[camera]", b"a = " + b"[" * 5000, b"a = " + b"9" * 5000, b"\x00"],
    ids=["open bracket", "no value", "key twice", "not UTF-8", "deep nesting", "huge number", "control character"],
)
def test_a_file_that_is_not_toml_is_refused(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "scene.toml"
    path.write_bytes(content)
    message = file_refusal(path)
    assert "not TOML" in message or "cannot be read" in message


def test_a_bad_value_in_a_file_names_file_and_key(tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(PAPER.read_text(encoding="utf-8").replace("width = 640", "width = true"), encoding="utf-8")
    assert "camera.width: found True" in file_refusal(path)


def test_toml_has_numbers_that_json_has_not(tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    path.write_text(PAPER.read_text(encoding="utf-8").replace("length_m = 0.3", "length_m = nan"), encoding="utf-8")
    assert "runway.markings[0].length_m: found nan" in file_refusal(path)


# --- any tables: a scene or a SceneError, nothing else ---

NUMBERS = st.floats() | st.floats(-10, 10) | st.sampled_from([0.0, -0.0, 5e-324, 1e-9, 1e6, 1e308, -1e308, math.inf, math.nan])
SCALARS = st.none() | st.booleans() | st.integers() | st.integers(-2, 3) | NUMBERS | st.text(max_size=5) | st.dates()
KNOWN_KEYS = st.sampled_from(
    [*TABLES, "calibration", "estimator", "markings", "centres", "width", "name", "x_m", "theta_rad", "principal_point"]
)
ANY_TOML = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(KNOWN_KEYS | st.text(max_size=5), inner, max_size=4), max_leaves=12
)


def paths_of(value: Any, path: KeyPath = ()) -> list[KeyPath]:
    """The path of every entry of nested tables and lists, the outermost first."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return list(itertools.chain.from_iterable([(*path, key), *paths_of(item, (*path, key))] for key, item in items))


def scene_or_refusal(tables: Any) -> Scene | None:
    """What `tables` give. A scene must be usable: it survives a round trip and sees finite ends from its domain's corners."""
    try:
        scene, message = Scene.from_dict(tables), ""
    except SceneError as error:
        scene, message = None, str(error)
    if scene is None:
        assert len(message.splitlines()) == 1
        return None
    assert Scene.from_dict(scene.to_dict()) == scene
    corners = np.array(list(itertools.product(*zip(scene.domain.lower, scene.domain.upper, strict=True))))
    assert np.isfinite(project(scene, corners)).all()
    borders = [scene.domain.borders_along(axis) for axis in range(4)]
    assert all((np.diff(each) > 0).all() for each, fixed in zip(borders, scene.domain.fixed, strict=True) if not fixed)
    return scene


@given(ANY_TOML)
def test_any_tables_give_a_scene_or_a_scene_error(tables: Any) -> None:
    scene_or_refusal(tables)


@given(st.data())
def test_the_papers_scene_with_any_damage_gives_a_scene_or_a_scene_error(data: st.DataObject) -> None:
    tables: Any = copy.deepcopy(TABLES)
    for _ in range(data.draw(st.integers(1, 3))):
        *parents, last = data.draw(st.sampled_from(paths_of(tables) or [("camera",)]))
        table: Any = functools.reduce(operator.getitem, parents, tables)
        old = table.get(last) if isinstance(table, dict) else table[last]
        slight = lengths(0.5, 2).map(lambda factor, old=old: old * factor) if type(old) in (int, float) else st.just(old)
        value = data.draw(slight | st.just(ABSENT) | SCALARS | NUMBERS | st.lists(NUMBERS, max_size=3) | ANY_TOML)
        if value is not ABSENT:
            table[last] = value
        elif last in table or isinstance(table, list):
            del table[last]
    scene_or_refusal(tables)


@given(lengths(-2e6, 2e6), lengths(0, 2e6), st.integers(1, 5), lengths(-math.pi, math.pi), lengths(0, 2e6))
def test_domains_of_any_size_give_a_scene_or_a_scene_error(first: float, width: float, cells: int, theta: float, altitude: float) -> None:
    tables = replaced(("domain", "z_m"), {"centres": [first + cell * width for cell in range(cells)], "width": width})
    tables["domain"]["theta_rad"] = {"centres": [theta], "width": 0.01}
    tables["domain"]["y_m"] = {"centres": [altitude], "width": 0.0}
    scene = scene_or_refusal(tables)
    assert scene is None or scene.domain.lower[3] > 0
