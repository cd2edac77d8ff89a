"""estimate_many gives what estimate gives, to the last bit, in the same order, and takes no more frames than it must."""

from __future__ import annotations

import copy
import itertools
import pickle
from collections.abc import Callable, Iterator
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from runtime.batch import CHUNK
from runtime.estimator import Box, Estimate, Estimator, FrameError
from runtime.model.format import ModelError
from runtime.recordings.bench import cluttered_frames


def same(first: Estimate, second: Estimate) -> bool:
    return all(same_value(getattr(first, field.name), getattr(second, field.name)) for field in fields(Estimate))


def same_value(first: object, second: object) -> bool:
    if isinstance(first, Box) and isinstance(second, Box):
        return bool((first.lower == second.lower).all() and (first.upper == second.upper).all())
    if isinstance(first, tuple) and isinstance(second, tuple):
        return len(first) == len(second) and all(map(same_value, first, second))
    return type(first) is type(second) and np.array_equal(np.asarray(first), np.asarray(second))


@pytest.fixture(scope="module")
def estimator(estimator_of: Callable[..., Estimator]) -> Estimator:
    return estimator_of("one cell")


@pytest.fixture(scope="module")
def frames(estimator: Estimator) -> list[NDArray[np.uint8]]:
    """More than one chunk, the last one not full; one frame without a runway and one of bool."""
    drawn = [*cluttered_frames(estimator.scene, 0.02, 2 * CHUNK, seed=5), np.zeros(estimator.scene.camera.shape, dtype=np.uint8)]
    return [*drawn, drawn[0].astype(np.bool_)]


@pytest.mark.parametrize("refine", [True, False])
def test_many_frames_give_what_each_gives_alone(estimator: Estimator, frames: list[NDArray[np.uint8]], refine: bool) -> None:
    alone = [estimator.estimate(frame, refine=refine) for frame in frames]
    assert not all(same(alone[0], estimate) for estimate in alone[1:])
    together = list(estimator.estimate_many(frames, refine=refine))
    assert len(together) == len(alone)
    assert [number for number, pair in enumerate(zip(alone, together, strict=True)) if not same(*pair)] == []
    assert all(not estimate.box.lower.flags.writeable for estimate in together if estimate.box is not None)


def test_an_endless_stream_is_taken_only_a_few_frames_ahead(estimator: Estimator, frames: list[NDArray[np.uint8]]) -> None:
    taken = []

    def endless() -> Iterator[NDArray[np.uint8]]:
        for number in itertools.count():
            taken.append(number)
            yield frames[number % len(frames)]

    estimates = estimator.estimate_many(endless(), refine=False, processes=2)
    first = list(itertools.islice(estimates, 3))
    assert same(first[2], estimator.estimate(frames[2], refine=False))
    assert len(taken) == 5 * CHUNK


def test_a_change_of_folder_and_a_relative_path_do_no_harm(
    model_of: Callable[[str], Path], frames: list[NDArray[np.uint8]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(model_of("one cell").parent)
    loaded = Estimator.load(model_of("one cell").name)
    monkeypatch.chdir(tmp_path)
    assert [same(*pair) for pair in zip(loaded.estimate_many(frames[:2]), map(loaded.estimate, frames[:2]), strict=True)] == [True] * 2
    assert same(copy.copy(loaded).estimate(frames[0]), loaded.estimate(frames[0]))


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda estimator: pickle.loads(pickle.dumps(estimator))])
def test_a_copy_of_an_estimator_is_one(
    model_of: Callable[[str], Path], frames: list[NDArray[np.uint8]], copied: Callable[[Estimator], Estimator]
) -> None:
    original = Estimator.load(model_of("one cell"), missed_budget=2, extra_budget=500)
    twin = copied(original)
    assert (twin.missed_budget, twin.extra_budget, twin.sha256) == (2, 500, original.sha256)
    assert same(twin.estimate(frames[0]), original.estimate(frames[0]))


def test_a_pickle_asks_for_the_very_file(model_of: Callable[[str], Path], tmp_path: Path) -> None:
    path = tmp_path / "model.onnx"
    path.write_bytes(model_of("one cell").read_bytes())
    pickled = pickle.dumps(Estimator.load(path))
    path.write_bytes((Path(__file__).parents[1] / "models" / "paper.onnx").read_bytes())
    with pytest.raises(ModelError, match="the caller trusts"):
        pickle.loads(pickled)


def test_a_frame_error_comes_back_from_another_process_as_it_was() -> None:
    error = pickle.loads(pickle.dumps(FrameError("a list", "an array")))
    assert (error.actual, error.expected, str(error)) == ("a list", "an array", "frame: found a list, expected an array")


def test_a_frame_that_does_not_fit_is_an_error_when_its_turn_comes(estimator: Estimator, frames: list[NDArray[np.uint8]]) -> None:
    estimates = estimator.estimate_many([*frames[:CHUNK], frames[0][1:]], refine=False, processes=1)
    with pytest.raises(FrameError, match=r"found \(479, 640\) of uint8"):
        list(estimates)
