"""Cosine and sine of our own: close to the true ones, and with the digits that they had when the digest was taken."""

from __future__ import annotations

import hashlib
import math

import numpy as np
from flint import arb, ctx
from hypothesis import given
from hypothesis import strategies as st

from runtime.turn import cosine_and_sine

DIGITS = "9638b1b552651faf"
"""First digits of the SHA-256 of 100,001 cosines and sines, evenly spaced."""


@given(angle=st.floats(-math.pi / 2, math.pi / 2))
def test_cosine_and_sine_are_close(angle: float) -> None:
    ctx.prec = 128
    (cosine,), (sine,) = (values[0] for values in cosine_and_sine(np.array([[angle]])))
    assert abs(arb(cosine) - arb(angle).cos()) <= arb(2) ** -51
    assert abs(arb(sine) - arb(angle).sin()) <= arb(2) ** -51 * abs(arb(sine)) + arb(2) ** -1074


def test_the_digits_are_the_same_everywhere() -> None:
    angles = (np.arange(-50_000, 50_001) * 2.0**-15).astype(np.float64)[:, None]
    values = np.stack(cosine_and_sine(angles)).astype("<f8")
    assert hashlib.sha256(values.tobytes()).hexdigest()[:16] == DIGITS


def test_what_is_exact_stays_exact() -> None:
    cosine, sine = cosine_and_sine(np.array([[0.0, 2.0**-30, -(2.0**-30)]]))
    assert cosine.tolist() == [[1.0, 1.0, 1.0]]
    assert sine.tolist() == [[0.0, 2.0**-30, -(2.0**-30)]]
