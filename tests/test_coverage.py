"""The campaign's truth against exact twins, its frames against what they say they are, and its check against a model that is wrong."""

from __future__ import annotations

import hashlib
import json
import math
from collections import Counter
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import pytest
from onnx import numpy_helper
from scenes import CUT_BELOW, CUT_LEFT, FREE_X, PAPER, UNLIKE_MARKINGS
from test_image import DRAWN, Point, exact_ends, near_ties, twin_image
from typer.testing import CliRunner

pytest.importorskip("faery", reason="the extra 'recordings' is not installed")

import typer
from coverage import campaign, frames, states
from coverage.chunk import code
from coverage.judge import Tally, extra_pixels, judge_frame, quantile
from coverage.models import DERIVED, LENSES, derived_scene
from coverage.scenarios import Scenario, camera_off, scenarios
from coverage.states import Rng, Stage
from rational_image import RationalState, RationalView, angle_is_at_least, lit_columns, turn

from runtime.camera import project
from runtime.image import runway_image
from runtime.model.format import METADATA_KEY, metadata_digest
from runtime.scene import Scene
from runtime.sensor_image import sensor_curves

SPREAD = (PAPER, FREE_X, UNLIKE_MARKINGS, CUT_LEFT, CUT_BELOW)


def stage_of(scene: Scene, path: str = "") -> Stage:
    return Stage(path, None, scene, RationalView.of(scene.to_dict()))


@pytest.fixture(scope="module")
def paper(repository: Path) -> Stage:
    return Stage.of(str(repository / "models" / "paper.onnx"), None)


@pytest.fixture
def rng() -> Rng:
    return np.random.default_rng(20)


# --- the rasteriser ---


@pytest.mark.parametrize("scene", SPREAD, ids=["paper", "free x", "unlike", "cut left", "cut below"])
def test_random_images_are_those_of_the_runtime(scene: Scene, rng: Rng) -> None:
    stage, lit = stage_of(scene), 0
    for _ in range(60):
        state = states.uniform(rng, stage)
        image = stage.view.image(state)
        assert (image.frame == runway_image(scene, state.floats).astype(bool)).all()
        lit += len(image.rows)
    assert lit > 60 * 20


def test_on_borders_the_images_are_the_exact_twins_and_the_runtimes_but_for_ties(rng: Rng) -> None:
    """A lit pixel is one that the marking meets, by a double loop over pixels that solves inequalities; no other is lit."""
    stage, ties = stage_of(PAPER), 0
    for _ in range(40):
        state = states.on_pixel_borders(rng, stage)
        segments: list[tuple[Point, Point]] = stage.view.segments(state)
        image = stage.view.image(state).frame
        assert (image == twin_image(PAPER, segments).astype(bool)).all()
        ties += near_ties(segments, runway_image(PAPER, state.floats), image.astype(np.uint8))
    assert ties > 0


@pytest.mark.parametrize("lens", LENSES)
def test_curves_behind_a_lens_are_the_runtimes(lens: str, rng: Rng) -> None:
    """All pixels of points close together along each curve, and none that the runtime's outward image has not."""
    scene = derived_scene(PAPER, lens)
    view = RationalView.of(scene.to_dict())
    for _ in range(3):
        state = RationalState.near(rng.uniform(scene.domain.lower, scene.domain.upper))
        image, outward = view.image(state).frame, runway_image(scene, state.floats) != 0
        assert not (image & ~outward).any()
        assert (outward & ~image).sum() <= 4 < image.sum()
        points = sensor_curves(scene, state.floats, points=20_001)
        columns, rows = np.floor(points[((points >= 0) & (points < [640, 480])).all(axis=-1)]).astype(int).T
        assert image[rows, columns].all()


@pytest.mark.parametrize(("start", "stop", "lit"), DRAWN)
def test_lit_columns_of_segments_that_one_can_draw(start: tuple[str, str], stop: tuple[str, str], lit: set[tuple[int, int]]) -> None:
    """Lit pixels as (column, row), of rows 0 to 2."""
    ends = [(Fraction(u), Fraction(v)) for u, v in (start, stop)]
    for one, other in (ends, ends[::-1]):
        assert {(column, row) for row, first, last in lit_columns(one, other, 3) for column in range(first, last + 1)} == lit


def test_ends_are_the_rigid_cameras(rng: Rng) -> None:
    """As the runtime has them to float64, and as fractions written down elsewhere, which take F as the runtime rounds it."""
    for scene, exact in ((UNLIKE_MARKINGS, False), (FREE_X, True)):
        stage = stage_of(scene)
        for _ in range(20):
            state = states.uniform(rng, stage)
            ends = np.array(stage.view.segments(state), dtype=np.float64)
            np.testing.assert_allclose(ends, project(scene, state.floats), rtol=0, atol=1e-9)
            if exact:
                rounded = replace(
                    stage.view, focal_u=Fraction(scene.camera.focal_u_px), focal_v=Fraction(scene.camera.focal_v_px)
                ).segments(state)
                assert rounded == exact_ends(scene, state.tangent, state.x, state.y, state.z)


def test_a_camera_that_is_off_is_yawed_then_rolled_zoomed_and_shifted(rng: Rng) -> None:
    stage = stage_of(FREE_X)
    yaw, roll, zoom, shift = 0.02, -0.03, 1.01, np.array([0.7, -0.4])
    off = replace(stage.view, yaw=Fraction(math.tan(yaw / 2)), roll=Fraction(math.tan(roll / 2)))
    off = replace(off, focal_u=off.focal_u * Fraction(zoom), focal_v=off.focal_v * Fraction(zoom))
    off = replace(off, u0=off.u0 + Fraction(shift[0]), v0=off.v0 + Fraction(shift[1]))
    camera = FREE_X.camera
    for _ in range(10):
        state = states.uniform(rng, stage)
        a, b = np.moveaxis((project(FREE_X, state.floats) - [camera.u0, camera.v0]) / camera.focal_v_px, -1, 0)
        depth = a * math.sin(yaw) + math.cos(yaw)
        a, b = (a * math.cos(yaw) - math.sin(yaw)) / depth, b / depth
        a, b = a * math.cos(roll) - b * math.sin(roll), a * math.sin(roll) + b * math.cos(roll)
        expected = np.stack([a, b], axis=-1) * camera.focal_v_px * zoom + shift + [camera.u0, camera.v0]
        np.testing.assert_allclose(np.array(off.segments(state), dtype=np.float64), expected, rtol=0, atol=1e-8)


def test_calibrations_stay_within_their_bounds_and_reach_them(rng: Rng) -> None:
    from coverage.models import OFF_BY

    stage = stage_of(replace(PAPER, calibration=OFF_BY))
    cameras = [camera_off(rng, stage) for _ in range(40)]
    rolls = [2 * math.atan(camera.roll) for camera in cameras]
    assert all(abs(math.atan(camera.yaw)) * 2 <= OFF_BY.yaw_rad for camera in cameras)
    assert max(rolls) == pytest.approx(OFF_BY.roll_rad, abs=1e-15)
    assert max(abs(camera.u0 - stage.view.u0) for camera in cameras) == Fraction(OFF_BY.principal_px)
    assert min(rolls) < 0


def test_angles_are_compared_exactly_where_float64_cannot() -> None:
    """The same float64 angle, and tangents on both sides of the true one, by less than float64's spacing."""
    bound = 0.45
    cosine, sine = turn(Fraction(math.tan(bound / 2)))
    assert cosine**2 + sine**2 == 1
    low, high = Fraction(math.tan(bound / 2)) - Fraction(1, 2**50), Fraction(math.tan(bound / 2)) + Fraction(1, 2**50)
    assert angle_is_at_least(high, bound)
    assert not angle_is_at_least(low, bound)
    for _ in range(150):  # to where neighbours differ by 2^-200, and the answer still changes between them
        middle = (low + high) / 2
        low, high = (low, middle) if angle_is_at_least(middle, bound) else (middle, high)
    assert angle_is_at_least(high, bound)
    assert not angle_is_at_least(low, bound)
    assert angle_is_at_least(Fraction(0), 0.0)


# --- states and frames ---


def test_states_are_where_they_say(paper: Stage, rng: Rng) -> None:
    lower, upper, shared, on_border = paper.lower, paper.upper, 0, 0
    for _ in range(150):
        face, border, beyond = states.on_faces(rng, paper), states.on_pixel_borders(rng, paper), states.outside(rng, paper, 0.05)
        assert paper.contains(face)
        assert paper.contains(border)
        assert not paper.contains(beyond)
        assert paper.contains(states.into_domain(paper, beyond))
        shared += len(paper.cells_of(face)) > 1
        coordinates = [value for end in paper.view.segments(border) for point in end for value in point]
        on_border += any(value.denominator == 1 for value in coordinates)
    assert shared > 8
    assert on_border > 30
    corner = RationalState(states.tangent_within(upper[0], lower[0], upper[0]), *map(Fraction, (lower[1], upper[2], lower[3])))
    assert paper.contains(corner)
    assert not paper.contains(replace(corner, y=corner.y + Fraction(1, 2**90)))


@pytest.mark.parametrize("order", [frames.anywhere, frames.one_end, frames.row_band, frames.must_light])
def test_exactly_as_many_pixels_are_missed_as_are_said(paper: Stage, rng: Rng, order: frames.Order) -> None:
    for missed in (1, 3, 8):
        scenario = Scenario("", (frames.everything,), states.on_faces, missed=(missed,), order=order)
        picture, m, _ = scenario.draw(rng, paper)
        assert m == missed
        assert paper.unwitnessed(paper.view.image(picture.states[0]), picture.frame) == missed
        assert (~picture.frame).sum() == missed


def test_as_many_pixels_are_extra_pixels_as_are_said(paper: Stage, rng: Rng) -> None:
    for extra in (0, 1, 8):
        picture, _, e = Scenario("", (frames.everything,), extra=(extra,)).draw(rng, paper)
        assert e == extra
        assert extra_pixels(picture, picture.states[0]) == extra
        assert picture.frame.mean() > 0.9


def test_clutter_is_what_it_says(paper: Stage, rng: Rng) -> None:
    picture = Scenario("", (frames.neighbourhood,)).draw(rng, paper)[0]
    assert picture.frame.sum() > 2 * picture.runway.sum()
    longer = [Scenario("", (frames.longer_markings,)).draw(rng, paper)[0] for _ in range(10)]
    assert sum(int(picture.frame.sum() > picture.runway.sum() + 5) for picture in longer) > 3
    second = Scenario("", (lambda rng, picture: frames.second_runway(rng, picture, 0.1),)).draw(rng, paper)[0]
    assert len(second.states) == 2
    assert paper.unwitnessed(paper.view.image(second.states[1]), second.frame) == 0
    assert (second.frame > second.runway).any()


# --- counting ---


def test_quantiles_are_those_of_the_values(rng: Rng) -> None:
    values = rng.uniform(0, 0.2, 999)
    histogram = Counter(np.round(values / 1e-4).astype(int).tolist())
    for share in (0.5, 0.95):
        assert quantile(histogram, share) == pytest.approx(np.quantile(values, share, method="inverted_cdf"), abs=0.5e-4 + 1e-12)


def test_a_tally_is_the_same_after_json(paper: Stage) -> None:
    scenario = next(iter(scenarios(False, 8)))
    tally = sum((judge_frame(paper, scenario, 1, number)[0] for number in range(3)), Tally())
    assert tally.frames == tally.judged == tally.certified == 3
    assert Tally.read(json.loads(json.dumps(vars(tally)))) == tally


# --- the campaign ---


def run(*arguments: object) -> Any:
    app = typer.Typer()
    app.command()(campaign.main)
    return CliRunner().invoke(app, [*map(str, arguments), "--jobs", "1"])


def test_a_small_campaign_over_all_scenarios(repository: Path, tmp_path: Path) -> None:
    output = tmp_path / "coverage.json"
    result = run(repository / "models" / "paper.onnx", "--frames", 5, "-o", output)
    assert result.exit_code == 0, result.output
    tables = json.loads(output.read_text())
    assert tables["violations"] == []
    chosen = list(scenarios(False, 8))
    assert set(tables["scenarios"]) == {scenario.name for scenario in chosen}
    assert {scenario.model for scenario in chosen} == {"given", *DERIVED}
    for scenario in chosen:
        counts = tables["scenarios"][scenario.name]
        assert counts["frames"] == 5
        assert counts["unrefined"] == 2
        if scenario.runway and "domain" not in scenario.name:
            assert counts["judged"] >= counts["frames"] == counts["certified"]


def small_work(path: Path, seed: int, frames: int = 6) -> list[campaign.Chunk]:
    return campaign.chunks_of({"given": path}, [each for each in scenarios(False, 8) if each.model == "given"][:3], frames, None, seed)


def test_a_stopped_campaign_goes_on_and_another_one_starts_anew(repository: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(campaign, "CHUNK", 2)
    path, file = repository / "models" / "paper.onnx", tmp_path / "chunks.jsonl"
    chunks = small_work(path, 1)
    campaign.run_campaign(chunks, campaign.Journal(tmp_path / "whole.jsonl", chunks), 1)
    whole = campaign.Journal(tmp_path / "whole.jsonl", chunks).done
    campaign.run_campaign(chunks[:4], campaign.Journal(file, chunks), 1)
    with file.open("a") as journal:
        journal.write('{"campaign": "cut sh')  # killed while it wrote
    kept = campaign.Journal(file, chunks)
    assert set(kept.done) == {chunk.key for chunk in chunks[:4]}
    campaign.run_campaign(chunks, kept, 1)
    assert len(file.read_text().splitlines()) == len(chunks)
    assert campaign.Journal(file, chunks).done == whole
    assert campaign.Journal(file, small_work(path, 2)).done == {}


def test_the_digest_covers_what_a_frame_depends_on_and_nothing_else() -> None:
    root = Path(__file__).parents[1]
    covered = {path.relative_to(root).as_posix() for path in code()}
    deciding = ("runtime/refine/refiner.py", "runtime/state_set.py", "runtime/recordings/recording.py", "build_model/hough_bank.py")
    assert {*deciding, "scripts/coverage/judge.py", "scripts/coverage/frames.py", "scripts/rational_image.py"} <= covered
    others = ("runtime/recordings/draw.py", "build_model/export.py", "build_model/verify/proof.py", "scripts/coverage/campaign.py")
    assert covered.isdisjoint(others)


def with_shifted_entries(path: Path, to: Path, by: float) -> Path:
    """A whole and undamaged file whose entries lie farther in z than they should, but for the domain's end, which the loader knows."""
    proto = onnx.load(path)
    metadata = json.loads(proto.metadata_props[0].value)
    boxes = {tensor.name: numpy_helper.to_array(tensor) for tensor in proto.graph.initializer if tensor.name in ("z_lower", "z_upper")}
    for tensor in proto.graph.initializer:
        if tensor.name in boxes:
            values = np.minimum(boxes[tensor.name] + np.float32(by), boxes["z_upper"].max())
            tensor.CopyFrom(numpy_helper.from_array(values, tensor.name))
    metadata["graph_sha256"] = hashlib.sha256(proto.graph.SerializeToString(deterministic=True)).hexdigest()
    metadata["metadata_sha256"] = metadata_digest(metadata)
    onnx.helper.set_model_props(proto, {METADATA_KEY: json.dumps(metadata, sort_keys=True)})
    to.write_bytes(proto.SerializeToString(deterministic=True))
    return to


def test_a_wrong_model_is_found_and_its_frames_can_be_seen_again(
    repository: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = with_shifted_entries(repository / "models" / "paper.onnx", tmp_path / "wrong.onnx", 0.04)
    chunks = small_work(path, 1)
    journal = campaign.Journal(tmp_path / "chunks.jsonl", chunks)
    campaign.run_campaign(chunks, journal, 1)
    assert campaign.report(chunks, journal, tmp_path / "coverage.json") > 0
    assert "--seed 1 --replay" in capsys.readouterr().out
    found = json.loads((tmp_path / "coverage.json").read_text())["violations"][0]
    frame = f"{found['scenario']}#{found['number']}"
    result = run(path, "--seed", found["seed"], "-o", tmp_path / "coverage.json", "--replay", frame)
    assert result.exit_code == 1
    assert found["state"] in result.output
    right = run(repository / "models" / "paper.onnx", "-o", tmp_path / "coverage.json", "--replay", frame)
    assert right.exit_code == 0
    assert "1 states judged, 0 violations" in right.output
    assert run(path, "-o", tmp_path / "coverage.json", "--replay", "no such#1").exit_code == 2


def test_scenarios_can_be_chosen(repository: Path, tmp_path: Path) -> None:
    model, output = repository / "models" / "paper.onnx", tmp_path / "coverage.json"
    chosen = run(model, "--frames", 2, "--only", "clutter 2%", "--only", "B: e pixels in S", "--jobs", 1, "-o", output)
    assert chosen.exit_code == 0
    assert set(json.loads(output.read_text())["scenarios"]) == {"clutter 2%", "B: e pixels in S"}
    other = run(model, "--only", "clutter 3%", "-o", output)
    assert other.exit_code == 2
    assert "no scenario 'clutter 3%'" in " ".join(other.output.replace("│", " ").split())
