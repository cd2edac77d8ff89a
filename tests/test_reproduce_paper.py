"""The paper's experiment as a page: its figures are right, and the page needs no other file."""

from __future__ import annotations

import base64
import json
import re
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("cv2", reason="the extra 'recordings' is not installed")
pytest.importorskip("typer", reason="the extra 'recordings' is not installed")

import cv2
import reproduce_paper as paper
import typer
from typer.testing import CliRunner

from build_model.partition import partition
from runtime.camera import project


@pytest.mark.parametrize("cell", [0, 13, 26])
def test_the_ranges_of_rho_and_phi_hold_every_states_lines_and_are_tight(paper_scene, cell):
    cells = partition(paper_scene)
    lower, upper = cells.lower[cell], cells.upper[cell]
    ranges = paper.hough_ranges(paper_scene, lower, upper)
    corners = np.stack(np.meshgrid(*zip(lower, upper, strict=True)), axis=-1).reshape(-1, 4)
    states = np.concatenate([np.random.default_rng(cell).uniform(lower, upper, (3000, 4)), corners])
    near, far = np.moveaxis(project(paper_scene, states), 2, 0)
    along = near - far
    phi = np.arctan(-along[..., 0] / along[..., 1])
    rho = near[..., 0] * np.cos(phi) + near[..., 1] * np.sin(phi)
    for values, low, high, slack in ((rho, ranges[:, 0], ranges[:, 1], 0.4), (np.degrees(phi), ranges[:, 2], ranges[:, 3], 0.02)):
        assert (low <= values.min(axis=0) + 1e-9).all()
        assert (values.max(axis=0) - 1e-9 <= high).all()
        assert (values.min(axis=0) - low < slack).all()
        assert (high - values.max(axis=0) < slack).all()


def test_a_line_is_the_runways_if_both_ends_are_near_one_marking(paper_scene):
    truth = np.array([0.6, 0.0, 0.9, 1.7])
    left, right = project(paper_scene, truth)
    found = np.stack([left, right + np.array([2.0, 0.0]), left + np.array([4.0, 0.0]), np.array([left[0], right[1]])])
    assert paper.is_runway(found, paper_scene, truth).tolist() == [True, True, False, False]


ERROR = {"theta_rad": 0.011, "x_m": 0.0, "y_m": 0.012, "z_m": 0.013}


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("page")
    run = folder / "run"
    run.mkdir()
    verdict = {"windows": 3, "inside": 3, "outside": 0, "no_runway": 0, "mean_error": ERROR, "largest_error": ERROR}
    none = {"windows": 0, "inside": 0, "outside": 0, "no_runway": 0, "mean_error": None, "largest_error": None}
    summary = {"model": "a/field.onnx", "windows": 3, "certified": 3, "assumptions_hold": verdict, "assumptions_broken": none}
    summary |= {"mean_half_widths": dict.fromkeys(["theta_rad", "x_m", "y_m", "z_m"], 0.05), "milliseconds_a_window": {"mean": 9.0}}
    (run / "summary.json").write_text(json.dumps(summary | {"assumptions": ["An assumption of <the run>."]}))
    done = invoke("--frames", 3, "--run", run, "--out", folder / "page")
    assert (done.exit_code, done.stderr) == (0, "")
    return folder / "page"


def invoke(*arguments: object):
    app = typer.Typer()
    app.command()(paper.main)
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def test_the_page_holds_every_picture_and_needs_no_other_file(page):
    text = (page / "index.html").read_text()
    assert not re.search(r"https?:|<script|<link|url\(", text)
    sources = re.findall(r'<img src="([^"]*)"', text)
    files = sorted(page.glob("*.png"))
    assert len(sources) == len(files) == 14
    contents = {path.read_bytes() for path in files}
    for source in sources:
        content = base64.b64decode(source.removeprefix("data:image/png;base64,"))
        assert content in contents
        assert np.std(np.asarray(cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_COLOR))) > 1


def test_the_page_has_the_cells_the_frames_and_the_runs(page):
    text = (page / "index.html").read_text()
    tables = re.findall(r"<table.*?</table>", text)
    assert len(tables) == 4
    assert tables[0].count("<tr>") == 28
    assert "<td>certified, truth inside the box</td><td>3</td>" in tables[1]
    assert "<td>assumptions hold, truth inside</td><td>3</td>" in tables[3]
    assert "<td>assumptions hold, mean error: θ rad, y m, z m</td><td>0.0110, 0.0120, 0.0130</td>" in tables[3]
    assert "<td>assumptions broken, mean error: θ rad, y m, z m</td><td>-</td>" in tables[3]
    assert "field assumes: An assumption of &lt;the run&gt;." in text


def test_a_run_without_a_truth_is_an_error_of_one_line(tmp_path):
    (tmp_path / "summary.json").write_text("{}")
    done = invoke("--frames", 2, "--run", tmp_path, "--out", tmp_path / "page")
    assert done.exit_code == 2
    assert "no truth in summary.json" in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "page").exists()
