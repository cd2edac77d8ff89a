"""What the format of a model file fixes, for reader, writer and verifier: names of tensors and outputs, padding, prefixes, versions.

models/README.md says what inputs and outputs mean.
"""

from __future__ import annotations

import hashlib
import json
from typing import Any

from runtime.scene import STATE_NAMES

FORMAT_VERSION = 1
METADATA_KEY = "glideproof"
"""Key among the ONNX file's metadata_props; its value is JSON with the scene, the digests and what else a user must know."""
OPSET = 20
"""Version of the standard operators that export-model writes and the runtime takes."""
IR_VERSION = 10

FRAME = "frame"
BUDGETS = ("missed_budget", "extra_budget")
"""Initialisers that are inputs too; their defaults are the scene's values."""
NETWORK_OUTPUT = "network_state"
OUTPUTS = ("cell", "support", "mismatch", "passes", "cell_lower", "cell_upper", "filtered", NETWORK_OUTPUT)
OVERFLOW = "overflow"
"""Output of a bank of windows: True if more groups passed their gates than there are places to open them."""
NETWORK_PREFIX = "state_network/"
"""Names of NN_e's nodes and constants start with this."""

SIDES = ("lower", "upper")
STATE_BOX_TENSORS = tuple(f"{name}_{side}" for name in STATE_NAMES for side in SIDES)
"""Each entry as a box of states."""
LINE_BOX_TENSORS = ("line_lower", "line_upper", "reference_row")
"""Each entry's box in theta, x, scale and z, and the row that its scale refers to: what the masks claim. No node reads them."""
BOX_TENSORS = ("row_cell", *STATE_BOX_TENSORS, *LINE_BOX_TENSORS, "must_light_size")
MASK_TENSORS = ("spatial_run_cell", "spatial_run_index", "spatial_run_step", "window_first", "window_stop")
SPAN_TENSORS = ("span_first", "span_stop", "gate_size", "window_first", "window_stop")
"""Initialisers that hold every entry as a box of states and of line coordinates, and every cell's spatial mask: in a bank of masks as
runs of pixels, in one of windows as spans of columns."""
PADDING_SIZE = 2**20
"""|K| of a place without an entry: more pixels than a window can hold lit, so that it never passes and is never the least mismatch."""


class ModelError(ValueError):
    """A model file that is not ours, damaged, of another version, or does not match what the caller demands."""


def metadata_digest(metadata: dict[str, Any]) -> str:
    """sha256 of the metadata as JSON with sorted keys, but for `metadata_sha256`, which holds it."""
    others = {key: value for key, value in metadata.items() if key != "metadata_sha256"}
    return hashlib.sha256(json.dumps(others, sort_keys=True).encode()).hexdigest()
