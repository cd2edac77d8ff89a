"""The cells' banks are the same, to the last byte, whoever builds them: this process, others, or a cluster that loses a worker."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator, Sequence
from typing import Any, cast

import pytest
from distributed import Client, LocalCluster
from scenes import PAPER

from build_model import export
from build_model.assembly import assemble
from build_model.export import ClusterError, build_banks
from build_model.filter_graph import filter_graph
from build_model.hough_bank import CellBank


def filter_bytes(banks: Sequence[CellBank]) -> bytes:
    """NN_F as the model file holds it: every table that was built."""
    return filter_graph(PAPER, assemble(PAPER, banks)).SerializeToString(deterministic=True)


@pytest.fixture(scope="module")
def alone() -> bytes:
    return filter_bytes(build_banks(PAPER, jobs=1))


@pytest.fixture
def cluster() -> Iterator[str]:
    """Address of a scheduler with two worker processes."""
    with LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address=":0", silence_logs=50) as cluster:
        yield str(cast(Any, cluster).scheduler_address)


def processes(address: str) -> list[int]:
    """Process numbers of the scheduler's workers."""
    with Client(address, set_as_default=False) as client:
        return list(cast(dict[str, int], client.run(os.getpid)).values())


def test_two_processes_build_the_same_tables(alone: bytes) -> None:
    assert filter_bytes(build_banks(PAPER, jobs=2)) == alone


def test_a_cluster_builds_the_same_tables_though_a_worker_is_killed_on_the_way(cluster: str, alone: bytes) -> None:
    """The first cell that comes back costs one of the two workers its life, with most of the cells still to be built."""
    victim, survivor = processes(cluster)
    cells_left = []

    def kill_one(_stage: str, done: int, total: int, _loss: float | None) -> None:
        if not cells_left:
            cells_left.append(total - done)
            os.kill(victim, signal.SIGKILL)

    banks = build_banks(PAPER, progress=kill_one, dask=cluster)
    assert cells_left[0] > len(banks) / 2
    assert survivor in processes(cluster)
    assert victim not in processes(cluster)
    assert filter_bytes(banks) == alone


def test_an_address_without_a_scheduler_is_an_error_that_names_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(export, "CONNECT_SECONDS", 0.5)
    with pytest.raises(ClusterError, match=r"--dask tcp://127\.0\.0\.1:1: no scheduler answers"):
        build_banks(PAPER, dask="tcp://127.0.0.1:1")
    with pytest.raises(ClusterError, match="no scheduler answers"):
        build_banks(PAPER, dask="nowhere at all")
