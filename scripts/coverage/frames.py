"""What is drawn over the runway in the coverage campaign, and which of its pixels go dark: at random, and where it hurts most."""

from __future__ import annotations

import bisect
import functools
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray
from rational_image import Frame, RationalState, RationalView

from build_model.hough_bank import CellBank, cell_bank
from coverage.states import Rng, Stage, estimator_of, image_of, into_domain, spatial_mask
from runtime.frames import events_to_frames
from runtime.recordings.recording import read_events

Pixels = NDArray[np.int64]
"""Numbers of pixels in the flattened frame, in the order in which they go dark."""

WINDOW_US = 40_000


@functools.cache
def recorded_frames(path: str, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """The recording's 40 ms frames, (frames, height, width)."""
    packets = list(read_events(path, shape))
    return events_to_frames(np.concatenate(packets), shape, WINDOW_US)[1].astype(np.bool_)


@functools.cache
def bank_of(path: str, cell: int) -> CellBank:
    """The bank of one cell, built anew: its K say which pixels hurt most."""
    sensor, cells = estimator_of(path).sensor, Stage.of(path, None).cells
    return cell_bank(sensor.ideal, cells.lower[cell], cells.upper[cell], sensor.unseen)


@dataclass
class Picture:
    """A frame as it is drawn. `states[0]` is the truth; further ones are states whose runways were drawn as clutter."""

    stage: Stage
    camera: RationalView
    """As the frame is taken: the scene's, or one that is off by its calibration."""
    states: list[RationalState]
    runway: Frame
    frame: Frame


# --- layers of clutter ---


def speckle(rng: Rng, picture: Picture, low: float, high: float) -> None:
    """Pixels lit at random, with a density between `low` and `high`."""
    density = rng.uniform(low, high)
    if density > 0:
        picture.frame |= rng.integers(2**16, size=picture.frame.shape, dtype=np.uint16) < density * 2**16


def recorded(rng: Rng, picture: Picture) -> None:
    """A frame of the recording, mirrored at random."""
    frames = recorded_frames(str(picture.stage.recording), picture.frame.shape)
    picture.frame |= frames[rng.integers(len(frames)), :: rng.choice([-1, 1]), :: rng.choice([-1, 1])]


def second_runway(rng: Rng, picture: Picture, within: float) -> None:
    """The runway as another state shows it, which lies `within` of the true one on each axis that has a width."""
    stage, true = picture.stage, picture.states[0].floats
    floats = np.where(stage.lower < stage.upper, true + rng.uniform(-within, within, 4), true)
    other = into_domain(stage, RationalState.near(floats))
    picture.states.append(other)
    picture.frame |= image_of(picture.camera, other).frame


def longer_markings(rng: Rng, picture: Picture) -> None:
    """The markings drawn on beyond their ends, along the ground."""
    picture.frame |= longer_image(rng, picture.camera, picture.states[0])


def longer_image(rng: Rng, view: RationalView, state: RationalState) -> Frame:
    """The markings with their near or their far ends or both farther out: by a share of their distance, from a hair to much."""
    nearer, farther = (Fraction(part) for part in 10.0 ** rng.uniform(-4, (-0.1, 1)) * ((1, 0), (0, 1), (1, 1))[rng.integers(3)])
    stripes = tuple(
        replace(stripe, near_z=stripe.near_z - nearer * (stripe.near_z + state.z), far_z=stripe.far_z + farther * (stripe.far_z + state.z))
        for stripe in view.stripes
    )
    return replace(view, stripes=stripes).image(state).frame


def neighbourhood(rng: Rng, picture: Picture) -> None:
    """All that lies within up to 6 px of the runway."""
    picture.frame |= image_of(picture.camera, picture.states[0]).thickened(int(rng.integers(1, 7)))


def everything(_rng: Rng, picture: Picture) -> None:
    """The whole frame."""
    picture.frame[:] = True


# --- missed pixels ---


def anywhere(rng: Rng, picture: Picture) -> Pixels:
    """The runway's pixels in random order."""
    return rng.permutation(image_of(picture.camera, picture.states[0]).flat)


def one_end(rng: Rng, picture: Picture) -> Pixels:
    """The pixels of one marking, from one of its ends on."""
    stripe = picture.camera.stripes[rng.integers(len(picture.camera.stripes))]
    lit = replace(picture.camera, stripes=(stripe,)).image(picture.states[0]).flat
    return lit if rng.random() < 0.5 else lit[::-1]


def row_band(rng: Rng, picture: Picture) -> Pixels:
    """All pixels from some row on."""
    lit = image_of(picture.camera, picture.states[0]).flat
    return np.roll(lit, -rng.integers(max(len(lit), 1)))


def must_light(rng: Rng, picture: Picture) -> Pixels:
    """Pixels of K of an entry that holds the state, which leave that entry nothing to spare."""
    stage, state = picture.stage, picture.states[0]
    bank = bank_of(stage.path, int(rng.choice(stage.cells_of(state))))
    theta, x, y, z = state.floats
    sensor = estimator_of(stage.path).sensor
    camera = sensor.ideal.camera
    tangent = (bank.lines.reference_row - camera.v0) / camera.focal_v_px
    scale = camera.focal_u_px * (np.cos(theta) * tangent + np.sin(theta)) / y
    line = np.stack([np.full_like(scale, theta), np.full_like(scale, x), scale, np.full_like(scale, z)], axis=-1)
    holding = np.flatnonzero(((bank.lines.lower - 1e-9 <= line) & (line <= bank.lines.upper + 1e-9)).all(axis=1))
    must, runs = np.zeros(camera.shape, dtype=np.bool_), bank.must_light
    for run in np.flatnonzero(runs.mask == rng.choice(holding)) if len(holding) else ():
        must[runs.start[run] : runs.stop[run], runs.column[run]] = True
    lit = image_of(picture.camera, state)
    return rng.permutation(lit.flat[sensor.seen_in(must)[lit.rows, lit.columns]])


def put_out(picture: Picture, order: Pixels, missed: int) -> None:
    """Darkens pixels in the given order, as many as leave no more than `missed` pixels of the true image without a witness."""
    if missed == 0:
        return
    stage, ideal = picture.stage, image_of(picture.stage.counted(picture.camera), picture.states[0])

    def put_out_first(count: int) -> Frame:
        frame = picture.frame.copy()
        frame.reshape(-1)[order[:count]] = False
        return frame

    counts = range(1, len(order) + 1)
    dark = bisect.bisect_right(counts, missed, key=lambda count: stage.unwitnessed(ideal, put_out_first(count)))
    picture.frame = put_out_first(dark)


def keep_out_of_spatial_mask(rng: Rng, picture: Picture, extra: int) -> None:
    """Theorem B's frames: of the clutter in S of the true cell exactly `extra` stay: anywhere, beside the runway or beyond its ends."""
    stage, state = picture.stage, picture.states[0]
    spatial = spatial_mask(stage.path, stage.cells_of(state)[0])
    ideal, tolerance = image_of(stage.view, state), stage.scene.tolerance.line_px
    clutter = spatial & ~(ideal.thickened(tolerance) | picture.runway)
    picture.frame &= ~clutter
    beside = clutter & ideal.thickened(tolerance + 1)
    beyond = clutter & longer_image(rng, picture.camera, state)
    choices = [np.flatnonzero(places) for places in (clutter, beside, beyond)]
    places = choices[rng.choice([number for number, found in enumerate(choices) if number == 0 or len(found) >= extra])]
    picture.frame.reshape(-1)[rng.choice(places, size=min(extra, len(places)), replace=False)] = True
