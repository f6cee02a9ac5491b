"""`.lamp` files: everything comes back, nothing damaged or hostile is taken for a bank."""

import json
import os
import struct
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from lampopt import lamp, load_bank, store_bank
from lampopt.errors import BankError, InputError
from lampopt.types import Bank, Calibration, Frame, Parameter, Spec

HERE = Path(__file__).parent
sys.path[:0] = [p for p in (str(HERE),) if p not in sys.path]
import small  # noqa: E402

from lampopt.types import LowRank  # noqa: E402

SCHEMA_1 = HERE / "data" / "bank_schema1.lamp"
SCHEMA_2 = HERE / "data" / "bank_schema2.lamp"
SCHEMA_3 = HERE / "data" / "bank_schema3.lamp"
FEW = LowRank([0.75, -1.0, 1.625], [[1.0], [-1.0]], [[0.75, -1.0, -1.375]])  # what schema 3 has besides


def tiny(**changes):
    """A bank that says something in every field; `tests/data/bank_schema2.lamp` is this one, stored."""
    fields = {
        "space": (Parameter("länge", "mm", 1.0, 3.0), Parameter("count", "", 0.1, 0.1)),
        "parameters": [[1.0, 0.1], [3.0, 0.1]],
        "label_space": (Parameter("drag", "N", 0.25, 0.25), Parameter("lift", "N")),
        "labels": [[np.nan, np.nan], [0.25, np.nan]],
        "names": ("first", "the second"),
        "weights": np.array([[1.5, -2.0, 0.25], [0.0, 1e-7, 3.0]], np.float32),
        "shared": {"lattice": np.arange(4).reshape(2, 2), "step": np.array(0.5, np.float32), "none": np.zeros((0, 3))},
        "frame": Frame(0.2, [1.0, -2.0, 1e6], "mm"),
        "decoder": Spec("some", depth=3, rate=0.1, kind="relu", fast=True),
        "probes": [[0.0, 0.5, 1.0]],
        "probe_values": np.array([[[0.5]], [[-0.125]]], np.float32),
        "fit_error": [0.001, 1 / 3],
        "measured_by": {"länge": "size.length", "count": "area.area"},
        "measured": [[1.0, 7.0], [3.0, 8.0]],
        "mesh_facts": {"bodies": 1, "genus": 2},
        "limits": {"alpha": 2.5},
        "calibration": Calibration(0.25, ("alpha", "mismatch"), [[1.0, np.nan], [0.5, 2.0]], [np.nan, 0.125], [0, 1]),
        "provenance": {"seed": 7, "lampopt": "0.1.0", "exact": True, "time": 0.5},
    }
    return Bank(**{**fields, **changes})


def damaged(path, edit):
    """The file at `path` with its header, as JSON, passed through `edit`; arrays as they are."""
    raw = path.read_bytes()
    (length,) = struct.unpack("<Q", raw[:8])
    header = json.loads(raw[8 : 8 + length])
    record = json.loads(header["__metadata__"]["lampopt"])
    header, record = edit(header, record) or (header, record)
    if record is not None:
        header["__metadata__"]["lampopt"] = json.dumps(record, sort_keys=True)
    text = json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(text)) + text + raw[8 + length :])


def sealed(change):
    """An edit as a forger would make it: the record is changed and hashed again."""

    def edit(header, record):
        record.update(change)
        record.pop("hash")
        record["hash"] = lamp._seal(record)

    return edit


def test_every_field_comes_back(tmp_path):
    bank = tiny()
    back = store_bank(bank, tmp_path / "a.lamp")
    assert small.same(bank, back)
    assert back.path == tmp_path / "a.lamp"
    assert list(back.measured_by) == ["länge", "count"]  # in the order of the columns, not of the alphabet
    assert not [p for p in tmp_path.iterdir() if p.name != "a.lamp"]


text = st.text(st.characters(exclude_categories=("Cs",)), max_size=8)
number = st.floats(-1e300, 1e300, allow_nan=False)
scalar = st.one_of(text, number, st.booleans(), st.integers(-(2**70), 2**70))


def array(dtype, *shape):
    values = {} if dtype in (np.bool_, np.int64) else {"elements": st.floats(-1e6, 1e6, width=32)}
    return hnp.arrays(dtype, shape, **values)


@settings(max_examples=25, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow])
@given(st.data())
def test_every_field_comes_back_whatever_it_holds(tmp_path_factory, data):
    path = tmp_path_factory.getbasetemp() / "any.lamp"
    n, size, probes = data.draw(st.tuples(st.integers(1, 4), st.integers(0, 5), st.integers(0, 3)))
    names = data.draw(st.lists(text, min_size=n, max_size=n, unique=True))
    low = data.draw(number)
    bank = tiny(
        names=tuple(names),
        space=(Parameter("x", data.draw(text), low, low + 1),),
        parameters=data.draw(array(np.float64, n, 1)),
        label_space=(Parameter("y"),),
        labels=np.where(data.draw(array(np.bool_, n, 1)), np.nan, 1.0),
        weights=data.draw(array(np.float32, n, size)),
        shared=data.draw(
            st.dictionaries(text, st.one_of(array(np.float32), array(np.int64, 0, 2), array(np.bool_, 3)), max_size=3)
        ),
        frame=Frame(data.draw(st.floats(1e-9, 1e9)), data.draw(array(np.float64, 3)), data.draw(text)),
        decoder=Spec(data.draw(text), **data.draw(st.dictionaries(text, scalar, max_size=3))),
        probes=data.draw(array(np.float64, probes, 3)),
        probe_values=data.draw(array(np.float32, n, probes, 2)),
        fit_error=data.draw(array(np.float64, n)),
        measured_by={"x": data.draw(text)},
        measured=data.draw(array(np.float64, n, 1)),
        limits=data.draw(st.dictionaries(text, number, max_size=3)),
        calibration=data.draw(
            st.none()
            | st.builds(
                Calibration,
                st.floats(1e-9, 1e9),
                st.just(("a",)),
                array(np.float64, 2, 1),
                array(np.float64, 2),
                st.just([0, n - 1]),
            )
        ),
        provenance=data.draw(st.dictionaries(text, scalar, max_size=3)),
    )
    assert small.same(bank, store_bank(bank, path))


def test_others_may_read_it_as_any_file(tmp_path):
    (tmp_path / "any").touch()
    store_bank(tiny(), tmp_path / "a.lamp")
    assert (tmp_path / "a.lamp").stat().st_mode == (tmp_path / "any").stat().st_mode


def test_arrays_are_mapped_from_the_file_and_read_only(tmp_path):
    weights = store_bank(tiny(), tmp_path / "a.lamp").weights
    base = weights
    while not isinstance(base, np.memmap) and base is not None:
        base = base.base
    assert isinstance(base, np.memmap)
    assert base.mode == "r"
    with pytest.raises(ValueError, match="read-only"):
        weights[0, 0] = 1


def test_same_bank_same_bytes(tmp_path):
    one = tiny(shared={"b": np.ones(2), "a": np.zeros(3)}, provenance={"x": 1, "y": 2})
    two = tiny(shared={"a": np.zeros(3), "b": np.ones(2)}, provenance={"y": 2, "x": 1})
    for bank, name in ((one, "one"), (two, "two"), (store_bank(one, tmp_path / "zero"), "again")):
        store_bank(bank, tmp_path / name)
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes() == (tmp_path / "again").read_bytes()


def test_a_bank_is_stored_over_the_file_it_is_mapped_from(tmp_path):
    path = tmp_path / "a.lamp"
    first = store_bank(tiny(), path)
    second = store_bank(replace(first, limits={"alpha": 9.0}), path)
    assert second.limits == {"alpha": 9.0}
    assert small.same(first, tiny())  # still the old bytes


def test_other_byte_orders_and_odd_layouts_come_back(tmp_path):
    shared = {"swapped": np.arange(6, dtype=">f8"), "columns": np.asfortranarray(np.arange(6.0).reshape(2, 3))}
    back = store_bank(tiny(shared=shared), tmp_path / "a.lamp").shared
    assert back["swapped"].tolist() == [0, 1, 2, 3, 4, 5]
    assert back["columns"].tolist() == [[0, 1, 2], [3, 4, 5]]


@pytest.mark.parametrize("array", [np.array(["text"]), np.array([1j]), np.array([None])], ids=repr)
def test_arrays_that_a_file_cannot_hold_are_refused_by_name(tmp_path, array):
    with pytest.raises(InputError, match=r"shared 'odd'.*array of numbers"):
        tiny(shared={"odd": array})
    with pytest.raises(BankError, match=r"odd.*dtype"):
        lamp.write(tmp_path / "a.lamp", {"odd": array}, {})
    assert not list(tmp_path.iterdir())


def test_a_place_that_cannot_be_written_is_refused(tmp_path):
    (tmp_path / "file").touch()
    for path in (tmp_path / "missing" / "a.lamp", tmp_path / "file" / "a.lamp", tmp_path):
        with pytest.raises(BankError, match="cannot be written"):
            store_bank(tiny(), path)
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("part", [0, 0.001, 0.01, 0.3, 0.9, 0.999])
def test_a_file_cut_short_is_refused(tmp_path, part):
    path = tmp_path / "a.lamp"
    store_bank(tiny(), path)
    raw = path.read_bytes()
    path.write_bytes(raw[: int(part * len(raw))])
    with pytest.raises(BankError, match=r"a\.lamp"):
        load_bank(path)


def test_a_file_with_something_behind_it_is_refused(tmp_path):
    path = tmp_path / "a.lamp"
    store_bank(tiny(), path)
    path.write_bytes(path.read_bytes() + b"x")
    with pytest.raises(BankError):
        load_bank(path)


def test_no_flipped_bit_goes_unnoticed(tmp_path):
    path, bank = tmp_path / "a.lamp", tiny()
    store_bank(bank, path)
    raw = path.read_bytes()
    rng = np.random.default_rng(0)
    noticed = 0
    for place, bit in zip(rng.integers(len(raw), size=400), rng.integers(8, size=400), strict=True):
        flipped = bytearray(raw)
        flipped[place] ^= 1 << bit
        path.write_bytes(flipped)
        try:
            found = load_bank(path)
        except BankError:
            noticed += 1
            continue
        assert small.same(found, bank), f"bit {bit} of byte {place}"
    assert noticed > 350


@pytest.mark.parametrize("name", [*lamp.PLAIN, "shared.lattice"])
def test_a_changed_array_is_named(tmp_path, name):
    path = tmp_path / "a.lamp"
    store_bank(tiny(), path)
    raw = bytearray(path.read_bytes())
    (length,) = struct.unpack("<Q", raw[:8])
    raw[8 + length + json.loads(raw[8 : 8 + length])[name]["data_offsets"][0]] ^= 1
    path.write_bytes(raw)
    with pytest.raises(BankError, match=f"array '{name}' is not what was written"):
        load_bank(path)


def test_a_changed_header_is_refused(tmp_path):
    path = tmp_path / "a.lamp"
    store_bank(tiny(), path)
    damaged(path, lambda header, record: record["frame"].update(scale=0.3))
    with pytest.raises(BankError, match="header is not what was written"):
        load_bank(path)


def _rename(header, record):
    header["weight"] = header.pop("weights")


def _other_dtype(header, record):
    header["weights"]["dtype"] = "BF16"
    header["weights"]["shape"] = [4, 3]


def _deep(header, record):
    header["__metadata__"]["lampopt"] = "[" * 100_000
    return header, None


def _no_record(header, record):
    del header["__metadata__"]["lampopt"]
    return header, None


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (sealed({"format": "lampopt part"}), "expected a bank, got 'lampopt part'"),
        (sealed({"schema": lamp.SCHEMA + 1}), "newer than this lampopt"),
        (sealed({"schema": 0}), "expected a schema from 1"),
        (sealed({"schema": True}), "expected a schema from 1"),
        (sealed({"schema": "1"}), "expected a schema from 1"),
        (sealed({"names": ["one"]}), "does not describe a bank"),
        (sealed({"names": ["a", "a"]}), "does not describe a bank"),
        (sealed({"names": 5}), "does not describe a bank"),
        (sealed({"space": [["x"], ["x"]]}), "does not describe a bank"),
        (sealed({"space": [[5, ""], ["y"]]}), "does not describe a bank"),
        (sealed({"frame": {"scale": 1.0}}), "does not describe a bank"),
        (sealed({"frame": {"scale": "1", "centre": [0, 0, 0]}}), "does not describe a bank"),
        (sealed({"decoder": {"name": "x", "options": {"y": [1]}}}), "does not describe a bank"),
        (sealed({"decoder": None}), "does not describe a bank"),
        (sealed({"measured_by": []}), "does not describe a bank"),
        (sealed({"hashes": {}}), "not those that its header lists"),
        (sealed({"hashes": None}), "not those that its header lists"),
        (_rename, "not those that its header lists"),
        (_other_dtype, "."),
        (_deep, "expected a .lamp file"),
        (_no_record, "expected a .lamp file"),
        (lambda header, record: (header, []), "header is not what was written"),
    ],
)
def test_headers_that_describe_no_bank_are_refused(tmp_path, edit, message):
    path = tmp_path / "a.lamp"
    store_bank(tiny(), path)
    damaged(path, edit)
    with pytest.raises(BankError, match=message):
        load_bank(path)


@pytest.mark.parametrize(
    "raw",
    [
        b"",
        b"solid not a bank",
        struct.pack("<Q", 2**63) + b"{}",
        struct.pack("<Q", 99_999_999) + b"{}",
        struct.pack("<Q", 2) + b"{}",
        struct.pack("<Q", 2) + b"[]",
        struct.pack("<Q", 200_000) + b"[" * 200_000,
        struct.pack("<Q", 8) + b'{"a": 1}',
    ],
    ids=["empty", "text", "2^63", "bomb", "{}", "[]", "nested", "number"],
)
def test_other_files_are_refused(tmp_path, raw):
    path = tmp_path / "a.lamp"
    path.write_bytes(raw)
    with pytest.raises(BankError, match=r"a\.lamp: expected a \.lamp file"):
        load_bank(path)


def test_an_array_of_an_absurd_shape_is_refused(tmp_path):
    path = tmp_path / "a.lamp"
    store_bank(tiny(), path)

    def edit(header, record):
        header["shared.none"]["shape"] = [0, 2**62]

    damaged(path, edit)
    with pytest.raises(BankError):
        load_bank(path)


def test_what_is_no_file_is_refused(tmp_path):
    with pytest.raises(BankError, match="no such file"):
        load_bank(tmp_path / "missing.lamp")
    with pytest.raises(BankError, match=r"expected a \.lamp file"):
        load_bank(tmp_path)


@pytest.mark.parametrize(
    ("path", "changes"), [(SCHEMA_1, {"calibration": None}), (SCHEMA_2, {}), (SCHEMA_3, {"weights": FEW})]
)
def test_files_of_every_schema_are_still_read(path, changes):
    bank = load_bank(path)
    assert small.same(bank, tiny(**changes))
    assert bank.space[0] == Parameter("länge", "mm", 1.0, 3.0)
    assert bank.weights[1].tolist() == pytest.approx([0.0, 1e-7, 3.0], abs=1e-7)
    assert bank.frame.centre.tolist() == [1.0, -2.0, 1e6]


def test_every_older_schema_has_a_migration_and_a_file():
    assert set(lamp.MIGRATIONS) == set(range(1, lamp.SCHEMA))
    for schema in range(1, lamp.SCHEMA + 1):
        assert (HERE / "data" / f"bank_schema{schema}.lamp").exists()


def test_two_processes_writing_one_file_do_not_meet(tmp_path, monkeypatch):
    """While one writes, another one writes the same file from beginning to end."""
    import safetensors.numpy

    path, save, me = tmp_path / "a.lamp", safetensors.numpy.save_file, os.getpid()

    def interrupted(arrays, place, metadata):
        save(arrays, place, metadata)
        monkeypatch.setattr(safetensors.numpy, "save_file", save)
        monkeypatch.setattr(os, "getpid", lambda: me + 1)
        lamp.write(path, {"other": np.ones(2)}, {})

    monkeypatch.setattr(safetensors.numpy, "save_file", interrupted)
    lamp.write(path, {"mine": np.zeros(3)}, {})
    assert set(lamp.read(path)[0]) == {"mine"}
    assert [p.name for p in tmp_path.iterdir()] == ["a.lamp"]
