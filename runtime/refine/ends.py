"""Contractor of z by the ends of markings: one does not go on past the (m' + 1)-th row that shows no pixel it could light."""

from __future__ import annotations

import numpy as np

from runtime.refine.ground import z_of_rows
from runtime.refine.sight import Sight
from runtime.state_set import StateSet


def contract_by_ends(sets: StateSet, sight: Sight) -> StateSet:
    """The sets with z contracted. A row whose dark pixels may be missed ones that were counted already ends nothing (`missed`)."""
    borders, ends_z_m = sight.borders, sight.scene.runway.ends_z_m
    row, dark = borders.row, sight.rows.dark & ~sight.missed.rows
    before_near, behind_far = row[1:] <= borders.near[0][:, None], row[:-1] >= borders.far[1][:, None]
    stops, starts = dark & (behind_far > before_near), dark & (before_near > behind_far)
    if sight.missed.budget > 0:
        budget = sight.missed.left + 1
        stops &= stops.cumsum(axis=1, dtype=np.int32) == budget
        starts &= starts[:, ::-1].cumsum(axis=1, dtype=np.int32)[:, ::-1] == budget
    last = np.minimum.reduce(np.where(stops, row[:-1], np.inf), axis=1)
    first = np.maximum.reduce(np.where(starts, row[1:], -np.inf), axis=1)
    last, first = np.minimum(last, borders.near[1]), np.maximum(first, borders.far[0])
    last, first = borders.ideal_rows(sight.scene, sets, last, first)
    return sets.contracted(z=z_of_rows(sight.scene.camera, sets, last, ends_z_m[:, 0], first, ends_z_m[:, 1]))
