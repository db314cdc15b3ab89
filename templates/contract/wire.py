"""The bytes of a private template on the wire and, sealed, in the store (docs/formats.md).

The container is safetensors. The decoder treats its input as hostile: it bounds the size, and
compares the header with the only ones that there can be, before it looks at a number.
"""

import json
import re
from dataclasses import dataclass, field
from typing import Any, Literal, NoReturn

import numpy as np
from numpy.typing import NDArray

from templates.contract.binding import MAX_M, MAX_N
from templates.contract.canonical import parse_object
from templates.errors import ContractError, InvalidTemplate
from templates.space.subspace import SubspaceBatch

FORMAT = "veilface-template"
VERSION = "1"
MAX_HEADER_BYTES = 4096

WireDtype = Literal["float16", "float32"]

_LENGTH_BYTES = 8
MAX_BYTES = _LENGTH_BYTES + MAX_HEADER_BYTES + 4 * MAX_N * (MAX_M + 1)
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


def encode(subspace: SubspaceBatch, *, contract_id: str, dtype: WireDtype = "float16") -> bytes:
    """Return the bytes of a template; equal templates give equal bytes.

    Float16 halves the size and moves distances by about 10⁻⁴. InvalidTemplate where the subspace
    fails its own check, or the contract id has not 64 lower-case hexadecimal digits.
    """
    if not _CONTRACT_ID.fullmatch(contract_id):
        raise InvalidTemplate("a contract id has 64 lower-case hexadecimal digits")
    subspace.validate()
    little = np.dtype(dtype).newbyteorder("<")
    payload = subspace.foot.astype(little).tobytes() + subspace.basis.astype(little).tobytes()
    return _header(subspace.n, subspace.m, dtype, contract_id) + payload


def encoded_size(n: int, m: int, dtype: WireDtype = "float16") -> int:
    """Return the exact number of bytes that ``encode`` makes of a template."""
    return len(_header(n, m, dtype, "0" * 64)) + np.dtype(dtype).itemsize * n * (m + 1)


def decode(data: bytes | bytearray | memoryview) -> WireTemplate:
    """Read the bytes of a template from anybody; of more than ``MAX_BYTES`` nothing is read.

    The basis is orthonormalised again and the foot point made orthogonal to it in float64, which
    removes the rounding of the wire. InvalidTemplate, with the reason, for anything that is not
    exactly as in docs/formats.md.
    """
    contract_id, dtype, foot, basis = _numbers(data)
    # Before the cast, which NumPy warns of for a signalling NaN.
    if not (np.isfinite(foot).all() and np.isfinite(basis).all()):
        _refuse("a number is not finite")
    rounded = SubspaceBatch(foot.astype(np.float32), basis.astype(np.float32))
    try:
        rounded.validate(TOLERANCES[dtype])
    except InvalidTemplate as error:
        _refuse(str(error))
    rows = _orthonormal(rounded.basis.astype(np.float64))
    point = rounded.foot - (rows @ rounded.foot) @ rows
    point /= max(1.0, float(np.linalg.norm(point)))
    subspace = SubspaceBatch(point.astype(np.float32), rows.astype(np.float32))
    return WireTemplate(subspace, contract_id, dtype)


def decode_as_stored(data: bytes | bytearray | memoryview) -> WireTemplate:
    """Read the bytes of a template that ``encode`` made and a seal has kept since.

    A seventh of the work of :func:`decode`. The numbers stay as they were rounded, which
    ``paired_distances`` allows for with ``as_stored``, and are not looked at: the seal vouches
    for them.
    """
    contract_id, dtype, foot, basis = _numbers(data)
    subspace = SubspaceBatch(foot.astype(np.float32), basis.astype(np.float32))
    return WireTemplate(subspace, contract_id, dtype)


def _numbers(
    data: bytes | bytearray | memoryview,
) -> tuple[str, WireDtype, NDArray[np.floating], NDArray[np.floating]]:
    """Read contract id, dtype, foot point and basis, as they stand in the bytes."""
    view = memoryview(data)
    if view.nbytes > MAX_BYTES:
        _refuse(f"more than {MAX_BYTES} bytes")
    raw = view.tobytes()
    length = int.from_bytes(raw[:_LENGTH_BYTES], "little")
    start = _LENGTH_BYTES + length
    if len(raw) < _LENGTH_BYTES or length > MAX_HEADER_BYTES:
        _refuse(f"no header of at most {MAX_HEADER_BYTES} bytes")
    if start > len(raw):
        _refuse("truncated inside the header")
    header = raw[_LENGTH_BYTES:start]
    if not header.startswith(b"{"):
        _refuse("the header is not a JSON object")
    try:
        given: Any = parse_object(header, what="the header")
        m, n = given["basis"]["shape"]
        dtype, contract_id = _DTYPES[given["foot"]["dtype"]], given["__metadata__"]["contract_id"]
    except ContractError as error:
        raise InvalidTemplate(f"template refused: {error}") from None
    except (KeyError, TypeError, ValueError):
        _refuse("the header has not the members of a template of F16 or F32 numbers")
    if not all(type(size) is int for size in (n, m)):
        _refuse("a dimension is not an integer")
    if not (2 <= n <= MAX_N and 1 <= m <= MAX_M and m < n):
        _refuse(f"dimensions out of range: 2 <= n <= {MAX_N}, 1 <= m <= {MAX_M}, m < n")
    if not isinstance(contract_id, str) or not _CONTRACT_ID.fullmatch(contract_id):
        _refuse("the contract id is malformed")
    # Two headers say this: with the foot first, and with the basis first. The text is compared,
    # because true and 1.0 are 1.
    said = json.dumps(given, sort_keys=True)
    for foot_first in (True, False):
        fields = _fields(n, m, dtype, contract_id, foot_first=foot_first)
        if said == json.dumps(fields, sort_keys=True):
            break
    else:
        _refuse("the header is not that of a template of these dimensions")
    payload = raw[start:]
    if len(payload) != np.dtype(dtype).itemsize * n * (m + 1):
        _refuse("the tensors do not fill the payload exactly")
    numbers = np.frombuffer(payload, dtype=np.dtype(dtype).newbyteorder("<"))
    foot, basis = (numbers[:n], numbers[n:]) if foot_first else (numbers[n * m :], numbers[: n * m])
    return contract_id, dtype, foot, basis.reshape(m, n)


def _orthonormal(basis: NDArray[np.float64]) -> NDArray[np.float64]:
    """Orthonormalise rows that are nearly so, by a series or one factorisation.

    Eigenvalues of the Gram matrix are within 192 tolerances of 1 (Gershgorin), which is 0.4.
    """
    gram = basis @ basis.T
    error = gram - np.eye(len(gram))
    if np.abs(error).sum(axis=1).max() < _SMALL:
        # G^(−1/2) by its series, which ends where float32 does: a third of a factorisation's time.
        return np.asarray(basis - (error / 2 - 0.375 * (error @ error)) @ basis)
    return np.asarray(np.linalg.inv(np.linalg.cholesky(gram)) @ basis)


def _fields(
    n: int, m: int, dtype: WireDtype, contract_id: str, *, foot_first: bool = True
) -> dict[str, Any]:
    """What a header says."""
    size = np.dtype(dtype).itemsize
    split, end = size * n * (1 if foot_first else m), size * n * (m + 1)
    first, second = [0, split], [split, end]
    of_foot, of_basis = (first, second) if foot_first else (second, first)
    return {
        "__metadata__": {"format": FORMAT, "version": VERSION, "contract_id": contract_id},
        "foot": {"dtype": _CODES[dtype], "shape": [n], "data_offsets": of_foot},
        "basis": {"dtype": _CODES[dtype], "shape": [m, n], "data_offsets": of_basis},
    }


def _header(n: int, m: int, dtype: WireDtype, contract_id: str) -> bytes:
    """Length and JSON header, padded with spaces to a multiple of eight bytes."""
    fields = _fields(n, m, dtype, contract_id)
    text = json.dumps(fields, separators=(",", ":")).encode("ascii")
    text += b" " * (-len(text) % 8)
    return len(text).to_bytes(_LENGTH_BYTES, "little") + text


def _refuse(reason: str) -> NoReturn:
    raise InvalidTemplate(f"template refused: {reason}") from None
