"""npz, npy and HDF5 files: columns under the names, in the orders and units that people have them, and compressed as they are."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import hdf5plugin
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from runtime.frames import FrameStream
from runtime.recordings.columns import column_of, order_of, unit_of
from runtime.recordings.recording import EVENT, PACKET_EVENTS, Notes, RecordingError, read_events, sensor_shape

SHAPE = (480, 640)


def approach(count: int = 2000, start_us: int = 0) -> NDArray:
    drawn = np.random.default_rng(1)
    events = np.empty(count, dtype=EVENT)
    events["t"] = np.sort(drawn.integers(0, 400_000, count)) + start_us
    for name, past in (("x", 640), ("y", 480), ("p", 2)):
        events[name] = drawn.integers(0, past, count)
    return events


def read(path: Path) -> tuple[NDArray, str]:
    notes = Notes()
    packets = list(read_events(path, SHAPE, notes))
    return np.concatenate([np.empty(0, dtype=EVENT), *packets]), notes.layout


def table(events: NDArray, order: str, dtype: Any = np.int64) -> NDArray:
    return np.stack([events[name].astype(dtype) for name in order], axis=1)


# --- npz and npy ---


@pytest.mark.parametrize(
    ("names", "scale", "layout"),
    [
        ("t x y p", 1, "t in us"),
        ("ts xs ys ps", 1e-6, "t in s"),
        ("timestamp x y polarity", 1e-6, "t in s"),
        ("Timestamps X Y Pol", 1, "t in us"),
        ("timestamp_ns x y p", 1000, "t in ns"),
        ("t_us x y on", 1, "t in us"),
        ("events_t events_x events_y events_p", 1, "t in us"),
    ],
)
def test_arrays_go_by_many_names(tmp_path, names, scale, layout):
    events = approach()
    columns = {"t": events["t"] * scale, "x": events["x"].astype("u2"), "y": events["y"].astype(float), "p": events["p"].astype(bool)}
    columns["t"] = columns["t"].astype(np.int64) if scale >= 1 else columns["t"]
    np.savez(tmp_path / "a.npz", **dict(zip(names.split(), columns.values(), strict=True)))
    back, found = read(tmp_path / "a.npz")
    np.testing.assert_array_equal(back, events)
    assert found == layout


@pytest.mark.parametrize("suffix", [".npz", ".npy"])
@pytest.mark.parametrize("order", ["txyp", "xypt", "xytp"])
@pytest.mark.parametrize("form", ["rows", "columns of rows", "columns", "columns in Fortran's order"])
def test_one_array_of_four_columns_is_read_in_any_order(tmp_path, suffix, order, form):
    events = approach(PACKET_EVENTS + 100)
    rows = table(events, order)
    rows = {"rows": rows, "columns of rows": np.asfortranarray(rows), "columns": rows.T.copy(), "columns in Fortran's order": rows.T}[form]
    path = tmp_path / f"a{suffix}"
    np.save(path, rows) if suffix == ".npy" else np.savez_compressed(path, events=rows)
    back, layout = read(path)
    np.testing.assert_array_equal(back, events)
    assert layout == f"columns {', '.join(order)}, t in us"


def test_a_structured_array_as_prophesee_gives_it_is_read(tmp_path):
    events = approach()
    stored = np.zeros(len(events), dtype={"names": ["x", "y", "p", "t"], "formats": ["<u2", "<u2", "<i2", "<i8"], "offsets": [0, 2, 4, 8]})
    for name in "xypt":
        stored[name] = events[name]
    np.save(tmp_path / "a.npy", stored)
    np.testing.assert_array_equal(read(tmp_path / "a.npy")[0], events)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"events": np.zeros((5, 5))}, "no array t, x, y, p; .*found events"),
        ({"a": np.zeros((5, 4)), "b": np.zeros((5, 4))}, "found a, b"),
        ({"events": np.zeros(5, dtype=[("t", "i8"), ("x", "i4")])}, r"found fields t, x, of shape \(5,\)"),
        ({"events": np.array([[1, 2, 3, 7], [700, 800, 900, 5]])}, "no order of the columns t, x, y, p fits 1, 2, 3, 7"),
        ({}, "found nothing"),
    ],
)
def test_arrays_that_are_no_events_are_refused(tmp_path, arrays, message):
    np.savez(tmp_path / "a.npz", **arrays)
    with pytest.raises(RecordingError, match=message):
        list(read_events(tmp_path / "a.npz"))


def test_an_array_of_one_column_is_refused(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros(5))
    with pytest.raises(RecordingError, match=r"no array t, x, y, p; .*found one array of shape \(5,\)"):
        list(read_events(tmp_path / "a.npy"))


def test_times_of_a_recording_with_one_wrong_time_keep_their_unit(tmp_path):
    """2**60 us would lie beyond the year 5000; one such time makes no file one of nanoseconds."""
    events = approach(start_us=1_605_537_493_718_345)
    for wrong in (0, 2**60):
        changed = np.insert(events, 500, np.array((wrong, 1, 1, 1), dtype=EVENT))
        np.savez(tmp_path / "a.npz", **{name: changed[name] for name in "txyp"})
        back, layout = read(tmp_path / "a.npz")
        np.testing.assert_array_equal(back, changed)
        assert layout == "t in us"
        stream = FrameStream(SHAPE, 40_000)
        assert len(list(stream.frames([back]))) == 10
        assert stream.misdated_events == 1


# --- HDF5 ---


def saved(path: Path, events: NDArray, place: str, names: str = "t x y p", **options: Any) -> Path:
    with h5py.File(path, "a") as file:
        for column, name in zip("txyp", names.split(), strict=True):
            file.create_dataset(f"{place}/{name}", data=events[column], **options)
    return path


@pytest.mark.parametrize("place", ["", "events", "CD/events", "davis/left/events", "prophesee/left", "a/b/c"])
@pytest.mark.parametrize("names", ["t x y p", "ts xs ys ps"])
def test_columns_are_found_wherever_they_are(tmp_path, place, names):
    events = approach()
    back, layout = read(saved(tmp_path / "a.h5", events, place, names))
    np.testing.assert_array_equal(back, events)
    assert layout == f"/{place}, t in us"


@pytest.mark.parametrize(("order", "dtype", "unit"), [("txyp", np.uint32, "us"), ("xytp", np.float64, "s"), ("xypt", np.int64, "us")])
def test_a_table_of_four_columns_is_read(tmp_path, order, dtype, unit):
    events = approach(PACKET_EVENTS + 100)
    rows = table(events, order, dtype)
    if unit == "s":
        rows[:, order.index("t")] = events["t"] / 1e6 + 1_506_119_776
        events["t"] += 1_506_119_776_000_000
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["davis/left/events"] = rows
        file["davis/right/events"] = rows[::-1]
        file["davis/left/imu"] = np.zeros((100, 4))
    back, layout = read(tmp_path / "a.h5")
    np.testing.assert_array_equal(back, events)
    assert layout == f"/davis/left/events, columns {', '.join(order)}, t in {unit}"


@pytest.mark.parametrize("dtype", ["u1", "u2", "u4", "u8"])
def test_a_polarity_of_minus_1_is_known_where_an_unsigned_type_holds_it(tmp_path, dtype):
    """A simulator stores events as one table of uint32: 4294967295 for OFF."""
    events = approach()
    events["p"] = 2 * events["p"] - 1
    saved(tmp_path / "a.h5", events, "events")
    with h5py.File(tmp_path / "a.h5", "a") as file:
        del file["events/p"]
        file["events/p"] = events["p"].astype(dtype)
    np.testing.assert_array_equal(read(tmp_path / "a.h5")[0], events)
    with h5py.File(tmp_path / "b.h5", "w") as file:
        file["events"] = table(events, "txyp", np.uint32)
    np.testing.assert_array_equal(read(tmp_path / "b.h5")[0], events)


def test_a_compound_table_with_its_size_is_read_as_prophesee_writes_it(tmp_path):
    events = approach()
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        file["CD/events"] = events.astype([("x", "<u2"), ("y", "<u2"), ("p", "<i2"), ("t", "<i8")])[["x", "y", "p", "t"]]
        file["CD/indexes"] = np.zeros(5, dtype=[("id", "<u8"), ("ts", "<i8")])
        file.attrs["geometry"] = "640x480"
    assert sensor_shape(tmp_path / "a.hdf5") == SHAPE


@pytest.mark.parametrize("place", ["t_offset", "events/t_offset", "attribute"])
def test_an_offset_beside_the_times_is_added(tmp_path, place):
    events = approach()
    path = saved(tmp_path / "a.h5", events, "events")
    with h5py.File(path, "a") as file:
        if place == "attribute":
            file.attrs["t_offset"] = 49_599_300_523
        else:
            file[place] = np.int64(49_599_300_523)
    events["t"] += 49_599_300_523
    np.testing.assert_array_equal(read(path)[0], events)


def test_an_offset_that_is_no_number_is_refused(tmp_path):
    path = saved(tmp_path / "a.h5", approach(), "events")
    with h5py.File(path, "a") as file:
        file["t_offset"] = [1, 2]
    with pytest.raises(RecordingError, match=r"t_offset is .*; give one whole number"):
        read(path)


@pytest.mark.parametrize(
    "filtered", [hdf5plugin.Zstd(), hdf5plugin.Blosc(), hdf5plugin.LZ4(), {"compression": "gzip"}, {"compression": "lzf"}]
)
def test_columns_may_be_compressed(tmp_path, filtered):
    events = approach()
    np.testing.assert_array_equal(read(saved(tmp_path / "a.h5", events, "events", chunks=True, **filtered))[0], events)


@pytest.mark.parametrize(
    ("code", "message"),
    [
        (
            0x8ECF,
            r"/CD/events/t is compressed by the HDF5 filter 36559, which is missing: Prophesee's ECF; metavision_file_to_csv converts",
        ),
        (40_000, r"filter 40000, which is missing: .*; install the HDF5 plugin that brings it"),
    ],
)
def test_a_filter_that_is_missing_is_named_before_anything_is_read(tmp_path, code, message):
    events = approach()
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        for name in "xyp":
            file[f"CD/events/{name}"] = events[name]
        settings = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        settings.set_chunk((len(events),))
        settings.set_filter(code, h5py.h5z.FLAG_OPTIONAL)
        space = h5py.h5s.create_simple((len(events),))
        h5py.h5d.create(file["CD/events"].id, b"t", h5py.h5t.NATIVE_INT64, space, settings)
    with pytest.raises(RecordingError, match=message) as caught:
        read_events(path)
    assert "damaged" not in str(caught.value)


def test_links_out_of_a_file_and_in_circles_are_not_followed(tmp_path):
    saved(tmp_path / "other.h5", approach(), "events")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["events"] = h5py.ExternalLink("other.h5", "/events")
        file["circle/again"] = file["/"]
    with pytest.raises(RecordingError, match="no columns t, x, y, p"):
        read(tmp_path / "a.h5")


# --- what numbers tell ---


@pytest.mark.parametrize(
    ("name", "wanted"),
    [
        ("t", ("t", "")),
        (' "Timestamp" ', ("t", "")),
        ("timestamp [us]", ("t", "us")),
        ("time (s)", ("t", "s")),
        ("timestamp_ms", ("t", "ms")),
        ("t_ns", ("t", "ns")),
        ("event_x", ("x", "")),
        ("ys", ("y", "")),
        ("polarity", ("p", "")),
        ("temperature", None),
        ("xyz", None),
        ("", None),
        *[(f"x{rest}", ("x", "")) for rest in (" [px]", "(pixels)", "_px", "pos", "")],
    ],
)
def test_names_tell_columns_and_units(name, wanted):
    assert column_of(name) == wanted


@given(
    start=st.integers(0, 10**12),
    steps=st.lists(st.integers(0, 100), min_size=120, max_size=200),
    order=st.sampled_from(["txyp", "xypt", "xytp"]),
    seed=st.integers(0, 99),
)
def test_the_order_of_sorted_events_is_told_from_their_numbers(start, steps, order, seed):
    drawn = np.random.default_rng(seed)
    columns = {"t": start + np.cumsum(steps), "x": drawn.integers(0, 640, len(steps)), "y": drawn.integers(0, 480, len(steps))}
    rows = np.stack([{**columns, "p": drawn.integers(0, 2, len(steps))}[name] for name in order], axis=1)
    assert order_of(rows) == order


@pytest.mark.parametrize(
    ("times", "unit"),
    [
        (np.arange(100), "us"),
        (np.arange(100.0), "us"),
        (np.arange(100) * 1000 + 1_605_537_493_718_345_000, "ns"),
        (np.arange(100) * 0.001 + 0.0005, "s"),
        (np.arange(1, 101) / 97 + 1_605_537_493, "s"),
        (np.empty(0), "us"),
    ],
)
def test_times_tell_their_unit(times, unit):
    assert unit_of(times) == unit


def test_fractions_that_are_no_seconds_are_refused():
    with pytest.raises(ValueError, match="name its unit, as in t_us"):
        unit_of(np.arange(100) * 1000.5 + 0.25)
