"""Keys that holders of enrollments keep: made here, sent with a call, and kept by nobody else."""

import base64
import secrets

KEY_BYTES = 32


def new_holder_key() -> bytes:
    """Make a key for one enrollment. Keep it where only the person, or their device, gets at it."""
    return secrets.token_bytes(KEY_BYTES)


def holder_key_field(key: bytes | None) -> dict[str, str]:
    """Return the field of a request; nothing where there is no key.

    Raises
    ------
    ValueError
        Where it is no key; the message does not repeat it.
    """
    if key is None:
        return {}
    if not isinstance(key, bytes | bytearray) or len(key) != KEY_BYTES:
        raise ValueError(f"a holder key is {KEY_BYTES} bytes: make one with new_holder_key()")
    return {"holder_key": base64.urlsafe_b64encode(key).decode("ascii").rstrip("=")}
