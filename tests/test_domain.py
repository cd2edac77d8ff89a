"""The domain: how edges, ratios and glides divide it into cells, what is refused, and what lies on its boundary."""

from __future__ import annotations

import copy
import itertools
import json
import math
import tomllib
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from flint import arb  # pyright: ignore[reportMissingModuleSource]
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from onnx import numpy_helper
from scenes import AIRPORT, PAPER, STRIP

from build_model.export import export_model
from build_model.partition import partition
from build_model.verify.cell_boxes import axis_borders, cell_boxes
from build_model.verify.proof import verify_model
from runtime import Estimator, Scene, SceneError
from runtime.domain import MOST_ITEMS, Axis, Domain, Edges, Glide, Growth
from runtime.image import runway_image
from runtime.model.format import METADATA_KEY, metadata_digest
from runtime.scene import Bank

Floats = NDArray[np.float64]
FIXED = Axis((0.0,), 0.0)
SCENES = {
    "paper": replace(
        PAPER,
        domain=Domain(Axis((0.6,), 0.03), FIXED, None, Edges((1.62, 1.66, 1.72)), glide=Glide((0.41, 0.42), 0.3, 2)),
        bank=Bank(2, 1, 0.5),
    ),
    "strip": replace(
        STRIP,
        domain=Domain(Edges((0.44, 0.46, 0.47)), FIXED, None, Growth(2.0, 2.3, 1.06), glide=Glide((0.3, 0.31), 2.0)),
        bank=Bank(1, 1, 0.5),
    ),
    "airport": replace(
        AIRPORT,
        domain=Domain(Axis((0.03,), 0.004), FIXED, None, Growth(900.0, 1000.0, 1.05), glide=Glide((0.0515, 0.0525))),
        bank=Bank(2, 2, 0.6),
    ),
}
"""Staircases that are quickly built, at three scales."""


# --- how an axis is divided ---


def test_cells_by_a_ratio_grow_and_end_where_the_scene_says() -> None:
    assert Growth(1.0, 8.0, 2.0).borders.tolist() == [1, 2, 4, 8]
    assert Growth(1.0, 6.0, 2.0).borders.tolist() == [1, 2, 4, 6], "half of the last cell fits"
    assert Growth(1.0, 5.999, 2.0).borders.tolist() == [1, 2, 5.999], "less than half of it: the cell before takes it in"
    assert Growth(1.0, 1.2, 2.0).borders.tolist() == [1, 1.2]
    assert len(Growth(300.0, 3000.0, 1.25).borders) == 11


@given(st.floats(1e-6, 1e5), st.floats(1.001, 10), st.floats(1.0001, 50))
def test_the_last_cell_of_a_ratio_takes_in_less_than_half_of_another(start: float, ratio: float, share: float) -> None:
    axis = Growth(start, start * share, ratio)
    try:
        axis.check("domain.z_m")
    except SceneError:
        return
    borders = [Fraction(border) for border in axis.borders.tolist()]
    assert (borders[0], borders[-1]) == (Fraction(start), Fraction(start * share))
    widths = [right - left for left, right in itertools.pairwise(borders)]
    if len(widths) > 1:
        assert 0.5 <= widths[-1] / (borders[-2] * (Fraction(ratio) - 1)) < 1 + ratio / 2 + 1e-9
    assert all(right == float(Fraction(left) * Fraction(ratio)) for left, right in itertools.pairwise(axis.borders.tolist()[:-1]))
    assert axis_borders(axis) == axis.borders.tolist()


def glides(z: Edges | Growth | Axis) -> st.SearchStrategy[Glide]:
    angles = st.tuples(st.floats(0.01, 0.7), st.floats(0.01, 0.7)).map(lambda pair: (min(pair), max(pair) + 0.001))
    return st.builds(Glide, angles, st.floats(0.5, 400).map(lambda beyond: beyond - float(z.borders[0])), st.integers(1, 3))


@st.composite
def ascending(draw: st.DrawFn, low: float, width: float) -> Edges:
    steps = draw(st.lists(st.floats(0.05, 1), min_size=1, max_size=4))
    return Edges(tuple(low + width * step / 4 for step in itertools.accumulate([0.0, *steps])))


@st.composite
def domains(draw: st.DrawFn) -> Domain:
    """Domains with axes of every kind, half of them along a glide."""
    scale = draw(st.sampled_from([0.1, 1.0, 100.0]))
    theta = draw(st.sampled_from([Axis((0.2, 0.3), 0.1), Axis((0.3,), 0.0), Edges((0.1, 0.15, 0.4))]))
    x = draw(st.sampled_from([FIXED, Edges((-scale, 0.25 * scale, scale))]))
    z = draw(ascending(scale, 4 * scale) | st.builds(Growth, st.just(scale), st.just(4 * scale), st.floats(1.3, 3)))
    if draw(st.booleans()):
        return Domain(theta, x, draw(ascending(scale, 2 * scale)), z)
    return Domain(theta, x, None, z, glide=draw(glides(z)))


def tables_of(scene: Scene, domain: Domain) -> dict[str, Any]:
    return replace(scene, domain=domain).to_dict()


def test_a_scene_of_every_kind_survives_toml_and_json(tmp_path: Path) -> None:
    path = tmp_path / "scene.toml"
    text = (Path(__file__).parents[1] / "models" / "paper.toml").read_text(encoding="utf-8")
    y, z = (f"{axis}_m = {{ centres = [{centres}], width = 0.1 }}" for axis, centres in (("y", "0.8, 0.9, 1.0"), ("z", "1.6, 1.7, 1.8")))
    assert y in text
    text = text.replace(y, "glide = { angle_rad = [0.41, 0.43], aim_m = 0.3, cells = 2 }")
    path.write_text(text.replace(z, "z_m = { from = 1.55, to = 1.85, ratio = 1.06 }"), encoding="utf-8")
    scene = Scene.load(path)
    assert scene.domain.z_m == Growth(1.55, 1.85, 1.06)
    assert scene.domain.glide == Glide((0.41, 0.43), 0.3, 2)
    assert scene.domain.cell_counts == (3, 1, 2, 3)
    assert scene.to_dict()["domain"]["z_m"] == {"from": 1.55, "to": 1.85, "ratio": 1.06}
    assert Scene.from_dict(json.loads(json.dumps(scene.to_dict()))) == scene


def test_the_aim_point_lies_300_m_behind_the_threshold_unless_told_otherwise() -> None:
    table = {"angle_rad": [0.05, 0.06]}
    tables = copy.deepcopy(AIRPORT.to_dict())
    del tables["domain"]["y_m"]
    assert Scene.from_dict(tables | {"domain": tables["domain"] | {"glide": table}}).domain.glide == Glide((0.05, 0.06), 300.0, 1)


# --- what is refused ---

TABLES = tomllib.loads((Path(__file__).parents[1] / "models" / "paper.toml").read_text(encoding="utf-8"))
GLIDE = {"angle_rad": [0.41, 0.43], "aim_m": 0.3}
GROWTH = {"from": 1.55, "to": 1.85, "ratio": 1.06}
BAD: list[tuple[str, Any, str]] = [
    ("z_m", {"edges": []}, "domain.z_m.edges: found []; give two edges or more"),
    ("z_m", {"edges": [1.6]}, "domain.z_m.edges: found [1.6]; give two edges or more"),
    ("z_m", {"edges": [1.6, 1.5]}, "domain.z_m.edges: found 1.6 and 1.5; edges must ascend by 1e-06 or more"),
    ("z_m", {"edges": [1.6, 1.6]}, "domain.z_m.edges: found 1.6 and 1.6; edges must ascend"),
    ("z_m", {"edges": [1.6, math.nan]}, "domain.z_m.edges[1]: found nan; give a finite number"),
    ("z_m", {"edges": [1.6, 1e300]}, "domain.z_m.edges: found 1e+300; stay within 1000000"),
    ("z_m", {"edges": 1.6}, "domain.z_m.edges: found 1.6; give a list"),
    (
        "z_m",
        {"edges": [1.6, 1.7], "width": 0.1},
        "domain.z_m: found edges in a table of the other kind; give { centres, width }, { edges } or { from, to, ratio }",
    ),
    ("z_m", {}, "domain.z_m: found {}; give { centres, width }, { edges } or { from, to, ratio }"),
    ("z_m", {"edge": [1.6, 1.7]}, "domain.z_m: found {'edge': [1.6, 1.7]}; give { centres, width }, { edges } or { from, to, ratio }"),
    ("z_m", GROWTH | {"ratio": 0.0}, "domain.z_m.ratio: found 0.0; give a cell's far border over its near one, above 1"),
    ("z_m", GROWTH | {"ratio": -1.5}, "domain.z_m.ratio: found -1.5"),
    ("z_m", GROWTH | {"ratio": 1.0}, "domain.z_m.ratio: found 1.0"),
    ("z_m", GROWTH | {"ratio": math.nan}, "domain.z_m.ratio: found nan"),
    ("z_m", GROWTH | {"ratio": 1 + 1e-9}, "domain.z_m.ratio: found 1.000000001; that makes 1.77e+08 cells: give more, for 4096 or fewer"),
    ("z_m", GROWTH | {"from": 0.0}, "domain.z_m.from: found 0.0; give 1e-06 to 1000000; an axis that reaches 0 or below has edges"),
    ("z_m", GROWTH | {"to": 1.55}, "domain.z_m.to: found 1.55; give more than from, 1.55"),
    ("z_m", GROWTH | {"to": 1.5}, "domain.z_m.to: found 1.5; give more than from"),
    ("z_m", GROWTH | {"to": math.inf}, "domain.z_m.to: found inf"),
    ("z_m", {"from": 1.55, "to": 1.85}, "domain.z_m.ratio: found nothing; this key is required"),
    ("z_m", GROWTH | {"cells": 3}, "domain.z_m.cells: found an unknown key; known here: from, to, ratio"),
    ("theta_rad", {"edges": [0.5, 1.6]}, "domain.theta_rad: found [0.5, 1.6]; stay within -pi/2 and pi/2"),
    ("y_m", {"edges": [0.0, 1.0]}, "domain.y_m: found 0.0; the camera must be above the runway"),
    ("glide", GLIDE, "domain.glide: found y_m beside it; give one of the two"),
    ("glide alone", {"aim_m": 300.0}, "domain.glide.angle_rad: found nothing; this key is required"),
    ("glide alone", GLIDE | {"angle_rad": [0.43, 0.41]}, "domain.glide.angle_rad: found [0.43, 0.41]; give the flattest and the steepest"),
    ("glide alone", GLIDE | {"angle_rad": [0.42, 0.42]}, "domain.glide.angle_rad: found [0.42, 0.42]"),
    ("glide alone", GLIDE | {"angle_rad": [0.0, 0.42]}, "domain.glide.angle_rad: found [0.0, 0.42]; give the flattest"),
    ("glide alone", GLIDE | {"angle_rad": [0.4, 1.6]}, "domain.glide.angle_rad: found [0.4, 1.6]"),
    ("glide alone", GLIDE | {"angle_rad": [0.4, math.nan]}, "domain.glide.angle_rad[1]: found nan"),
    ("glide alone", GLIDE | {"angle_rad": 0.4}, "domain.glide.angle_rad: found 0.4; give a list"),
    ("glide alone", GLIDE | {"angle_rad": [0.4]}, "domain.glide.angle_rad: found [0.4]; give 2 values"),
    ("glide alone", GLIDE | {"aim_m": -1.55}, "domain.glide.aim_m: found -1.55; stay within 1000000 m, and above -1.55 m"),
    ("glide alone", GLIDE | {"aim_m": 1e9}, "domain.glide.aim_m: found 1000000000.0"),
    ("glide alone", GLIDE | {"cells": 0}, "domain.glide.cells: found 0; give 1 to"),
    ("glide alone", GLIDE | {"cells": 1.0}, "domain.glide.cells: found 1.0; give a whole number"),
    ("glide alone", GLIDE | {"cells": 10**6}, "domain.glide.cells: found 1000000; give 1 to 1365"),
    ("glide alone", GLIDE | {"step": 1}, "domain.glide.step: found an unknown key; known here: angle_rad, aim_m, cells"),
    ("glide alone", GLIDE | {"angle_rad": [1e-9, 2e-9]}, "domain.glide.angle_rad: found altitudes down to 1.85e-09 m"),
    ("glide alone", GLIDE | {"angle_rad": [0.4, 1.5707963]}, "domain.glide.angle_rad: found altitudes of up to"),
    ("glide alone", 3, "domain.glide: found 3; give a table"),
]


@pytest.mark.parametrize(("key", "table", "expected"), BAD, ids=[f"{case[0]} {case[2][:70]}" for case in BAD])
def test_a_bad_division_is_refused_by_name(key: str, table: Any, expected: str) -> None:
    tables: Any = copy.deepcopy(TABLES)
    if key == "glide alone":
        del tables["domain"]["y_m"]
    tables["domain"][key.removesuffix(" alone")] = table
    with pytest.raises(SceneError) as caught:
        Scene.from_dict(tables)
    assert expected in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


KEYS = st.sampled_from(["edges", "from", "to", "ratio", "centres", "width", "angle_rad", "aim_m", "cells"])
NUMBERS = st.floats() | st.floats(0, 3) | st.sampled_from([0.0, 5e-324, 1e-9, 1.0000001, 1e6, 1e308, -1e308]) | st.integers()
AXES = st.dictionaries(KEYS, NUMBERS | st.lists(NUMBERS, max_size=4), max_size=4)


@given(st.dictionaries(st.sampled_from(["theta_rad", "x_m", "y_m", "z_m", "glide"]), AXES, max_size=5), st.booleans())
def test_any_division_gives_a_scene_or_a_scene_error(axes: dict[str, Any], without_y: bool) -> None:
    tables: Any = copy.deepcopy(TABLES)
    if without_y:
        del tables["domain"]["y_m"]
    tables["domain"] |= axes
    try:
        scene, message = Scene.from_dict(tables), ""
    except SceneError as error:
        scene, message = None, str(error)
    if scene is None:
        assert len(message.splitlines()) == 1
        return
    assert Scene.from_dict(scene.to_dict()) == scene
    assert scene.domain.altitude_borders.size <= 2 * MOST_ITEMS


# --- cells ---


@given(domains())
def test_cells_are_row_major_and_share_their_borders(domain: Domain) -> None:
    lower, upper = (side.reshape(*domain.cell_counts, 4) for side in domain.cells())
    assert domain.cell_count == len(domain.cells()[0])
    assert (lower[..., 0] == domain.theta_rad.borders[:-1, None, None, None]).all()
    assert (upper[..., 3] == domain.z_m.borders[1:]).all()
    for axis in range(4):
        low, high = (np.moveaxis(side[..., axis], axis, 0) for side in (lower, upper))
        assert (low[1:] == high[:-1]).all()
        assert (high > low).all() or domain.fixed[axis]
    assert (domain.lower == lower.min(axis=(0, 1, 2, 3))).all()
    assert (domain.upper == upper.max(axis=(0, 1, 2, 3))).all()


@given(domains())
def test_the_verifier_derives_the_same_cells(domain: Domain) -> None:
    scene = copy.copy(PAPER)
    object.__setattr__(scene, "domain", domain)  # whether such a scene shows its runway does not matter here
    found = cell_boxes(scene)
    assert (found.lower == partition(scene).lower).all()
    assert (found.upper == partition(scene).upper).all()


@given(domains(), st.floats(0, 1), st.floats(0, 1))
def test_a_glides_cells_hold_its_altitudes_and_little_more(domain: Domain, along: float, between: float) -> None:
    """The truth in balls; tightness: no more than two units in the last place of a float32 beyond the altitudes at a cell's ends."""
    if domain.glide is None:
        return
    low, high = domain.glide.angle_rad
    z = min(float(domain.lower[3] + along * (domain.upper[3] - domain.lower[3])), float(domain.upper[3]))
    angle = min(max(low + between * (high - low), low), high)
    altitude = (arb(z) + arb(domain.glide.aim_m)) * arb(angle).tan()
    held = [cell for cell, (near, far) in enumerate(itertools.pairwise(domain.z_m.borders)) if near <= z <= far]
    assert held
    for cell in held:
        lowest, highest = (float(domain.altitude_borders[cell, side]) for side in (0, -1))
        assert altitude >= lowest
        assert altitude <= highest
        for bound, end, tangent in ((lowest, cell, arb(low).tan()), (highest, cell + 1, arb(high).tan())):
            exact = (arb(float(domain.z_m.borders[end])) + arb(domain.glide.aim_m)) * tangent
            assert abs(exact - bound) <= 2 * float(np.spacing(np.float32(bound)))


def test_the_altitudes_of_a_real_approach() -> None:
    """3 degrees at 1000 m, aimed 300 m behind the threshold: 68 m."""
    glide = Glide((math.radians(3), math.radians(3.5)))
    low, high = glide.borders(np.array([1000.0, 1100.0]))[0]
    assert low == pytest.approx(1300 * math.tan(math.radians(3)), rel=3e-7)
    assert high == pytest.approx(1400 * math.tan(math.radians(3.5)), rel=3e-7)


# --- the union of the cells ---


def in_a_cell(domain: Domain, state: Floats) -> bool:
    """The naive twin of `contains`."""
    lower, upper = domain.cells()
    return any(((low <= state) & (state <= high)).all() for low, high in zip(lower, upper, strict=True))


@st.composite
def places(draw: st.DrawFn, domain: Domain) -> Floats:
    """States in and about the domain's hull, on faces of cells among them."""
    state = domain.lower + np.array([draw(st.floats(-0.2, 1.2)) for _ in range(4)]) * (domain.upper - domain.lower)
    for axis in range(4):
        if draw(st.booleans()) or domain.fixed[axis]:
            state[axis] = draw(st.sampled_from(domain.borders_along(axis).tolist()))
    return state


@given(st.data())
def test_what_the_domain_contains_is_in_a_cell(data: st.DataObject) -> None:
    domain = data.draw(domains())
    state = data.draw(places(domain))
    assert bool(domain.contains(state)) == in_a_cell(domain, state)
    nearest = domain.nearest(state)
    assert in_a_cell(domain, nearest)
    assert in_a_cell(domain, state) == bool((nearest == state).all())


@given(domains(), st.integers(0, 10))
def test_states_are_drawn_from_all_of_the_domain_and_nowhere_else(domain: Domain, seed: int) -> None:
    states = domain.uniform(np.random.default_rng(seed), 300)
    assert all(in_a_cell(domain, state) for state in states[:20])
    assert domain.contains(states).all()
    if domain.y_m is not None:
        assert (states == np.random.default_rng(seed).uniform(domain.lower, domain.upper, (300, 4))).all(), "the hull's own, one by one"


def clear_of_the_boundary(domain: Domain, lower: Floats, upper: Floats) -> bool:
    """The naive twin of `reaches_boundary`: every open piece between neighbouring faces that touches the box is part of a cell."""
    cells = list(zip(*domain.cells(), strict=True))
    pieces = []
    for axis in range(4):
        if domain.fixed[axis]:
            pieces.append([float(domain.lower[axis])])
            continue
        faces = [-math.inf, *np.unique([[low[axis], high[axis]] for low, high in cells]).tolist(), math.inf]
        touched = [(left, right) for left, right in itertools.pairwise(faces) if left <= upper[axis] and right >= lower[axis]]
        pieces.append([math.inf if math.inf in map(abs, side) else (side[0] + side[1]) / 2 for side in touched])
    return all(in_a_cell(domain, np.array(middle)) for middle in itertools.product(*pieces))


@given(st.data())
def test_a_box_reaches_the_boundary_of_the_union_or_keeps_clear_of_it(data: st.DataObject) -> None:
    domain = data.draw(domains())
    ends = np.sort([domain.nearest(data.draw(places(domain))) for _ in range(2)], axis=0)
    if data.draw(st.booleans()):  # a small box, which may lie between the steps
        ends[1] = np.minimum(ends[1], ends[0] + 0.1 * (domain.upper - domain.lower))
    assert domain.reaches_boundary(*ends) != clear_of_the_boundary(domain, *ends)


def test_a_face_that_cells_share_is_none_of_the_domains() -> None:
    domain = Domain(Axis((0.3,), 0.2), FIXED, None, Edges((100.0, 110.0, 120.0)), glide=Glide((0.1, 0.3), 100.0, 2))
    (low, middle, high), (next_low, _, next_high) = domain.altitude_borders.tolist()
    assert low < next_low < high < next_high

    def reaches(y: tuple[float, float], z: tuple[float, float]) -> bool:
        return domain.reaches_boundary(np.array([0.25, 0.0, y[0], z[0]]), np.array([0.35, 0.0, y[1], z[1]]))

    assert not reaches((middle - 1, middle + 1), (101.0, 109.0)), "within a cell of z, over the border of two parts"
    assert not reaches((middle - 1, middle + 1), (109.0, 111.0)), "over the border of two cells of z"
    assert reaches((middle, middle), (120.0, 120.0)), "the far end"
    assert not reaches((low + 0.1, low + 0.2), (101.0, 109.0))
    assert reaches((low + 0.1, low + 0.2), (101.0, 110.0)), "at the part of a face that the next cell leaves free"
    assert reaches((high + 0.1, high + 0.2), (109.5, 112.0)), "out of the union, into the step"
    assert reaches((low, low + 0.1), (101.0, 102.0))


# --- models ---


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder = tmp_path_factory.mktemp("glides")
    for name, scene in SCENES.items():
        export_model(scene, folder / f"{name}.onnx", estimator="none")
    return {name: folder / f"{name}.onnx" for name in SCENES}


@pytest.mark.parametrize("name", SCENES)
def test_a_glides_boxes_hold_the_truth_and_are_tight(models: dict[str, Path], name: str) -> None:
    estimator = Estimator.load(models[name])
    scene, rng = estimator.scene, np.random.default_rng(5)
    widths, touching = [], 0
    lower, upper = scene.domain.cells()
    corners = [np.where(rng.random(4) < 0.5, low, high) for low, high in zip(lower, upper, strict=True)]
    for state in [*corners, *scene.domain.uniform(rng, 20)]:
        clutter = (rng.random(scene.camera.shape) < 0.02).astype(np.uint8)
        estimate = estimator.estimate(runway_image(scene, state) | clutter)
        assert estimate.box is not None
        assert estimate.box.contains(state)
        widths.append(estimate.box.half_widths)
        touching += estimate.touches_boundary
        assert estimate.touches_boundary == scene.domain.reaches_boundary(estimate.box.lower, estimate.box.upper)
    assert touching >= len(corners)
    assert (np.median(widths, axis=0) < 0.35 * (scene.domain.upper - scene.domain.lower)).sum() == 3


@pytest.mark.parametrize("name", SCENES)
def test_a_glides_model_is_proved(models: dict[str, Path], name: str) -> None:
    report = verify_model(models[name])
    assert report.counterexample is None
    assert report.cells == SCENES[name].domain.cell_count


def refuted(path: Path, mutate: Callable[[onnx.ModelProto, dict[str, Any]], None]) -> str:
    """What `verify-model` finds in a file that was mutated, its checksums recomputed."""
    import hashlib

    proto = onnx.load(path)
    metadata = json.loads(proto.metadata_props[0].value)
    mutate(proto, metadata)
    metadata["graph_sha256"] = hashlib.sha256(proto.graph.SerializeToString(deterministic=True)).hexdigest()
    metadata["metadata_sha256"] = metadata_digest(metadata)
    onnx.helper.set_model_props(proto, {METADATA_KEY: json.dumps(metadata, sort_keys=True)})
    mutated = path.with_name("mutated.onnx")
    mutated.write_bytes(proto.SerializeToString(deterministic=True))
    return str(verify_model(mutated).counterexample)


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize(("side", "axis", "sign"), [("lower", 2, 1), ("upper", 2, -1), ("lower", 3, 1), ("upper", 3, -1), ("upper", 2, 1)])
def test_a_cells_edge_that_is_moved_is_refuted(models: dict[str, Path], name: str, side: str, axis: int, sign: int) -> None:
    def mutate(proto: onnx.ModelProto, _metadata: dict[str, Any]) -> None:
        tensor = next(each for each in proto.graph.initializer if each.name == f"whole_{side}")
        values = numpy_helper.to_array(tensor).copy()
        values[axis, -1] += sign * 8 * np.spacing(values[axis, -1])
        tensor.CopyFrom(numpy_helper.from_array(values, tensor.name))

    assert f"whole_{side}" in refuted(models[name], mutate)


CLAIMED_OTHERWISE: dict[str, Callable[[dict[str, Any]], None]] = {
    "steeper": lambda domain: domain["glide"]["angle_rad"].__setitem__(1, domain["glide"]["angle_rad"][1] * 1.001),
    "aimed elsewhere": lambda domain: domain["glide"].__setitem__("aim_m", domain["glide"]["aim_m"] * 1.01),
    "other cells": lambda domain: domain["glide"].__setitem__("cells", domain["glide"]["cells"] + 1),
    "a farther edge": lambda domain: domain["z_m"]["edges"].__setitem__(1, 1.6601),
    "an edge that is farther by less than a float32 tells": lambda domain: domain["z_m"]["edges"].__setitem__(1, 1.66 + 1e-9),
}


@pytest.mark.parametrize("claim", CLAIMED_OTHERWISE)
def test_a_scene_that_claims_other_cells_is_refuted(models: dict[str, Path], claim: str) -> None:
    found = refuted(models["paper"], lambda _proto, metadata: CLAIMED_OTHERWISE[claim](metadata["scene"]["domain"]))
    assert "the entries do not cover the cell" in found if "tells" in claim else "graph: " in found


@pytest.mark.parametrize(("name", "expected"), [("narrow", "leave out an altitude"), ("wide", "beyond the glide's angles")])
def test_a_scenes_reader_with_wrong_altitudes_is_refuted(models: dict[str, Path], monkeypatch, name: str, expected: str) -> None:
    """The verifier takes no altitude from the scene's reader that it has not proved."""
    right, off = Glide.borders, np.array([1, -1]) * (2e-7 if name == "narrow" else -2e-6)

    def wrong(self: Glide, z_borders: Floats) -> Floats:
        borders = right(self, z_borders)
        borders[:, [0, -1]] *= 1 + off
        return borders

    monkeypatch.setattr(Glide, "borders", wrong)
    found = str(verify_model(models["airport"]).counterexample)
    assert expected in found
