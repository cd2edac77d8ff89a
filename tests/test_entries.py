"""What the loader guarantees of the entries' boxes, whoever wrote the file: it holds of every bank that is taken, and of no other."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scenes import examples

from runtime.camera import ground_scale
from runtime.model.entries import Entries
from runtime.model.format import BOX_TENSORS, MASK_TENSORS, PADDING_SIZE, STATE_BOX_TENSORS, ModelError
from runtime.model.limits import BELOW_HORIZON_PX
from runtime.model.model_file import parse_model
from runtime.rounding import OUTWARD_RELATIVE
from runtime.scene import Scene

Tensors = dict[str, NDArray[Any]]
HOSTILE = (0.0, -0.0, 1.0, -1.0, 0.5, 480.0, 482.0, 1e16, -1e16, 1e-300, 1e300, 5e-324, np.nan, np.inf, -np.inf)
SHARES = np.linspace(0, 1, 5)


@pytest.fixture(scope="module")
def paper(repository: Path) -> tuple[Scene, Tensors]:
    """Scene and tensors of the paper's model, 524 of whose places are padding."""
    model = parse_model((repository / "models" / "paper.onnx").read_bytes(), "paper.onnx", BOX_TENSORS + MASK_TENSORS)
    return Scene.from_dict(model.metadata["scene"]), model.tensors


def assert_guaranteed(scene: Scene, tensors: Tensors) -> int:
    """1 to 3 of `runtime.model.entries`, at the boxes' corners and between them. Returns the number of sets."""
    entries = Entries.of(scene, tensors, "model")
    sets, camera = entries.sets(np.ones(tensors["must_light_size"].shape, dtype=bool)), scene.camera
    for bounds, low, high in zip((sets.theta, sets.x, sets.y, sets.z), scene.domain.lower, scene.domain.upper, strict=True):
        assert ((low <= bounds[:, 0]) & (bounds[:, 0] <= bounds[:, 1]) & (bounds[:, 1] <= high)).all()
    row = camera.v0 + camera.focal_v_px * sets.tangent[:, None]
    assert ((row >= -1e-9) & (row <= camera.height + 1 + 1e-9)).all()
    theta = sets.theta[:, :1] + SHARES * (sets.theta[:, 1:] - sets.theta[:, :1])
    assert (row - (camera.v0 - camera.focal_v_px * np.tan(theta)) >= BELOW_HORIZON_PX - 1e-9).all()
    assert (sets.scale[:, 0] <= sets.scale[:, 1]).all()
    allowed = np.stack([ground_scale(camera, theta, y[:, None], row) for y in sets.y.T], axis=-1)
    margin = 1 + 2 * OUTWARD_RELATIVE
    assert (sets.scale[:, 0] * margin >= allowed.min(axis=(1, 2))).all()
    peak = camera.focal_v_px * np.sqrt(1 + sets.tangent**2) / sets.y[:, 0]  # where a theta inside the box looks straight down the row
    assert (sets.scale[:, 1] <= margin * np.maximum(allowed.max(axis=(1, 2)), peak)).all()
    assert sets.scale.min(initial=1) > 0
    return len(sets)


def test_every_entry_of_the_papers_model_is_a_set_and_padding_is_none(paper: tuple[Scene, Tensors]) -> None:
    scene, tensors = paper
    assert assert_guaranteed(scene, tensors) == (tensors["must_light_size"] != PADDING_SIZE).sum() == 2905


def test_scales_are_drawn_in_to_what_the_states_have(paper: tuple[Scene, Tensors]) -> None:
    """The outermost bins of the scale reach beyond the cell; no state is there, and none is cut off."""
    scene, tensors = paper
    used = tensors["must_light_size"] != PADDING_SIZE
    sets = Entries.of(scene, tensors, "model").all
    lower, upper = tensors["line_lower"][used][:, 2], tensors["line_upper"][used][:, 2]
    assert ((lower <= sets.scale[:, 0]) & (sets.scale[:, 1] <= upper)).all()
    assert 0 < ((lower < sets.scale[:, 0]) | (sets.scale[:, 1] < upper)).sum() < len(sets)
    rng = np.random.default_rng(0)
    row = scene.camera.v0 + scene.camera.focal_v_px * sets.tangent
    for _ in range(50):
        theta, y = (bounds[:, 0] + rng.random(len(sets)) * (bounds[:, 1] - bounds[:, 0]) for bounds in (sets.theta, sets.y))
        scale = ground_scale(scene.camera, theta, y, row)
        claimed = (lower <= scale) & (scale <= upper)
        assert ((sets.scale[:, 0] <= scale) & (scale <= sets.scale[:, 1]))[claimed].all()


def with_values(tensors: Tensors, name: str, change: Callable[[NDArray[Any]], None]) -> Tensors:
    """The tensors with one of them changed."""
    values = tensors[name].copy()
    change(values)
    return {**tensors, name: values}


def first_used(value: float, *place: int) -> Callable[[NDArray[Any]], None]:
    def change(values: NDArray[Any]) -> None:
        values[(0, 0, *place)] = value

    return change


REFUSED = {
    "a reference row of 1e16": ("reference_row", lambda rows: rows.fill(1e16), r"an entry's reference_row is 1e\+16, 0 to 481 are taken"),
    "one below the frame": ("reference_row", first_used(481.5), "reference_row is 481.5, 0 to 481"),
    "one above the frame": ("reference_row", first_used(-1e-3), "reference_row is -0.001, 0 to 481"),
    "scales without an end": ("line_upper", first_used(1e300, 2), r"scale is .* to 1e\+300 px/m where its states allow"),
    "a scale of 0": ("line_lower", first_used(0.0, 2), "scale is 0 to"),
    "scales inverted": ("line_lower", first_used(300.0, 2), "scale is 300 to 2"),
    "theta inverted": ("theta_lower", first_used(0.74), "an entry's theta is from 0.74"),
    "theta out of the domain": ("theta_lower", first_used(0.4), "theta is from 0.4.* to .*, its scene's domain from 0.4499999.* to 0.75"),
    "y out of the domain": ("y_upper", first_used(1e30), "an entry's y is from"),
    "x on a fixed axis": ("x_upper", first_used(1e-3), "an entry's x is from"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_claim_that_the_refinement_cannot_rely_on_is_refused(paper: tuple[Scene, Tensors], case: str) -> None:
    scene, tensors = paper
    name, change, message = REFUSED[case]
    assert tensors["must_light_size"][0, 0] != PADDING_SIZE
    with pytest.raises(ModelError, match=message) as caught:
        Entries.of(scene, with_values(tensors, name, change), "model")
    assert str(caught.value).startswith("model: ")
    assert str(caught.value).isprintable()


def test_constants_that_do_not_fit_the_scene_are_refused(paper: tuple[Scene, Tensors]) -> None:
    """Of another type or shape, or not finite; windows and masks out of the frame; cells without rows."""
    scene, tensors = paper
    cases: list[tuple[str, NDArray[Any], str]] = [
        ("theta_lower", np.zeros((2, 3), dtype=np.float32), r"theta_lower is float32 \[2, 3\], its scene asks for float32 \[27, 127\]"),
        ("line_lower", np.zeros((1, 9, 4), dtype=np.float32), "line_lower is float32"),
        ("window_first", np.array([-1, 0]), "its window or its spatial masks lie outside the frame"),
        ("window_stop", np.array([10_000, 10_000]), "its window or its spatial masks lie outside the frame"),
        ("spatial_run_index", np.zeros(3, dtype=np.int32), "spatial_run_cell is int32"),
        ("spatial_run_index", tensors["spatial_run_index"] + np.int32(2**20), "its window or its spatial masks lie outside the frame"),
        ("reference_row", np.full(tensors["reference_row"].shape, np.nan), "not finite"),
        ("row_cell", np.zeros(27, dtype=np.int32), "row_cell does not give rows to every one of 27 cells"),
    ]
    for name, values, message in cases:
        with pytest.raises(ModelError, match=message):
            Entries.of(scene, {**tensors, name: values}, "model")


def test_a_reference_row_at_the_horizon_is_refused(paper: tuple[Scene, Tensors]) -> None:
    """By a principal point that puts the horizon into view; half a pixel below it is taken, if only the scales were such."""
    scene, tensors = paper
    tables = scene.to_dict()
    tables["camera"]["principal_point"] = [320.0, 600.0]
    theta = np.clip(tensors["theta_lower"].astype(float), scene.domain.lower[0], scene.domain.upper[0])
    horizon = 600 - scene.camera.focal_v_px * np.tan(theta)
    for below_px, message in ((0.51, "an entry's scale is"), (0.49, "reference_row is .*, which is not below the horizon")):
        with pytest.raises(ModelError, match=message):
            Entries.of(Scene.from_dict(tables), {**tensors, "reference_row": horizon + below_px}, "model")


@examples(300)
@given(data=st.data())
def test_any_numbers_are_refused_or_guaranteed(paper: tuple[Scene, Tensors], data: st.DataObject) -> None:
    """Some numbers of a bank replaced, moved or scaled; what is taken keeps the guarantees, and entries without states are left out."""
    scene, tensors = paper
    changed = dict(tensors)
    for _ in range(data.draw(st.integers(1, 3))):
        name = data.draw(st.sampled_from([*STATE_BOX_TENSORS, "line_lower", "line_upper", "reference_row"]))
        values = changed[name].copy()
        flat = values.reshape(-1)
        places = data.draw(st.lists(st.integers(0, flat.size - 1), min_size=1, max_size=3))
        old = flat[places]
        with np.errstate(over="ignore"):
            flat[places] = data.draw(
                st.sampled_from(HOSTILE)
                | st.floats(0.5, 2).map(lambda factor, old=old: old * factor)
                | st.floats(-0.1, 0.1).map(lambda shift, old=old: old + shift)
                | st.integers(-3, 3).map(lambda steps, old=old: old + steps * np.spacing(old))
            )
        changed[name] = values
    try:
        assert 2905 - 9 <= assert_guaranteed(scene, changed) <= 2905
    except ModelError as error:
        assert str(error).isprintable()  # noqa: PT017
