"""The reader of MATLAB files, against SciPy's on sound files and on altered ones."""

import contextlib
import io

import numpy as np
import pytest
import scipy.io
import scipy.sparse
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.verify.evaluation.layouts import agedb_folds, agedb_splits
from verify.evaluation.readers.mat5 import RefusedMat, read_variable


def saved(value: object, *, compressed: bool = False) -> bytes:
    stream = io.BytesIO()
    content = {"before": np.arange(3), "splits": value, "x": "y"}
    scipy.io.savemat(stream, content, do_compression=compressed)
    return stream.getvalue()


def assert_alike(mine: object, theirs: object) -> None:
    if isinstance(theirs, np.ndarray) and theirs.size:
        assert isinstance(mine, np.ndarray)
        assert mine.shape == theirs.shape
        assert mine.dtype.names == theirs.dtype.names
        for one, other in zip(mine.reshape(-1), theirs.reshape(-1), strict=True):
            assert_alike(one, other)
    elif isinstance(theirs, np.void):
        assert isinstance(mine, np.void)
        for name in theirs.dtype.names or ():
            assert_alike(mine[name], theirs[name])
    elif not isinstance(theirs, np.ndarray):
        assert mine == theirs


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize(
    "value",
    [
        np.arange(12).reshape(3, 4),
        np.arange(6, dtype=">f4").reshape(1, 2, 3),
        np.array([[True, False]]),
        np.array([[-1, 1]], dtype=np.int8),
        "Renée",
        {"a": np.eye(2), "b": {"c": "text", "d": np.empty((0, 0))}},
        np.array([["a", np.eye(3)], [{"f": 1}, 2.5]], dtype=object),
        agedb_splits("published", agedb_folds()),
        agedb_splits("pair of cells", agedb_folds()),
    ],
)
def test_values_are_read_as_scipy_reads_them(value: object, compressed: bool) -> None:
    data = saved(value, compressed=compressed)
    assert_alike(read_variable(data, "splits"), scipy.io.loadmat(io.BytesIO(data))["splits"])
    assert read_variable(data, "absent") is None


@pytest.mark.parametrize("compressed", [False, True])
def test_a_file_cut_anywhere_is_refused(compressed: bool) -> None:
    data = saved(agedb_splits("columns", agedb_folds()[:1]), compressed=compressed)
    reached = 0
    for end in range(0, len(data), 5):
        try:
            # A cut behind the variable is not noticed, nor need it be.
            reached += read_variable(data[:end], "splits") is not None
        except RefusedMat:
            assert not reached


@given(st.data())
@settings(max_examples=150)
def test_an_altered_file_only_ever_raises_one_exception(data: st.DataObject) -> None:
    raw = bytearray(saved(agedb_splits("published", agedb_folds()[:1])))
    for _ in range(data.draw(st.integers(1, 6))):
        raw[data.draw(st.integers(128, len(raw) - 1))] = data.draw(st.integers(0, 255))
    with contextlib.suppress(RefusedMat):
        read_variable(bytes(raw), "splits")


def test_declared_sizes_are_not_believed() -> None:
    data = saved(np.array([["a", "b", "c"]], dtype=object))
    dims = np.array([1, 3], dtype="<i4").tobytes()
    assert data.count(dims) == 2  # that of "before", too
    huge = np.array([2**30, 2**30], dtype="<i4").tobytes()
    at = data.rindex(dims)
    with pytest.raises(RefusedMat, match="more elements than it holds"):
        read_variable(data[:at] + huge + data[at + 8 :], "splits")


@pytest.mark.parametrize(
    ("dims", "kind"),
    [
        (np.array([1.0, 3.0], "<f8"), 9),
        (np.array([0, 2**31 - 1, 2**31 - 1, 2**31 - 1], "<i4"), 5),
        (np.array([0, 2**63], "<u8"), 13),
        (np.array([2**63, 2**63], "<u8"), 13),
    ],
)
def test_sides_are_whole_numbers_of_a_plausible_size(dims: np.ndarray, kind: int) -> None:
    def element(kind: int, data: bytes) -> bytes:
        tag = np.array([kind, len(data)], "<u4").tobytes()
        return tag + data + bytes(-len(data) % 8)

    flags = element(6, np.array([6, 0], "<u4").tobytes())
    inner = flags + element(kind, dims.tobytes()) + element(1, b"splits") + element(9, b"")
    data = saved(0)[:128] + element(14, inner)
    with pytest.raises(RefusedMat, match=r"plain header|more elements"):
        read_variable(data, "splits")


def test_a_struct_has_so_many_fields_and_no_more() -> None:
    assert read_variable(saved({f"f{i}": 1 for i in range(64)}), "splits") is not None
    with pytest.raises(RefusedMat, match="more than 64 fields"):
        read_variable(saved({f"f{i}": 1 for i in range(65)}), "splits")


def test_all_variables_share_one_budget_of_unpacked_bytes() -> None:
    stream = io.BytesIO()
    content = {name: np.zeros(2**22) for name in ("one", "two")} | {"splits": np.eye(2)}
    scipy.io.savemat(stream, content, do_compression=True)
    with pytest.raises(RefusedMat, match="all unpack to more than 67108864 bytes"):
        read_variable(stream.getvalue(), "splits")
    assert read_variable(stream.getvalue(), "one") is not None


def test_deep_nesting_is_refused() -> None:
    value: object = np.eye(1)
    for _ in range(40):
        value = {"a": value}
    with pytest.raises(RefusedMat, match="nests more than"):
        read_variable(saved(value), "splits")


def test_other_classes_are_refused() -> None:
    with pytest.raises(RefusedMat, match="class 5"):
        read_variable(saved(scipy.sparse.csc_array(np.eye(3))), "splits")
