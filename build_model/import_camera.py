"""The table `[camera]` of a scene from a calibration file: OpenCV's, ROS's, Kalibr's or Metavision's.

All of these count pixels from the centre of the first one, and a scene from its outer corner (`runtime.camera`): half a pixel is added to
the principal point. Focal lengths, and the coefficients of a lens, mean the same in all of them:

    plumb_bob, radtan                k1 k2 p1 p2 [k3]     "radial-tangential"
    equidistant, equi, fisheye       k1 k2 k3 k4          "fisheye"
    none                                                  no distortion

OpenCV's further coefficients (rational, thin prism, tilted) are taken where they are all 0. A file that names no model has OpenCV's
radial-tangential one if it has 5 coefficients or more; with 4 it could be either, and the caller must say.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import yaml

from runtime.scene import DISTORTIONS, Camera, Distortion, SceneError

HALF_PIXEL = 0.5
"""From the centre of a pixel to its corner."""
LARGEST_FILE_BYTES = 2**24
"""Files with the detections of all pictures have a few MB."""
MODELS = {
    **dict.fromkeys(("plumb_bob", "radtan", "radial-tangential", "radial_tangential", "brown_conrady"), "radial-tangential"),
    **dict.fromkeys(("rational_polynomial", "rational", "thin_prism", "pinhole"), "radial-tangential"),
    **dict.fromkeys(("equidistant", "equi", "fisheye", "kannala_brandt"), "fisheye"),
    "none": None,
}
"""Names that files have for a lens, and the scene's for it."""
SHORTEST_FOCAL, LONGEST_FOCAL = 0.1, 100.0
"""Focal lengths, in widths of the frame, that a matrix in px can have; others are in mm, or in shares of the frame."""
SIZE_KEYS = (("image_width", "image_height"), ("width", "height"), ("Image_Width", "Image_Height"))
PAIR_KEYS = ("image_size", "img_size", "resolution", "imageSize")
MATRIX_KEYS = ("camera_matrix", "Camera_Matrix", "cameraMatrix", "intrinsic_matrix", "K", "k")
COEFFICIENT_KEYS = ("distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "dist_coeffs", "D", "d")
MODEL_KEYS = ("distortion_model", "camera_model", "type")


class CalibrationFileError(ValueError):
    """A calibration file that cannot be used. One line: the file, the key, what was found, what to do."""


@dataclass(frozen=True)
class Wanted:
    """What the caller says that a file may lack: which of several cameras, its lens's model, its frame (width, height)."""

    camera: str | None = None
    model: str | None = None
    size: tuple[int, int] | None = None


def import_camera(path: Path, wanted: Wanted | None = None) -> Camera:
    """The camera of a calibration file. Raises `CalibrationFileError`."""
    try:
        return _camera_of(_tables(path), wanted or Wanted())
    except (CalibrationFileError, SceneError) as error:
        raise CalibrationFileError(f"{path}: {error}") from error


def camera_toml(camera: Camera, source: str) -> str:
    """The table `[camera]`, as a scene file has it."""
    lines = [f"# From {source}; half a pixel was added to its principal point: pixel corners are at integers here.", "[camera]"]
    lines += [f"width = {camera.width}", f"height = {camera.height}", f"focal_px = {_list([camera.focal_u_px, camera.focal_v_px])}"]
    lines.append(f"principal_point = {_list([camera.u0, camera.v0])}")
    if camera.distortion is not None:
        model, coefficients = camera.distortion.model, _list(camera.distortion.coefficients)
        lines.append(f'distortion = {{ model = "{model}", coefficients = {coefficients} }}')
    return "\n".join([*lines, ""])


def _list(values: Iterable[float]) -> str:
    return f"[{', '.join(repr(float(value)) for value in values)}]"


def _demand(holds: bool, key: str, found: object, advice: str) -> None:
    if not holds:
        raise CalibrationFileError(f"{key}: found {found!s:.120}; {advice}")


# --- from a file to tables ---


def _tables(path: Path) -> dict[str, Any]:
    """The file's keys and values. Raises `CalibrationFileError`."""
    try:
        if path.stat().st_size > LARGEST_FILE_BYTES:
            raise CalibrationFileError(f"larger than {LARGEST_FILE_BYTES / 1e6:.0f} MB; give a calibration file")
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise CalibrationFileError(f"cannot be read ({error}); give a calibration file: YAML, XML or JSON") from error
    start = text.lstrip()[:1]
    kind, read = {"<": ("XML", _xml), "{": ("JSON", json.loads)}.get(start, ("YAML", _yaml))
    try:
        tables = read(text)
    except (ValueError, yaml.YAMLError, ElementTree.ParseError, RecursionError) as error:
        raise CalibrationFileError(f"not {kind} ({' '.join(str(error).split()):.120}); give the file as the tool wrote it") from error
    _demand(isinstance(tables, dict), "file", type(tables).__name__, "give a file with keys and values")
    return tables


class _OpenCvLoader(yaml.SafeLoader):
    """YAML with OpenCV's tags for matrices, which are plain tables."""


_OpenCvLoader.add_multi_constructor("tag:yaml.org,2002:opencv-", lambda loader, _suffix, node: loader.construct_mapping(node, deep=True))


def _yaml(text: str) -> Any:
    """OpenCV begins with a directive that YAML does not know, %YAML:1.0; what ROS prints of a topic ends with a document's border."""
    return next(yaml.load_all(re.sub(r"\A\s*%YAML:1\.0[^\n]*\n", "", text), _OpenCvLoader), None)


def _xml(text: str) -> Any:
    root = ElementTree.fromstring(text)
    _demand(root.tag == "opencv_storage", "file", f"<{root.tag}>", "of XML only OpenCV's <opencv_storage> is read")
    return {child.tag: _xml_value(child) for child in root}


def _xml_value(element: ElementTree.Element) -> Any:
    if len(element):
        return {child.tag: _xml_value(child) for child in element}
    words = (element.text or "").split()
    return words[0] if len(words) == 1 else words


# --- from tables to a camera ---


def _camera_of(tables: dict[str, Any], wanted: Wanted) -> Camera:
    cameras = {name: table for name, table in tables.items() if re.fullmatch(r"cam\d+", str(name)) and isinstance(table, dict)}
    if not cameras:
        return _camera_of_matrix(tables, wanted)
    name = wanted.camera or next(iter(cameras))
    _demand(name in cameras, "camera", name, f"the file has {', '.join(cameras)}")
    _demand(
        wanted.camera is not None or len(cameras) == 1, "camera", f"{len(cameras)} of them", f"choose with --camera: {', '.join(cameras)}"
    )
    return _camera_of_kalibr(name, cameras[name], wanted)


def _camera_of_kalibr(name: str, table: dict[str, Any], wanted: Wanted) -> Camera:
    projection = table.get("camera_model", "nothing")
    _demand(projection == "pinhole", f"{name}.camera_model", projection, "only pinhole is read, with radtan, equidistant or none")
    fu, fv, pu, pv = _numbers(f"{name}.intrinsics", table.get("intrinsics"), 4)
    size = _pair(f"{name}.resolution", table["resolution"]) if "resolution" in table else None
    model = wanted.model or table.get("distortion_model")
    coefficients = _numbers(f"{name}.distortion_coeffs", table.get("distortion_coeffs", []))
    key = "--model" if wanted.model else f"{name}.distortion_model"
    return _camera(size, (fu, fv, pu, pv), key, model, coefficients, wanted)


def _camera_of_matrix(tables: dict[str, Any], wanted: Wanted) -> Camera:
    """OpenCV's, ROS's and Metavision's files: a matrix of the camera and a row of coefficients."""
    key = _present(tables, MATRIX_KEYS)
    if key is None:
        stereo = "M1" in tables or "cameraMatrix1" in tables
        advice = "of a stereo pair give one camera's file" if stereo else f"known here: {', '.join(MATRIX_KEYS)}, or Kalibr's cam0"
        raise CalibrationFileError(f"camera_matrix: found nothing; {advice}")
    fx, skew, cx, zero, fy, cy, *last = _numbers(key, tables[key], 9)
    _demand(skew == 0 and zero == 0, key, f"a skew of {skew or zero}", "only cameras without skew are taken")
    _demand(last == [0, 0, 1], key, f"a last row of {last}", "it must be [0, 0, 1]")
    lens = _present(tables, COEFFICIENT_KEYS)
    coefficients = [] if lens is None else _numbers(lens, tables[lens])
    _check_whole_frame(tables)
    model = wanted.model or _model_named(tables)
    key = "--model" if wanted.model else "distortion_model"
    return _camera(_size(tables), (fx, fy, cx, cy), key, model, coefficients, wanted)


def _model_named(tables: dict[str, Any]) -> str | None:
    if "fisheye_model" in tables:
        return "fisheye" if _number("fisheye_model", tables["fisheye_model"]) else "radial-tangential"
    key = _present(tables, MODEL_KEYS)
    return None if key is None else str(tables[key])


def _check_whole_frame(tables: dict[str, Any]) -> None:
    """Of a ROS message: no binning, no region of interest."""
    for key in ("binning_x", "binning_y"):
        _demand(
            _number(key, tables.get(key, 0)) in (0, 1), key, tables.get(key), "give the calibration of the whole frame, without binning"
        )
    region = tables.get("roi")
    if isinstance(region, dict):
        offsets = [_number(f"roi.{key}", region.get(key, 0)) for key in ("x_offset", "y_offset")]
        _demand(not any(offsets), "roi", offsets, "give the calibration of the whole frame")


def _camera(
    size: tuple[int, int] | None, intrinsics: tuple[float, ...], key: str, model: str | None, coefficients: list[float], wanted: Wanted
) -> Camera:
    """The camera with these numbers (fx, fy, cx, cy), counted from pixel centres."""
    if wanted.size is not None and size not in (None, wanted.size):
        given, stated = ("x".join(map(str, each)) for each in (wanted.size, size))
        raise CalibrationFileError(f"--size: found {given} for a calibration of {stated}; leave it out, or give that frame's calibration")
    size = wanted.size or size
    if size is None:
        raise CalibrationFileError("image_width, image_height: found nothing; give the frame's size with --size WIDTHxHEIGHT")
    width, height = size
    fx, fy, cx, cy = intrinsics
    for name, focal in (("fx", fx), ("fy", fy)):
        usable = SHORTEST_FOCAL * width <= focal <= LONGEST_FOCAL * width
        _demand(usable, name, focal, f"no focal length in px of a frame of {width} columns: give the matrix in px, not in mm or shares")
    for name, centre, side in (("cx", cx, width), ("cy", cy, height)):
        _demand(-side <= centre <= 2 * side, name, centre, f"far out of a frame of {side} px; give the matrix in px of this frame")
    distortion = _distortion(key, model, coefficients)
    return Camera(width, height, principal_point=(cx + HALF_PIXEL, cy + HALF_PIXEL), focal_px=(fx, fy), distortion=distortion)


def _distortion(key: str, model: str | None, coefficients: list[float]) -> Distortion | None:
    """The lens that a file's model and coefficients describe; None where there is none."""
    if model is None:
        _demand(len(coefficients) != 4, key, "nothing", "its 4 coefficients may be of either: give --model radial-tangential or fisheye")
        model = "radial-tangential" if coefficients else "none"
    known = model.strip().lower()
    _demand(known in MODELS, key, model, f"known here: {', '.join(MODELS)}")
    kind = MODELS[known]
    if kind is None:
        _demand(not any(coefficients), "distortion_coefficients", coefficients, f"a lens of model {model} has none")
        return None
    counts = DISTORTIONS[kind]
    kept, beyond = coefficients[: max(counts)], coefficients[max(counts) :]
    _demand(
        not any(beyond), "distortion_coefficients", beyond, f"only {model}'s first {max(counts)} are taken, calibrate without the others"
    )
    _demand(
        len(kept) in counts or not coefficients,
        "distortion_coefficients",
        f"{len(kept)} of them",
        f"{model} has {' or '.join(map(str, counts))}",
    )
    if not coefficients and kind == "fisheye":
        raise CalibrationFileError("distortion_coefficients: found nothing; a fisheye lens has 4")
    distortion = Distortion(kind, tuple(kept or [0.0] * min(counts)))
    return None if distortion.none else distortion


# --- values ---


def _present(tables: dict[str, Any], keys: Iterable[str]) -> str | None:
    return next((key for key in keys if key in tables), None)


def _size(tables: dict[str, Any]) -> tuple[int, int] | None:
    for keys in SIZE_KEYS:
        if all(key in tables for key in keys):
            return _pair(", ".join(keys), [tables[key] for key in keys])
    key = _present(tables, PAIR_KEYS)
    return None if key is None else _pair(key, tables[key])


def _pair(key: str, value: Any) -> tuple[int, int]:
    """Width and height, from a list or a table."""
    sides = [value.get("width"), value.get("height")] if isinstance(value, dict) else value
    if not isinstance(sides, list) or len(sides) != 2:
        raise CalibrationFileError(f"{key}: found {value!s:.120}; give the width and the height")
    width, height = (_number(key, side) for side in sides)
    _demand(width == int(width) and height == int(height), key, value, "give whole numbers of pixels")
    return int(width), int(height)


def _numbers(key: str, value: Any, count: int | None = None) -> list[float]:
    """The numbers of a matrix: OpenCV's and ROS's table with `data`, or a list, of rows too."""
    values = value.get("data") if isinstance(value, dict) else value
    if not isinstance(values, list | str):
        raise CalibrationFileError(f"{key}: found {'nothing' if values is None else values!s:.120}; give a row of numbers")
    flat = [number for item in ([values] if isinstance(values, str) else values) for number in (item if isinstance(item, list) else [item])]
    _demand(count is None or len(flat) == count, key, f"{len(flat)} numbers", f"give {count}")
    return [_number(key, number) for number in flat]


def _number(key: str, value: Any) -> float:
    """A finite number; YAML takes those like 1e-05 for text."""
    try:
        number = math.nan if isinstance(value, bool) or value is None else float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    _demand(math.isfinite(number), key, repr(value), "give a finite number")
    return number
