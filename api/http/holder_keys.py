"""The key that the holder of an enrollment keeps, as a request carries it."""

from collections.abc import Callable, Mapping
from typing import Annotated, Any, TypeVar

from fastapi import Depends, Header, Request

from api.http.errors import ApiError
from api.http.schemas import HOLDER_KEY
from templates.errors import SealError
from templates.keys.holder_key import decode_holder_key, wipe

HEADER = "Veilface-Holder-Key"
FIELD = "holder_key"

T = TypeVar("T")


async def holder_key_header_of(
    request: Request,
    veilface_holder_key: Annotated[
        str | None,
        Header(
            description="The holder's key, in place of the field `holder_key`: 32 random bytes, "
            "base64url. Both at once are refused.",
            examples=[HOLDER_KEY],
        ),
    ] = None,
) -> str | None:
    """Return the header; :func:`holder_key_of` checks it.

    Raises
    ------
    ApiError
        ``validation_failed`` where it stands there twice.
    """
    if len(request.headers.getlist(HEADER)) > 1:
        raise _refused(f"send {HEADER} once")
    return veilface_holder_key


HolderKeyHeaderDep = Annotated[str | None, Depends(holder_key_header_of)]


def holder_key_of(header: str | None, fields: Mapping[str, Any]) -> bytearray | None:
    """Return the holder's key of a request, to be wiped after its use; None where it has none.

    Raises
    ------
    ApiError
        ``validation_failed``; the message never repeats the input.
    """
    field = fields.get(FIELD)
    if header is not None and field is not None:
        raise _refused(f"send the holder's key in the field {FIELD} or in {HEADER}, not in both")
    text = header if field is None else field
    if text is None:
        return None
    try:
        return decode_holder_key(text)
    except SealError as error:
        raise _refused(str(error)) from None


def wiping(key: bytearray | None, work: Callable[[], T]) -> Callable[[], T]:
    """Return work that forgets the key in the end.

    In the thread of the work: nobody waits for one whose request was cancelled.
    """

    def wiped() -> T:
        try:
            return work()
        finally:
            wipe(key)

    return wiped


def _refused(message: str) -> ApiError:
    return ApiError("validation_failed", message, {"field": FIELD})
