"""NN_r, the Runway Generative Model as a network with hand-set weights (paper, Definition 2 of Appendix A).

For zeta = h(xi) = (u1, v1, u2, v2), the two ends of one marking, and a pixel with columns [k, k+1] and rows [l, l+1]:

    phi_Det   det = u1 v2 - v1 u2
    phi_Lin   zeta^1 = W (u1, v1, u2, v2, det, 1)                              16 values a pixel, 4 for each edge
    phi_Abs   |a| + |b| - |a + b|: positive exactly when a and b have opposite signs
    phi_Min   min(a, b): positive exactly when both are
    ReLU      of the sum over edges and ends: positive if the pixel is lit

The four values of an edge tell on which side of the marking's line each of its corners lies, and on which side of the edge
each end of the marking lies; the edge is crossed if both pairs differ. The print lacks two things that are added here: the
constant input 1, because the edges of a pixel are not at 0, and the two ends: an end lies within a pixel if the left and right
edge, and the top and bottom one, have it on different sides. Without it a marking inside one pixel would light nothing. Both
use the same 16 values.

The inequalities are strict, so a marking that only touches a pixel's border does not light it: NN_r lights a subset of the exact
supercover `runtime.image.runway_image` and equals it but for such ties, up to float64's rounding of the orientations (1e-9 px
at corners). The supercover decides; NN_r is the paper's network, and an oracle that shares no arithmetic with it.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from build_model.window import Window
from runtime.scene import Camera

ABS_PAIRS = ((0, 1), (2, 3), (4, 5), (6, 7), (8, 9), (10, 11), (12, 13), (14, 15), (2, 6), (10, 14), (3, 7), (11, 15))
"""Rows of W that phi_Abs compares: corners and ends at the left, right, top and bottom edge; near end and far end in u and v."""

MIN_PAIRS = ((0, 1), (2, 3), (4, 5), (6, 7), (8, 9), (10, 11))
"""Outputs of phi_Abs that phi_Min joins: the four edges, then the near and the far end."""


def pixel_weights(window: Window) -> NDArray[np.float64]:
    """W of every pixel of the window, (rows, columns, 16, 6), for the inputs (u1, v1, u2, v2, det, 1).

    Four rows for each of the edges left, right, top, bottom: the orientation of its two corners (x, y) to the marking's line,
    [-y, x, y, -x, 1, 0], and the signed distance of the two ends to it, in px.
    """
    row, column = np.meshgrid(np.arange(window.top, window.bottom), np.arange(window.left, window.right), indexing="ij")
    left, right, top, bottom = column, column + 1, row, row + 1
    weights = [
        *(_orientation(left, top), _orientation(left, bottom), *_distances(0, left)),
        *(_orientation(right, top), _orientation(right, bottom), *_distances(0, right)),
        *(_orientation(left, top), _orientation(right, top), *_distances(1, top)),
        *(_orientation(left, bottom), _orientation(right, bottom), *_distances(1, bottom)),
    ]
    return np.stack(weights, axis=-2)


def _orientation(x: NDArray, y: NDArray) -> NDArray[np.float64]:
    """Rows of W that give (end 1 - corner) x (end 2 - corner), twice the signed area that corner and marking span, px^2."""
    return np.stack([-y, x, y, -x, np.ones_like(x), np.zeros_like(x)], axis=-1).astype(np.float64)


def _distances(axis: int, edge: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Rows of W that give the coordinate `axis` (0: u, 1: v) of the near and of the far end, counted from the edge."""
    near, far = np.zeros((*edge.shape, 6)), np.zeros((*edge.shape, 6))
    near[..., axis] = far[..., axis + 2] = 1
    near[..., 5] = far[..., 5] = -edge
    return near, far


def phi_det(zeta: Tensor) -> Tensor:
    """u1 v2 - v1 u2. `zeta`: (..., 4); returns (..., 1)."""
    u1, v1, u2, v2 = zeta.split(1, dim=-1)
    return u1 * v2 - v1 * u2


def phi_lin(weights: Tensor, zeta: Tensor, det: Tensor) -> Tensor:
    """W (zeta, det, 1) at every pixel. `weights`: (rows, columns, 16, 6), `zeta`: (batch, 4); returns (batch, rows, columns, 16)."""
    inputs = torch.cat([zeta, det, torch.ones_like(det)], dim=-1)
    return nn.functional.linear(inputs, weights.flatten(0, 2)).unflatten(-1, weights.shape[:3])


def phi_abs(values: Tensor) -> Tensor:
    """|a| + |b| - |a + b| of the pairs. (..., 16) to (..., 12); exactly 0 where a and b have one sign, in float64 too."""
    first, second = _pairs(values, ABS_PAIRS)
    return first.abs() + second.abs() - (first + second).abs()


def phi_min(values: Tensor) -> Tensor:
    """min(a, b) of the pairs. (..., 12) to (..., 6)."""
    return torch.minimum(*_pairs(values, MIN_PAIRS))


def _pairs(values: Tensor, pairs: tuple[tuple[int, int], ...]) -> tuple[Tensor, Tensor]:
    first, second = zip(*pairs, strict=True)
    return values[..., list(first)], values[..., list(second)]


class RunwayNetwork(nn.Module):
    """NN_r for the pixels of a window, by default the whole frame.

    Holds 96 weights a pixel in float64: 0.8 kB, or 236 MB for a frame of 640 x 480, and a state needs a third of that to pass
    through. Give the window that is of interest.
    """

    weights: Tensor

    def __init__(self, camera: Camera, window: Window | None = None) -> None:
        """Sets the weights of the window's pixels."""
        super().__init__()
        self.window = window or Window(0, camera.height, 0, camera.width)
        self.register_buffer("weights", torch.from_numpy(pixel_weights(self.window)))

    def forward(self, zeta: Tensor) -> Tensor:
        """`zeta`: (batch, 4) float64, the ends (u1, v1, u2, v2) of one marking, px. Returns (batch, rows, columns), lit where > 0."""
        edges_and_ends = phi_min(phi_abs(phi_lin(self.weights, zeta, phi_det(zeta))))
        return torch.relu(edges_and_ends.sum(dim=-1))

    def image(self, ends: Tensor) -> Tensor:
        """The window of I_r, several markings joined by OR.

        `ends`: (batch, markings, 2, 2) float64 as `runtime.camera.project` gives them; returns (batch, rows, columns) bool.
        """
        markings = ends.flatten(start_dim=-2).unbind(dim=1)
        return torch.stack([self(zeta) > 0 for zeta in markings]).any(dim=0)
