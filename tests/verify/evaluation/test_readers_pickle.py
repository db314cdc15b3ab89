"""The unpickler of plain values: equal to Python's on them, and deaf to everything else."""

import contextlib
import os
import pickle
import pickletools
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from verify.evaluation.readers.plain_pickle import PickledArray, RefusedPickle, read_pickle

PLAIN = st.recursive(
    st.one_of(
        st.none(),
        st.booleans(),
        st.integers(-(2**31), 2**62),
        st.binary(min_size=1, max_size=20),
        st.text(max_size=20),
    ),
    lambda inner: st.one_of(st.lists(inner, max_size=5), st.tuples(inner, inner)),
    max_leaves=20,
)


@given(PLAIN, st.integers(0, 5))
@settings(max_examples=200)
def test_plain_values_are_read_as_python_reads_them(value: object, protocol: int) -> None:
    data = pickle.dumps(value, protocol)
    assert read_pickle(data) == pickle.loads(data)
    assert read_pickle(pickletools.optimize(data)) == value


@pytest.mark.parametrize("protocol", range(6))
@pytest.mark.parametrize("numpy_1", [False, True])
def test_arrays_and_numbers_of_numpy(protocol: int, numpy_1: bool) -> None:
    photo = np.random.default_rng(0).integers(0, 256, 300).astype(np.uint8)
    value = [photo, photo[:, None], np.array([True, False]), np.bool_(True), np.int64(-3)]
    data = pickle.dumps(value, protocol)
    if numpy_1:
        if protocol > 3:
            # Without its frame, whose length would change; then shorten the names' prefixes by one.
            data = data[:2] + data[11:]
        for old in ("multiarray", "numeric"):
            name = f"numpy._core.{old}".encode()
            data = data.replace(
                b"\x8c" + bytes([len(name)]) + name,
                b"\x8c" + bytes([len(name) - 1]) + name.replace(b"_core", b"core"),
            )
            data = data.replace(b"c" + name, b"c" + name.replace(b"_core", b"core"))
        assert b"_core" not in data
    row, column, flags, yes, number = read_pickle(data)  # type: ignore[misc]
    for array, shape in ((row, (300,)), (column, (300, 1))):
        assert isinstance(array, PickledArray)
        assert (array.shape, array.content) == (shape, photo.tobytes())
        assert array.type.code == "u1"
    assert flags.content == b"\x01\x00"
    assert (yes, number) == (True, -3)


def python_2(protocol: int, raw: bytes) -> bytes:
    """What Python 2's cPickle writes for ``[raw, numpy.array(bytearray(raw))]``."""
    if protocol == 0:
        quoted = "'" + "".join(f"\\x{byte:02x}" for byte in raw) + "'"
        string = b"S" + quoted.encode() + b"\n"
        dtype = b"cnumpy\ndtype\n(S'u1'\nI0\nI1\ntR(I3\nS'|'\nNNNI-1\nI-1\nI0\ntb"
        start = b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\n(I0\ntS'b'\ntR"
        state = b"(I1\n(L%dL\nt" % len(raw) + dtype + b"I00\n" + string + b"tb"
        return b"(lp1\n" + string + b"a" + start + state + b"a."
    string = b"U" + bytes([len(raw)]) + raw
    minus = b"J\xff\xff\xff\xff"
    dtype = b"cnumpy\ndtype\nq\x05U\x02u1K\x00K\x01\x87R(K\x03U\x01|NNN" + 2 * minus + b"K\x00tb"
    start = b"cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85U\x01b\x87R"
    state = b"(K\x01\x8a\x01" + bytes([len(raw)]) + b"\x85" + dtype + b"\x89" + string + b"tb"
    return b"\x80\x02]q\x01(" + string + start + state + b"e."


@pytest.mark.parametrize("protocol", [0, 2])
def test_python_2(protocol: int) -> None:
    raw = bytes(range(0, 250, 3)) + b"\\'\n"
    data = python_2(protocol, raw)
    truth = pickle.loads(data, encoding="bytes")
    assert truth[0] == raw
    assert truth[1].tobytes() == raw
    text, array = read_pickle(data)  # type: ignore[misc]
    assert (text, array.content, array.shape) == (raw, raw, (len(raw),))


class Runs:
    def __init__(self, target: object, *arguments: object) -> None:
        self.made = (target, arguments)

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        return self.made


def hostile(marker: Path) -> dict[str, bytes]:
    command = f"touch {marker}"
    line = command.encode()
    short = b"\x8c" + bytes([len(line)]) + line
    system = b"c" + os.name.encode() + b"\nsystem\n"
    cases = {
        f"os.system, protocol {protocol}": pickle.dumps(Runs(os.system, command), protocol)
        for protocol in range(6)
    }
    code = f"open({str(marker)!r}, 'w')"
    return cases | {
        "eval": pickle.dumps(Runs(eval, code)),
        "exec": pickle.dumps(Runs(exec, code)),
        "open": pickle.dumps(Runs(open, str(marker), "w")),
        "array beside": pickle.dumps([np.zeros(3, np.uint8), Runs(os.system, command)]),
        "INST": b"(S'" + line + b"'\ni" + os.name.encode() + b"\nsystem\n.",
        "OBJ": b"(" + system + b"S'" + line + b"'\no.",
        "NEWOBJ": b"\x80\x02" + system + short + b"\x85\x81.",
        "NEWOBJ_EX": b"\x80\x04" + system + short + b"\x85}\x92.",
        "BUILD": b"\x80\x02cnumpy\nndarray\n}" + short + b"K\x01sb.",
        "STACK_GLOBAL": b"\x80\x04\x8c\x05posix\x8c\x06system\x93" + short + b"\x85R.",
        "dotted": b"\x80\x04\x8c\x05numpy\x8c\x15ndarray.__class__.mro\x93)R.",
        "extension": b"\x80\x02\x82\x01.",
        "persistent": b"Pname\n.",
        "persistent 1": b"K\x01Q.",
        "buffer": b"\x80\x05\x97.",
        "numpy name as callable": b"cnumpy\nndarray\n(K\x05tR.",
        "codecs to a file": b"c_codecs\nencode\n(V61\nVhex\ntR.",
        "fields": pickle.dumps(np.zeros(2, dtype=[("a", "u1")])),
        "float": pickle.dumps(np.zeros(2)),
        "attributes of what is allowed": (
            b"cnumpy\ndtype\n(N}S'__init__'\nc_codecs\nencode\ns\x86bcnumpy\ndtype\n(S'u1'\ntR."
        ),
    }


def test_nothing_of_a_hostile_pickle_runs(tmp_path: Path) -> None:
    marker = tmp_path / "ran"
    cases = hostile(marker)
    for name, data in cases.items():
        with pytest.raises(RefusedPickle):
            pytest.fail(f"{name} was read as {read_pickle(data)!r}")
        assert not marker.exists(), name
    # The cases are real: Python's own unpickler falls for them.
    pickle.loads(cases["open"]).close()
    assert marker.exists()


def test_a_pickle_cut_anywhere_is_refused() -> None:
    for protocol in range(6):
        data = pickle.dumps(([b"\xff\xd8abc", np.zeros(4, np.uint8)], [True]), protocol)
        for end in range(len(data)):
            with pytest.raises(RefusedPickle):
                read_pickle(data[:end])
        with pytest.raises(RefusedPickle, match="follow its end"):
            read_pickle(data + b"\n")


@given(st.binary(max_size=200))
@settings(max_examples=300)
def test_random_bytes_only_ever_raise_one_exception(data: bytes) -> None:
    with contextlib.suppress(RefusedPickle, MemoryError):
        read_pickle(data)


@given(st.data())
@settings(max_examples=200)
def test_a_mutated_pickle_only_ever_raises_one_exception(data: st.DataObject) -> None:
    protocol = data.draw(st.integers(0, 5))
    raw = bytearray(pickle.dumps(([b"abc", np.zeros(4, np.uint8)], [True, np.bool_(1)]), protocol))
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    with contextlib.suppress(RefusedPickle, MemoryError):
        read_pickle(bytes(raw))
