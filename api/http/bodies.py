"""Request bodies: multipart and JSON into plain values, in memory only.

FastAPI's own body parsing is not used: one call accepts two content types, and Starlette writes
parts over 1 MiB to a temporary file, where a face has no business to be.
"""

import base64
import binascii
import json
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from typing import Any

import anyio
import anyio.to_thread
from starlette.datastructures import FormData
from starlette.formparsers import MultiPartException, MultiPartParser
from starlette.requests import Request

from api.http.errors import ApiError
from api.limits.admission import MAX_JSON_BYTES, read_limited, stream_limited
from api.settings import Settings
from templates.contract.canonical import too_many_parts

_FORM, _JSON = "multipart/form-data", "application/json"
_MEDIA_TYPE = re.compile(r"[a-z0-9.+-]{1,63}/[a-z0-9.+-]{1,63}")
MAX_FIELD_BYTES = 4096
MAX_FIELDS = 16
MAX_JSON_PARTS = 24_576
"""Values in a JSON body, counted before it is parsed: six of the longest embeddings, where no
request has more than five. Without it 4 MiB of small objects take 120 MiB."""
MAX_PARSED_AT_ONCE = 64 * 1024
"""Bytes of JSON that are parsed on the event loop; more go to a thread."""


@dataclass(frozen=True)
class Form:
    """A multipart body: files and text fields, each in the order they came."""

    files: tuple[tuple[str, bytes], ...] = field(repr=False)
    fields: Mapping[str, str] = field(repr=False)

    def images(self, *names: str) -> list[bytes]:
        """Return the files of one field: of that of ``names`` that the first file came under.

        Raises
        ------
        ApiError
            ``validation_failed`` if a file came under another name, or the field as plain text.
        """
        came = [key for key, _ in self.files if key in names]
        name = came[0] if came else names[0]
        stray = sorted({key for key, _ in self.files if key != name} | ({name} & set(self.fields)))
        if stray or not self.files:
            raise ApiError(
                "validation_failed", f"{_how_to_send(name)}, and no other file", {"field": name}
            )
        return [data for _, data in self.files]


class _InMemoryParser(MultiPartParser):
    """Starlette's parser without its temporary files, with the limits of photos."""

    # Python's SpooledTemporaryFile never moves to disk when its limit is 0.
    spool_max_size = 0

    def __init__(
        self, request: Request, *, max_bytes: int, max_images: int, max_image_bytes: int
    ) -> None:
        super().__init__(
            request.headers,
            stream_limited(request, max_bytes),
            max_files=float("inf"),
            max_fields=MAX_FIELDS,
            max_part_size=MAX_FIELD_BYTES,
        )
        self._max_images = max_images
        self._max_image_bytes = max_image_bytes
        self._image_bytes = 0
        self._complete = False

    def on_end(self) -> None:
        self._complete = True

    async def parse(self) -> FormData:
        try:
            form = await super().parse()
            if not self._complete:
                # Otherwise a truncated form would pass with the photos that came before the cut.
                raise MultiPartException("the last boundary is missing")
        except BaseException:
            for file in self._files_to_close_on_error:
                file.close()
            raise
        return form

    def on_headers_finished(self) -> None:
        super().on_headers_finished()
        self._image_bytes = 0
        if self._current_files > self._max_images:
            raise ApiError(
                "too_many_images",
                f"at most {self._max_images} {'photo' if self._max_images == 1 else 'photos'} "
                "in one request",
                {"limit": self._max_images},
            )

    def on_part_data(self, data: bytes, start: int, end: int) -> None:
        if self._current_part.file is not None:
            self._image_bytes += end - start
            if self._image_bytes > self._max_image_bytes:
                raise ApiError(
                    "image_too_large",
                    f"photo {self._current_files} is larger than {self._max_image_bytes:,} bytes: "
                    "send a smaller copy",
                    {"limit_bytes": self._max_image_bytes, "image": self._current_files - 1},
                )
        super().on_part_data(data, start, end)


def is_form(request: Request) -> bool:
    """Whether the body is a multipart form, as its content type says."""
    return _media_type(request) == _FORM


def _media_type(request: Request) -> str:
    return request.headers.get("content-type", "").partition(";")[0].strip().lower()


def _how_to_send(photos: str) -> str:
    return f"send photos as files of the multipart field {photos} (curl: -F {photos}=@photo.jpg)"


def _require_type(request: Request, media_type: str, how: str) -> None:
    """Refuse a body of another type, in words that say what came and what to send."""
    if request.headers.get("content-encoding", "identity").lower() != "identity":
        raise ApiError(
            "malformed_request", "the body is compressed: send it without a Content-Encoding"
        )
    sent = _media_type(request)
    if sent != media_type:
        named = sent if _MEDIA_TYPE.fullmatch(sent) else "of no known type"
        raise ApiError(
            "malformed_request", f"the body is {named}: {how}", {"content_type": media_type}
        )


async def sent_form(request: Request, settings: Settings, *, field: str, max_images: int) -> Form:
    """Read a multipart body within the limits of the settings; raises as :func:`read_form`.

    `field` is the one that photos are sent in.
    """
    _require_type(request, _FORM, _how_to_send(field))
    return await read_form(
        request,
        max_bytes=settings.max_request_bytes,
        max_images=max_images,
        max_image_bytes=settings.max_image_bytes,
        timeout_s=settings.body_timeout_s,
    )


async def sent_json(
    request: Request, settings: Settings, known: Collection[str], *, photos: str | None = None
) -> dict[str, Any]:
    """Read a JSON object within the limits of the settings.

    Parameters
    ----------
    request, settings
        Whose body it is, and its limits.
    known
        Names of fields that the call reads. Others are refused: a misspelt `level` must not pass as
        the default.
    photos
        Multipart field for photos, where the call takes these too.

    Raises
    ------
    ApiError
        ``validation_failed`` for an unknown field; the message never repeats the input. Else as
        :func:`read_json`.
    """
    how = "send JSON as application/json"
    if photos is not None:
        how = f"{_how_to_send(photos)}, and what is no photo as application/json"
    _require_type(request, _JSON, how)
    body = await read_json(
        request, max_bytes=settings.max_request_bytes, timeout_s=settings.body_timeout_s
    )
    reject_unknown(body, known, otherwise="" if photos is None else f"; {_how_to_send(photos)}")
    return body


async def read_form(
    request: Request, *, max_bytes: int, max_images: int, max_image_bytes: int, timeout_s: float
) -> Form:
    """Read a multipart body.

    Raises
    ------
    ApiError
        ``malformed_request``, ``validation_failed`` or one of the 413 codes.
    """
    parser = _InMemoryParser(
        request, max_bytes=max_bytes, max_images=max_images, max_image_bytes=max_image_bytes
    )
    with _arrives_within(timeout_s):
        try:
            form = await parser.parse()
        except (MultiPartException, UnicodeError, ValueError):
            raise ApiError(
                "malformed_request",
                "the body is not a well-formed multipart form, or has a field that is too long or "
                "too many fields: let your HTTP library write both the form and its Content-Type, "
                "which names the boundary",
            ) from None
    files: list[tuple[str, bytes]] = []
    fields: dict[str, str] = {}
    try:
        for name, value in form.multi_items():
            if not isinstance(value, str):
                files.append((name, value.file.read()))
            elif name in fields:
                raise ApiError("validation_failed", "a form field is given twice")
            else:
                fields[name] = value
    finally:
        await form.close()
    return Form(files=tuple(files), fields=fields)


async def read_json(request: Request, *, max_bytes: int, timeout_s: float) -> dict[str, Any]:
    """Read a JSON object.

    ``NaN`` and infinities pass, so that an embedding that holds them is refused as such.

    Raises
    ------
    ApiError
        ``malformed_request`` or ``request_too_large``.
    """
    with _arrives_within(timeout_s):
        body = await read_limited(request, min(max_bytes, MAX_JSON_BYTES))
    if too_many_parts(body, MAX_JSON_PARTS):
        raise ApiError(
            "malformed_request", f"the body holds more than {MAX_JSON_PARTS} values or commas"
        )
    try:
        if len(body) > MAX_PARSED_AT_ONCE:
            value = await anyio.to_thread.run_sync(parse_json, body)
        else:
            value = parse_json(body)
    except (ValueError, RecursionError):
        raise ApiError(
            "malformed_request", "the body is not well-formed JSON in UTF-8, or names a field twice"
        ) from None
    if not isinstance(value, dict):
        raise ApiError("malformed_request", "the body must be a JSON object")
    return value


def parse_json(text: str | bytes) -> Any:
    """Parse JSON, as bytes in UTF-8, in which no object names a field twice.

    Readers differ in which of two counts, and in how they guess other encodings.

    Raises
    ------
    ValueError, RecursionError
        It is no such JSON.
    """
    if isinstance(text, bytes):
        text = text.decode("utf-8-sig")
    return json.loads(text, object_pairs_hook=_unique)


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    fields = dict(pairs)
    if len(fields) != len(pairs):
        raise ValueError("a field is named twice")
    return fields


class _arrives_within:
    """Bounds the time that a body may take to arrive."""

    def __init__(self, seconds: float) -> None:
        self._scope = anyio.fail_after(seconds)
        self._seconds = seconds

    def __enter__(self) -> None:
        self._scope.__enter__()

    def __exit__(self, kind: Any, value: Any, trace: Any) -> None:
        try:
            self._scope.__exit__(kind, value, trace)
        except TimeoutError:
            raise ApiError(
                "malformed_request",
                f"the body did not arrive within {self._seconds:g} seconds",
                {},
                {"Connection": "close"},
            ) from None


def reject_unknown(names: Collection[str], known: Collection[str], *, otherwise: str = "") -> None:
    """Refuse fields that nobody reads.

    Raises
    ------
    ApiError
        ``validation_failed``; the message lists the known fields, and ends as `otherwise` says.
    """
    if not set(names) <= set(known):
        raise ApiError(
            "validation_failed",
            f"unknown field; known are {', '.join(sorted(known))}{otherwise}",
            {"known": sorted(known)},
        )


def text_field(value: Any, name: str, *, max_length: int = 64) -> str | None:
    """Return an optional string.

    Raises
    ------
    ApiError
        ``validation_failed``.
    """
    if value is None:
        return None
    # A lone surrogate, which JSON can write and UTF-8 cannot, is not printable.
    if not isinstance(value, str) or not 0 < len(value) <= max_length or not value.isprintable():
        raise ApiError(
            "validation_failed",
            f"{name} must be a string of 1 to {max_length} printable characters",
            {"field": name},
        )
    return value


def base64_field(value: Any, name: str, *, code: str) -> bytes:
    """Return the bytes of a base64 string, standard alphabet, padded.

    Raises
    ------
    ApiError
        ``validation_failed`` if it is no string, ``code`` if it is no base64.
    """
    if not isinstance(value, str):
        raise ApiError("validation_failed", f"{name} must be a base64 string", {"field": name})
    try:
        return base64.b64decode(value, validate=True)
    except (binascii.Error, ValueError):
        raise ApiError(code, f"{name} is not base64", {"field": name}) from None
