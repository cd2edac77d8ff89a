"""The command export-model, as users start it: what it prints, its exit codes, and one line for every error."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from build_model.box_size import clean_half_widths
from build_model.cli import bound_rows
from build_model.paper.paper_bound import PaperBound
from runtime import Estimator, Scene
from runtime.image import runway_image

COMMAND = "from build_model.cli import export_model_command; export_model_command()"
Run = Callable[..., subprocess.CompletedProcess]

ONE_CELL = """
[camera]
width = 640
height = 480
focal_length_m = 0.008
pixel_pitch_m = 15e-6

[[runway.markings]]
name = "L"
x_m = -0.1
start_z_m = 0.0
length_m = 0.3

[[runway.markings]]
name = "R"
x_m = 0.1
start_z_m = 0.0
length_m = 0.3

[domain]
theta_rad = { centres = [0.6], width = 0.1 }
x_m = { centres = [0.0], width = 0.0 }
y_m = { centres = [0.9], width = 0.1 }
z_m = { centres = [1.7], width = 0.1 }

[bank]
pitch_bins = 4
distance_bins = 2
column_px = 0.35

[estimator]
training_frames = 256
epochs = 1
"""


@pytest.fixture
def scene_file(tmp_path: Path) -> Path:
    path = tmp_path / "field.toml"
    path.write_text(ONE_CELL)
    return path


@pytest.fixture
def run(tmp_path: Path, repository: Path) -> Run:
    """Runs the command in a folder of its own, as a process of its own."""

    def started(*arguments: object, code: str = COMMAND) -> subprocess.CompletedProcess:
        command = [sys.executable, "-c", code, *map(str, arguments)]
        environment = {"PATH": "", "PYTHONPATH": str(repository), "HOME": str(tmp_path), "OMP_NUM_THREADS": "1", "COLUMNS": "140"}
        return subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300, check=False)

    return started


def models_in(folder: Path) -> set[str]:
    """Names of all models, whole and half-written."""
    return {path.name for pattern in ("*.onnx", "*.part") for path in folder.rglob(pattern)}


def fails_with(result: subprocess.CompletedProcess, *parts: str, code: int = 2) -> None:
    """One line on stderr that holds all parts, and no traceback."""
    assert result.returncode == code, result.stderr
    assert result.stderr.count("\n") == 1
    for part in parts:
        assert part in result.stderr
    assert "Traceback" not in result.stdout + result.stderr


def test_a_scene_becomes_a_model_with_a_summary(run: Run, scene_file: Path, tmp_path: Path) -> None:
    """Beside the summary: progress of every stage with its loss, NN_e's errors and the certificate's assumptions; then again, the same."""
    result = run(scene_file.name, "--seed", 3, "--jobs", 1)
    assert result.returncode == 0, result.stderr
    assert result.stderr == ""
    model = tmp_path / "out" / "field.onnx"
    estimator = Estimator.load(model)
    for text in ("cells", "entries", "smallest |K| - m", "S, pixels a cell", "NN_F, seconds", "NN_e, seconds", "MB", estimator.sha256):
        assert text in result.stdout
    for text in ("training NN_e", "loss 0.", "frames for NN_e", "The certificate assumes:", "At most 0 pixels of the runway's image"):
        assert text in result.stdout
    (bound,) = estimator.metadata["paper_bounds"]
    length, extent = bound["inverse_lipschitz_per_px"], bound["zeta_half_extent_px"]
    (printed,) = (line for line in result.stdout.splitlines() if "the paper's bound, not a certificate" in line)
    for value in (4 * length * extent, length, extent):
        assert f"{value:.3g} to {value:.3g}" in printed
    (boxes,) = (line for line in result.stdout.splitlines() if "certified box, corner to corner" in line)
    assert "median of 50 frames without clutter" in boxes
    again = run(scene_file.name, "-o", "again.onnx", "--seed", 3)
    assert again.returncode == 0
    assert (tmp_path / "again.onnx").read_bytes() == model.read_bytes()


def test_the_papers_bound_stands_beside_the_boxes_also_where_it_is_lacking(paper_scene: Scene) -> None:
    half_widths = np.array([[0.3, 0.0, 0.4, 0.0], [0.3, 0.0, 0.4, 0.0], [9.0, 0.0, 9.0, 9.0]])
    bounds = [PaperBound(2.0, 0.5), None, PaperBound(3.0, 0.25)]
    rows = bound_rows(paper_scene, bounds, half_widths)
    assert list(rows.values()) == [
        "3 to 4 (L_h 0.25 to 0.5 per px, delta 2 to 3 px); none for 1 of 3 cells",
        "1, median of 3 frames without clutter",
        "theta 0.3000 rad, y 0.4000 m, z 0.0000 m",
    ]
    assert next(iter(bound_rows(paper_scene, [None], half_widths).values())) == "no finite L_h is proved for any cell"


def test_clean_boxes_are_those_of_their_own_images(estimator_of: Callable[..., Estimator]) -> None:
    estimator = estimator_of("one cell")
    scene = estimator.scene
    half_widths = clean_half_widths(estimator, 3, seed=5)
    states = np.random.default_rng(5).uniform(scene.domain.lower, scene.domain.upper, (3, 4))
    boxes = [estimator.estimate(runway_image(scene, state)).box for state in states]
    np.testing.assert_array_equal(half_widths, [box.half_widths for box in boxes if box is not None])
    assert len(half_widths) == 3


@pytest.mark.parametrize(
    ("old", "new", "parts"),
    [
        ("width = 640", "widht = 640", ("field.toml: camera.widht: found an unknown key", "known here")),
        ("[bank]", "[bank", ("field.toml: not TOML",)),
        ("[estimator]", "[tolerance]\nmissed_budget = 100\n[estimator]", ("bank: in theta 0.55", "missed_budget 100")),
        ("[estimator]", "[calibration]\nprincipal_px = 0.4\n[estimator]", ("tolerance.line_px: found 0", "give 1 or more")),
        ("pixel_pitch_m = 15e-6", "pixel_pitch_m = 15e-6\nprincipal_point = [320.0, 3000.0]", ("only 0 pixels", "keep the runway in view")),
    ],
)
def test_a_bad_scene_is_one_line(run: Run, scene_file: Path, tmp_path: Path, old: str, new: str, parts: tuple[str, ...]) -> None:
    assert old in ONE_CELL
    scene_file.write_text(ONE_CELL.replace(old, new))
    fails_with(run(scene_file.name), *parts)
    assert models_in(tmp_path) == set()


def test_missing_files_are_one_line(run: Run, scene_file: Path, tmp_path: Path) -> None:
    fails_with(run("nowhere.toml"), "nowhere.toml: cannot be read", "give the path of a TOML scene file")
    fails_with(run(scene_file.name, "--estimator", "nowhere.onnx"), "nowhere.onnx: cannot be read", "give the path of an ONNX file")
    fails_with(run(scene_file.name, "--estimator", scene_file.name), "field.toml: not a usable ONNX model")
    fails_with(run(scene_file.name, "-o", "field.toml/model.onnx"), "model.onnx: cannot be written (Not a directory)")
    assert scene_file.read_text() == ONE_CELL
    assert models_in(tmp_path) == set()


def test_a_folder_gets_a_model_of_the_scenes_name(run: Run, scene_file: Path, tmp_path: Path) -> None:
    """Also the one that the user stands in, and one whose name looks like markup."""
    (tmp_path / "run[" / "]x").mkdir(parents=True)
    for folder in (".", "run[/]x"):
        result = run(scene_file.name, "-o", folder, "--jobs", 1)
        assert result.returncode == 0, result.stderr
        assert f"{Path(folder) / 'field.onnx'}" in result.stdout
        assert (tmp_path / folder / "field.onnx").is_file()


def test_a_full_disk_leaves_the_old_model(run: Run, scene_file: Path, tmp_path: Path) -> None:
    """The system's limit on the size of a file stands for the disk."""
    (tmp_path / "model.onnx").write_bytes(b"old")
    limited = textwrap.dedent(f"""
        import resource, signal
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, 50_000))
        {COMMAND}
    """)
    result = run(scene_file.name, "-o", "model.onnx", "--jobs", 1, code=limited)
    fails_with(result, "model.onnx: cannot be written (File too large)", "the model that was there before is untouched")
    assert (tmp_path / "model.onnx").read_bytes() == b"old"
    assert models_in(tmp_path) == {"model.onnx"}


@pytest.mark.parametrize("seconds", [1.5, 2.5, 5.0])
def test_ctrl_c_leaves_the_old_model(run: Run, scene_file: Path, tmp_path: Path, seconds: float) -> None:
    """A real SIGINT while torch is imported, and while frames are made for far longer than the test waits: exit code 130, one line.

    The handler is set since a background job of a shell, and what it starts, ignores the signal.
    """
    (tmp_path / "model.onnx").write_bytes(b"old")
    scene_file.write_text(ONE_CELL.replace("training_frames = 256", "training_frames = 10_000_000"))
    interrupted = textwrap.dedent(f"""
        import build_model.cli, os, signal, threading
        signal.signal(signal.SIGINT, signal.default_int_handler)
        threading.Timer({seconds}, os.kill, (os.getpid(), signal.SIGINT)).start()
        {COMMAND}
    """)
    result = run(scene_file.name, "-o", "model.onnx", "--jobs", 1, "--memory-mb", 10**6, code=interrupted)
    fails_with(result, "model.onnx: interrupted; the model that was there before is untouched", code=130)
    assert (tmp_path / "model.onnx").read_bytes() == b"old"
    assert models_in(tmp_path) == {"model.onnx"}


def test_a_dry_run_tells_what_a_scene_takes_and_builds_nothing(run: Run, scene_file: Path, tmp_path: Path) -> None:
    result = run(scene_file.name, "--dry-run")
    assert result.returncode == 0, result.stderr
    assert result.stderr == ""
    for text in (
        "cells",
        "boxes",
        "entries, about",
        "memory, at most about",
        "file, about",
        "NN_F, seconds, about",
        "NN_e, seconds, about",
    ):
        assert text in result.stdout
    assert "NN_e" not in run(scene_file.name, "--dry-run", "--estimator", "none").stdout
    fails_with(run(scene_file.name, "--dry-run", "--estimator", "net.onnx"), "net.onnx: cannot be read")
    assert models_in(tmp_path) == set()
    assert not (tmp_path / "out").exists()


def test_a_build_of_more_memory_than_it_may_take_is_one_line(run: Run, scene_file: Path, tmp_path: Path) -> None:
    for also in ([], ["--dry-run"]):
        result = run(scene_file.name, "--memory-mb", 200, *also)
        assert "memory that it may take" in result.stdout
        fails_with(result, "--memory-mb: found 200; give ", "or more, or fewer --jobs")
    scene_file.write_text(ONE_CELL.replace("x_m = { centres = [0.0], width = 0.0 }", "x_m = { centres = [0.0], width = 1.2 }"))
    fails_with(run(scene_file.name, "--memory-mb", 700, "--jobs", 1), "domain.x_m: x spans 1.2 m", "narrow it to about")
    assert models_in(tmp_path) == set()


def test_help_names_every_option(run: Run) -> None:
    result = run("--help")
    assert result.returncode == 0
    for option in ("--output", "-o", "--estimator", "--seed", "--jobs", "--memory-mb", "--dry-run"):
        assert option in result.stdout
