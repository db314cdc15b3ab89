"""Receipts of erasure, as the service answers them and as anyone can verify them.

The store writes and signs a receipt in the same transaction that erases the subject
(``templates.store.receipts``). What is signed is a text, canonical JSON; it is passed on as that
text, so that nobody has to write it again byte by byte in order to verify it.
"""

import base64
from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import Any

from templates.errors import StoreError
from templates.store.receipts import Receipt, ReceiptKey, verify_under


def receipt_json(receipt: Receipt) -> dict[str, Any]:
    """Return the answer of an erasure: the signed text, its signature, and the text as JSON."""
    return {"receipt": receipt.to_json(), "claims": receipt.claims}


def receipt_keys_json(keys: Sequence[ReceiptKey]) -> dict[str, Any]:
    """Return ``receipt_key`` of ``GET /v1/contract``: the key in force, and those before it."""

    def named(key: ReceiptKey) -> dict[str, Any]:
        public_key = base64.b64encode(key.public_key).decode("ascii")
        return {"key_id": key.key_id, "public_key": public_key}

    retired = [
        # To the microsecond, as a receipt is dated.
        {**named(key), "retired_at": key.retired_at.isoformat()}
        for key in keys[1:]
        if key.retired_at is not None
    ]
    return {"algorithm": "Ed25519", **named(keys[0]), "retired": retired}


def read_receipt_keys(entry: Mapping[str, Any]) -> list[ReceiptKey]:
    """Read what :func:`receipt_keys_json` wrote; a contract of an earlier version has one key.

    Raises
    ------
    StoreError
        For anything else.
    """
    try:
        retired = [
            ReceiptKey(_decoded(key["public_key"]), datetime.fromisoformat(key["retired_at"]))
            for key in entry.get("retired", [])
        ]
        return [ReceiptKey(_decoded(entry["public_key"])), *retired]
    except (AttributeError, KeyError, TypeError, ValueError):
        raise StoreError("this is not the receipt key of a contract") from None


def _decoded(text: str) -> bytes:
    return base64.b64decode(text, validate=True)


def verify_answer(
    answer: Mapping[str, Any], keys: Sequence[ReceiptKey]
) -> tuple[dict[str, Any], ReceiptKey]:
    """Verify the answer of an erasure, or its ``receipt`` alone.

    Parameters
    ----------
    answer
        The JSON object as the service returned it. ``claims`` in it is not looked at, because it
        is not signed.
    keys
        Of ``receipt_key`` in ``GET /v1/contract``.

    Returns
    -------
    tuple
        What was signed, and the key that signed it.

    Raises
    ------
    StoreError
        If it is no receipt, was signed with another key or after its key was retired, or was
        altered.
    """
    receipt = answer.get("receipt", answer)
    if not isinstance(receipt, Mapping):
        raise StoreError("this is not a receipt: `receipt` is not an object")
    return verify_under(Receipt.from_json(dict(receipt)), keys)
