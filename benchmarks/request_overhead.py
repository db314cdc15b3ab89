"""What one verify request costs beyond the bare model inference, and the share of each step.

Every round sends one photo to a running service and, in turn, runs detection, alignment and
embedding alone on the same decoded photo in this process, with the same number of ONNX threads.
The figures are medians over the rounds, so that a noisy machine disturbs both alike.

Example
-------
::

    python -m benchmarks.request_overhead --work FOLDER    # a folder of benchmarks.end_to_end
"""

import argparse
import json
import os
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from statistics import median
from typing import ParamSpec, TypeVar

import httpx
import numpy as np
import numpy.typing as npt

from api.service.runtime import Runtime
from api.settings import load_settings
from benchmarks.deployment import service, veilface
from benchmarks.end_to_end import (
    UNLIMITED,
    Person,
    enroll_photos,
    people_of,
    verify_photos,
    with_clear_faces,
)
from models.decoding import decode_image
from models.pack import ModelPack

P = ParamSpec("P")
T = TypeVar("T")


class Clock:
    """Milliseconds by step, over many rounds."""

    def __init__(self) -> None:
        self.steps: dict[str, list[float]] = {}

    def time(self, step: str, call: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
        """Run ``call`` and book its time under ``step``."""
        started = time.perf_counter()
        result = call(*args, **kwargs)
        self.steps.setdefault(step, []).append(1000 * (time.perf_counter() - started))
        return result

    def medians(self) -> dict[str, float]:
        """Median of every step."""
        return {step: round(median(times), 3) for step, times in self.steps.items()}


def main() -> None:
    """Time rounds of request and bare inference, then each step of the service in this process."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--pack", type=Path, help="default: DATA/packs/w600k_mbf")
    parser.add_argument("--work", type=Path, required=True, help="holds contract and decoys")
    parser.add_argument("--master-key", type=Path, help="default: WORK/master.key")
    parser.add_argument("--rounds", type=int, default=200)
    parser.add_argument("--threads", type=int, default=1)
    args = parser.parse_args()
    packs = args.pack or args.data / "packs" / "w600k_mbf"
    pack = ModelPack.load(packs, threads=args.threads)
    people = with_clear_faces(people_of(args.data / "lfw" / "photos"), pack)
    clock = Clock()
    with ExitStack() as stack:
        fresh = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        settings = {
            "VEILFACE_DATA_DIR": str(fresh),
            "VEILFACE_DATABASE_URL": f"sqlite:///{fresh / 'veilface.db'}",
            "VEILFACE_PACK": str(packs),
            "VEILFACE_DECOYS_FILE": str(args.work / "decoys.veil"),
            "VEILFACE_CONTRACT_FILE": str(args.work / "contract.json"),
            "VEILFACE_MASTER_KEY_FILE": str(args.master_key or args.work / "master.key"),
            "VEILFACE_ONNX_THREADS": str(args.threads),
            **UNLIMITED,
        }
        env = os.environ | settings
        token = json.loads(
            veilface("keys", "create", "--json", "--right", "enroll", "--right", "verify", env=env)
        )["token"]
        address = stack.enter_context(service(env, workers=1, log=fresh / "serve.log"))
        client = stack.enter_context(
            httpx.Client(base_url=address, headers={"Authorization": f"Bearer {token}"}, timeout=60)
        )
        enrolled = people[:8]
        for person in enrolled:
            enroll_photos(client, person, None).raise_for_status()
        attempts = [(person, photo) for person in enrolled for photo in person.probes]
        for turn in range(-10, args.rounds):
            person, photo = attempts[turn % len(attempts)]
            image = decode_image(photo.read_bytes())

            if turn < 0:
                bare_inference(pack, image)
                request(client, person, photo)
                continue
            clock.time("bare inference", bare_inference, pack, image)
            clock.time("request", request, client, person, photo)
        os.environ.update(settings)
        steps = steps_of(Runtime.open(load_settings()), pack, attempts, args.rounds)
    totals = clock.medians()
    ratio = [
        a / b for a, b in zip(clock.steps["request"], clock.steps["bare inference"], strict=True)
    ]
    report = {
        "rounds": args.rounds,
        "onnx_threads": args.threads,
        "median_ms": totals,
        "overhead_ms": round(totals["request"] - totals["bare inference"], 3),
        "ratio_of_medians": round(totals["request"] / totals["bare inference"], 3),
        "median_of_ratios": round(median(ratio), 3),
        "steps_median_ms": steps,
    }
    print(json.dumps(report, indent=2))


def bare_inference(pack: ModelPack, image: npt.NDArray[np.uint8]) -> None:
    """Detect, align and embed one decoded photo."""
    face = max(pack.detect(image), key=lambda found: found.area)
    pack.embed(pack.align(image, face)[None])


def request(client: httpx.Client, person: Person, photo: Path) -> None:
    """Verify one photo over HTTP."""
    verify_photos(client, person.name, (photo,), "fmr-1e-3").raise_for_status()


def steps_of(
    runtime: Runtime, pack: ModelPack, attempts: Sequence[tuple[Person, Path]], rounds: int
) -> dict[str, float]:
    """Median milliseconds of every step of a request, run one by one in this process."""
    clock = Clock()
    tenant = runtime.settings.default_tenant
    verifier = runtime.verifier(tenant, runtime.epoch(tenant))
    for turn in range(rounds):
        person, photo = attempts[turn % len(attempts)]
        data = photo.read_bytes()
        image = clock.time("decode the photo", decode_image, data)
        faces = clock.time("detect", pack.detect, image)
        face = max(faces, key=lambda found: found.area)
        crop = clock.time("align", pack.align, image, face)
        embedding = clock.time("embed", pack.embed, crop[None])[0]
        stored = clock.time("fetch and decrypt", runtime.store.subjects.get, tenant, person.name)
        if stored is None:
            raise SystemExit(f"{person.name} is not enrolled")
        clock.time("compare and decide", verifier.decide_embedding, embedding, stored)
    runtime.close()
    return clock.medians()


if __name__ == "__main__":
    main()
