"""Probes as requests bring them: photos, frames, embeddings or a lifted template, read and checked.

Nothing is decoded or compared here: what a :class:`Probe` has is done later, in a compute slot.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from fastapi import Request
from numpy.typing import NDArray

from api.http.auth import Caller
from api.http.bodies import (
    base64_field,
    is_form,
    reject_unknown,
    sent_form,
    sent_json,
    text_field,
)
from api.http.challenges import FIELD as CHALLENGE
from api.http.challenges import MAX_ID, Challenge, opened_challenge
from api.http.errors import ApiError
from api.http.holder_keys import FIELD, holder_key_of
from api.http.values import (
    embedding_of,
    embeddings_of,
    face_policy,
)
from api.service.metrics import step
from api.service.runtime import Runtime
from api.settings import Settings
from templates.space.agreement import distinct_rows
from verify import (
    MAX_FRAMES,
    MAX_PROBE_PHOTOS,
    MIN_FRAMES,
    Decision,
    OpenedTemplate,
    PhotoProbe,
    Verifier,
)

PROBES = ("embedding", "embeddings", "template")
"""Fields that hold a probe that is not a photo."""


@dataclass(frozen=True)
class Probe:
    """What is compared, how, with whose template, and what keeps it from a second use."""

    kind: Literal["photo", "frames", "embedding", "template"]
    compare: Callable[[Verifier, OpenedTemplate], Decision]
    token: str | None
    holder_key: bytearray | None = field(repr=False)


async def sent_probe(
    request: Request,
    runtime: Runtime,
    caller: Caller,
    subject: str,
    holder_key_header: str | None,
) -> Probe:
    """Read the probe of a request.

    Raises
    ------
    ApiError, VeilfaceError
        Whatever is wrong with it, or forbids it, that can be told without decoding anything.
    """
    if is_form(request):
        return await _photos(request, runtime, caller, subject, holder_key_header)
    return await _numbers(request, runtime, caller, holder_key_header)


async def _photos(
    request: Request,
    runtime: Runtime,
    caller: Caller,
    subject: str,
    holder_key_header: str | None,
) -> Probe:
    pack = runtime.required_pack()
    settings = runtime.settings
    form = await sent_form(request, settings, field="image", max_images=MAX_FRAMES)
    photos = form.images("image", "images")
    reject_unknown(form.fields, ("level", "face", CHALLENGE, FIELD))
    challenge_id = text_field(form.fields.get(CHALLENGE), CHALLENGE, max_length=MAX_ID)
    _check_count(len(photos), settings, is_challenge=challenge_id is not None)
    level = _level(runtime, caller, text_field(form.fields.get("level"), "level"))
    policy = face_policy(form.fields.get("face"))
    holder_key = holder_key_of(holder_key_header, form.fields)

    runtime.liveness.require(photos=True, challenge=challenge_id is not None)
    passive = runtime.liveness.policy.passive
    challenge = None
    if challenge_id is not None:
        challenge = opened_challenge(
            runtime.keyring, challenge_id, tenant=caller.tenant, subject=subject
        )
    token = _one_use(caller, challenge)
    embed: Callable[[Verifier], PhotoProbe]
    if challenge is None:

        def embed(verifier: Verifier) -> PhotoProbe:
            return verifier.photo_probe(
                pack, photos, passive=passive, policy=policy, limits=runtime.image_limits
            )
    else:

        def embed(verifier: Verifier) -> PhotoProbe:
            return verifier.frames_probe(
                pack,
                photos,
                challenge.movements,
                passive=passive,
                policy=policy,
                limits=runtime.image_limits,
            )

    probes: list[PhotoProbe] = []

    def compare(verifier: Verifier, stored: OpenedTemplate) -> Decision:
        if not probes:  # a probe may be decided more than once
            with step("photo"):
                probes.append(embed(verifier))
        (probe,) = probes
        with step("decide"):
            decision = verifier.decide_embedding(
                probe.embedding, stored, holder_key=holder_key, level=level, photos=probe.photos
            )
        if challenge is not None or passive:
            decision = decision.with_liveness(probe.failure)
        return decision.with_advice(clear=probe.clear)

    return Probe(
        "photo" if challenge is None else "frames",
        compare,
        token,
        holder_key,
    )


def _one_use(caller: Caller, challenge: Challenge | None) -> str | None:
    """Return the digest of what a decision uses up, if anything.

    Raises
    ------
    ApiError
        ``validation_failed`` where a challenge was asked for with a token, and comes without it,
        or was not, and comes with one. A decision under an API key, at whatever level it asks for,
        must not be taken for the token's.
    """
    token = None if caller.subject_token is None else caller.subject_token.digest
    if challenge is None:
        return token
    if token != (challenge.digest if challenge.is_of_token else None):
        raise ApiError(
            "validation_failed",
            "a challenge is answered with the token that it was asked for with, and one of an API "
            "key with an API key: ask for one with what you send",
            {"field": CHALLENGE},
        )
    return challenge.digest


def _check_count(count: int, settings: Settings, *, is_challenge: bool) -> None:
    """Refuse more photos than a probe has, or fewer frames than show movements."""
    most = MAX_FRAMES if is_challenge else min(MAX_PROBE_PHOTOS, settings.max_images)
    if count > most:
        raise ApiError("too_many_images", f"at most {most} photos in one request", {"limit": most})
    if is_challenge and count < MIN_FRAMES:
        raise ApiError(
            "validation_failed",
            f"a challenge is answered by {MIN_FRAMES} to {MAX_FRAMES} frames",
            {"field": "images"},
        )


async def _numbers(
    request: Request, runtime: Runtime, caller: Caller, holder_key_header: str | None
) -> Probe:
    known = (*PROBES, "level", FIELD)
    body = await sent_json(request, runtime.settings, known, photos="image")
    named = [kind for kind in PROBES if kind in body]
    if len(named) != 1:
        raise ApiError(
            "validation_failed",
            "send exactly one of embedding, embeddings and template, or photos",
        )
    # After the fields: a caller that only forgot how to send a photo needs no further right.
    caller.require("embeddings")
    kind, value = named[0], body[named[0]]
    sent: bytes | NDArray[np.float64]
    if kind == "template":
        sent = base64_field(value, "template", code="invalid_template")
    else:
        sent = embedding_of(value) if kind == "embedding" else embeddings_of(value)
    level = _level(runtime, caller, text_field(body.get("level"), "level"))
    runtime.liveness.require(photos=False, challenge=False)
    holder_key = holder_key_of(holder_key_header, body)

    def compare(verifier: Verifier, stored: OpenedTemplate) -> Decision:
        with step("decide"):
            if isinstance(sent, bytes):
                return verifier.decide_template(sent, stored, holder_key=holder_key, level=level)
            rows = np.atleast_2d(sent)
            mean = verifier.average(rows)
            return verifier.decide_embedding(
                mean,
                stored,
                holder_key=holder_key,
                level=level,
                photos=len(distinct_rows(rows)),
            )

    return Probe(
        "template" if kind == "template" else "embedding",
        compare,
        _one_use(caller, None),
        holder_key,
    )


def _level(runtime: Runtime, caller: Caller, asked: str | None) -> str:
    if caller.subject_token is not None:
        asked = caller.subject_token.level_of(asked)
    return runtime.levels.in_force(asked, lowest_of_key=caller.lowest_level)
