"""Many frames on several cores: the same estimates to the last bit, in the same order.

Refinement is numpy, which holds Python's lock, and needs processes; frames travel between them as bits, 8 pixels to a byte. Without
refinement most of the time is onnxruntime's, which works without the lock, and threads are enough.
"""

from __future__ import annotations

import itertools
import multiprocessing
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from runtime.estimate import Estimate

Frame = NDArray[np.uint8]
Estimates = Callable[[Frame], Estimate]
"""What makes an estimate of a frame that fits the model."""
CHUNK = 8
"""Frames that a worker is given at once."""
_estimate: Estimates
"""The function by which a process that `by_processes` has started estimates a frame; set when that process starts."""


def by_threads(estimate: Estimates, frames: Iterable[Frame], workers: int) -> Iterator[Estimate]:
    """The frames' estimates in their order, made by `estimate` on `workers` threads."""
    with ThreadPoolExecutor(workers) as pool:
        yield from _in_order(frames, workers, lambda chunk: pool.submit(_estimate_each, estimate, chunk))


def by_processes(load: Callable[[], Estimates], width: int, frames: Iterable[Frame], workers: int) -> Iterator[Estimate]:
    """The estimates of frames of that width in their order, by `workers` processes; each calls `load()` once, which pickle sends there."""
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, context, initializer=_load, initargs=(load,)) as pool:
        for estimate in _in_order(frames, workers, lambda chunk: pool.submit(_estimate_bits, np.packbits(chunk, axis=-1), width)):
            yield replace(estimate, filtered=np.unpackbits(estimate.filtered, axis=-1, count=width))


def _in_order(frames: Iterable[Frame], workers: int, submit: Callable[[list[Frame]], Future[list[Estimate]]]) -> Iterator[Estimate]:
    """The chunks' estimates in the order of the frames. At most 2 `workers` + 1 chunks are taken before the first of them is given out."""
    remaining, started = iter(frames), deque[Future[list[Estimate]]]()
    while chunk := list(itertools.islice(remaining, CHUNK)):
        started.append(submit(chunk))
        if len(started) > 2 * workers:
            yield from started.popleft().result()
    while started:
        yield from started.popleft().result()


def _estimate_each(estimate: Estimates, frames: Iterable[Frame]) -> list[Estimate]:
    return [estimate(frame) for frame in frames]


def _load(load: Callable[[], Estimates]) -> None:
    global _estimate
    _estimate = load()


def _estimate_bits(bits: NDArray[np.uint8], width: int) -> list[Estimate]:
    estimates = _estimate_each(_estimate, np.unpackbits(bits, axis=-1, count=width))
    return [replace(estimate, filtered=np.packbits(estimate.filtered, axis=-1)) for estimate in estimates]
