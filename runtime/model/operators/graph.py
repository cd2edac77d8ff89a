"""A graph's nodes, one after the other: whether each reads what is there, and whether the whole keeps to the limits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from runtime.model.format import ModelError
from runtime.model.operators.table import results
from runtime.model.operators.tensor import LARGEST_RANK, Tensor
from runtime.model.protobuf import shown

MOST_NODES = 2**11
"""Nodes of a graph. Some of onnxruntime's optimisers take time with the square of their number, 0.3 s at this one."""
MOST_EDGES = 2**14
"""Inputs and outputs of all nodes together."""
LARGEST_BYTES = 2**31
"""Bytes of all tensors that the nodes give, as if all were kept, and of what the largest operator needs while it runs."""
MOST_TERMS = 2**37
"""Terms of all sums that the nodes take, as in matrix products and convolutions: half a minute's work or more of one core."""


@dataclass(frozen=True)
class Node:
    """An operator, the names of what it is given ("" where nothing is) and of what it gives, and the attributes that it states."""

    operator: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    attributes: Mapping[str, Any]


def check_nodes(nodes: Sequence[Node], given: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """What is known of every tensor of a graph by name, from what is `given`: inputs and constants. Raises `ModelError`."""
    known, size, working, terms = dict(given), 0, 0, 0
    edges = sum(len(node.inputs) + len(node.outputs) for node in nodes)
    if edges > MOST_EDGES:
        raise ModelError(f"found nodes with {edges} inputs and outputs; at most {MOST_EDGES} are taken: use a smaller network")
    for node in nodes:
        for name, tensor in zip(node.outputs, _given(node, known), strict=True):
            if name in known:
                raise ModelError(f"found {shown(name)} written twice, by {node.operator} the second time; export the network again")
            if tensor.rank > LARGEST_RANK or tensor.size == 0:
                found = f"{node.operator} give {tensor}"
                raise ModelError(f"found {found}; tensors have elements, and at most {LARGEST_RANK} axes: export the network again")
            known[name] = tensor
            size += tensor.size * tensor.dtype.itemsize
            terms += tensor.size * tensor.terms
            working = max(working, tensor.working_bytes)
        for found, most, what in ((size + working, LARGEST_BYTES, "bytes of tensors"), (terms, MOST_TERMS, "terms of sums")):
            if found > most:
                raise ModelError(f"found {found} {what} up to {node.operator}; at most {most} are taken: use a smaller network")
    return known


def _given(node: Node, known: Mapping[str, Tensor]) -> Sequence[Tensor]:
    """Types and shapes of what a node gives. Raises `ModelError`."""
    missing = [name for name in node.inputs if name and name not in known]
    if missing:
        raise ModelError(f"found {shown(node.operator)} before {shown(missing[0])}, which it reads; export the network again")
    return results(node.operator, [known[name] if name else None for name in node.inputs], len(node.outputs), node.attributes)
