"""The readers under test: what each is given, what it may raise, and what it may cost."""

import asyncio
import threading
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

Read = Callable[[bytes], object]
MIB = 2**20
COPIES = 5
"""A file as it was read, in parts, opened, and as what it says."""


@dataclass(frozen=True)
class Target:
    """A reader of hostile bytes.

    Parameters
    ----------
    read
        Reads one case, and checks what was accepted.
    refusals
        The exceptions that the reader documents. Any other is a finding.
    make
        Makes one case from a source of randomness; equal states give equal cases.
    memory_mib
        What reading one case may add to the memory of the process, MiB, beside
        :data:`COPIES` times its own size.
    regressions
        Inputs that once were findings, each made when it is asked for.
    """

    read: Read
    refusals: tuple[type[Exception], ...]
    make: Callable[[Random], bytes]
    memory_mib: int
    regressions: Sequence[Callable[[], bytes]] = field(default=())

    def memory_for(self, size: int) -> int:
        """Bytes that a case of ``size`` bytes may take."""
        return self.memory_mib * MIB + COPIES * size


class Broken(AssertionError):
    """A reader accepted what it must not, or gave something else than it promises."""


def demand(holds: bool, promise: str) -> None:
    """Raise :class:`Broken` unless ``holds``."""
    if not holds:
        raise Broken(promise)


def image(folder: Path) -> Target:
    """``models.decoding``: any picture of a request."""
    from models.decoding import BYTES_PER_PIXEL, MAX_PIXELS, MAX_SIDE, decode_image, image_size
    from models.errors import ImageError
    from tests.fuzz import regressions
    from tests.fuzz.pictures import Pictures

    def read(data: bytes) -> None:
        try:
            pixels = decode_image(data)
        finally:
            image_size(data)
        height, width, channels = pixels.shape
        demand(pixels.dtype == np.uint8 and channels == 3, "8-bit RGB")
        demand(pixels.flags.c_contiguous, "C-contiguous")
        demand(max(height, width) <= MAX_SIDE, "no side above the limit")
        demand(height * width <= MAX_PIXELS, "no more pixels than the limit")

    most = MAX_PIXELS * BYTES_PER_PIXEL // MIB + 1
    return Target(read, (ImageError,), Pictures().make, most, regressions.pictures())


def template(folder: Path) -> Target:
    """``templates.contract.wire``: templates and lifted probes of clients, and the store's own."""
    from templates.contract import wire
    from templates.errors import InvalidTemplate
    from tests.fuzz import regressions
    from tests.fuzz.tensors import Templates

    def read(data: bytes) -> None:
        received = wire.decode(data)
        received.subspace.validate()
        again = wire.encode(
            received.subspace, contract_id=received.contract_id, dtype=received.dtype
        )
        wire.decode(again)
        demand(len(again) <= wire.MAX_BYTES, "no larger than the limit")

    return Target(read, (InvalidTemplate,), Templates().make, 64, regressions.templates())


def probe(folder: Path) -> Target:
    """``Verifier.decide_template``: a lifted probe on its way to a decision."""
    from enroll import Enrollment
    from templates.contract import wire
    from templates.errors import ContractMismatch, InvalidTemplate, Uncalibrated
    from templates.keys.rotation import TenantRotation
    from tests.fuzz.tensors import Templates, subspace
    from tests.verify.synthetic import K, M, calibrate_people, draw_people, make_generator
    from verify import CalibrationOptions, Verifier

    options = CalibrationOptions(
        targets=(1e-1,), probe_dims=(0, 2), lifted_probes=100, lifted_impostor_pairs=5_000
    )
    contract = calibrate_people(draw_people(60), options=options).contract
    rotation = TenantRotation(bytes(32), K)
    verifier = Verifier(contract, make_generator(), rotation=rotation)
    enrolled = subspace(K, M, 5).turned_by(rotation.of("template").turned)
    data = wire.encode(enrolled, contract_id=contract.contract_id)
    stored = Enrollment(data, "template", contract.contract_id)
    templates = Templates(contract.contract_id)
    right = [
        wire.encode(subspace(K, m), contract_id=contract.contract_id, dtype=dtype)
        for m in (2, M)
        for dtype in ("float16", "float32")
    ]
    templates.sound = right * 3 + templates.sound

    def read(data: bytes) -> None:
        decision = verifier.decide_template(data, stored)
        demand(np.isfinite(decision.distance), "a finite distance")
        demand(np.isfinite(decision.score), "a finite score")

    read(wire.encode(subspace(K, 2), contract_id=contract.contract_id))
    refusals = (InvalidTemplate, ContractMismatch, Uncalibrated)
    return Target(read, refusals, templates.make, 64)


def body(folder: Path) -> Target:
    """``api.http.bodies``: JSON and multipart bodies, up to the largest that are read."""
    from starlette.requests import Request

    from api.http.bodies import read_form, read_json
    from api.http.errors import ApiError
    from api.http.requests import VerifyForm, VerifyJson
    from templates.errors import TemplateError
    from tests.fuzz import regressions
    from tests.fuzz.bodies import Bodies

    runner = asyncio.Runner()

    def run(reading: Coroutine[Any, Any, Any]) -> Any:
        try:
            return runner.run(reading)
        finally:
            # The worker threads of a root task go with it, and a server has one task for all.
            for thread in threading.enumerate():
                if thread is not threading.current_thread():
                    thread.join(5)

    def read(data: bytes) -> None:
        kind, _, content = data.partition(b"\n")
        parts = [content[at : at + 65536] for at in range(0, len(content), 65536)] or [b""]

        async def receive() -> dict[str, Any]:
            return {"type": "http.request", "body": parts.pop(0), "more_body": bool(parts)}

        headers = [(b"content-type", kind)]
        request = Request({"type": "http", "method": "POST", "headers": headers}, receive)
        if kind == b"application/json":
            run(read_json(request, VerifyJson))
        else:
            form = run(read_form(request, VerifyForm, photos="image", most=5))
            demand(1 <= len(form.photos) <= 5, "no more photos than the limit")

    return Target(read, (ApiError, TemplateError), Bodies().make, 64, regressions.bodies())


TARGETS: dict[str, Callable[[Path], Target]] = {
    "image": image,
    "template": template,
    "probe": probe,
    "body": body,
}
