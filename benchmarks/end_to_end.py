"""FRR and FMR of the running service on real photos, beside raw embeddings on the same attempts.

Builds the decoys and the contract with the command line, or takes those of a folder, starts
``veilface serve`` with two workers, enrolls the first photos of every person over HTTP, then
verifies the others, one by one or several in a request, against the person (genuine) and against
other people (impostor). An enrollment that is refused counts as failed genuine attempts. Every
answer that is not a decision is counted by its status.

Example
-------
::

    python -m benchmarks.end_to_end --data ../shared/data --dim 16 --database sqlite
    python -m benchmarks.end_to_end --prepared FOLDER --enrolled 2 --burst 3 --level fmr-1e-4
"""

import argparse
import base64
import csv
import json
import os
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import httpx
import numpy as np
import numpy.typing as npt

from benchmarks.deployment import database, service, settings_of, veilface
from models.cache import EmbeddingCache
from models.errors import FaceError
from models.extraction import Extractor
from models.pack import ModelPack
from models.selection import FacePolicy
from templates.contract.wire import encode
from templates.decoys import DecoyGenerator
from templates.keys.sealing import KeyringSealer, MasterKeyring
from templates.space.lifting import Strategy, lift
from verify.datasets import labelled_folder
from verify.metrics import wilson
from verify.trials import unit_means

UNLIMITED = {
    "VEILFACE_ACCEPT_WEAK_PRIVACY": "true",
    "VEILFACE_LOCKOUT_AFTER": "0",
    "VEILFACE_RATE_LIMIT_KEY": "off",
    "VEILFACE_RATE_LIMIT_ADDRESS": "off",
}
"""Settings under which every impostor attempt is decided: rates are measured, not defences."""


Photos = tuple[Path, ...]


@dataclass(frozen=True)
class Person:
    """A person of the folder, with the photos of enrollment and those of the probes."""

    name: str
    enroll: list[Path]
    probes: list[Path]
    burst: int = 1

    @property
    def bursts(self) -> list[Photos]:
        """The photos of every probe; those that fill none are left out."""
        starts = range(0, len(self.probes) - self.burst + 1, self.burst)
        return [tuple(self.probes[start : start + self.burst]) for start in starts]


@dataclass
class AttemptCounts:
    """Counts of one run; rates come with 95 % Wilson intervals."""

    genuine_rejected: int = 0
    genuine: int = 0
    impostor_accepted: int = 0
    impostor: int = 0
    refused_enrollments: dict[str, str] = field(default_factory=dict)
    other_answers: Counter[str] = field(default_factory=Counter)

    def summary(self) -> dict[str, object]:
        """Counts, rates and intervals, as they are reported."""
        return {
            "frr": rate(self.genuine_rejected, self.genuine),
            "fmr": rate(self.impostor_accepted, self.impostor),
            "refused_enrollments": self.refused_enrollments,
            "answers_that_are_no_decision": dict(self.other_answers),
        }


def rate(errors: int, trials: int) -> dict[str, object]:
    """``errors / trials`` with its counts and 95 % Wilson interval."""
    low, high = wilson(errors, trials)
    return {
        "errors": errors,
        "trials": trials,
        "percent": round(100 * errors / trials, 3),
        "ci95_percent": [round(100 * low, 3), round(100 * high, 3)],
    }


def people_of(folder: Path, *, enrolled: int = 3, burst: int = 1) -> list[Person]:
    """People of ``folder/Name/*.jpg`` with photos for at least one probe beyond those enrolled."""
    people = []
    for person in sorted(p for p in folder.iterdir() if p.is_dir()):
        photos = sorted(person.glob("*.jpg"))
        if len(photos) >= enrolled + burst:
            people.append(Person(person.name, photos[:enrolled], photos[enrolled:], burst))
    return people


def with_clear_faces(people: Sequence[Person], pack: ModelPack) -> list[Person]:
    """Those of whom the service takes every photo: each shows one face that is clearly meant."""
    return [
        person
        for person in people
        if all(_is_usable(pack, photo) for photo in (*person.enroll, *person.probes))
    ]


def _is_usable(pack: ModelPack, photo: Path) -> bool:
    try:
        pack.crop_photo(photo.read_bytes())
    except FaceError:
        return False
    return True


def impostor_attempts(people: Sequence[Person], each: int) -> Iterator[tuple[Person, Photos]]:
    """``each`` other people, evenly spread over the list, for every probe."""
    count = len(people)
    steps = np.unique(np.linspace(1, count - 1, each).astype(int))
    for position, person in enumerate(people):
        for probe in person.bursts:
            for step in steps:
                yield people[(position + int(step)) % count], probe


def enroll_photos(
    client: httpx.Client,
    person: Person,
    attributes: dict[str, str] | None,
    *,
    face: str = FacePolicy.DOMINANT,
    holder_key: str | None = None,
) -> httpx.Response:
    """PUT the person's enrollment photos."""
    fields = {"face": face} | ({"attributes": json.dumps(attributes)} if attributes else {})
    return client.put(
        f"/v1/subjects/{person.name}/enrollment",
        files=[("images", (p.name, p.read_bytes(), "image/jpeg")) for p in person.enroll],
        data=fields | ({} if holder_key is None else {"holder_key": holder_key}),
    )


def verify_photos(
    client: httpx.Client,
    subject: str,
    photos: Photos,
    level: str,
    *,
    face: str = FacePolicy.DOMINANT,
) -> httpx.Response:
    """POST the photos of one probe."""
    return client.post(
        f"/v1/subjects/{subject}/verify",
        files=[("images", (p.name, p.read_bytes(), "image/jpeg")) for p in photos],
        data={"level": level, "face": face},
    )


def mean_embedding(pack: ModelPack, photos: Sequence[Path]) -> npt.NDArray[np.float32]:
    """Unit mean of the most central faces' embeddings, (n,): no photo is refused."""
    faces = [pack.embed_photo(p.read_bytes(), policy=None, quality=None).embedding for p in photos]
    mean: npt.NDArray[np.float32] = unit_means(np.array([faces]))[0]
    return mean


@dataclass(frozen=True)
class LiftingClient:
    """A device that embeds and lifts by itself and sends only private templates."""

    pack: ModelPack
    generator: DecoyGenerator
    contract_id: str
    strategy: Strategy
    m: int

    @classmethod
    def connect(cls, client: httpx.Client, pack: ModelPack) -> "LiftingClient":
        """Fetch what lifting needs: the contract and the decoy generator, never a pool."""
        binding = client.get("/v1/contract").raise_for_status().json()
        generator = client.get("/v1/contract/generator").raise_for_status()
        return cls(
            pack=pack,
            generator=DecoyGenerator.from_bytes(generator.content),
            contract_id=binding["contract_id"],
            strategy=Strategy(binding["binding"]["strategy"]),
            m=binding["binding"]["m"],
        )

    def template(self, photos: Sequence[Path], m: int) -> str:
        """Base64 of the wire bytes: the photos' mean embedding, lifted once to dimension m."""
        mean = mean_embedding(self.pack, photos)
        points = self.generator.project(mean[None])
        lifted = lift(points, strategy=self.strategy, m=m, source=self.generator)
        return base64.b64encode(encode(lifted[0], contract_id=self.contract_id)).decode()


def decide(counts: AttemptCounts, answer: httpx.Response, *, genuine: bool) -> None:
    """Count one answer; a genuine attempt that gets no decision is a rejection."""
    accepted = answer.status_code == 200 and answer.json()["decision"] == "accept"
    if answer.status_code != 200:
        code = answer.json()["error"]["code"]
        counts.other_answers[f"{answer.status_code} {code}"] += 1
    if genuine:
        counts.genuine += 1
        counts.genuine_rejected += not accepted
    else:
        counts.impostor += 1
        counts.impostor_accepted += accepted


def attempt_all(
    client: httpx.Client,
    people: Sequence[Person],
    *,
    level: str,
    face: str,
    impostors: int,
    attributes: dict[str, dict[str, str]] | None,
    lifting: LiftingClient | None,
    probe_dim: int,
    clients: int,
) -> AttemptCounts:
    """Enroll everybody, then verify every genuine and impostor attempt."""
    counts = AttemptCounts()
    probes: dict[Photos, str] = {}
    if lifting:
        probes = {p: lifting.template(p, probe_dim) for person in people for p in person.bursts}

    def enroll(person: Person) -> httpx.Response:
        if lifting:
            return client.put(
                f"/v1/subjects/{person.name}/enrollment",
                json={"template": lifting.template(person.enroll, lifting.m)},
            )
        labels = attributes[person.name] if attributes else None
        return enroll_photos(client, person, labels, face=face)

    def verify(attempt: tuple[str, Photos]) -> httpx.Response:
        subject, photos = attempt
        if lifting:
            return client.post(
                f"/v1/subjects/{subject}/verify",
                json={"template": probes[photos], "level": level},
            )
        return verify_photos(client, subject, photos, level, face=face)

    with ThreadPoolExecutor(clients) as pool:
        for person, answer in zip(people, pool.map(enroll, people), strict=True):
            if answer.status_code not in (200, 201):
                counts.refused_enrollments[person.name] = answer.json()["error"]["code"]
        genuine = [(person.name, photos) for person in people for photos in person.bursts]
        for answer in pool.map(verify, genuine):
            decide(counts, answer, genuine=True)
        enrolled = [p for p in people if p.name not in counts.refused_enrollments]
        others = [
            (person.name, photos) for person, photos in impostor_attempts(enrolled, impostors)
        ]
        for answer in pool.map(verify, others):
            decide(counts, answer, genuine=False)
    return counts


def raw_outcome(
    pack: ModelPack,
    people: Sequence[Person],
    calibration: Path,
    *,
    fmr: float,
    impostors: int,
    cache: EmbeddingCache | None,
) -> dict[str, object]:
    """The same attempts with raw embeddings and a cosine threshold at the same FMR target.

    The threshold comes from all cross-identity pairs of single photos of the calibration faces,
    people of the attempts left out; means of several photos pass it more often than the target
    says, strangers' too.
    """
    names = {person.name for person in people}
    faces = labelled_folder(calibration)
    keep = [i for i, name in enumerate(faces.identities) if name not in names]
    crops = Extractor(pack, aligned=True, cache=cache).extract([faces.paths[i] for i in keep])
    identity = np.unique([faces.identities[i] for i in keep], return_inverse=True)[1]
    cosines = crops.descriptors @ crops.descriptors.T
    impostor = cosines[np.triu(identity[:, None] != identity[None, :], k=1)]
    allowed = int(fmr * impostor.size)
    threshold = float(np.partition(impostor, impostor.size - allowed - 1)[-allowed - 1])

    means = {p.name: mean_embedding(pack, p.enroll) for p in people}
    probes = {photos: mean_embedding(pack, photos) for p in people for photos in p.bursts}

    def accepted(person: Person, photos: Photos) -> bool:
        return bool(probes[photos] @ means[person.name] > threshold)

    counts = AttemptCounts()
    for person in people:
        for photos in person.bursts:
            counts.genuine += 1
            counts.genuine_rejected += not accepted(person, photos)
    for person, photos in impostor_attempts(people, impostors):
        counts.impostor += 1
        counts.impostor_accepted += accepted(person, photos)
    return {"cosine_threshold": round(threshold, 4)} | counts.summary()


def predicted_attributes(
    pack: ModelPack,
    people: Sequence[Person],
    fairface: Path,
    *,
    cache: EmbeddingCache | None,
    neighbours: int = 10,
) -> dict[str, dict[str, str]]:
    """Gender and race of every person by K-NN of their enrollment photos on FairFace labels."""
    with (fairface / "fairface_label_train.csv").open(newline="") as table:
        labels = {row["file"]: row for row in csv.DictReader(table)}
    gallery = Extractor(pack, cache=cache).extract([fairface / name for name in labels])
    rows = [labels[str(path.relative_to(fairface))] for path in gallery.paths]
    predicted: dict[str, dict[str, str]] = {}
    for person in people:
        votes: dict[str, Counter[str]] = {"gender": Counter(), "race": Counter()}
        for photo in person.enroll:
            sample = pack.embed_photo(photo.read_bytes(), policy=None, quality=None)
            for index in np.argsort(gallery.descriptors @ sample.embedding)[-neighbours:]:
                for attribute, count in votes.items():
                    count[rows[int(index)][attribute]] += 1
        predicted[person.name] = {a: count.most_common(1)[0][0] for a, count in votes.items()}
    return predicted


def prepare(args: argparse.Namespace, work: Path, env: dict[str, str]) -> None:
    """Decoys and contract by the command line, people of the attempts left out."""
    data = args.data
    cache = ["--cache", args.cache] if args.cache else []
    probe_dims = ["--probe-dims", str(args.probe_dim or "none")]
    kind = "pool" if args.pool else "generator"
    veilface(
        "decoys", "build", data / "fairface" / "train", "--pack", args.pack,
        "--kind", kind, *cache, "--out", work / "decoys.veil", env=env,
    )  # fmt: skip
    veilface(
        "calibrate", data / "lfw" / "aligned112", "--aligned", "--pack", args.pack,
        "--decoys", work / "decoys.veil", "--strategy", args.strategy, "--dim", str(args.dim),
        *probe_dims, "--exclude-people", data / "lfw" / "photos",
        *cache, "--out", work / "contract.json", env=env,
    )  # fmt: skip


def main() -> None:
    """Run one configuration and print its figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--pack", type=Path, help="default: DATA/packs/w600k_mbf")
    parser.add_argument("--strategy", default="adversarial")
    parser.add_argument("--dim", type=int, default=16)
    parser.add_argument("--pool", action="store_true", help="real decoys, not generated ones")
    parser.add_argument("--probe-dim", type=int, default=0, help="0: photos; else lifted probes")
    parser.add_argument("--prepared", type=Path, help="folder of decoys, contract, master key")
    parser.add_argument("--enrolled", type=int, default=3, help="photos of an enrollment")
    parser.add_argument("--burst", type=int, default=1, help="photos of a probe")
    parser.add_argument("--database", choices=["sqlite", "postgresql"], default="sqlite")
    parser.add_argument("--level", default="fmr-1e-3")
    parser.add_argument("--face", choices=list(FacePolicy), default=FacePolicy.DOMINANT)
    parser.add_argument("--impostors", type=int, default=20, help="other people for each probe")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--clients", type=int, default=4)
    parser.add_argument("--work", type=Path, help="keep decoys, contract, database and log here")
    parser.add_argument("--cache", type=Path, help="sealed embeddings, shared between runs")
    parser.add_argument("--master-key", type=Path, help="the key file that the cache belongs to")
    args = parser.parse_args()
    args.pack = args.pack or args.data / "packs" / "w600k_mbf"

    with ExitStack() as stack:
        work = args.work or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        work.mkdir(parents=True, exist_ok=True)
        made = args.prepared or work
        url = stack.enter_context(database(args.database, work))
        settings = settings_of(work, args.pack, url, made=made, master_key=args.master_key)
        env = os.environ | settings | UNLIMITED
        started = time.perf_counter()
        if not args.prepared:
            prepare(args, work, env)
        prepared = time.perf_counter()
        token = json.loads(
            veilface(
                "keys",
                "create",
                "--json",
                "--right",
                "enroll",
                "--right",
                "verify",
                "--right",
                "embeddings",
                env=env,
            )
        )["token"]
        pack = ModelPack.load(args.pack)
        keyring = MasterKeyring.load(Path(env["VEILFACE_MASTER_KEY_FILE"]))
        cache = EmbeddingCache.open_file(args.cache, KeyringSealer(keyring)) if args.cache else None
        people = people_of(args.data / "lfw" / "photos", enrolled=args.enrolled, burst=args.burst)
        attributes = (
            predicted_attributes(pack, people, args.data / "fairface", cache=cache)
            if args.strategy == "hybrid+"
            else None
        )
        address = stack.enter_context(service(env, workers=args.workers, log=work / "serve.log"))
        client = stack.enter_context(
            httpx.Client(
                base_url=address,
                headers={"Authorization": f"Bearer {token}"},
                timeout=120,
                # A kept connection stays with one worker; new ones reach all of them.
                limits=httpx.Limits(max_keepalive_connections=0),
            )
        )
        attempted = time.perf_counter()
        counts = attempt_all(
            client,
            people,
            level=args.level,
            face=args.face,
            impostors=args.impostors,
            attributes=attributes,
            lifting=LiftingClient.connect(client, pack) if args.probe_dim else None,
            probe_dim=args.probe_dim,
            clients=args.clients,
        )
        finished = time.perf_counter()
        target = float(args.level.removeprefix("fmr-"))
        report = {
            "pack": args.pack.name,
            "strategy": args.strategy,
            "decoys": "pool" if args.pool else "generator",
            "m": client.get("/v1/contract").json()["binding"]["m"],
            "probe_m": args.probe_dim,
            "photos": {"enrolled": args.enrolled, "shown": args.burst},
            "database": args.database,
            "level": args.level,
            "face": args.face,
            "workers": args.workers,
            "service": counts.summary(),
            "raw": raw_outcome(
                pack,
                people,
                args.data / "lfw" / "aligned112",
                fmr=target,
                impostors=args.impostors,
                cache=cache,
            ),
            "seconds": {
                "decoys_and_calibration": round(prepared - started, 1),
                "attempts": round(finished - attempted, 1),
            },
        }
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
