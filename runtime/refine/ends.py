"""Contractor of z by the ends of markings: one does not go on past the (m' + 1)-th row that shows no pixel it could light."""

from __future__ import annotations

import numpy as np

from runtime.refine.ground import z_at_least, z_at_most
from runtime.refine.sight import Sight
from runtime.state_set import StateSet


def contract_by_ends(sets: StateSet, sight: Sight) -> StateSet:
    """The sets with z contracted. A row whose dark pixels may be missed ones that were counted already ends nothing (`missed`)."""
    borders, camera, ends_z_m = sight.borders, sight.scene.camera, sight.scene.runway.ends_z_m
    row, dark, budget = borders.row[:-1], sight.rows.dark & ~sight.missed.rows, sight.missed.left + 1
    before_near, behind_far = row + 1 <= borders.near[0][:, None], row >= borders.far[1][:, None]
    stops, starts = dark & behind_far & ~before_near, dark & before_near & ~behind_far
    if sight.missed.budget > 0:
        stops &= stops.cumsum(axis=1) == budget
        starts &= starts[:, ::-1].cumsum(axis=1)[:, ::-1] == budget
    last = np.minimum(np.where(stops, row, np.inf).min(axis=1), borders.near[1])
    first = np.maximum(np.where(starts, row + 1, -np.inf).max(axis=1), borders.far[0])
    return sets.contracted(z=(z_at_least(camera, sets, last, ends_z_m[:, 0]), z_at_most(camera, sets, first, ends_z_m[:, 1])))
