"""run-model and replay: what is written of a recording, and what is said of one that cannot be used."""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("cv2", reason="the extra 'recordings' is not installed")
pytest.importorskip("typer", reason="the extra 'recordings' is not installed")

import compare_tracking
import cv2
import replay
import typer
from typer.testing import CliRunner, Result

from runtime import Box, Estimator, Motion
from runtime.explanation import missed_pixels
from runtime.frames import FrameStream
from runtime.image import runway_image
from runtime.recordings.attitude import COLUMNS as ATTITUDE_COLUMNS
from runtime.recordings.attitude import AttitudeReadings
from runtime.recordings.cli import run_model
from runtime.recordings.gyroscope import COLUMNS as GYROSCOPE_COLUMNS
from runtime.recordings.history import MOST_MOMENTS, History, Moment, draw_history
from runtime.recordings.recording import EVENT
from runtime.recordings.report import COLUMNS, TRACKED_COLUMNS, TRACKED_INSIDE, TRUTH_COLUMNS
from runtime.recordings.tally import Tally
from runtime.recordings.truth import Truth, TruthError
from runtime.recordings.video import is_whole

MODEL = Path(__file__).parents[1] / "models" / "paper.onnx"
RECORDINGS = Path(os.environ.get("GLIDEPROOF_RECORDINGS", Path(__file__).resolve().parents[2] / "shared" / "recordings"))
WINDOWS = 25
STATES = np.linspace([0.50, 0, 1.00, 1.80], [0.68, 0, 0.80, 1.62], WINDOWS)


@pytest.fixture(scope="module")
def estimator() -> Estimator:
    return Estimator.load(MODEL)


@pytest.fixture(scope="module")
def events(estimator: Estimator) -> NDArray:
    """One second: in every 40 ms the runway's exact image and 1 % clutter; the eighth window has no runway."""
    drawn, packets = np.random.default_rng(0), []
    for number, state in enumerate(STATES):
        frame = drawn.random(estimator.scene.camera.shape) < 0.01
        lit = np.nonzero(frame if number == 7 else frame | (runway_image(estimator.scene, state) != 0))
        packet = np.zeros(len(lit[0]), dtype=EVENT)
        packet["y"], packet["x"] = lit
        packet["t"] = np.sort(drawn.integers(40_000 * number, 40_000 * (number + 1), len(packet)))
        packet["t"][0] = 40_000 * number
        packets.append(packet)
    return np.concatenate(packets)


@pytest.fixture(scope="module")
def recording(events: NDArray, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recordings") / "second.npz"
    np.savez(path, t=events["t"], x=events["x"], y=events["y"], p=events["p"])
    return path


@pytest.fixture(scope="module")
def truth(recording: Path) -> Path:
    path = recording.parent / "truth.csv"
    rows = np.column_stack([40_000 * np.arange(WINDOWS) + 20_000, STATES])
    np.savetxt(path, rows, delimiter=",", header="time_us,theta_rad,x_m,y_m,z_m", comments="", fmt=["%d", *["%.17g"] * 4])
    return path


def invoke(*arguments: object) -> Result:
    app = typer.Typer()
    app.command()(run_model)
    return CliRunner().invoke(app, [str(argument) for argument in arguments])


def rows_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "estimates.csv").open() as file:
        return list(csv.DictReader(file))


def test_a_recording_becomes_a_table_a_summary_pictures_and_a_video(recording, truth, estimator, tmp_path):
    done = invoke(MODEL, recording, "-o", tmp_path, "--truth", truth)
    assert (done.exit_code, done.stderr) == (0, "")
    rows = rows_of(tmp_path)
    assert list(rows[0]) == [*COLUMNS, *TRUTH_COLUMNS]
    assert [int(row["time_us"]) for row in rows] == [40_000 * number for number in range(WINDOWS)]
    for number, (row, state) in enumerate(zip(rows, STATES, strict=True)):
        if number == 7:
            assert row["assumptions_hold"] == "0"
            continue
        lower, upper = ([float(row[f"{side}_{name}"]) for name in ("theta_rad", "y_m", "z_m")] for side in ("lower", "upper"))
        assert row["outcome"] == "certified"
        assert (row["missed"], row["assumptions_hold"], row["truth_inside"]) == ("0", "1", "1")
        assert (np.less_equal(lower, state[[0, 2, 3]]) & np.less_equal(state[[0, 2, 3]], upper)).all()
        found = [float(row[name]) for name in ("theta_rad", "x_m", "y_m", "z_m")]
        assert [float(row[f"error_{name}"]) for name in ("theta_rad", "x_m", "y_m", "z_m")] == (np.array(found) - state).tolist()
        assert np.linalg.norm(np.array(found) - state) < 0.15
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["assumptions_hold"]["windows"] == summary["assumptions_hold"]["inside"] == WINDOWS - 1
    assert summary["windows"] == WINDOWS == summary["certified"] + summary["no_runway"]
    assert summary["sha256"] == estimator.sha256
    assert summary["fault"] is None
    video = cv2.VideoCapture(str(tmp_path / "overlay.mp4"))
    assert (video.get(cv2.CAP_PROP_FRAME_COUNT), video.get(cv2.CAP_PROP_FPS)) == (-(-WINDOWS // 3), pytest.approx(25 / 3, rel=1e-4))
    assert video.get(cv2.CAP_PROP_FRAME_WIDTH) == 640
    for name in [*(f"overlay_{number:06d}.png" for number in range(0, WINDOWS, 4)), "state.png"]:
        assert cv2.imread(str(tmp_path / name)).shape[1] == 1280
    assert not list(tmp_path.glob("*.part*"))


def test_the_estimates_are_the_estimators_own(recording, events, estimator, tmp_path):
    assert invoke(MODEL, recording, "-o", tmp_path, "--no-video").exit_code == 0
    assert not (tmp_path / "overlay.mp4").exists()
    for row, (_, frame) in zip(rows_of(tmp_path), FrameStream((480, 640), 40_000).frames([events]), strict=True):
        estimate = estimator.estimate(frame)
        assert (row["outcome"], int(row["cell"]), int(row["mismatch"])) == (estimate.outcome.value, estimate.cell, estimate.mismatch)
        if estimate.state is not None:
            assert [float(row[name]) for name in ("theta_rad", "x_m", "y_m", "z_m")] == estimate.state.tolist()


def test_windows_may_overlap_and_the_budget_be_changed(recording, tmp_path):
    done = invoke(MODEL, recording, "-o", tmp_path, "--no-video", "--window-ms", 40, "--step-ms", 20, "--missed-budget", 3, "--no-refine")
    assert done.exit_code == 0
    assert [int(row["time_us"]) for row in rows_of(tmp_path)] == [20_000 * number for number in range(2 * WINDOWS)]


def test_windows_are_judged_by_the_budget_that_was_given(events, truth, estimator, tmp_path):
    image = runway_image(estimator.scene, STATES[3]) != 0
    row, column = np.argwhere(image)[20]
    dead = (events["y"] == row) & (events["x"] == column)
    changed = events[~(dead & (events["t"] >= 120_000) & (events["t"] < 160_000))]
    np.savez(tmp_path / "a.npz", t=changed["t"], x=changed["x"], y=changed["y"], p=changed["p"])
    for budget, holds in ((0, "0"), (1, "1")):
        done = invoke(MODEL, tmp_path / "a.npz", "-o", tmp_path / "out", "--truth", truth, "--no-video", "--missed-budget", budget)
        assert done.exit_code == 0
        judged = rows_of(tmp_path / "out")[3]
        assert (judged["missed"], judged["assumptions_hold"]) == ("1", holds)
        assert judged["truth_inside"] == "1" or budget == 0
        summary = json.loads((tmp_path / "out" / "summary.json").read_text())
        assert summary["missed_budget"] == budget
        assert (summary["assumptions"][-1] == "In place of these 0 pixels: at most 1.") == (budget == 1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--window-ms", "0"], "window_us: found 0"),
        (["--window-ms", "nan"], "window_us"),
        (["--step-ms", "80"], "step_us: found 80000, above window_us 40000"),
        (["--missed-budget", "9999"], "missed_budget 9999"),
        (["--truth", "no.csv"], "no.csv"),
    ],
)
def test_options_that_cannot_be_used_are_an_error_of_one_line(recording, tmp_path, options, message):
    done = invoke(MODEL, recording, "-o", tmp_path / "out", *options)
    assert done.exit_code == 2
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("empty.raw", b"", "the file is empty"),
        ("foreign.raw", b"GIF89a", "found no format in the header"),
        ("none.raw", b"% evt 3.0\n% geometry 640x480\n% end\n", "no event in it"),
        ("other.csv", b"t,x@320,y@240,p\n1,2,3,1\n", "sensor of 320x240 px, expected 640x480"),
        ("zeros.npz", b"\0" * 100, "cannot be read"),
        ("faulty.csv", b"t,x,y,p\n1,2,3,one\n", "line 2: found 1,2,3,one"),
        ("kind.log", b"1", "unknown kind '.log'"),
    ],
)
def test_an_unusable_recording_is_an_error_of_one_line_and_nothing_is_written(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    done = invoke(MODEL, tmp_path / name, "-o", tmp_path / "out")
    assert done.exit_code == 2
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("suffix", [".raw", ".dat", ".es", ".aedat4", ".csv", ".npz", ".h5", ".hdf5"])
@pytest.mark.parametrize("content", [b"", b"\0" * 5000, b"GIF89a" * 99], ids=["empty", "zeros", "foreign"])
def test_no_kind_of_recording_that_is_unusable_gets_past_one_line(tmp_path, suffix, content):
    path = tmp_path / f"a{suffix}"
    path.write_bytes(content)
    done = invoke(MODEL, path, "-o", tmp_path / "out")
    assert done.exit_code == 2
    assert done.stderr.startswith(f"{path}: ")
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(("suffix", "version"), [(".raw", "evt2"), (".raw", "evt3"), (".dat", "dat2"), (".es", None), (".aedat4", None)])
def test_a_recording_without_an_event_is_refused(tmp_path, suffix, version):
    faery = pytest.importorskip("faery", reason="the extra 'recordings' is not installed")
    path = tmp_path / f"a{suffix}"
    none = np.empty(0, dtype=faery.EVENTS_DTYPE)
    faery.events_stream_from_array(none, dimensions=(640, 480)).to_file(path, version=version, zero_t0=False)
    done = invoke(MODEL, path, "-o", tmp_path / "out")
    assert done.exit_code == 2
    assert "no event in it" in done.stderr
    assert done.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_of_a_damaged_recording_what_was_good_is_estimated(events, tmp_path):
    good = events[events["t"] < 400_000]
    lines = [f"{t},{x},{y},{p}" for t, x, y, p in good.tolist()]
    (tmp_path / "cut.csv").write_text("\n".join([*lines, "400000,12"]))
    done = invoke(MODEL, tmp_path / "cut.csv", "-o", tmp_path / "out", "--no-video")
    assert done.exit_code == 1
    assert f"line {len(lines) + 1}: found 400000,12" in done.stderr
    assert "10 windows are written" in done.stderr
    assert len(rows_of(tmp_path / "out")) == 10
    assert "found 400000,12" in json.loads((tmp_path / "out" / "summary.json").read_text())["fault"]


def test_unsorted_and_outside_events_are_told(events, tmp_path):
    changed = events.copy()
    changed["t"][5000], changed["x"][10:13] = 3, 640
    np.savez(tmp_path / "a.npz", t=changed["t"], x=changed["x"], y=changed["y"], p=changed["p"])
    done = invoke(MODEL, tmp_path / "a.npz", "-o", tmp_path / "out", "--no-video")
    assert done.exit_code == 0
    assert "1 unsorted" in done.stderr
    assert "3 outside the sensor" in done.stderr
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["events_to_note"]["outside_sensor"] == 3


def test_after_ctrl_c_what_was_done_is_written(recording, tmp_path, monkeypatch):
    estimate, calls = Estimator.estimate, []

    def interrupted(self, frame, **options):
        calls.append(frame)
        if len(calls) == 6:
            raise KeyboardInterrupt
        return estimate(self, frame, **options)

    monkeypatch.setattr(Estimator, "estimate", interrupted)
    done = invoke(MODEL, recording, "-o", tmp_path)
    assert done.exit_code == 130
    assert "interrupted; 5 windows are written" in done.stderr
    assert len(rows_of(tmp_path)) == 5
    assert cv2.VideoCapture(str(tmp_path / "overlay.mp4")).get(cv2.CAP_PROP_FRAME_COUNT) == 2  # of five windows, the first and the fourth
    assert not list(tmp_path.glob("*.part*"))


def test_ctrl_c_while_files_are_finished_leaves_the_earlier_ones(recording, tmp_path, monkeypatch):
    assert invoke(MODEL, recording, "-o", tmp_path, "--no-video", "--no-refine").exit_code == 0
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("runtime.recordings.report.draw_history", interrupted)
    done = invoke(MODEL, recording, "-o", tmp_path)
    assert done.exit_code == 130
    assert done.stderr.startswith(f"{tmp_path}: interrupted")
    assert done.stderr.count("\n") == 1
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before


def without_pixels(events: NDArray, window: int, pixels: NDArray) -> NDArray:
    """The events but for those of a window in the given pixels, (n, 2) row and column."""
    dead = np.isin(events["y"] * 640 + events["x"], pixels @ [640, 1]) & (events["t"] // 40_000 == window)
    return events[~dead]


def test_windows_without_a_certificate_are_explained_by_numbers_that_help(events, estimator, tmp_path):
    changed = events
    for number in range(8, 12):
        changed = without_pixels(changed, number, np.argwhere(runway_image(estimator.scene, STATES[number]))[5::15])
    np.savez(tmp_path / "a.npz", t=changed["t"], x=changed["x"], y=changed["y"], p=changed["p"])
    done = invoke(MODEL, tmp_path / "a.npz", "-o", tmp_path / "out", "--no-video")
    assert done.exit_code == 0
    rows = rows_of(tmp_path / "out")
    lacking = [row for row in rows if row["outcome"] == "no runway"]
    assert 4 <= len(lacking) <= 5
    assert all((row["reason"] == "") == (row["outcome"] == "certified") for row in rows)
    assert {row["reason"] for row in lacking} <= {"no entry passes NN_F", "found by NN_F, refuted by the refinement"}
    assert all((row["passing"] == "0") == (row["reason"] == "no entry passes NN_F") for row in lacking)
    assert all(0 < int(row["nearest_missed"]) <= int(row["nearest_pixels"]) and " row" in row["nearest_dark_rows"] for row in lacking)
    told = json.loads((tmp_path / "out" / "summary.json").read_text())["no_runway_explained"]
    assert sum(told["reasons"].values()) == len(lacking)
    budget = told["certifying_budget"]
    assert f"with --missed-budget {budget}" in done.stdout
    assert invoke(MODEL, tmp_path / "a.npz", "-o", tmp_path / "more", "--no-video", "--missed-budget", budget).exit_code == 0
    outcomes = {row["time_us"]: row["outcome"] for row in rows_of(tmp_path / "more")}
    helped = [row for row in lacking if int(row["nearest_missed"]) <= budget]
    assert 2 * len(helped) >= len(lacking)
    assert {outcomes[row["time_us"]] for row in helped} == {"certified"}


def test_a_truth_that_no_window_lies_within_is_told_with_both_ranges(recording, tmp_path):
    rows = np.column_stack([10**12 + 40_000 * np.arange(WINDOWS), STATES])
    np.savetxt(tmp_path / "t.csv", rows, delimiter=",", header="time_us,theta_rad,x_m,y_m,z_m", comments="", fmt=["%d", *["%.17g"] * 4])
    done = invoke(MODEL, recording, "-o", tmp_path / "out", "--no-video", "--truth", tmp_path / "t.csv")
    assert done.exit_code == 2
    for part in ("t.csv: no window's instant lies within its times, 1000000.000000 to 1000000.960000 s", "0.020000 to 0.980000 s"):
        assert part in done.stderr
    assert done.stderr.count("\n") == 1
    assert len(rows_of(tmp_path / "out")) == WINDOWS


@pytest.mark.parametrize(
    ("options", "largest_bytes", "message"),
    [
        ([], 100_000, "overlay.mp4: the video was cut short, as by a full disk; free some space there, or use --no-video"),
        (["--no-video"], 20_000, ".png: cannot be written (File too large)"),
        (["--no-video"], 2_000, "estimates.csv: cannot be written (File too large)"),
    ],
)
def test_a_full_disk_leaves_the_old_files_and_nothing_else(recording, tmp_path, options, largest_bytes, message):
    """The system's limit on the size of a file stands for the disk."""
    old = {"estimates.csv": "old table", "overlay.mp4": "old video", "overlay_000000.png": "old picture"}
    old["summary.json"] = json.dumps({"files": [*old]})
    for name, text in old.items():
        (tmp_path / name).write_text(text)
    limited = f"""
import resource, signal
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, ({largest_bytes}, {largest_bytes}))
from runtime.recordings.cli import run_model_command
run_model_command()
"""
    command = [sys.executable, "-c", limited, MODEL, recording, "-o", tmp_path, *options]
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}
    done = subprocess.run([str(part) for part in command], env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 2
    assert done.stderr.startswith(str(tmp_path))
    assert message in done.stderr
    assert done.stderr.count("\n") == 1
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == old


def test_only_an_earlier_reports_own_files_make_room_for_the_new_ones(recording, tmp_path):
    assert invoke(MODEL, recording, "-o", tmp_path).exit_code == 0
    for name in ("overlay_mine.png", "overlay_000001.png", "notes.txt"):
        (tmp_path / name).write_text("foreign")
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert {*summary["files"]} | {"overlay_mine.png", "overlay_000001.png", "notes.txt"} == {path.name for path in tmp_path.iterdir()}
    (tmp_path / "summary.json").write_text(json.dumps({"files": [*summary["files"], "notes.txt", "../outside.png", 5]}))
    (tmp_path.parent / "outside.png").write_text("foreign")
    assert invoke(MODEL, recording, "-o", tmp_path, "--no-video", "--window-ms", 500).exit_code == 0
    own = {"estimates.csv", "summary.json", "state.png", "overlay_000000.png", "overlay_000001.png"}
    assert own | {"overlay_mine.png", "notes.txt"} <= {path.name for path in tmp_path.iterdir()}
    assert (tmp_path.parent / "outside.png").read_text() == "foreign"


def test_a_recording_in_the_output_folder_is_not_replaced(events, tmp_path):
    lines = [f"{t},{x},{y},{p}" for t, x, y, p in events[events["t"] < 40_000].tolist()]
    (tmp_path / "estimates.csv").write_text("\n".join(lines))
    done = invoke(MODEL, tmp_path / "estimates.csv", "-o", tmp_path)
    assert done.exit_code == 2
    assert "estimates.csv: is read and would be replaced; give another folder with -o" in done.stderr
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"estimates.csv": "\n".join(lines)}


@pytest.mark.parametrize("name", ["http:x", "pipe:1", "file:x", "concat:a|b", "10:30:00", "50%d", "run[/]x", "grüß", "a b'c"])
def test_a_folder_may_have_any_name(events, tmp_path, monkeypatch, name):
    """FFmpeg takes what stands before a colon for a protocol, and would look the host x up."""
    part = events[events["t"] < 120_000]
    np.savez(tmp_path / "a.npz", t=part["t"], x=part["x"], y=part["y"], p=part["p"])
    monkeypatch.chdir(tmp_path)
    done = invoke(MODEL, "a.npz", "-o", name)
    assert (done.exit_code, done.stderr) == (0, "")
    assert name in done.stdout
    assert is_whole(tmp_path / name / "overlay.mp4")


def test_a_recording_without_a_window_is_told(truth, tmp_path):
    """Every event lies outside the sensor: there is neither a frame nor a video."""
    np.savez(tmp_path / "a.npz", t=np.arange(9), x=np.full(9, 640), y=np.zeros(9, int), p=np.ones(9, int))
    done = invoke(MODEL, tmp_path / "a.npz", "-o", tmp_path / "out")
    assert done.exit_code == 0
    assert "9 outside the sensor" in done.stderr
    assert rows_of(tmp_path / "out") == []
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"estimates.csv", "summary.json", "state.png"}
    assert invoke(MODEL, tmp_path / "a.npz", "-o", tmp_path / "out", "--truth", truth).exit_code == 2


@pytest.mark.parametrize(("window_ms", "pictures", "rate"), [(0.25, 1, 10), (20, 2, 10), (3_600_000, 1, 0.1)])
def test_a_video_is_in_the_recordings_time_whatever_the_windows_are(events, tmp_path, window_ms, pictures, rate):
    part = events[events["t"] < window_ms * 10_000]
    np.savez(tmp_path / "a.npz", t=part["t"], x=part["x"], y=part["y"], p=part["p"])
    assert invoke(MODEL, tmp_path / "a.npz", "-o", tmp_path / "out", "--window-ms", window_ms, "--no-refine").exit_code == 0
    video = cv2.VideoCapture(str(tmp_path / "out" / "overlay.mp4"))
    assert video.get(cv2.CAP_PROP_FRAME_COUNT) == pictures
    assert video.get(cv2.CAP_PROP_FPS) == pytest.approx(rate, rel=1e-3)


def test_a_cut_video_is_known_by_its_boxes(recording, tmp_path):
    assert invoke(MODEL, recording, "-o", tmp_path).exit_code == 0
    content = (tmp_path / "overlay.mp4").read_bytes()
    assert is_whole(tmp_path / "overlay.mp4")
    for size in (0, 7, 100, len(content) // 2, len(content) - 1):
        (tmp_path / "cut.mp4").write_bytes(content[:size])
        assert not is_whole(tmp_path / "cut.mp4")


def test_without_opencv_one_line_says_what_to_install(recording):
    """In an interpreter of its own, as the installed command: an entry of None makes an import fail as if nothing were installed."""
    program = "import sys; sys.modules['cv2'] = None; from runtime.recordings.cli import run_model_command; run_model_command()"
    arguments = ["run-model", str(MODEL), str(recording)]
    command = [sys.executable, "-c", f"import sys; sys.argv = {arguments!r}; {program}"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 2
    assert done.stderr.strip() == "run-model: the package 'cv2' is missing; pip install 'glideproof[recordings]'"


def test_neither_the_current_folder_nor_the_home_has_a_say(recording, tmp_path):
    """Settings of matplotlib's in the one, and no place for its cache in the other."""
    (tmp_path / "matplotlibrc").write_text("text.usetex: True\nno.such.setting: 1\n")
    environment = {name: value for name, value in os.environ.items() if name not in ("MPLCONFIGDIR", "XDG_CONFIG_HOME", "XDG_CACHE_HOME")}
    environment |= {"PYTHONPATH": str(Path(__file__).parents[1]), "HOME": os.devnull}
    program = "from runtime.recordings.cli import run_model_command; run_model_command()"
    command = [sys.executable, "-c", program, str(MODEL), str(recording), "-o", "out", "--no-video"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "out" / "state.png").is_file()


def test_a_real_recording_is_estimated(tmp_path):
    path = RECORDINGS / "ecpy_test1_640x480_evt3.raw"
    if not path.is_file():
        pytest.skip(f"{path} is missing; set GLIDEPROOF_RECORDINGS to the folder of the recordings")
    pytest.importorskip("faery", reason="the extra 'recordings' is not installed")
    assert invoke(MODEL, path, "-o", tmp_path, "--no-video").exit_code == 0
    assert len(rows_of(tmp_path)) == 52


# --- truth and history ---


@pytest.mark.parametrize(
    "text", ["", "time_us,theta_rad\n1,2\n", "time_us,theta_rad,x_m,y_m,z_m\n", "time_us,theta_rad,x_m,y_m,z_m\n5,0,0,1,1\n4,0,0,1,1\n"]
)
@pytest.mark.filterwarnings("ignore:loadtxt")
def test_an_unusable_truth_is_an_error_that_names_the_file(tmp_path, text):
    (tmp_path / "t.csv").write_text(text)
    with pytest.raises(TruthError, match=r"t\.csv: "):
        Truth.load(tmp_path / "t.csv")


def test_between_two_known_states_the_truth_is_interpolated_and_outside_unknown(truth):
    known = Truth.load(truth)
    np.testing.assert_allclose(known.at(40_000), (STATES[0] + STATES[1]) / 2)
    assert known.at(19_999) is None
    assert known.at(1e9) is None


def test_missed_pixels_are_those_without_a_lit_one_nearby(estimator):
    scene, frame = estimator.scene, runway_image(estimator.scene, STATES[3])
    rows, columns = np.nonzero(frame)
    assert missed_pixels(scene, frame, STATES[3], 0) == 0
    moved = np.roll(frame, 1, axis=1)
    expected = sum(not moved[row, column] for row, column in zip(rows, columns, strict=True))
    assert missed_pixels(scene, moved, STATES[3], 0) == expected > 0
    assert missed_pixels(scene, moved, STATES[3], 1) == 0


def test_a_history_keeps_the_hull_of_what_it_joins_in_constant_memory(estimator):
    history, drawn = History(), np.random.default_rng(0)
    lower = drawn.uniform(0, 1, (5 * MOST_MOMENTS, 4))
    for number, low in enumerate(lower):
        history.add(Moment(number, number + 1, low, low, low + 0.1, None))
    assert len(history.moments) < MOST_MOMENTS
    assert history.moments[0].start_us == 0
    assert history.moments[-1].stop_us == len(lower)
    for moment in history.moments:
        part = lower[int(moment.start_us) : int(moment.stop_us)]
        np.testing.assert_array_equal(moment.lower, part.min(axis=0))
        np.testing.assert_array_equal(moment.upper, (part + 0.1).max(axis=0))
    assert draw_history(estimator.scene, history).shape[1:] == (1280, 3)
    assert draw_history(estimator.scene, History()).shape[1:] == (1280, 3)


# --- replay ---


def test_a_replay_hands_over_every_event_when_it_is_due(events):
    part, got = events[events["t"] < 120_000], []
    begun = time.monotonic()
    player = replay.Replay(np.array_split(part, 7), 10_000, 2.0)
    player.run(lambda packet: got.append((time.monotonic() - begun, packet)))
    np.testing.assert_array_equal(np.concatenate([packet for _, packet in got]), part)
    for passed_s, packet in got:
        assert passed_s >= packet["t"].max() / 1e6 / 2.0
        assert packet["t"].max() - packet["t"].min() < 10_000


def test_a_replay_waits_for_no_clock_that_breaks(events):
    """One time in the far future would be awaited for days, and after a restart nothing would be awaited."""
    part, got = events[events["t"] < 120_000], []
    wrong = np.concatenate([part[:1000], part[:1], part[1000:], part])
    wrong["t"][1000] = 2**50
    begun = time.monotonic()
    replay.Replay([wrong], 10_000, 2.0).run(got.append)
    np.testing.assert_array_equal(np.concatenate(got), wrong)
    assert 0.1 < time.monotonic() - begun < 30


def test_a_live_estimator_gives_what_the_windows_give(events, estimator):
    got, stream = [], FrameStream((480, 640), 40_000, 20_000)
    live = replay.LiveEstimator(estimator, stream, lambda start_us, estimate: got.append((start_us, estimate)))
    replay.Replay([events], 10_000, 1000.0).run(live.on_events)
    windows = list(FrameStream((480, 640), 40_000, 20_000).feed(events))
    assert [start for start, _ in got] == [start for start, _ in windows]
    for (_, estimate), (_, frame) in zip(got, windows, strict=True):
        np.testing.assert_array_equal(estimate.filtered, estimator.estimate(frame).filtered)
    assert "certified" in replay.line_of(*got[0], 1.0)


# --- certified tracking ---

MOTION = "0.2,0,0.3,0.3"
"""The flight's own rates are 0.19 rad/s, 0.21 m/s and 0.19 m/s."""


def attitude_file(path: Path, bias: float) -> Path:
    """Readings every 10 ms, nose up by -theta, off by `bias`, with a plus-minus of 0.005 rad."""
    times = np.arange(0, 1_000_001, 10_000)
    theta = np.interp(times, 40_000 * np.arange(WINDOWS) + 20_000, STATES[:, 0])
    columns = [times, 0 * times, -theta + bias, 0 * times, 0 * times, 0 * times + 0.005, 0 * times]
    header = "time_us,roll_rad,pitch_rad,yaw_rad,roll_plus_minus_rad,pitch_plus_minus_rad,yaw_plus_minus_rad"
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=header, comments="")
    return path


def widths(rows: list[dict[str, str]], prefix: str) -> NDArray:
    """Widths of theta's certified interval in all windows but the one without a runway."""
    seen = [row for number, row in enumerate(rows) if number != 7]
    return np.array([float(row[f"{prefix}upper_theta_rad"]) - float(row[f"{prefix}lower_theta_rad"]) for row in seen])


def test_windows_are_certified_over_time_too(recording, truth, tmp_path):
    done = invoke(MODEL, recording, "-o", tmp_path, "--truth", truth, "--no-video", "--track", "--motion", MOTION)
    assert (done.exit_code, done.stderr) == (0, "")
    rows, summary = rows_of(tmp_path), json.loads((tmp_path / "summary.json").read_text())
    assert list(rows[0]) == [*COLUMNS, *TRUTH_COLUMNS, *TRACKED_COLUMNS, TRACKED_INSIDE]
    assert [int(row["instant_us"]) for row in rows] == [40_000 * number + 20_000 for number in range(WINDOWS)]
    assert [row["tracked_outcome"] for row in rows] == ["no runway" if number == 7 else "certified" for number in range(WINDOWS)]
    assert [row["tracked_truth_inside"] for row in rows] == ["0" if number == 7 else "1" for number in range(WINDOWS)]
    assert (widths(rows, "tracked_") <= widths(rows, "") * 1.2).all()
    assert np.median(widths(rows, "tracked_")) < 0.9 * np.median(widths(rows, ""))
    assert (summary["tracked"]["certified"], summary["tracked"]["inside"]) == (WINDOWS - 1, WINDOWS - 1)
    assert 0 < summary["tracked"]["mean_error"]["theta_rad"] <= widths(rows, "tracked_").max()
    assert "over time: error, mean / largest" in done.stdout
    assert "the state moves by theta -0.2 to 0.2 rad/s" in " ".join(done.stdout.split())


def test_means_of_nothing_are_none() -> None:
    tally = Tally(0, 1)
    tally.followed["no runway"] += 1
    assert (
        tally.table()["mean_half_widths"] is tally.table()["tracked"]["mean_half_widths"] is tally.table()["tracked"]["mean_error"] is None
    )


def test_the_picture_shows_the_estimate_within_the_narrower_band(recording, truth, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr("runtime.recordings.report.draw_history", lambda *parts: drawn.append(parts[1]) or draw_history(*parts))
    attitude = attitude_file(tmp_path / "attitude.csv", 0.004)
    options = (MODEL, recording, "-o", tmp_path, "--truth", truth, "--no-video", "--track", "--motion", MOTION, "--attitude", attitude)
    assert invoke(*options).exit_code == 0
    names = [column.removeprefix("tracked_lower_") for column in TRACKED_COLUMNS if column.startswith("tracked_lower_")]
    rows = [row for row in rows_of(tmp_path) if row["tracked_outcome"] == "certified"]
    moments = [moment for moment in drawn[0].moments if moment.tracked is not None]
    assert len(rows) == len(moments) == WINDOWS - 1
    for row, moment in zip(rows, moments, strict=True):
        assert moment.state.tolist() == pytest.approx([float(row[f"tracked_{name}"]) for name in names], rel=1e-6)
        assert moment.tracked.contains(moment.state)


def test_an_attitude_reference_makes_the_box_smaller_and_a_wrong_one_is_found(recording, truth, tmp_path):
    options = (MODEL, recording, "-o", tmp_path, "--truth", truth, "--no-video", "--track", "--motion", MOTION)
    assert invoke(*options, "--attitude", attitude_file(tmp_path / "good.csv", 0.004)).exit_code == 0
    rows = rows_of(tmp_path)
    assert (widths(rows, "tracked_") <= 0.012 + 0.2 * 0.02).all()
    assert [row["tracked_truth_inside"] for row in rows] == ["0" if number == 7 else "1" for number in range(WINDOWS)]
    assert invoke(*options, "--attitude", attitude_file(tmp_path / "bad.csv", 0.06)).exit_code == 0
    assert {row["tracked_outcome"] for row in rows_of(tmp_path)} == {"inconsistent", "no runway"}
    done = invoke(*options, "--horizon", 5, "--outliers", 1)
    assert done.exit_code == 0
    assert [row["tracked_truth_inside"] for row in rows_of(tmp_path)] == ["1"] * WINDOWS
    assert "of any 5 windows all but 1 at most keep these assumptions" in " ".join(done.stdout.split())


def gyroscope_file(path: Path, off: float) -> Path:
    """Readings every 10 ms of the mean pitch rates from window to window, off by so much, with a plus-minus of 0.02 rad/s."""
    times = np.arange(0, 1_000_001, 10_000)
    turning = np.gradient(np.interp(times, 40_000 * np.arange(WINDOWS) + 20_000, STATES[:, 0]), times * 1e-6)
    none = 0 * times
    columns = [times, none, -turning + off, none, none, none + 0.02, none]
    np.savetxt(path, np.column_stack(columns), delimiter=",", header=",".join(GYROSCOPE_COLUMNS), comments="")
    return path


def test_a_gyroscope_makes_the_box_smaller_and_a_wrong_one_is_found(recording, truth, tmp_path):
    options = (MODEL, recording, "-o", tmp_path, "--truth", truth, "--no-video", "--track", "--motion", MOTION)
    assert invoke(*options).exit_code == 0
    without = widths(rows_of(tmp_path), "tracked_")
    done = invoke(*options, "--gyroscope", gyroscope_file(tmp_path / "good.csv", 0.015))
    assert (done.exit_code, done.stderr) == (0, "")
    rows = rows_of(tmp_path)
    assert [row["tracked_truth_inside"] for row in rows] == ["0" if number == 7 else "1" for number in range(WINDOWS)]
    assert np.median(widths(rows, "tracked_")) < min(0.0165, 0.95 * np.median(without))
    assert "within the plus-minus of" in " ".join(done.stdout.split())
    assert invoke(*options, "--gyroscope", gyroscope_file(tmp_path / "bad.csv", 3.0)).exit_code == 0
    assert "inconsistent" in {row["tracked_outcome"] for row in rows_of(tmp_path)}


def test_ways_to_follow_a_recording_are_compared(recording, truth, tmp_path):
    files = ["--attitude", attitude_file(tmp_path / "a.csv", 0.004), "--gyroscope", gyroscope_file(tmp_path / "g.csv", 0.015)]
    app = typer.Typer()
    app.command()(compare_tracking.main)
    done = CliRunner().invoke(app, [*map(str, [MODEL, recording, truth, *files]), "--motion", MOTION])
    assert done.exit_code == 0, done.output
    rows = [line.split("│") for line in done.stdout.splitlines() if line.startswith("│")]
    assert [row[1].strip() for row in rows] == [
        "the frame alone",
        "over time",
        "with the reference",
        "with the gyroscope",
        "with both",
    ]
    assert [[int(cell) for cell in row[2:6]] for row in rows] == [[WINDOWS - 1, 1, 0, 0]] * len(rows)
    theta = [float(row[6].split()[0]) for row in rows]
    assert theta[4] <= theta[2] < theta[1] < theta[0]
    broken = CliRunner().invoke(app, [str(MODEL), str(recording), str(tmp_path / "none.csv")])
    assert (broken.exit_code, broken.stderr.count("\n")) == (2, 1)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--gyroscope", "g.csv"], "--gyroscope: found g.csv without --track; add --track, or leave it out"),
        (["--track", "--motion", MOTION, "--gyroscope", "none.csv"], "none.csv: No such file or directory; give "),
        (["--track"], "--track: the model's scene has no [motion]; give --motion, the largest rates of theta, x, y, z"),
        (["--motion", MOTION], f"--motion: found {MOTION} without --track; add --track, or leave it out"),
        (["--track", "--motion", "1,2"], "--motion: found '1,2'; give four numbers from 0 on, as 0.1,0,0.3,1 (rad/s and m/s)"),
        (["--track", "--motion", "-1,0,0,0"], "--motion: found '-1,0,0,0'; give four numbers from 0 on, as 0.1,0,0.3,1 (rad/s and m/s)"),
        (["--track", "--motion", MOTION, "--outliers", "1"], "--outliers: found 1 with no horizon; give 0, or fewer than "),
        (["--track", "--motion", MOTION, "--horizon", "0"], "--horizon: found 0; give 1 frame or more, or None"),
    ],
)
def test_tracking_that_cannot_be_done_is_refused(recording, tmp_path, options, message):
    done = invoke(MODEL, recording, "-o", tmp_path / "out", *options)
    assert (done.exit_code, done.stderr.count("\n")) == (2, 1)
    assert done.stderr.startswith(message)


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("time_us,roll_rad\n1,2\n", "no column pitch_rad, yaw_rad, roll_plus_minus_rad"),
        (None, "No such file"),
        ("{header}\n1,0,0,0,0,-1,0\n", "found a plus-minus below 0 in row 1 of its numbers"),
        ("{header}\n1,0,0,0,0,0,0\n1,0,0,0,0,0,0\n", "found a time that is not after the line's before in row 2"),
        ("{header}\n", "found no line"),
    ],
)
def test_attitudes_that_cannot_be_used_are_refused(recording, tmp_path, text, found):
    path = tmp_path / "attitude.csv"
    if text is not None:
        path.write_text(text.format(header=",".join(ATTITUDE_COLUMNS)))
    done = invoke(MODEL, recording, "-o", tmp_path / "out", "--track", "--motion", MOTION, "--attitude", path)
    assert (done.exit_code, done.stderr.count("\n")) == (2, 1)
    assert done.stderr.startswith(f"{path}: ")
    assert found in done.stderr


def test_a_recording_of_a_camera_that_rolls_and_yaws_is_certified_with_its_attitude(tmp_path):
    """The boxes hold the camera's own state; taken for level, it shows no runway."""
    pytest.importorskip("flint", reason="the extra 'build' is not installed")
    from turned_state import TurnedState

    rng, turned = np.random.default_rng(3), TurnedState.near(np.array([0.6, 0.0, 0.9, 1.7]), -0.03, 0.06)
    roll, theta, yaw = (float(angle.mid()) for angle in turned.angles)
    rows, columns = np.nonzero(turned.view(Estimator.load(MODEL).scene).image(turned.seen).frame)
    parts = []
    for number in range(3):
        part = np.zeros(len(rows), dtype=EVENT)
        part["x"], part["y"], part["t"] = columns, rows, np.sort(rng.integers(40_000 * number, 40_000 * (number + 1), len(rows)))
        part["t"][0] = 40_000 * number
        parts.append(part)
    events = np.concatenate(parts)
    np.savez(tmp_path / "rolled.npz", **{name: events[name] for name in "txyp"})
    readings = np.array([[time_us, roll, -theta, yaw, 0.001, 0.002, 0.001] for time_us in (0, 60_000, 120_000)])
    np.savetxt(tmp_path / "a.csv", readings, delimiter=",", header=",".join(ATTITUDE_COLUMNS), comments="")
    states = np.array([[time_us, theta, 0.0, 0.9, 1.7] for time_us in (0, 120_000)])
    np.savetxt(tmp_path / "truth.csv", states, delimiter=",", header="time_us,theta_rad,x_m,y_m,z_m", comments="", fmt="%.17g")
    options = [MODEL, tmp_path / "rolled.npz", "-o", tmp_path / "out", "--no-video", "--track", "--motion", "0.01,0,0.01,0.01"]
    done = invoke(*options, "--truth", tmp_path / "truth.csv", "--attitude", tmp_path / "a.csv")
    assert (done.exit_code, done.stderr) == (0, "")
    found = rows_of(tmp_path / "out")
    assert [(row["outcome"], row["tracked_outcome"], row["tracked_truth_inside"]) for row in found] == [("certified", "certified", "1")] * 3
    assert {row["assumptions_hold"] for row in found} == {""}
    said = " ".join(done.stdout.split())
    assert "Between two readings roll moves by 0 to 0 rad/s" in said
    assert "Roll and yaw as told, and the camera as in the scene" in said
    assert "No roll or yaw" not in said
    assert "not told: of a camera that rolls or yaws" in said
    assert invoke(*options, "--attitude", tmp_path / "a.csv", "--pitch-alone").exit_code == 0
    assert "certified" not in {row["tracked_outcome"] for row in rows_of(tmp_path / "out")}


def test_windows_of_an_odd_length_are_certified_at_their_very_middle(recording, truth, tmp_path):
    done = invoke(MODEL, recording, "-o", tmp_path, "--truth", truth, "--no-video", "--window-ms", 40.001, "--track", "--motion", MOTION)
    assert done.exit_code == 0
    rows = rows_of(tmp_path)
    assert [float(row["instant_us"]) - int(row["time_us"]) for row in rows] == [20_000.5] * len(rows)


def test_readings_are_moved_to_the_instant_between_them(tmp_path):
    readings = AttitudeReadings.load(attitude_file(tmp_path / "a.csv", 0.0))
    estimator = Estimator.load(MODEL)
    motion, nose_down = Motion([-0.1] * 4, [0.1] * 4), STATES[0, 0]
    for time_us, widening in ((0, 0.0), (4_000, 0.0006), (10_000, 0.0), (-1_000_000, 0.1)):
        box = readings.prior(time_us, motion, estimator.domain)
        assert box.lower[0] == pytest.approx(nose_down - 0.005 - widening, abs=1e-9)
        assert box.upper[0] == pytest.approx(nose_down + 0.005 + widening, abs=1e-9)
        assert box.lower[1:].tolist() == estimator.domain.lower[1:].tolist()
    unknown = readings.prior(5_000, Motion([-np.inf] * 4, [np.inf] * 4), estimator.domain)
    assert (unknown.lower[0], unknown.upper[0]) == (estimator.domain.lower[0], estimator.domain.upper[0])
    assert readings.level(0.0, 0.0)


def test_all_readings_since_the_last_window_bound_the_pitch() -> None:
    """Each within its plus-minus, moved by the bounds on the rate or as a gyroscope has it; where they contradict each other, either."""
    rows = [(0, 0.5, 0.01), (10_000, 0.508, 0.01), (20_000, 0.503, 0.01), (30_000, 0.499, 0.01), (40_000, 0.9, 0.01)]
    times, theta, plus_minus = np.array(rows).T
    readings = AttitudeReadings(times, np.outer(-theta, [0, 1, 0]), np.outer(plus_minus, [0, 1, 0]))
    domain, motion = Box(np.full(4, -9.0), np.full(4, 9.0)), Motion([-0.1] * 4, [0.2] * 4)
    near = {"abs": 1e-12}
    beside = readings.prior(25_000, motion, domain)
    assert (beside.lower[0], beside.upper[0]) == (pytest.approx(0.499 - 0.01 - 0.001, **near), pytest.approx(0.503 + 0.01 + 0.001, **near))
    since = readings.prior(25_000, motion, domain, 5_000)
    assert (since.lower[0], since.upper[0]) == (pytest.approx(0.508 - 0.01 - 0.0015, **near), pytest.approx(0.499 + 0.01 + 0.0005, **near))
    turned = readings.prior(25_000, motion, domain, 5_000, lambda since_us, until_us: (0.0, 1e-8 * (until_us - since_us)))
    assert (turned.lower[0], turned.upper[0]) == (pytest.approx(0.508 - 0.01, **near), pytest.approx(0.499 + 0.01, **near))
    wrong = readings.prior(35_000, motion, domain, 5_000)
    assert (wrong.lower[0], wrong.upper[0]) == (pytest.approx(0.499 - 0.01 - 0.0005, **near), pytest.approx(0.9 + 0.01 + 0.0005, **near))
    alone = readings.prior(25_000, motion, domain, 30_000)
    assert (alone.lower[0], alone.upper[0]) == (pytest.approx(0.503 - 0.01 - 0.0005, **near), pytest.approx(0.499 + 0.01 + 0.0005, **near))


def test_readings_of_a_pitch_hold_it_whatever_was_the_last_window() -> None:
    """The truth stays inside, at rates on either bound, readings off by their whole plus-minus; more readings never make it wider."""
    rng, domain = np.random.default_rng(5), Box(np.full(4, -9.0), np.full(4, 9.0))
    motion, times = Motion([-0.3] * 4, [0.1] * 4), np.arange(0.0, 300_000, 7_000)
    for _ in range(200):
        rates = rng.choice([-0.3, 0.1, -0.1], len(times))
        theta = 0.5 + np.concatenate([[0.0], np.cumsum(rates[:-1] * np.diff(times) / 1e6)])
        off = rng.choice([-1, 1, 0.3], len(times)) * (1 - 1e-12)
        readings = AttitudeReadings(times, np.outer(-(theta + 0.004 * off), [0, 1, 0]), np.full((len(times), 3), 0.004))
        now_us = float(rng.uniform(times[0], times[-1]))
        boxes = [readings.prior(now_us, motion, domain, now_us - before_us) for before_us in (0, 20_000, 200_000)]
        truth = np.interp(now_us, times, theta)
        assert all(box.lower[0] <= truth <= box.upper[0] for box in boxes)
        sizes = [box.upper[0] - box.lower[0] for box in boxes]
        assert sizes == sorted(sizes, reverse=True)


def test_the_chart_shows_both_bands():
    scene, history = Estimator.load(MODEL).scene, History()
    for number, state in enumerate(STATES):
        box = Box(state - 0.01, state + 0.01)
        history.add(Moment(number, number + 1, state, state - 0.05, state + 0.05, state, None if number == 3 else box))
    with_both = draw_history(scene, history)
    plain = History()
    for moment in history.moments:
        plain.add(replace(moment, tracked=None))
    assert (with_both != draw_history(scene, plain)).mean() > 0.01
    joined = history.moments[2].joined(history.moments[3]).tracked
    assert joined is not None
    assert joined.lower.tolist() == (STATES[2] - 0.01).tolist()
