"""Where a page of a list ended, sealed: it shows nothing, and is good for one list of a tenant."""

import base64

from templates.errors import SealError
from templates.keys.sealing import MasterKeyring
from templates.store.identifiers import InvalidIdentifier


def close_cursor(keyring: MasterKeyring, place: str, *, purpose: str, tenant: str) -> str:
    """Seal the place at which a page ended; `purpose` names the list."""
    sealed = keyring.seal(place.encode(), purpose=purpose, bound_to=[tenant])
    return base64.urlsafe_b64encode(sealed).decode().rstrip("=")


def open_cursor(keyring: MasterKeyring, cursor: str, *, purpose: str, tenant: str) -> str:
    """Return the place that :func:`close_cursor` sealed for this list of this tenant."""
    try:
        sealed = base64.urlsafe_b64decode(cursor + "=" * (-len(cursor) % 4))
        return keyring.open(sealed, purpose=purpose, bound_to=[tenant]).decode()
    except (SealError, ValueError):
        raise InvalidIdentifier(
            "this cursor was not given for this list: start again without one"
        ) from None
