"""What a camera may be off by shifts and shears offsets by the same parameters: the shift that goes with a shear, in fractions."""

from __future__ import annotations

import itertools
from fractions import Fraction

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scenes import examples

from runtime.refine.unknowns import Common, Unknowns

FOCAL_PX = 512.0
number = st.floats(-2, 2, allow_nan=False).map(lambda value: round(value, 6))
share = st.sampled_from([-1.0, 1.0, 0.0]) | st.floats(-1, 1).map(lambda value: round(value, 3))


@st.composite
def unknowns(draw: st.DrawFn) -> Unknowns:
    """Of one set, whose w is known exactly, with five parameters of sizes far apart."""
    c, k = (tuple(np.array([draw(number) * draw(st.sampled_from([1.0, 1e-3, 0.0]))]) for _ in range(5)) for _ in range(2))
    off = tuple(np.array([draw(st.sampled_from([0.0, 1e-5, 1e-3, 2e-3]))]) for _ in range(5))
    nothing = np.zeros(1)
    return Unknowns(c, k, (nothing,) * 5, Common((nothing,) * 5, nothing, nothing, nothing), off, np.array([FOCAL_PX]))


def total(parts: tuple[np.ndarray, ...], by: list[Fraction]) -> Fraction:
    return sum((Fraction(float(part[0])) * each for part, each in zip(parts, by, strict=True)), Fraction(0)) * Fraction(FOCAL_PX)


@examples(200)
@given(unknowns=unknowns(), shares=st.tuples(*[share] * 5), grown=st.sampled_from([1.0, 0.7]), wide=st.sampled_from([0.0, 1e-6, 0.3]))
def test_the_shift_that_goes_with_a_shear_is_within_its_range(
    unknowns: Unknowns, shares: tuple[float, ...], grown: float, wide: float
) -> None:
    by = [Fraction(each) * Fraction(float(off[0])) * Fraction(grown) for each, off in zip(shares, unknowns.off, strict=True)]
    kappa, shift = total(unknowns.k, by), total(unknowns.c, by)
    least, most = np.nextafter(float(kappa), -np.inf) - wide, np.nextafter(float(kappa), np.inf) + wide
    low, high = unknowns.shifted_px(np.array([least]), np.array([most]))
    assert Fraction(float(low[0])) <= shift <= Fraction(float(high[0]))


def largest_at(unknowns: Unknowns, kappa: float) -> float:
    """The largest shift at a shear: of a linear programme with one equation, at most one parameter is not at a bound."""
    c, k, off = (np.concatenate(side) for side in (unknowns.c, unknowns.k, unknowns.off))
    c, k = c * off * FOCAL_PX, k * off * FOCAL_PX
    best = -np.inf
    for free in range(5):
        others = [number for number in range(5) if number != free]
        for signs in itertools.product((-1.0, 1.0), repeat=4):
            rest = kappa - float(np.dot(k[others], signs))
            if k[free] != 0 and abs(rest / k[free]) <= 1 + 1e-12:
                best = max(best, float(np.dot(c[others], signs)) + c[free] * rest / k[free])
    return best


def test_the_range_is_reached() -> None:
    rng = np.random.default_rng(3)
    nothing = np.zeros(1)
    for _ in range(50):
        c, k, off = (tuple(np.array([value]) for value in rng.uniform(low, high, 5)) for low, high in ((-2, 2), (-2, 2), (1e-4, 2e-3)))
        each = Unknowns(c, k, (nothing,) * 5, Common((nothing,) * 5, nothing, nothing, nothing), off, np.array([FOCAL_PX]))
        kappa = rng.uniform(-0.9, 0.9) * each.sheared_px
        low, high = each.shifted_px(kappa, kappa)
        assert abs(high[0] - largest_at(each, float(kappa[0]))) < 1e-7
        assert abs(low[0] + largest_at(each, -float(kappa[0]))) < 1e-7
        whole_low, whole_high = each.shifted_px(-each.sheared_px, each.sheared_px)
        alone = sum(abs(float(part[0])) * float(one[0]) for part, one in zip(c, off, strict=True)) * FOCAL_PX
        assert abs(whole_high[0] - alone) < 1e-7
        assert abs(whole_low[0] + alone) < 1e-7
        assert high[0] - low[0] < 2 * alone
