"""Request bodies: multipart and JSON into the models of ``api.http.requests``, in memory only.

FastAPI's own parsing is not used: a body is read after authentication, one call accepts two content
types, and Starlette writes parts over 1 MiB to a temporary file, where a face has no business to
be.
"""

import json
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, TypeVar

import anyio
import anyio.to_thread
from pydantic import ValidationError
from starlette.datastructures import FormData
from starlette.formparsers import MultiPartException, MultiPartParser
from starlette.requests import Request

from api.http.errors import ApiError, refuse_unknown_names, wrong_value
from api.http.requests import Body, how_to_send
from api.limits.admission import MAX_JSON_BYTES, read_limited, stream_limited
from models.decoding import MAX_BYTES
from templates.contract.canonical import too_many_parts

_FORM, _JSON = "multipart/form-data", "application/json"
_MEDIA_TYPE = re.compile(r"[a-z0-9.+-]{1,63}/[a-z0-9.+-]{1,63}")
MAX_REQUEST_BYTES = 32 * 2**20
MAX_IMAGE_BYTES = MAX_BYTES
MAX_FIELD_BYTES = 4096
MAX_FIELDS = 16
BODY_TIMEOUT_S = 60.0
"""Seconds that a body may take to arrive."""
MAX_JSON_PARTS = 24_576
"""Values in a JSON body, counted before it is parsed: six of the longest embeddings, where no
request has more than five. Without it 4 MiB of small objects take 120 MiB."""

B = TypeVar("B", bound=Body)


class _InMemoryParser(MultiPartParser):
    """Starlette's parser without its temporary files, with the limits of photos."""

    # Python's SpooledTemporaryFile never moves to disk when its limit is 0.
    spool_max_size = 0

    def __init__(self, request: Request, most: int) -> None:
        super().__init__(
            request.headers,
            stream_limited(request, MAX_REQUEST_BYTES),
            max_files=float("inf"),
            max_fields=MAX_FIELDS,
            max_part_size=MAX_FIELD_BYTES,
        )
        self._most = most
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
        if self._current_files > self._most:
            raise too_many_images(self._most)

    def on_part_data(self, data: bytes, start: int, end: int) -> None:
        if self._current_part.file is not None:
            self._image_bytes += end - start
            if self._image_bytes > MAX_IMAGE_BYTES:
                raise ApiError(
                    "image_too_large",
                    f"photo {self._current_files} is larger than {MAX_IMAGE_BYTES:,} bytes: "
                    "send a smaller copy",
                    {"limit_bytes": MAX_IMAGE_BYTES, "image": self._current_files - 1},
                )
        super().on_part_data(data, start, end)


def too_many_images(most: int) -> ApiError:
    """Refuse more photos than a call takes."""
    photos = "photo" if most == 1 else "photos"
    return ApiError("too_many_images", f"at most {most} {photos} in one request", {"limit": most})


def is_form(request: Request) -> bool:
    """Whether the body is a multipart form, as its content type says."""
    return _media_type(request) == _FORM


def _media_type(request: Request) -> str:
    return request.headers.get("content-type", "").partition(";")[0].strip().lower()


def _require_type(request: Request, media_type: str, how: str) -> None:
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


async def read_form(request: Request, model: type[B], *, photos: str, most: int) -> B:
    """Read a multipart body.

    `photos` names the field for photos, of which at most `most` may come.
    """
    _require_type(request, _FORM, how_to_send(photos))
    with _arrives_within(BODY_TIMEOUT_S):
        try:
            form = await _InMemoryParser(request, most).parse()
        except (MultiPartException, UnicodeError, ValueError):
            raise ApiError(
                "malformed_request",
                "the body is not a well-formed multipart form, or has a field that is too long or "
                "too many fields: let your HTTP library write both the form and its Content-Type, "
                "which names the boundary",
            ) from None
    values: dict[str, Any] = {}
    try:
        for name, value in form.multi_items():
            content = value if isinstance(value, str) else value.file.read()
            if isinstance(content, bytes) and isinstance(values.setdefault(name, []), list):
                values[name].append(content)
            elif name in values:
                raise ApiError("validation_failed", "a form field is given twice")
            else:
                values[name] = content
    finally:
        await form.close()
    return _checked(model, values, photos)


async def read_json(request: Request, model: type[B], *, photos: str | None = None) -> B:
    """Read a JSON object, in UTF-8; `photos` is the multipart field, where a call takes these too.

    ``NaN`` and infinities pass, so that an embedding that holds them is refused as such.
    """
    how = "send JSON as application/json"
    if photos is not None:
        how = f"{how_to_send(photos)}, and what is no photo as application/json"
    _require_type(request, _JSON, how)
    with _arrives_within(BODY_TIMEOUT_S):
        body = await read_limited(request, MAX_JSON_BYTES)
    if too_many_parts(body, MAX_JSON_PARTS):
        raise ApiError(
            "malformed_request", f"the body holds more than {MAX_JSON_PARTS} values or commas"
        )
    return await anyio.to_thread.run_sync(_parsed, model, body, photos)


def _parsed(model: type[B], body: bytes, photos: str | None) -> B:
    try:
        values = json.loads(body.decode("utf-8-sig"), object_pairs_hook=_unique)
    except (ValueError, RecursionError):
        raise ApiError(
            "malformed_request", "the body is not well-formed JSON in UTF-8, or names a field twice"
        ) from None
    if not isinstance(values, dict):
        raise ApiError("malformed_request", "the body must be a JSON object")
    return _checked(model, values, photos)


def _unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    # Readers differ in which of two counts.
    fields = dict(pairs)
    if len(fields) != len(pairs):
        raise ValueError("a field is named twice")
    return fields


def _checked(model: type[B], values: Mapping[str, Any], photos: str | None) -> B:
    remedy = "" if photos is None else f"; {how_to_send(photos)}"
    refuse_unknown_names(values, list(model.model_fields), "field", remedy)
    try:
        return model.model_validate(values)
    except ValidationError as error:
        problem = error.errors(include_url=False, include_input=False)[0]
        raise wrong_value(problem, remedy if problem["loc"] in ((photos,), ()) else "") from None


@contextmanager
def _arrives_within(seconds: float) -> Iterator[None]:
    try:
        with anyio.fail_after(seconds):
            yield
    except TimeoutError:
        raise ApiError(
            "malformed_request",
            f"the body did not arrive within {seconds:g} seconds",
            {},
            {"Connection": "close"},
        ) from None
