"""FRR and FMR of the running service on real photos, beside raw embeddings on the same attempts.

The first photos of every person are enrolled over HTTP; the others are verified, one by one or
several in a request, against the person (genuine) and against other people (impostor). With
--private the Python client embeds and lifts, and the service has no model pack.
"""

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks import deployment
from benchmarks.people import AttemptCounts, Person, attempt_all, impostor_attempts, people_of
from models.cache import EmbeddingCache
from models.extraction import Extractor
from models.pack import ModelPack
from models.selection import FacePolicy
from templates.keys.sealing import MasterKeyring, Sealer
from veilface_client import Client, PrivateClient
from verify.datasets import labelled_folder
from verify.trials import unit_means


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    deployment.add_options(parser)
    parser.add_argument("--private", action="store_true", help="lift on the client's side")
    parser.add_argument("--enrolled", type=int, default=3, help="photos of an enrollment")
    parser.add_argument("--burst", type=int, default=1, help="photos of a probe")
    parser.add_argument("--face", choices=list(FacePolicy), default=FacePolicy.DOMINANT)
    parser.add_argument("--impostors", type=int, default=20, help="other people for each probe")
    parser.add_argument("--people", type=int, help="the first so many")


def measure(args: argparse.Namespace) -> list[dict[str, object]]:
    """Return a row of the service, and one of raw embeddings."""
    people = people_of(args.data / "lfw" / "photos", enrolled=args.enrolled, burst=args.burst)
    people = people[: args.people]
    with deployment.running(args, workers=2, with_pack=not args.private) as service:
        client = (
            PrivateClient(service.url, service.token, pack=args.pack, dim=args.probe_dim)
            if args.private
            else Client(service.url, service.token)
        )
        started = time.perf_counter()
        with client:
            counts = attempt_all(
                client, people, level=args.level, face=args.face, impostors=args.impostors
            )
            m = client.contract().binding["m"]
        seconds = time.perf_counter() - started
        keyring = MasterKeyring.load(Path(service.env["VEILFACE_MASTER_KEY_FILE"]))
    cache = EmbeddingCache(args.work / "cache.veil", Sealer(keyring))
    run = {"level": args.level, "enrolled": args.enrolled, "shown": args.burst}
    means = "lifted probes" if args.private else "photos"
    raw = raw_counts(args, people, cache)
    return [
        {"sent": f"{means}, m = {m}", **run, **counts.row(), "s": round(seconds, 1)},
        {"sent": "raw embeddings", **run, **raw.row()},
    ]


def raw_counts(
    args: argparse.Namespace, people: Sequence[Person], cache: EmbeddingCache
) -> AttemptCounts:
    """The same attempts with raw embeddings and a cosine threshold at the same FMR target.

    The threshold comes from all cross-identity pairs of single photos of the calibration faces,
    people of the attempts left out; means of several photos pass it more often than the target
    says, strangers' too. No photo is refused.
    """
    pack = ModelPack.load(args.pack)
    names = {person.name for person in people}
    faces = labelled_folder(args.data / "lfw" / "aligned112")
    keep = [i for i, name in enumerate(faces.identities) if name not in names]
    crops = Extractor(pack, aligned=True, cache=cache).extract([faces.paths[i] for i in keep])
    identity = np.unique([faces.identities[i] for i in keep], return_inverse=True)[1]
    cosines = crops.embeddings @ crops.embeddings.T
    impostor = cosines[np.triu(identity[:, None] != identity[None, :], k=1)]
    allowed = int(float(args.level.removeprefix("fmr-")) * impostor.size)
    threshold = float(np.partition(impostor, impostor.size - allowed - 1)[-allowed - 1])

    def mean(photos: Sequence[Path]) -> NDArray[np.float32]:
        rows = [
            pack.embed_photo(photo.read_bytes(), policy=None, quality=None).embedding
            for photo in photos
        ]
        unit: NDArray[np.float32] = unit_means(np.array([rows]))[0]
        return unit

    enrolled = {person.name: mean(person.enroll) for person in people}
    probes = {photos: mean(photos) for person in people for photos in person.bursts}
    counts = AttemptCounts()
    for person in people:
        for photos in person.bursts:
            accepted = probes[photos] @ enrolled[person.name] > threshold
            counts.add(bool(accepted), genuine=True)
    for person, photos in impostor_attempts(people, args.impostors):
        accepted = probes[photos] @ enrolled[person.name] > threshold
        counts.add(bool(accepted), genuine=False)
    return counts
