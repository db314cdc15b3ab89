"""Receipts of erasure, as the service answers them and as anyone can verify them.

The store writes and signs a receipt in the same transaction that erases the subject
(``templates.store.receipts``). What is signed is a text, canonical JSON; it is passed on as that
text, so that nobody has to write it again byte by byte in order to verify it.
"""

from collections.abc import Mapping
from typing import Any

from templates.errors import StoreError
from templates.store.receipts import Receipt, key_fingerprint, verify_receipt

__all__ = ["key_fingerprint", "receipt_json", "verify_answer"]


def receipt_json(receipt: Receipt) -> dict[str, Any]:
    """Return the answer of an erasure: the signed text, its signature, and the text as JSON."""
    return {"receipt": receipt.to_json(), "claims": receipt.claims}


def verify_answer(answer: Mapping[str, Any], public_key: bytes) -> dict[str, Any]:
    """Verify the answer of an erasure, or its ``receipt`` alone; return what was signed.

    Parameters
    ----------
    answer
        The JSON object as the service returned it. ``claims`` in it is not looked at, because it
        is not signed.
    public_key
        The 32 bytes of ``receipt_key.public_key`` in ``GET /v1/contract``.

    Raises
    ------
    StoreError
        If it is no receipt, was signed with another key, or was altered.
    """
    receipt = answer.get("receipt", answer)
    if not isinstance(receipt, Mapping):
        raise StoreError("this is not a receipt: `receipt` is not an object")
    return verify_receipt(Receipt.from_json(dict(receipt)), public_key)
