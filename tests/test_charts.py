"""Charts show the numbers that they are given, at their places: read from the pictures' pixels."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

pytest.importorskip("matplotlib", reason="the extra 'pictures' is not installed")

import matplotlib
from bench_scale import Size, scale_chart

from runtime.recordings.chart import BLUE, RED, new_figure, picture_of, rgb
from runtime.recordings.draw import BACKGROUND, NO_RUNWAY, STATE, TRUTH
from runtime.recordings.history import BAND, History, Moment, draw_history
from runtime.scene import Axis, Scene

SCENE = Scene.load(Path(__file__).resolve().parents[1] / "models" / "paper.toml")
PANELS = 3
"""Of the paper's scene, whose x is fixed."""


def with_colour(picture: NDArray, colour: tuple[int, int, int], slack: int = 0) -> NDArray[np.bool_]:
    return (np.abs(picture.astype(int) - colour) <= slack).all(axis=2)


def at(share: float) -> NDArray[np.float64]:
    """The state at that share of the domain's width, on every axis."""
    return SCENE.domain.lower + share * (SCENE.domain.upper - SCENE.domain.lower)


def history_of(*moments: tuple[float | None, float | None, float | None, float | None]) -> History:
    """A second each: state, lower, upper and truth as shares of the domain's width, or None."""
    history = History()
    for second, shares in enumerate(moments):
        history.add(Moment(second * 1e6, (second + 1) * 1e6, *(None if share is None else at(share) for share in shares)))
    return history


def panel_parts(picture: NDArray) -> list[NDArray]:
    """The picture's panels, without the legend above, the time below and the names at the left."""
    height = picture.shape[0]
    top, bottom = int(0.09 * height), int(0.905 * height)
    return np.array_split(picture[top:bottom, 100:], PANELS)


def middle_of(found: NDArray[np.bool_]) -> float:
    """Row in the middle of the pixels found."""
    return float(np.nonzero(found.any(axis=1))[0].mean())


def test_a_figure_has_the_size_and_the_colours_that_were_asked_for() -> None:
    figure = new_figure(2.0, 640)
    figure.set_facecolor(rgb((10, 120, 250)))
    picture = picture_of(figure)
    assert (picture.dtype, picture.shape) == (np.uint8, (200, 640, 3))
    assert with_colour(picture, (10, 120, 250)).all()


def test_a_users_own_settings_change_no_chart() -> None:
    """As a matplotlibrc in the current folder or in the home has them; LaTeX may not even be there."""
    history, sizes = history_of((0.5, 0.4, 0.6, None)), [Size("finer", 27, 1, 1, 1.0, 1.0, 2.0, 1.0, 1.0, 1.0, 1.0)]
    expected = draw_history(SCENE, history), scale_chart(sizes)
    settings = {"text.usetex": True, "font.size": 40, "axes.grid": True, "axes.facecolor": "red", "lines.linestyle": ":"}
    with matplotlib.rc_context(settings):
        for drawn, plain in zip((draw_history(SCENE, history), scale_chart(sizes)), expected, strict=True):
            np.testing.assert_array_equal(drawn, plain)
        assert {name: matplotlib.rcParams[name] for name in settings} == settings


@pytest.mark.parametrize(("kind", "colour"), [(0, STATE), (3, TRUTH)])
def test_a_state_is_drawn_at_its_height_in_every_panel(kind: int, colour: tuple[int, int, int]) -> None:
    rows = []
    for share in (0.1, 0.5, 0.9):
        given = [None, None, None, None]
        given[kind] = share
        picture = draw_history(SCENE, history_of(tuple(given), tuple(given)))  # pyright: ignore[reportArgumentType]
        rows.append([middle_of(with_colour(panel, colour, 60)) for panel in panel_parts(picture)])
    low, middle, high = np.array(rows)
    assert (high < middle).all()
    np.testing.assert_allclose(low - middle, middle - high, atol=1.5)
    np.testing.assert_allclose(np.ptp(low - high), 0, atol=1.5)


def test_the_band_lasts_as_long_as_its_moments_and_red_marks_the_rest() -> None:
    certified, lost = (0.5, 0.25, 0.75, None), (None, None, None, None)
    picture = draw_history(SCENE, history_of(certified, certified, lost, certified))
    for panel in panel_parts(picture):
        band = with_colour(panel, BAND).sum(axis=0) > 20
        red = with_colour(panel, NO_RUNWAY).any(axis=0)
        assert not (band & red).any()
        assert red.sum() == pytest.approx(band.sum() / 3, abs=4)
        first, last = np.nonzero(red)[0][[0, -1]]
        assert band[:first].sum() == pytest.approx(2 * band[last:].sum(), abs=4)


def test_the_band_is_as_high_as_its_bounds() -> None:
    heights = []
    for low, high in ((0.4, 0.6), (0.2, 0.8)):
        picture = draw_history(SCENE, history_of((None, low, high, None)))
        heights.append([with_colour(panel, BAND).any(axis=1).sum() for panel in panel_parts(picture)])
    np.testing.assert_allclose(heights[1], np.multiply(heights[0], 3), atol=4)


def test_a_domain_of_one_state_has_a_history_without_panels() -> None:
    axes = [Axis((float(value),), 0.0) for value in at(0.5)]
    scene = replace(SCENE, domain=type(SCENE.domain)(*axes))
    picture = draw_history(scene, history_of((0.5, 0.5, 0.5, None)))
    assert with_colour(picture, BACKGROUND).mean() > 0.9


def test_both_families_start_at_the_first_scene_and_equal_ratios_are_equally_far() -> None:
    def size(family: str, cells: int, run_ms: float) -> Size:
        return Size(family, cells, 1, 1, 1.0, 1.0, run_ms, 1.0, 1.0, 1.0, 1.0)

    sizes = [size("finer", 27, 0.3), *(size("finer", 27 * 8**step, 0.3 * 2**step) for step in (1, 2)), size("larger", 1728, 2.4)]
    picture = scale_chart(sizes)
    blue, red = (with_colour(picture[150:], colour) for colour in (BLUE, RED))

    def row(found: NDArray[np.bool_], column: int) -> float:
        return float(np.nonzero(found[:, column])[0].mean())

    columns = np.nonzero(blue.any(axis=0))[0]
    first, last = columns[0] + 20, columns[-1] - 20
    rows = [row(blue, column) for column in (first, (first + last) // 2, last)]
    assert rows[0] - rows[1] == pytest.approx(rows[1] - rows[2], abs=2)
    assert np.nonzero(red.any(axis=0))[0][0] == pytest.approx(columns[0], abs=24)  # its mark covers blue's
    assert row(red, (first + last) // 2) < rows[1]
