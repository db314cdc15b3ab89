"""The bytes of a private template on the wire and, sealed, in the store (docs/formats.md).

The container is safetensors. The decoder treats its input as hostile: it bounds the size, reads
the header itself and compares it with the only headers there can be, before the library sees it.
"""

import json
import re
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple, NoReturn

import numpy as np
import safetensors.numpy
from numpy.typing import NDArray
from safetensors import SafetensorError

from templates.errors import InvalidTemplate, LiftingError
from templates.space.subspace import SubspaceBatch, span_basis

FORMAT = "veilface-template"
VERSION = "1"
MAX_HEADER_BYTES = 4096

WireDtype = Literal["float16", "float32"]

_LENGTH_BYTES = 8
_CODES: dict[WireDtype, str] = {"float16": "F16", "float32": "F32"}
_DTYPES: dict[str, WireDtype] = {code: dtype for dtype, code in _CODES.items()}
# Rounding to float16 moves an inner product of unit rows by at most 2⁻¹⁰. Float32 leaves room for
# clients that orthonormalise in float32.
TOLERANCES: dict[WireDtype, float] = {"float16": 2e-3, "float32": 1e-4}
_SMALL = 5e-3  # what float16 does to 160 rows in R⁵¹² is 2·10⁻³
_CONTRACT_ID = re.compile(r"[0-9a-f]{64}")


@dataclass(frozen=True)
class WireTemplate:
    """What the bytes of a template say."""

    subspace: SubspaceBatch = field(repr=False)
    contract_id: str
    dtype: WireDtype


class _Layout(NamedTuple):
    """What a checked header says."""

    dtype: WireDtype
    contract_id: str
    n: int
    m: int


def encode(subspace: SubspaceBatch, *, contract_id: str, dtype: WireDtype = "float16") -> bytes:
    """Return the bytes of a template; equal templates give equal bytes.

    Parameters
    ----------
    subspace : SubspaceBatch
    contract_id : str
        64 lower-case hexadecimal digits.
    dtype : {"float16", "float32"}
        Float16 halves the size and moves distances by about 10⁻⁴.

    Raises
    ------
    InvalidTemplate
        The subspace fails its own check, or the contract id is malformed.
    """
    if dtype not in _CODES:
        raise InvalidTemplate("a template is written in float16 or float32")
    if not _CONTRACT_ID.fullmatch(contract_id):
        raise InvalidTemplate("a contract id has 64 lower-case hexadecimal digits")
    subspace.validate()
    little = np.dtype(dtype).newbyteorder("<")
    payload = subspace.foot.astype(little).tobytes() + subspace.basis.astype(little).tobytes()
    return _header(subspace.n, subspace.m, dtype, contract_id) + payload


def encoded_size(n: int, m: int, dtype: WireDtype = "float16") -> int:
    """Return the exact number of bytes that ``encode`` makes of a template."""
    return len(_header(n, m, dtype, "0" * 64)) + np.dtype(dtype).itemsize * n * (m + 1)


def size_limit(max_n: int, max_m: int) -> int:
    """Return the number of bytes beyond which ``decode`` refuses without reading."""
    return _LENGTH_BYTES + MAX_HEADER_BYTES + 4 * max_n * (max_m + 1)


def decode(
    data: bytes | bytearray | memoryview, *, max_n: int = 4096, max_m: int = 192
) -> WireTemplate:
    """Read the bytes of a template from anybody.

    Parameters
    ----------
    data : bytes-like
    max_n, max_m : int
        Largest dimensions that are accepted; they bound the size before anything is read.

    Returns
    -------
    WireTemplate
        The basis orthonormalised again and the foot point made orthogonal to it in float64,
        which removes the rounding of the wire.

    Raises
    ------
    InvalidTemplate
        Anything is not exactly as in docs/formats.md. The message gives the reason.
    """
    layout, foot, basis = _numbers(data, max_n, max_m)
    # Before the cast, which NumPy warns of for a signalling NaN.
    if not (np.isfinite(foot).all() and np.isfinite(basis).all()):
        _refuse("a number is not finite")
    subspace = _canonical(
        foot.astype(np.float64), basis.astype(np.float64), TOLERANCES[layout.dtype]
    )
    return WireTemplate(subspace, layout.contract_id, layout.dtype)


def decode_as_stored(
    data: bytes | bytearray | memoryview, *, max_n: int = 4096, max_m: int = 192
) -> WireTemplate:
    """Read the bytes of a template that ``encode`` made and a seal has kept since.

    A seventh of the work of :func:`decode`. The numbers stay as they were rounded, which
    ``paired_distances`` allows for with ``as_stored``, and are not looked at: the seal vouches
    for them.

    Raises
    ------
    InvalidTemplate
        The container is not exactly as in docs/formats.md.
    """
    layout, foot, basis = _numbers(data, max_n, max_m)
    subspace = SubspaceBatch(foot.astype(np.float32), basis.astype(np.float32))
    return WireTemplate(subspace, layout.contract_id, layout.dtype)


def _numbers(
    data: bytes | bytearray | memoryview, max_n: int, max_m: int
) -> tuple[_Layout, NDArray[np.floating], NDArray[np.floating]]:
    """Read what a container says, foot point and basis."""
    view = memoryview(data)
    if view.nbytes > size_limit(max_n, max_m):
        _refuse(f"more than {size_limit(max_n, max_m)} bytes")
    raw = view.tobytes()
    layout = _read_header(raw, max_n, max_m)
    try:
        tensors = safetensors.numpy.load(raw)
    except SafetensorError:
        raise InvalidTemplate("template refused: not a safetensors container") from None
    return layout, tensors["foot"], tensors["basis"]


def _canonical(
    foot: NDArray[np.float64], basis: NDArray[np.float64], tolerance: float
) -> SubspaceBatch:
    """Check the numbers, then remove what rounding did to them."""
    # Entries of unit rows; also keeps the products below from overflowing.
    if max(np.abs(foot).max(), np.abs(basis).max()) > 1 + tolerance:
        _refuse("a number is larger than 1")
    gram = basis @ basis.T
    if np.abs(gram - np.eye(len(basis))).max() > tolerance:
        _refuse(f"the basis is not orthonormal within {tolerance:g}")
    if np.abs(basis @ foot).max() > tolerance:
        _refuse(f"the foot point is not orthogonal to the basis within {tolerance:g}")
    if np.linalg.norm(foot) > 1 + tolerance:
        _refuse("the foot point lies outside the unit ball")
    rows = _orthonormal(basis, gram)
    foot = foot - (rows @ foot) @ rows
    foot /= max(1.0, float(np.linalg.norm(foot)))
    return SubspaceBatch(foot.astype(np.float32), rows.astype(np.float32))


def _orthonormal(basis: NDArray[np.float64], gram: NDArray[np.float64]) -> NDArray[np.float64]:
    """Orthonormalise rows that are nearly so: a series or one factorisation is enough for most.

    The rounding of float64 grows with the condition of the Gram matrix, at most 3 here.
    """
    error = gram - np.eye(len(gram))
    bound = np.abs(error).sum(axis=1).max()  # Gershgorin
    if bound < _SMALL:
        # G^(−1/2) by its series, which ends where float32 does: a third of a factorisation's time.
        return np.asarray(basis - (error / 2 - 0.375 * (error @ error)) @ basis)
    if bound < 0.5:
        return np.asarray(np.linalg.inv(np.linalg.cholesky(gram)) @ basis)
    try:
        return np.asarray(span_basis(basis[None])[0])
    except LiftingError:
        raise InvalidTemplate("template refused: the basis is linearly dependent") from None


def _header(n: int, m: int, dtype: WireDtype, contract_id: str) -> bytes:
    """Length and JSON header, padded with spaces to a multiple of eight bytes."""
    size = np.dtype(dtype).itemsize
    split, end = size * n, size * n * (m + 1)
    fields = {
        "__metadata__": {"format": FORMAT, "version": VERSION, "contract_id": contract_id},
        "foot": {"dtype": _CODES[dtype], "shape": [n], "data_offsets": [0, split]},
        "basis": {"dtype": _CODES[dtype], "shape": [m, n], "data_offsets": [split, end]},
    }
    text = json.dumps(fields, separators=(",", ":")).encode("ascii")
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(_LENGTH_BYTES, "little") + text


def _read_header(raw: bytes, max_n: int, max_m: int) -> _Layout:
    length = int.from_bytes(raw[:_LENGTH_BYTES], "little")
    if len(raw) < _LENGTH_BYTES or length > MAX_HEADER_BYTES:
        _refuse(f"no header of at most {MAX_HEADER_BYTES} bytes")
    start = _LENGTH_BYTES + length
    if start > len(raw):
        _refuse("truncated inside the header")
    fields = _parse(raw[_LENGTH_BYTES:start])
    metadata, foot, basis = _members(fields, "__metadata__", "foot", "basis")
    form, version, contract_id = _members(metadata, "format", "version", "contract_id")
    if form != FORMAT or version != VERSION:
        _refuse(f"not the format {FORMAT} version {VERSION}")
    if not isinstance(contract_id, str) or not _CONTRACT_ID.fullmatch(contract_id):
        _refuse("the contract id is malformed")
    foot_dtype, foot_shape, foot_range = _tensor(foot, axes=1)
    basis_dtype, (m, n), basis_range = _tensor(basis, axes=2)
    if foot_dtype != basis_dtype or foot_shape != (n,):
        _refuse("foot point and basis do not fit each other")
    if not (2 <= n <= max_n and 1 <= m <= max_m and m < n):
        _refuse(f"dimensions out of range: 2 <= n <= {max_n}, 1 <= m <= {max_m}, m < n")
    size = np.dtype(foot_dtype).itemsize
    small, large = size * n, size * n * m
    end = small + large
    layouts = (((0, small), (small, end)), ((large, end), (0, large)))
    if (foot_range, basis_range) not in layouts or len(raw) - start != end:
        _refuse("the tensors do not fill the payload exactly")
    return _Layout(foot_dtype, contract_id, n, m)


def _tensor(value: object, *, axes: int) -> tuple[WireDtype, tuple[int, ...], tuple[int, ...]]:
    code, shape, offsets = _members(value, "dtype", "shape", "data_offsets")
    if not isinstance(code, str) or code not in _DTYPES:
        _refuse("numbers must be F16 or F32")
    return _DTYPES[code], _integers(shape, axes), _integers(offsets, 2)


def _integers(value: object, count: int) -> tuple[int, ...]:
    if not isinstance(value, list) or len(value) != count:
        _refuse("a shape or an offset pair has the wrong length")
    # bool is a subclass of int, and `true` is no dimension.
    if not all(type(item) is int and 0 <= item < 2**48 for item in value):
        _refuse("a shape or an offset is not an integer in range")
    return tuple(value)


def _members(value: object, *names: str) -> list[Any]:
    """Return the members of a JSON object that must have exactly these names."""
    if not isinstance(value, dict) or set(value) != set(names):
        _refuse(f"the header must have exactly the members {', '.join(names)}")
    return [value[name] for name in names]


def _parse(header: bytes) -> object:
    if not header.startswith(b"{"):
        _refuse("the header is not a JSON object")
    try:
        return json.loads(
            header.decode("utf-8"),
            object_pairs_hook=_without_duplicates,
            parse_float=_no_number,
            parse_constant=_no_number,
        )
    except (ValueError, RecursionError):
        # Not chained: the error of the parser quotes the input.
        raise InvalidTemplate("template refused: the header is not JSON") from None


def _without_duplicates(pairs: list[tuple[str, object]]) -> dict[str, object]:
    members = dict(pairs)
    if len(members) != len(pairs):
        _refuse("the header names a member twice")
    return members


def _no_number(_text: str) -> NoReturn:
    _refuse("the header holds a number that is not an integer")


def _refuse(reason: str) -> NoReturn:
    raise InvalidTemplate(f"template refused: {reason}")
