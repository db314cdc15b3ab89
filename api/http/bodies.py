"""Request bodies: multipart and JSON into the models of ``api.http.requests``, in memory only.

FastAPI's own parsing is not used: a body is read after authentication, one call accepts two content
types, and Starlette writes parts over 1 MiB to a temporary file, where a face has no business to
be.
"""

import codecs
import re
from collections.abc import Iterator, Mapping
from contextlib import closing, contextmanager
from typing import Any, TypeVar

import anyio
import anyio.to_thread
from pydantic import ValidationError
from starlette.datastructures import FormData
from starlette.formparsers import MultiPartException, MultiPartParser
from starlette.requests import Request

from api.http.errors import ApiError, refuse_unknown_names, wrong_value
from api.http.requests import MAX_EMBEDDING, Body, how_to_send, too_many_images
from api.limits.admission import MAX_JSON_BYTES, read_limited, stream_limited
from templates.contract.canonical import parse_object
from templates.errors import ContractError, InvalidEmbedding
from verify import MAX_PROBE_PHOTOS

_FORM, _JSON = "multipart/form-data", "application/json"
_MEDIA_TYPE = re.compile(r"[a-z0-9.+-]{1,63}/[a-z0-9.+-]{1,63}")
MAX_REQUEST_BYTES = 32 * 2**20
MAX_FIELD_BYTES = 4096
MAX_FIELDS = 16
BODY_TIMEOUT_S = 60.0
"""Seconds that a body may take to arrive."""
MAX_JSON_PARTS = 24_576
"""Values in a JSON body, counted before it is parsed: six of the longest embeddings, where no
request has more than five. Without it 4 MiB of small objects take 120 MiB."""

B = TypeVar("B", bound=Body)


class _InMemoryParser(MultiPartParser):
    """Starlette's parser without its temporary files, with a bound on photos."""

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
        self._complete = False

    def on_end(self) -> None:
        self._complete = True

    def on_headers_finished(self) -> None:
        super().on_headers_finished()
        if self._current_files > self._most:
            raise too_many_images(self._most)

    async def parse(self) -> FormData:
        form = await super().parse()
        if not self._complete:
            # Otherwise a truncated form would pass with the photos that came before the cut.
            raise MultiPartException("the last boundary is missing")
        return form

    def close(self) -> None:
        for file in self._files_to_close_on_error:
            file.close()


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
    values: dict[str, Any] = {}
    with _arrives_within(BODY_TIMEOUT_S), closing(_InMemoryParser(request, most)) as parser:
        try:
            form = await parser.parse()
        except (MultiPartException, UnicodeError, ValueError):
            raise ApiError(
                "malformed_request",
                "the body is not a well-formed multipart form, or has a field that is too long or "
                "too many fields: let your HTTP library write both the form and its Content-Type, "
                "which names the boundary",
            ) from None
        for name, value in form.multi_items():
            if isinstance(value, str) and name not in values:
                values[name] = value
            elif not isinstance(value, str) and isinstance(values.setdefault(name, []), list):
                values[name].append(value.file.read())
            else:
                raise ApiError("validation_failed", "a form field is given twice")
    return _checked(model, values, photos)


async def read_json(request: Request, model: type[B], *, photos: str | None = None) -> B:
    """Read a JSON object, in UTF-8; `photos` is the multipart field, where a call takes these."""
    how = "send JSON as application/json"
    if photos is not None:
        how = f"{how_to_send(photos)}, and what is no photo as application/json"
    _require_type(request, _JSON, how)
    with _arrives_within(BODY_TIMEOUT_S):
        body = await read_limited(request, MAX_JSON_BYTES)
    return await anyio.to_thread.run_sync(_parsed, model, body, photos)


def _parsed(model: type[B], body: bytes, photos: str | None) -> B:
    try:
        body = body.removeprefix(codecs.BOM_UTF8)
        values = parse_object(body, what="the body", most=MAX_JSON_PARTS)
    except ContractError as error:
        raise ApiError("malformed_request", str(error)) from None
    return _checked(model, values, photos)


def _checked(model: type[B], values: Mapping[str, Any], photos: str | None) -> B:
    remedy = "" if photos is None else f"; {how_to_send(photos)}"
    refuse_unknown_names(values, list(model.model_fields), "field", remedy)
    try:
        return model.model_validate(values)
    except ValidationError as error:
        problem = error.errors(include_url=False, include_input=False)[0]
    name = str(problem["loc"][0]) if problem["loc"] else None
    if name in ("embedding", "embeddings"):
        raise InvalidEmbedding(
            f"an embedding is a list of 1 to {MAX_EMBEDDING} numbers, and embeddings are 1 to "
            f"{MAX_PROBE_PHOTOS} of them"
        )
    if name == "attributes":
        raise ApiError(
            "validation_failed",
            "attributes must be a JSON object with texts for gender and race, or one of them",
            {"field": name},
        )
    if name == photos and problem["type"] == "too_long":
        raise too_many_images(problem["ctx"]["max_length"])
    raise wrong_value(problem, name, remedy if name in (photos, None) else "")


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
