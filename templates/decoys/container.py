"""The files of decoy sources: safetensors with one canonical encoding.

A safetensors file may order its tensors, pad its header and carry foreign metadata as it likes.
Here one content has one encoding, so that its hash can name it.
"""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import safetensors
from numpy.typing import NDArray
from safetensors.numpy import load, save

from templates.errors import DecoyError
from templates.keys import private_file

METADATA_KEY = "veilface"
# The writer keeps metadata in an unordered map: a second key would make the bytes vary by run.

MAX_HEADER = 64 * 1024
_LENGTH_BYTES = 8

Fields = Mapping[str, str | int]


def encode(fields: Fields, tensors: Mapping[str, NDArray[np.generic]]) -> bytes:
    """Encode named float32 or uint8 arrays and a few plain fields; equal input, equal bytes."""
    text = json.dumps(fields, sort_keys=True, separators=(",", ":"), ensure_ascii=True)
    arrays = {name: np.ascontiguousarray(array) for name, array in tensors.items()}
    return bytes(save(arrays, metadata={METADATA_KEY: text}))


def decode(
    data: bytes, *, what: str, max_bytes: int
) -> tuple[dict[str, object], dict[str, NDArray[np.generic]]]:
    """Decode bytes that may be hostile into fields and arrays.

    The caller checks names, types, shapes and values, and that it would write the same bytes.
    `what` names the thing in error messages; a DecoyError says that the bytes cannot be read.
    """
    if len(data) > max_bytes:
        raise DecoyError(f"the {what} has {len(data)} bytes; at most {max_bytes} are accepted")
    if len(data) < _LENGTH_BYTES:
        raise DecoyError(f"the {what} is truncated: it has {len(data)} bytes")
    header_size = int.from_bytes(data[:_LENGTH_BYTES], "little")
    if header_size > min(MAX_HEADER, len(data) - _LENGTH_BYTES):
        raise DecoyError(
            f"the {what} declares a header of {header_size} bytes, which cannot be; is it a file "
            "of `veilface decoys build`?"
        )
    try:
        header = json.loads(data[_LENGTH_BYTES : _LENGTH_BYTES + header_size])
        fields = json.loads(header["__metadata__"][METADATA_KEY])
        arrays = load(data)
    except (
        ValueError,
        KeyError,
        TypeError,
        AttributeError,
        RecursionError,
        OverflowError,
        safetensors.SafetensorError,
    ):
        # The parser's own words may quote the input, which may be a descriptor.
        raise DecoyError(f"the {what} is not a valid safetensors file of this kind") from None
    if not isinstance(fields, dict):
        raise DecoyError(f"the {what} is not a valid safetensors file of this kind")
    return fields, arrays


def write_private(path: Path, data: bytes) -> None:
    """Replace `path` at once by a file of mode 0600; see `replace_private`."""
    try:
        private_file.replace_private(path, data)
    except OSError as error:
        raise DecoyError(f"cannot write {path.name}: {error.strerror}") from error


def read_bounded(path: Path, limit: int) -> bytes:
    """Read a file of at most `limit` bytes."""
    try:
        return private_file.read_bounded(path, limit)
    except OSError as error:
        raise DecoyError(f"cannot read {path.name}: {error.strerror}") from error
