"""Receipts of erasure, as the service answers them and as anyone can verify them.

The store writes and signs a receipt in the same transaction that erases the subject
(``templates.store.receipts``). What is signed is a text, canonical JSON; it is passed on as that
text, so that nobody has to write it again byte by byte in order to verify it.
"""

import base64
from collections.abc import Mapping
from typing import Any

from templates.errors import StoreError
from templates.store.receipts import Receipt, key_fingerprint, verify_receipt


def receipt_json(receipt: Receipt) -> dict[str, Any]:
    """Return the answer of an erasure: the signed text, its signature, and the text as JSON."""
    return {"receipt": receipt.to_json(), "claims": receipt.claims}


def receipt_key_json(public_key: bytes) -> dict[str, Any]:
    """Return ``receipt_key`` of ``GET /v1/contract``."""
    return {
        "algorithm": "Ed25519",
        "key_id": key_fingerprint(public_key),
        "public_key": base64.b64encode(public_key).decode("ascii"),
    }


def read_receipt_key(entry: Mapping[str, Any]) -> bytes:
    """Return the public key, 32 bytes, of what :func:`receipt_key_json` wrote."""
    try:
        return base64.b64decode(entry["public_key"], validate=True)
    except (KeyError, TypeError, ValueError):
        raise StoreError("this is not the receipt key of a contract") from None


def verify_answer(answer: Mapping[str, Any], public_key: bytes) -> dict[str, Any]:
    """Verify the answer of an erasure, or its ``receipt`` alone; return what was signed.

    ``claims`` is not looked at, because it is not signed. A receipt that was altered, or signed
    with another key, is a `StoreError`.
    """
    receipt = answer.get("receipt", answer)
    if not isinstance(receipt, Mapping):
        raise StoreError("this is not a receipt: `receipt` is not an object")
    return verify_receipt(Receipt.from_json(dict(receipt)), public_key)
