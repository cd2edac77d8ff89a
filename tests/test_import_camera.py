"""Calibration files as the tools write them, and the camera that they describe."""

from __future__ import annotations

import json
import subprocess
import sys
import tomllib
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from build_model.import_camera import CalibrationFileError, Wanted, camera_toml, import_camera
from runtime.scene import Camera, Distortion

MATRIX = np.array([[580.46715, 0, 315.27153], [0, 576.62721, 247.47257], [0, 0, 1]])
COEFFICIENTS = [-0.277, 0.067, 0.00087, 0.00011, 1e-5]
SEEN = Camera(
    640,
    480,
    principal_point=(315.77153, 247.97257),
    focal_px=(580.46715, 576.62721),
    distortion=Distortion("radial-tangential", tuple(COEFFICIENTS)),
)
FISHEYE = Camera(
    640,
    480,
    principal_point=(315.77153, 247.97257),
    focal_px=(580.46715, 576.62721),
    distortion=Distortion("fisheye", (-0.013, 0.05, -0.045, 0.012)),
)

ROS = """image_width: 640
image_height: 480
camera_name: narrow_stereo
camera_matrix:
  rows: 3
  cols: 3
  data: [580.46715,   0.     , 315.27153,
           0.     , 576.62721, 247.47257,
           0.     ,   0.     ,   1.     ]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.277000, 0.067000, 0.000870, 0.000110, 1e-05]
rectification_matrix:
  rows: 3
  cols: 3
  data: [1., 0., 0., 0., 1., 0., 0., 0., 1.]
projection_matrix:
  rows: 3
  cols: 4
  data: [500., 0., 316., 0., 0., 500., 248., 0., 0., 0., 1., 0.]
"""
ROS_TOPIC = """header:
  stamp: {sec: 12, nanosec: 5}
  frame_id: camera
height: 480
width: 640
distortion_model: equidistant
d: [-0.013, 0.05, -0.045, 0.012]
k: [580.46715, 0.0, 315.27153, 0.0, 576.62721, 247.47257, 0.0, 0.0, 1.0]
r: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]
p: [580.0, 0.0, 315.0, 0.0, 0.0, 576.0, 247.0, 0.0, 0.0, 0.0, 1.0, 0.0]
binning_x: 0
binning_y: 0
roi: {x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: false}
---
"""
KALIBR = """cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.277, 0.067, 0.00087, 0.00011]
  distortion_model: radtan
  intrinsics: [580.46715, 576.62721, 315.27153, 247.47257]
  resolution: [640, 480]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [0.99998, 0.00226, 0.00520, -0.11016]
  - [-0.00225, 0.99999, -0.00373, 0.00007]
  - [-0.00521, 0.00372, 0.99998, 0.00025]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [0]
  camera_model: pinhole
  distortion_coeffs: [-0.013, 0.05, -0.045, 0.012]
  distortion_model: equidistant
  intrinsics: [580.46715, 576.62721, 315.27153, 247.47257]
  resolution: [640, 480]
  rostopic: /cam1/image_raw
"""


def written(tmp_path: Path, text: str, name: str = "calibration.yaml") -> Path:
    path = tmp_path / name
    path.write_text(text)
    return path


def opencv_file(path: Path, coefficients: list[float], fisheye: bool | None = None) -> Path:
    """As OpenCV's sample calibration.cpp writes it; the suffix decides the format."""
    storage = cv2.FileStorage(str(path), cv2.FileStorage_WRITE)
    storage.write("calibration_time", "Thu 07 Nov 2019 05:21:22 PM CST")
    storage.write("image_width", 640)
    storage.write("image_height", 480)
    storage.write("square_size", 0.025)
    if fisheye is not None:
        storage.write("fisheye_model", int(fisheye))
    storage.write("camera_matrix", MATRIX)
    storage.write("distortion_coefficients", np.array([coefficients]).T)
    storage.write("avg_reprojection_error", 0.21)
    storage.release()
    return path


def metavision_file(path: Path, coefficients: list[float]) -> Path:
    """As metavision_mono_calibration writes its intrinsics.json."""
    storage = cv2.FileStorage(str(path), cv2.FileStorage_WRITE)
    storage.write("n_kept_views", 12)
    storage.write("image_size", np.array([640, 480]))
    storage.release()
    tables = json.loads(path.read_text())
    storage = cv2.FileStorage(str(path), cv2.FileStorage_WRITE)
    storage.write("camera_matrix", MATRIX)
    storage.write("distortion_coefficients", np.array([coefficients]))
    storage.release()
    tables = {**tables, "image_size": [640, 480], "pattern": {"n_rows": 6, "n_cols": 9}, **json.loads(path.read_text())}
    path.write_text(json.dumps(tables))
    return path


@pytest.mark.parametrize("suffix", ["yaml", "yml", "xml", "json"])
def test_files_of_opencv(tmp_path: Path, suffix: str) -> None:
    assert import_camera(opencv_file(tmp_path / f"camera.{suffix}", COEFFICIENTS)) == SEEN
    assert import_camera(opencv_file(tmp_path / f"lens.{suffix}", [-0.013, 0.05, -0.045, 0.012], fisheye=True)) == FISHEYE
    pinhole = import_camera(opencv_file(tmp_path / f"none.{suffix}", [0.0] * 5, fisheye=False))
    assert pinhole.pinhole
    assert pinhole.distortion is None


def test_files_of_ros_kalibr_and_metavision(tmp_path: Path) -> None:
    assert import_camera(written(tmp_path, ROS)) == SEEN
    assert import_camera(written(tmp_path, "%YAML:1.0\n---\n" + ROS)) == SEEN
    assert import_camera(written(tmp_path, ROS_TOPIC)) == FISHEYE
    assert import_camera(written(tmp_path, KALIBR), Wanted(camera="cam1")) == FISHEYE
    first = import_camera(written(tmp_path, KALIBR.partition("cam1")[0]))
    assert first.distortion == Distortion("radial-tangential", (-0.277, 0.067, 0.00087, 0.00011))
    assert import_camera(metavision_file(tmp_path / "intrinsics.json", COEFFICIENTS)) == SEEN
    flat = {"type": "PINHOLE", "img_size": {"width": 640, "height": 480}, "K": MATRIX.tolist(), "D": COEFFICIENTS}
    assert import_camera(written(tmp_path, json.dumps(flat))) == SEEN


def test_pixel_centres_become_pixel_corners(tmp_path: Path) -> None:
    """A point on the axis is seen at (cx, cy) by OpenCV, whose first pixel's centre is (0, 0); here that centre is (0.5, 0.5)."""
    camera = import_camera(written(tmp_path, ROS))
    seen, _ = cv2.projectPoints(np.array([[0.0, 0.0, 5.0]]), np.zeros(3), np.zeros(3), MATRIX, np.array(COEFFICIENTS))
    assert np.asarray(seen).ravel() + 0.5 == pytest.approx([camera.u0, camera.v0], abs=1e-12)


def test_coefficients_beyond_the_fifth_must_be_none(tmp_path: Path) -> None:
    assert import_camera(opencv_file(tmp_path / "thin.yaml", [*COEFFICIENTS, *[0.0] * 9])) == SEEN
    with pytest.raises(CalibrationFileError, match=r"distortion_coefficients: found \[0.1, 0.0, 0.0\]; only radial-tangential's first 5"):
        import_camera(opencv_file(tmp_path / "rational.yaml", [*COEFFICIENTS, 0.1, 0.0, 0.0]))


def test_the_table_is_a_scenes() -> None:
    text = camera_toml(FISHEYE, "camera.yaml")
    table = tomllib.loads(text)["camera"]
    assert table == {
        "width": 640,
        "height": 480,
        "focal_px": [580.46715, 576.62721],
        "principal_point": [315.77153, 247.97257],
        "distortion": {"model": "fisheye", "coefficients": [-0.013, 0.05, -0.045, 0.012]},
    }


ROS_TABLES = yaml.safe_load(ROS)


def ros(**changes: object) -> str:
    tables = {key: value for key, value in {**ROS_TABLES, **changes}.items() if value is not None}
    return json.dumps(tables)


REFUSED = [
    (ros(distortion_model="fov"), "distortion_model: found fov; known here: plumb_bob"),
    (
        ros(distortion_model=None, distortion_coefficients=[0.1, 0.0, 0.0, 0.0]),
        "distortion_model: found nothing; its 4 coefficients may be",
    ),
    (ros(distortion_model="equidistant"), "distortion_coefficients: found [1e-05]; only equidistant's first 4 are taken"),
    (ros(distortion_model="equidistant", distortion_coefficients=[]), "a fisheye lens has 4"),
    (ros(distortion_coefficients=[0.1, 0.1]), "distortion_coefficients: found 2 of them; plumb_bob has 4 or 5"),
    (ros(image_width=None), "image_width, image_height: found nothing; give the frame's size with --size"),
    (ros(image_width=640.5), "give whole numbers of pixels"),
    (ros(camera_matrix=None), "camera_matrix: found nothing; known here"),
    (ros(camera_matrix=None, M1=[1.0]), "of a stereo pair give one camera's file"),
    (ros(camera_matrix=[1.0, 2.0]), "camera_matrix: found 2 numbers; give 9"),
    (ros(camera_matrix=[500, 0.3, 320, 0, 500, 240, 0, 0, 1]), "found a skew of 0.3"),
    (ros(camera_matrix=[500, 0, 320, 0, 500, 240, 0, 0, 2]), "camera_matrix: found a last row of [0.0, 0.0, 2.0]"),
    (ros(camera_matrix=[8.0, 0, 320, 0, 8.0, 240, 0, 0, 1]), "fx: found 8.0; no focal length in px of a frame of 640 columns"),
    (ros(camera_matrix=[0.9, 0, 0.5, 0, 1.2, 0.5, 0, 0, 1]), "fx: found 0.9; no focal length in px"),
    (ros(camera_matrix=[500, 0, 3200, 0, 500, 240, 0, 0, 1]), "cx: found 3200.0; far out of a frame of 640 px"),
    (ros(camera_matrix=[500, 0, 320, 0, "x", 240, 0, 0, 1]), "camera_matrix: found 'x'; give a finite number"),
    (ros(camera_matrix=[500, 0, 320, 0, True, 240, 0, 0, 1]), "camera_matrix: found True; give a finite number"),
    (ros(binning_x=2), "binning_x: found 2; give the calibration of the whole frame"),
    (ros(roi={"x_offset": 8}), "roi: found [8.0, 0.0]"),
    (KALIBR, "camera: found 2 of them; choose with --camera: cam0, cam1"),
    (KALIBR.partition("cam1")[0].replace("pinhole", "omni"), "cam0.camera_model: found omni; only pinhole is read"),
    (KALIBR.partition("cam1")[0].replace("radtan", "fov"), "cam0.distortion_model: found fov"),
    (KALIBR.partition("cam1")[0].replace("radtan", "none"), "a lens of model none has none"),
    ("<svg></svg>", "file: found <svg>; of XML only OpenCV's"),
    ("{", "not JSON"),
    ("a: [", "not YAML"),
    ("<a>", "not XML"),
    ("", "file: found NoneType"),
    ("- 1", "file: found list"),
    ("a: !!python/object:os.system {}", "not YAML"),
]


@pytest.mark.parametrize(("text", "message"), REFUSED, ids=[message[:60] for _, message in REFUSED])
def test_what_cannot_be_used_is_named(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(CalibrationFileError) as raised:
        import_camera(written(tmp_path, text, "file"))
    assert message in str(raised.value)
    assert "\n" not in str(raised.value)


def test_what_a_file_lacks_is_taken_from_the_caller(tmp_path: Path) -> None:
    text = ros(distortion_model=None, distortion_coefficients=[-0.013, 0.05, -0.045, 0.012], image_width=None)
    assert import_camera(written(tmp_path, text), Wanted(model="fisheye", size=(640, 480))) == FISHEYE


def test_a_frame_of_another_size_than_the_files_is_refused(tmp_path: Path) -> None:
    """Its principal point would be elsewhere."""
    with pytest.raises(CalibrationFileError, match=r": --size: found 1280x720 for a calibration of 640x480; leave it out"):
        import_camera(written(tmp_path, ROS), Wanted(size=(1280, 720)))
    assert import_camera(written(tmp_path, ROS), Wanted(size=(640, 480))) == SEEN


def test_the_command(tmp_path: Path) -> None:
    program = "from build_model.cli import import_camera_command; import_camera_command()"

    def run(*arguments: object) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-c", program, *map(str, arguments)]
        return subprocess.run(command, capture_output=True, text=True, check=False, cwd=Path(__file__).parents[1])

    source, target = written(tmp_path, ROS), tmp_path / "out" / "camera.toml"
    done = run(source, "-o", target)
    assert (done.returncode, done.stderr) == (0, "")
    assert target.read_text() == camera_toml(SEEN, source.name) == run(source).stdout
    for arguments, message in (
        ((tmp_path / "none.yaml",), "cannot be read"),
        ((source, "--size", "640"), "--size 640: give the frame's width and height"),
        ((source, "-o", source / "camera.toml"), "cannot be written"),
    ):
        done = run(*arguments)
        assert done.returncode == 2
        assert message in done.stderr
        assert done.stderr.count("\n") == 1
