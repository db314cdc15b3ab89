"""Canonical JSON for hashing, and a JSON reader that treats its input as hostile.

Two programs that agree on a contract must compute the same ``contract_id``, so the bytes under
the hash are fixed: sorted keys, no spaces, UTF-8, no NaN or infinity, and integral floats written
as integers (as RFC 8785 does), so that ``127`` and ``127.0`` bind the same preprocessing.
"""

import hashlib
import json
import math
from collections.abc import Mapping, Sequence

from pydantic import JsonValue

from templates.errors import ContractError

Json = JsonValue

MAX_DEPTH = 12
FREE_DEPTH = 4  # of an object of free content, which sits some levels down in its document
MAX_ITEMS = 4096
MAX_STRING = 4096
MAX_PARTS = 100_000
"""Values in a document, counted before it is parsed: a parsed value takes up to a hundred times
the bytes of its text."""


def plain_json(value: object, *, depth: int = MAX_DEPTH) -> Json:
    """Copy ``value`` as plain JSON values, bounded in depth, length and string size.

    Tuples become lists and integral floats become integers, so that a value equals itself after
    a round trip through a file.

    Raises
    ------
    ContractError
        Where the value is not JSON, not finite, or beyond the bounds.
    """
    if depth < 0:
        raise ContractError("a value is nested too deep")
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, str):
        if len(value) > MAX_STRING:
            raise ContractError(f"a text is longer than {MAX_STRING} characters")
        return str(value)
    if isinstance(value, int):
        if abs(value) > 2**53:
            raise ContractError("an integer is beyond 2^53, which JSON readers do not keep exactly")
        return int(value)
    if isinstance(value, float):
        if not math.isfinite(value):
            raise ContractError("a number is not finite")
        if value.is_integer() and abs(value) <= 2**53:
            return int(value)
        return float(value)
    if isinstance(value, Mapping):
        if len(value) > MAX_ITEMS:
            raise ContractError(f"an object has more than {MAX_ITEMS} entries")
        if not all(isinstance(key, str) and len(key) <= MAX_STRING for key in value):
            raise ContractError("an object has a key that is not a short text")
        return {str(key): plain_json(entry, depth=depth - 1) for key, entry in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, bytes | bytearray):
        if len(value) > MAX_ITEMS:
            raise ContractError(f"a list has more than {MAX_ITEMS} entries")
        return [plain_json(entry, depth=depth - 1) for entry in value]
    raise ContractError(f"a value of type {type(value).__name__} cannot be written as JSON")


def free_object(value: object, *, what: str) -> dict[str, Json]:
    """Copy an object of free content, at most ``FREE_DEPTH`` levels deep."""
    plain = plain_json(value, depth=FREE_DEPTH)
    if not isinstance(plain, dict):
        raise ContractError(f"{what} is not a JSON object")
    return plain


def canonical_json(value: object) -> bytes:
    """Bytes under every hash: sorted keys, no spaces, UTF-8, finite numbers."""
    plain = plain_json(value)
    try:
        text = json.dumps(
            plain, sort_keys=True, separators=(",", ":"), ensure_ascii=False, allow_nan=False
        )
        return text.encode("utf-8")
    except UnicodeEncodeError:
        raise ContractError("a text holds a lone surrogate, which UTF-8 cannot carry") from None


def digest(value: object) -> str:
    """SHA-256 of the canonical JSON, as 64 lower-case hexadecimal digits."""
    return hashlib.sha256(canonical_json(value)).hexdigest()


def too_many_parts(data: bytes, most: int = MAX_PARTS) -> bool:
    """Whether JSON text may hold more than ``most`` values; text that holds commas counts too."""
    return sum(map(data.count, (b",", b"[", b"{"))) > most


def parse_object(data: bytes, *, what: str) -> dict[str, object]:
    """Parse one JSON object; refuse duplicate keys, NaN, infinity and more than ``MAX_PARTS``.

    Raises
    ------
    ContractError
        Where the bytes are not one such object.
    """
    if too_many_parts(data):
        raise ContractError(f"{what} holds more than {MAX_PARTS} values")

    def refuse_constant(_: str) -> float:
        raise ContractError(f"{what} holds a number that is not finite")

    def unique(pairs: list[tuple[str, object]]) -> dict[str, object]:
        entries = dict(pairs)
        if len(entries) != len(pairs):
            raise ContractError(f"{what} holds a duplicate key")
        return entries

    try:
        parsed = json.loads(
            data.decode("utf-8"), parse_constant=refuse_constant, object_pairs_hook=unique
        )
    except (ValueError, RecursionError):
        # The decoder's own message may quote the file; the cause is enough.
        raise ContractError(f"{what} is not valid JSON in UTF-8") from None
    if not isinstance(parsed, dict):
        raise ContractError(f"{what} is not a JSON object")
    return parsed
