"""Canonical JSON for hashing, and a JSON reader that treats its input as hostile.

Two programs that agree on a contract must compute the same ``contract_id``, so the bytes under
the hash are fixed: sorted keys, no spaces, UTF-8, no NaN or infinity, and integral floats written
as integers (as RFC 8785 does), so that ``127`` and ``127.0`` bind the same preprocessing.
"""

import hashlib
import json
import math
from collections.abc import Mapping

from pydantic import JsonValue

from templates.errors import ContractError

Json = JsonValue

MAX_PARTS = 100_000
"""Values in a document, counted before it is parsed: a parsed value takes up to a hundred times
the bytes of its text."""


def plain_json(value: object) -> Json:
    """Copy ``value`` as plain JSON values, which equal themselves after a round trip.

    Tuples become lists, and integral floats become integers.

    Raises
    ------
    ContractError
        Where the value is not JSON, or a number is not finite.
    """
    match value:
        case None | bool() | str() | int():
            return value
        case float() if math.isfinite(value):
            return int(value) if value.is_integer() else value
        case Mapping() if all(isinstance(key, str) for key in value):
            return {key: plain_json(entry) for key, entry in value.items()}
        case list() | tuple():
            return [plain_json(entry) for entry in value]
    raise ContractError(f"a {type(value).__name__} cannot be written as JSON, or is not finite")


def canonical_json(value: object) -> bytes:
    """Bytes under every hash: sorted keys, no spaces, UTF-8, finite numbers."""
    try:
        plain = plain_json(value)
        text = json.dumps(plain, sort_keys=True, separators=(",", ":"), ensure_ascii=False)
        return text.encode("utf-8")
    except (UnicodeEncodeError, RecursionError):
        raise ContractError("a text is no Unicode, or a value is nested too deep") from None


def digest(value: object) -> str:
    """SHA-256 of the canonical JSON, as 64 lower-case hexadecimal digits."""
    return hashlib.sha256(canonical_json(value)).hexdigest()


def parse_object(data: bytes, *, what: str, most: int = MAX_PARTS) -> dict[str, object]:
    """Parse one JSON object; refuse duplicate keys, NaN, infinity and more than ``most`` values.

    They are counted before it is parsed, and commas in a text count too.

    Raises
    ------
    ContractError
        Where the bytes are not one such object.
    """
    if sum(map(data.count, (b",", b"[", b"{"))) > most:
        raise ContractError(f"{what} holds more than {most} values or commas")

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
