"""Each contractor by itself: the true state stays in the set, decided in fractions at every scale, and what is left is narrow."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray
from rational_image import RationalState, RationalView, turn
from scenes import PAPER, examples

from runtime.refine.altitude import contract_by_altitude
from runtime.refine.borders import Borders
from runtime.refine.crossings import offsets_at_crossings
from runtime.refine.end_pixels import offsets_at_ends
from runtime.refine.ends import contract_by_ends
from runtime.refine.ground import z_of_rows
from runtime.refine.interval import relaxed_intersection
from runtime.refine.lit_pixels import LitPixels
from runtime.refine.missed import HalfWindows
from runtime.refine.offsets import contract_by_offsets
from runtime.refine.scales import contract_by_scales, horizon_bounds, scales_at_borders
from runtime.refine.sight import Sight, Vouched
from runtime.refine.vouched import contract_by_vouched, offsets_by_vouched
from runtime.scene import Axis, Camera, Domain, Marking, Runway, Scene, SceneError
from runtime.state_set import StateSet, end_rows, tangent_of_row

Frame = NDArray[np.bool_]
WHOLE = slice(None), slice(None)
CONTRACTORS = {
    "offsets": contract_by_offsets,
    "vouched": contract_by_vouched,
    "scales": contract_by_scales,
    "ends": contract_by_ends,
}
SOURCES = {"crossings": offsets_at_crossings, "end pixels": offsets_at_ends, "vouched": offsets_by_vouched}


@dataclass(frozen=True)
class Case:
    """A true state of a scene, its image, and a set of states that holds it."""

    scene: Scene
    state: RationalState
    sets: StateSet
    image: Frame

    def scale(self) -> Fraction:
        """g at the set's reference row, px per metre, exactly."""
        cosine, sine = turn(self.state.tangent)
        fall = cosine * Fraction(float(self.sets.tangent[0])) + sine
        return RationalView.of(self.scene.to_dict()).focal_u * fall / self.state.y

    def held_by(self, sets: StateSet) -> bool:
        """Is the state in what is left of the set? Decided in fractions."""
        slow, fast = sets.scale[0].tolist()
        return self.state.within(sets.lower[0], sets.upper[0]) and slow <= self.scale() <= fast

    def seen(self, frame: Frame, budget: int, vouched_budget: int = -1) -> Sight:
        """What the frame shows; with a `vouched_budget` all that is lit is vouched for but for so many pixels."""
        vouched = None if vouched_budget < 0 else Vouched(LitPixels.of(frame, WHOLE, beyond=False), vouched_budget)
        return Sight.of(self.scene, self.sets, LitPixels.of(frame, WHOLE, beyond=True), budget, vouched)


def spread(low: float, high: float) -> st.SearchStrategy[float]:
    """Numbers between two, over their orders of magnitude."""
    return st.floats(math.log10(low), math.log10(high)).map(lambda exponent: 10.0**exponent)


def around(draw: st.DrawFn, value: float, width: float) -> list[float]:
    """An interval of up to that width that holds the value, often at its end."""
    width *= draw(st.sampled_from([0.0, 0.01, 0.1, 1.0]))
    share = draw(st.sampled_from([0.0, 0.3, 1.0]))
    return [value - share * width, value + (1 - share) * width]


def pinhole(draw: st.DrawFn, width: int, height: int, focal_px: float) -> Camera:
    """A camera whose pixels are square, or a tenth wider or taller."""
    return Camera(width, height, focal_px=(draw(st.sampled_from([1.0, 0.9, 1.1])) * focal_px, focal_px))


@st.composite
def cases(draw: st.DrawFn) -> Case:
    """Cameras of 32 to 320 px from 0.3 to 300 m up over one to three markings, often side by side; sets up to a few pixels wide."""
    width, height = draw(st.integers(32, 320)), draw(st.integers(32, 240))
    camera = pinhole(draw, width, height, draw(spread(0.6, 8)) * width)
    y, slope = draw(spread(0.3, 300)), draw(spread(0.02, 3))  # of altitude over distance, at the nearest end
    distance = y / slope
    row = draw(st.floats(0.4, 1.1)) * height  # of the nearest end
    theta = math.atan(slope) - math.atan((row - camera.v0) / camera.focal_v_px)
    shift = draw(st.sampled_from([0.0, 1e4, -98_765.4]))
    state = RationalState.near([theta, shift, y, distance - shift])
    scale = camera.focal_u_px * math.cos(theta) / (distance + y * slope) / (1 + slope * math.tan(theta))  # about that there
    markings, column = [], draw(st.floats(-0.02, 1.02)) * width
    for number in range(draw(st.integers(1, 3))):
        across = (column - camera.u0) / scale
        start = draw(st.sampled_from([0.0, 0.0, 0.1, 0.5])) * distance
        markings.append(Marking(str(number), shift + across, shift + start, draw(spread(0.1, 30)) * distance))
        column = draw(
            st.one_of(st.floats(-0.02, 1.02).map(lambda share: share * width), st.sampled_from([0.5, 1.0, 2.0]).map(column.__add__))
        )
    try:
        axes = [Axis((float(value),), 0.0) for value in state.floats]
        scene = Scene(camera, Runway(tuple(markings)), Domain(*axes), PAPER.bank)
    except SceneError:
        assume(False)
        raise
    px = 1 / camera.focal_v_px
    theta_x_y_z = [
        around(draw, value, extent) for value, extent in zip(state.floats, (2 * px, distance * px, 0.1 * y, 0.2 * distance), strict=True)
    ]
    tangent = tangent_of_row(camera, np.array([round(min(row, height))]))
    sets = StateSet(*np.array(theta_x_y_z)[:, None], scale=np.zeros((1, 2)), tangent=tangent)
    assume(sets.y[0, 0] > 0)
    assume((sets.z[0, 0] + scene.runway.ends_z_m).min() > 0)
    assume((np.cos(sets.theta) * tangent + np.sin(sets.theta)).min() > 1e-3)
    case = Case(scene, state, sets, RationalView.of(scene.to_dict()).image(state).frame)
    true = float(case.scale())
    sets.scale[:] = np.array(around(draw, true, 0.05 * true)) + np.array([-1, 1]) * 2.0**-45 * true
    sets.theta[:] += np.array([-1, 1]) * 2.0**-50
    assume(case.held_by(sets))
    return case


def spoiled(case: Case, data: st.DataObject, most_missed: int, clutter: Frame) -> tuple[Frame, int]:
    """The image with up to so many pixels dark, which are often neighbours, under clutter; and how many are."""
    lit = np.flatnonzero(case.image)
    count = min(data.draw(st.sampled_from([0, *range(most_missed + 1)])), len(lit))
    if count == 0:
        return case.image | clutter, 0
    first = data.draw(st.integers(0, len(lit) - 1))
    step = data.draw(st.sampled_from([1, 1, 2, 7]))
    dark = np.unique(lit[(first + step * np.arange(count)) % len(lit)])
    frame = case.image | clutter
    frame.ravel()[dark] = False
    return frame, len(dark)


def clutter_of(case: Case, data: st.DataObject) -> Frame:
    density, seed = data.draw(st.sampled_from([0.0, 0.0, 0.02, 0.3])), data.draw(st.integers(0, 1000))
    return np.random.default_rng(seed).random(case.image.shape) < density


def vouched_for(case: Case, data: st.DataObject) -> tuple[Frame, int]:
    """Up to four more pixels are lit near the image: the frame, and how many."""
    near = np.flatnonzero(case.image)[:, None] + np.array([-2, -1, 1, 2])
    places = np.setdiff1d(near[(near >= 0) & (near < case.image.size)], np.flatnonzero(case.image))
    assume(len(places) > 0)
    count = min(data.draw(st.sampled_from([0, 1, 1, 2, 4])), len(places))
    chosen = places[sorted(data.draw(st.sets(st.integers(0, len(places) - 1), min_size=count, max_size=count)))]
    frame = case.image.copy()
    frame.ravel()[chosen] = True
    return frame, len(chosen)


# --- containment ---


@pytest.mark.parametrize("name", CONTRACTORS)
@examples(60)
@given(case=cases(), data=st.data())
def test_a_contractor_keeps_the_state_whatever_the_clutter(name: str, case: Case, data: st.DataObject) -> None:
    frame, missed = spoiled(case, data, 4, clutter_of(case, data))
    assert case.held_by(CONTRACTORS[name](case.sets, case.seen(frame, missed)))


@pytest.mark.parametrize("name", CONTRACTORS)
@examples(60)
@given(case=cases(), data=st.data())
def test_a_contractor_keeps_the_state_with_bounded_clutter(name: str, case: Case, data: st.DataObject) -> None:
    frame, extra = vouched_for(case, data)
    assert case.held_by(CONTRACTORS[name](case.sets, case.seen(frame, 0, extra)))


@pytest.mark.parametrize("name", SOURCES)
@examples(60)
@given(case=cases(), data=st.data())
def test_true_offsets_lie_within_their_bounds(name: str, case: Case, data: st.DataObject) -> None:
    frame, missed = spoiled(case, data, 3, clutter_of(case, data)) if name != "vouched" else (case.image, 0)
    sight = case.seen(frame, missed, 0 if name == "vouched" else -1)
    low, high = SOURCES[name](case.sets, sight)
    assert sight.missed.left[0] >= 0
    for marking, x_m in enumerate(case.scene.runway.x_m.tolist()):
        assert low[marking, 0] <= (Fraction(x_m) - case.state.x) * case.scale() <= high[marking, 0]


@examples(60)
@given(case=cases())
def test_altitude_and_scale_keep_the_state(case: Case) -> None:
    assert case.held_by(contract_by_altitude(case.scene.camera, case.sets))


# --- tightness: what a clean frame that holds one whole marking tells of a set that is wide in one way alone ---


@st.composite
def whole_markings(draw: st.DrawFn) -> Case:
    """One marking, all of it in the frame with a margin of 8 px, not flatter than a pixel a row; the set is the state but for 2^-44."""
    width, height = draw(st.integers(96, 320)), draw(st.integers(96, 240))
    camera = pinhole(draw, width, height, draw(st.floats(0.8, 3)) * width)
    y, theta = draw(spread(0.3, 300)), draw(st.floats(0.1, 1.0))
    rows = draw(st.floats(8, height / 2)), draw(st.floats(height / 2 + 4, height - 8))
    assume((rows[0] - camera.v0) / camera.focal_v_px + math.tan(theta) > 0.05)
    far, near = (y / math.tan(theta + math.atan((row - camera.v0) / camera.focal_v_px)) for row in rows)
    assume(near > 0.01 * y)  # ahead of the camera
    scales = [camera.focal_u_px / (y * math.sin(theta) + d * math.cos(theta)) for d in (far, near)]
    reach = min((width / 2 - 8) / scales[1], (rows[1] - rows[0]) / (scales[1] - scales[0]))
    across = draw(st.sampled_from([-1, 1])) * draw(st.floats(0.05, 1)) * reach
    shift = draw(st.sampled_from([0.0, 1e4, -98_765.4]))
    state = RationalState.near([theta, shift, y, near - shift])
    axes = [Axis((float(value),), 0.0) for value in state.floats]
    scene = Scene(camera, Runway((Marking("m", shift + across, shift, far - near),)), Domain(*axes), PAPER.bank)
    sides = [np.array([[value - 2.0**-44, value + 2.0**-44]]) for value in state.floats]
    sides[1][:] = shift
    tangent = tangent_of_row(camera, np.array([round(rows[1])]))
    sets = StateSet(*sides, scale=np.zeros((1, 2)), tangent=tangent)
    case = Case(scene, state, sets, RationalView.of(scene.to_dict()).image(state).frame)
    sets.scale[:] = float(case.scale()) * (1 + np.array([[-1, 1]]) * 2.0**-40)
    assume(case.held_by(sets))
    return case


def widened(case: Case, **extents: float) -> Case:
    """Its set with some intervals so much wider on both sides."""
    wide = {name: getattr(case.sets, name) + np.array([-extent, extent]) for name, extent in extents.items()}
    return replace(case, sets=replace(case.sets, **wide))


def lit_rows(case: Case) -> tuple[int, int]:
    """The first and the last row in which the image is lit."""
    rows = np.flatnonzero(case.image.any(axis=1))
    return int(rows[0]), int(rows[-1])


@examples(60)
@given(case=whole_markings(), budget=st.integers(0, 2))
def test_borders_tell_an_offset_to_a_pixel_at_the_lowest_one(case: Case, budget: int) -> None:
    """A marking lights the pixels of its column on both sides of a border, and no others there: a pixel is left, whatever is not missed."""
    wide = widened(case, scale=3 * float(case.scale()) / case.scene.camera.width)
    sight = wide.seen(case.image, budget)
    low, high = (float(side[0, 0]) for side in offsets_at_crossings(wide.sets, sight))
    lowest = np.flatnonzero(sight.borders.crossed[0, :, 0])[-1 - budget]
    flat = 1 if budget else 0  # a row that may be spoiled leaves the border to the other one, which may hold two pixels
    assert high - low <= (1 + flat + 1e-4) / sight.borders.ratio[0][lowest, 0]


@examples(60)
@given(case=whole_markings(), budget=st.integers(0, 3))
def test_a_marking_ends_no_more_rows_beyond_the_lit_ones_than_may_be_missed(case: Case, budget: int) -> None:
    wide = widened(case, z=0.2 * case.scene.runway.markings[0].length_m)
    assume((wide.sets.z[0, 0] + case.scene.runway.ends_z_m).min() > 0)
    closer = contract_by_ends(wide.sets, wide.seen(case.image, budget))
    first, last = lit_rows(case)
    camera, (near_z, far_z) = case.scene.camera, case.scene.runway.ends_z_m[0]
    assert end_rows(camera, closer, near_z)[1][0] <= last + 1 + budget + 1e-4
    assert end_rows(camera, closer, far_z)[0][0] >= first - budget - 1e-4


@examples(60)
@given(case=whole_markings())
def test_vouched_pixels_pull_the_ends_out_to_their_rows(case: Case) -> None:
    """Theorem B with nothing else lit: the near end reaches the last lit row, the far end the first."""
    wide = widened(case, z=0.2 * case.scene.runway.markings[0].length_m)
    assume((wide.sets.z[0, 0] + case.scene.runway.ends_z_m).min() > 0)
    closer = contract_by_vouched(wide.sets, wide.seen(case.image, 0, 0))
    first, last = lit_rows(case)
    camera, (near_z, far_z) = case.scene.camera, case.scene.runway.ends_z_m[0]
    assert end_rows(camera, closer, near_z)[0][0] >= last - 1e-4
    assert end_rows(camera, closer, far_z)[1][0] <= first + 1 + 1e-4


@examples(60)
@given(case=whole_markings(), name=st.sampled_from(["end pixels", "vouched"]))
def test_lit_pixels_tell_an_offset_to_their_columns(case: Case, name: str) -> None:
    """Of the end's row, one pixel or two; of vouched pixels, the smallest pixel of all."""
    wide = widened(case, scale=3 * float(case.scale()) / case.scene.camera.width)
    sight = wide.seen(case.image, 0, 0 if name == "vouched" else -1)
    low, high = (float(side[0, 0]) for side in SOURCES[name](wide.sets, sight))
    lowest = np.flatnonzero(sight.borders.crossed[0, :, 0])[-1]
    assert high - low <= (2 + 0.1) / sight.borders.ratio[0][lowest, 0]


@examples(60)
@given(case=whole_markings())
def test_offsets_tell_the_scale_and_the_track(case: Case) -> None:
    """Offset over (p_x - x) is the scale, and p_x less offset over scale is x: no more is left than the sources leave."""
    for axis, extent in (("scale", 0.1 * float(case.scale())), ("x", 10 / float(case.scale()))):
        wide = widened(case, **{axis: extent})
        sight = wide.seen(case.image, 0)
        bounds = [SOURCES[name](wide.sets, sight) for name in ("crossings", "end pixels")]
        low, high = max(low[0, 0] for low, _ in bounds), min(high[0, 0] for _, high in bounds)
        across, scale = case.scene.runway.x_m[0] - float(case.state.x), float(case.scale())
        found = getattr(contract_by_scales(contract_by_offsets(wide.sets, sight), sight), axis)[0]
        left = (high - low) / (abs(across) if axis == "scale" else scale)
        assert found[1] - found[0] <= left + 1e-5 * extent


def all_pairs(row: list[float], low: list[float], high: list[float]) -> tuple[float, float]:
    """What all pairs of borders say of T, one by one: g between `low` and `high` at rows v - v0, proportional to (v - v0) + T."""
    least, most = -math.inf, math.inf
    for one, other in itertools.product(range(len(row)), repeat=2):
        if low[one] > 0 and high[other] < math.inf and low[one] != high[other]:
            bound = low[one] * (row[other] - row[one]) / (high[other] - low[one]) - row[one]
            least, most = (max(least, bound), most) if low[one] < high[other] else (least, min(most, bound))
    return least, most


@examples(60)
@given(case=whole_markings(), extent=st.floats(1e-4, 1e-2), free=st.booleans())
def test_border_pairs_come_to_what_all_pairs_say(case: Case, extent: float, free: bool) -> None:
    """Repeated with the same frame; x free leaves the marking on one side, and so no more than a wider range of scales."""
    wide = widened(case, theta=extent, **({"x": 0.1 * abs(case.scene.runway.x_m[0] - float(case.state.x))} if free else {}))
    sight, camera = wide.seen(case.image, 0), case.scene.camera
    assert isinstance(sight.borders, Borders)
    low, high = (side[:, 0].tolist() for side in scales_at_borders(wide.sets, sight, sight.borders))
    least, most = all_pairs((sight.borders.row[:, 0] - camera.v0).tolist(), low, high)
    sets = wide.sets
    for _ in range(8):
        sets = contract_by_scales(sets, sight)
    start, stop = wide.sets.theta[0]
    expected = max(start, math.atan(least / camera.focal_v_px)), min(stop, math.atan(most / camera.focal_v_px))
    assert sets.theta[0].tolist() == pytest.approx(expected, abs=1e-7 * extent + 1e-12)


@examples(60)
@given(data=st.data())
def test_two_borders_tell_the_horizon(data: st.DataObject) -> None:
    """Exact scales at two rows leave one T; those of contradicting rows leave none."""
    horizon, unit = data.draw(st.floats(-500, 500)), data.draw(spread(1e-3, 1e3))
    row = np.array(data.draw(st.lists(st.integers(1, 2000), min_size=2, max_size=9, unique=True)), dtype=np.float64)[:, None] - horizon
    scales = unit * (row + horizon)
    least, most = horizon_bounds(row, 0.0, scales, scales, np.array([[horizon - 0.4], [horizon + 0.4]]))
    assert least[0] <= horizon <= most[0]
    assert most[0] - least[0] <= 1e-6
    falling = -np.sort(-scales, axis=0)
    assert horizon_bounds(np.sort(row, axis=0), 0.0, falling, falling, np.array([[horizon], [horizon + 0.4]]))[1][0] < horizon


@examples(60)
@given(case=whole_markings())
def test_altitude_and_scale_tell_each_other(case: Case) -> None:
    for axis in ("y", "scale"):
        wide = widened(case, **{axis: 0.1 * getattr(case.sets, axis)[0, 0]})
        low, high = getattr(contract_by_altitude(case.scene.camera, wide.sets), axis)[0]
        assert high - low <= 1e-9 * high


def test_of_several_markings_the_closest_bounds_on_z_are_taken() -> None:
    lower, upper = PAPER.domain.lower, PAPER.domain.upper
    theta, x, y, z = ((lower + upper) / 2)[:, None, None] + np.zeros((4, 1, 2))
    tangent = np.zeros(1)
    sets = contract_by_altitude(PAPER.camera, StateSet(theta, x, y, z, scale=np.array([[1.0, 1e4]]), tangent=tangent))
    rows, ends = np.array([[250.0], [270.0]]), np.zeros(2)
    low, high = z_of_rows(PAPER.camera, sets, rows, ends, rows, ends)
    alone = [z_of_rows(PAPER.camera, sets, row[None], ends[:1], row[None], ends[:1]) for row in rows]
    assert low == max(bound for bound, _ in alone)
    assert high == min(bound for _, bound in alone)
    assert alone[0][0] != alone[1][0]


# --- against naive twins ---


def lit_within(frame: Frame, row: int, first: float, last: float) -> tuple[float, float]:
    """First and last lit column of a window of a row; what lies outside of the frame is lit, and bounds nothing."""
    height, width = frame.shape
    if not 0 <= row < height:
        return -np.inf, np.inf
    lit = [column for column in range(max(int(first), -1), min(int(last), width) + 1) if column in (-1, width) or frame[row, column]]
    return (
        min(lit, default=np.inf) if 0 <= first < width else -np.inf,
        max(lit, default=-np.inf) if 0 <= last < width else np.inf,
    )


@examples(200)
@given(case=cases(), data=st.data())
def test_offsets_at_crossings_are_those_of_a_naive_twin(case: Case, data: st.DataObject) -> None:
    """Row by row the bounds of its two half-windows, where they are usable; of all rows the closest but for the missed pixels left."""
    frame, missed = spoiled(case, data, 4, clutter_of(case, data))
    sight = case.seen(frame, missed + data.draw(st.sampled_from([0, 0, 1, 2])))
    borders, u0 = sight.borders, case.scene.camera.u0
    low, high = offsets_at_crossings(case.sets, sight)
    for marking in range(len(low)):
        lower, upper = [], []
        for row in range(len(borders.row) - 1):
            bounds = [(-np.inf, np.inf)]
            for half in (0, 1):
                if sight.crossed[half, marking, row, 0] and not sight.missed.halves[half, marking, row, 0]:
                    window = (float(side[marking, row + half, 0]) for side in borders.columns)
                    first, last = lit_within(frame, int(borders.row[row, 0]), *window)
                    slow, fast = (float(side[row + half, 0]) for side in borders.ratio)
                    left, right = first - u0 - borders.margin_px[0], last + 1 - u0 + borders.margin_px[0]
                    bounds.append((min(left / slow, left / fast), max(right / slow, right / fast)))
            lower.append(max(bound for bound, _ in bounds))
            upper.append(min(bound for _, bound in bounds))
        spared = int(sight.missed.left[0])
        assert low[marking, 0] == pytest.approx([*sorted(lower, reverse=True), *[-np.inf] * spared][spared], rel=1e-9, abs=1e-9)
        assert high[marking, 0] == pytest.approx([*sorted(upper), *[np.inf] * spared][spared], rel=1e-9, abs=1e-9)


@examples(200)
@given(case=cases(), data=st.data())
def test_ends_are_those_of_a_naive_twin(case: Case, data: st.DataObject) -> None:
    """Row by row from the far end down, and from the near end up: a marking ends where one more is dark than may be missed."""
    frame, missed = spoiled(case, data, 4, clutter_of(case, data))
    sight = case.seen(frame, missed + data.draw(st.sampled_from([0, 0, 1, 2])))
    borders, (first, last) = sight.borders, sight.borders.across_rows()
    lowest, highest = borders.near[1].copy(), borders.far[0].copy()
    for marking in range(len(lowest)):
        dark_below, dark_above = [], []
        for row, v in enumerate(borders.row[:-1, 0].tolist()):
            shown = lit_within(frame, int(v), float(first[marking, row, 0]), float(last[marking, row, 0]))
            if shown[0] > shown[1] and not sight.missed.rows[marking, row, 0]:
                if v >= borders.far[1][marking, 0] and v + 1 > borders.near[0][marking, 0]:
                    dark_below.append(v)
                if v < borders.far[1][marking, 0] and v + 1 <= borders.near[0][marking, 0]:
                    dark_above.insert(0, v + 1)
        spared = int(sight.missed.left[0])
        lowest[marking] = min([*lowest[marking], *dark_below[spared : spared + 1]])
        highest[marking] = max([*highest[marking], *dark_above[spared : spared + 1]])
    ends_z_m = case.scene.runway.ends_z_m
    expected = z_of_rows(case.scene.camera, case.sets, lowest, ends_z_m[:, 0], highest, ends_z_m[:, 1])
    assert contract_by_ends(case.sets, sight).z.tolist() == case.sets.contracted(z=expected).z.tolist()


@given(seed=st.integers(0, 10_000), most=st.integers(0, 4), shape=st.tuples(st.integers(1, 3), st.integers(1, 6), st.integers(1, 5)))
def test_relaxed_intersection_is_that_of_all_choices(seed: int, most: int, shape: tuple[int, int, int]) -> None:
    """The largest lower and the smallest upper bound but for so many, by sorting each."""
    rng = np.random.default_rng(seed)
    low, high = rng.integers(-9, 9, (2, *shape)).astype(float)
    spoiled_by = rng.integers(0, most + 1, shape[2])
    found = relaxed_intersection(low.copy(), high.copy(), spoiled_by, most)
    for marking, number in itertools.product(range(shape[0]), range(shape[2])):
        count = int(spoiled_by[number])
        lower = sorted(low[marking, :, number], reverse=True)
        upper = sorted(high[marking, :, number])
        assert found[0][marking, number] == (lower[count] if count < len(lower) else -np.inf)
        assert found[1][marking, number] == (upper[count] if count < len(upper) else np.inf)


@given(seed=st.integers(0, 10_000), markings=st.integers(1, 3), dark_share=st.floats(0, 1), in_order=st.booleans())
def test_missed_pixels_are_counted_by_disjoint_dark_windows(seed: int, markings: int, dark_share: float, in_order: bool) -> None:
    """One row, windows of one to four columns: never more than the largest disjoint choice, found by trying all; that one if in order."""
    rng = np.random.default_rng(seed)
    first = rng.integers(0, 14, (markings, 2))
    if in_order:
        first = np.sort(first.ravel()).reshape(first.shape)
    low = first.T[..., None].astype(float)
    high = low + (2.0 if in_order else rng.integers(0, 4, low.shape).astype(float))
    dark = rng.random(low.shape) < dark_share
    windows = HalfWindows(low, high, dark)
    taken, (of_halves, of_rows) = windows.cost(), windows.that_meet_dark_ones()
    charged = list(zip(low[dark], high[dark], strict=True))
    largest = max(
        size
        for size in range(len(charged) + 1)
        for chosen in itertools.combinations(charged, size)
        if all(one[1] < other[0] or other[1] < one[0] for one, other in itertools.combinations(chosen, 2))
    )
    assert min(largest, 1) <= taken[0] <= largest
    assert taken[0] == largest or not in_order
    for found, windows in ((of_halves, (low, high)), (of_rows, (low.min(axis=0), high.max(axis=0)))):
        meets = [any(start <= one[1] and one[0] <= stop for one in charged) for start, stop in zip(*map(np.ravel, windows), strict=True)]
        assert found.ravel().tolist() == meets
