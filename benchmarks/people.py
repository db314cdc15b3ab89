"""People of LFW with their photos, and the attempts that are made with them."""

import argparse
import base64
import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import numpy as np

from models.errors import FaceError
from models.pack import ModelPack
from veilface_client import Client, LiftFailed, PrivateClient, Probe, ServiceError
from verify.metrics import wilson

Photos = tuple[Path, ...]
KINDS = ("embedding", "template", "photo")
BOUNDARY = "veilface-load"


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


def people_of(folder: Path, *, enrolled: int = 3, burst: int = 1) -> list[Person]:
    """People of ``folder/Name/*.jpg`` with photos for at least one probe beyond those enrolled."""
    people = []
    for person in sorted(p for p in folder.iterdir() if p.is_dir()):
        photos = sorted(person.glob("*.jpg"))
        if len(photos) >= enrolled + burst:
            people.append(Person(person.name, photos[:enrolled], photos[enrolled:], burst))
    return people


def clear_people(
    args: argparse.Namespace, pack: ModelPack, most: int | None = None
) -> list[Person]:
    """Those of whom the service takes every photo: each shows one face that is clearly meant."""

    def usable(photo: Path) -> bool:
        try:
            pack.crop_photo(photo.read_bytes())
        except FaceError:
            return False
        return True

    people = people_of(args.data / "lfw" / "photos")[:most]
    return [person for person in people if all(map(usable, (*person.enroll, *person.probes)))]


def impostor_attempts(people: Sequence[Person], each: int) -> Iterator[tuple[Person, Photos]]:
    """``each`` other people, evenly spread over the list, for every probe."""
    count = len(people)
    steps = np.unique(np.linspace(1, count - 1, each).astype(int))
    for position, person in enumerate(people):
        for probe in person.bursts:
            for step in steps:
                yield people[(position + int(step)) % count], probe


@dataclass
class AttemptCounts:
    """Counts of one run; rates come with 95 % Wilson intervals."""

    genuine_rejected: int = 0
    genuine: int = 0
    impostor_accepted: int = 0
    impostor: int = 0
    refused_enrollments: dict[str, str] = field(default_factory=dict)
    other_answers: Counter[str] = field(default_factory=Counter)

    def add(self, accepted: bool, *, genuine: bool) -> None:
        """Count an attempt."""
        if genuine:
            self.genuine += 1
            self.genuine_rejected += not accepted
        else:
            self.impostor += 1
            self.impostor_accepted += accepted

    def row(self) -> dict[str, object]:
        """Return the rates as columns of a table."""
        return {
            "FRR": rate(self.genuine_rejected, self.genuine),
            "FMR": rate(self.impostor_accepted, self.impostor),
            "refused enrollments": len(self.refused_enrollments),
            "answers that are no decision": _listed(self.other_answers),
        }


def rate(errors: int, trials: int) -> str:
    """Return ``errors / trials`` in per cent with its 95 % Wilson interval."""
    low, high = wilson(errors, trials)
    percent = f"{100 * errors / max(trials, 1):.2f} % [{100 * low:.2f}, {100 * high:.2f}]"
    return f"{errors} / {trials} = {percent}"


def _listed(counts: Counter[str]) -> str:
    return ", ".join(f"{name} {count}" for name, count in sorted(counts.items())) or "none"


def attempt_all(
    client: Client | PrivateClient,
    people: Sequence[Person],
    *,
    level: str,
    face: Any,
    impostors: int,
) -> AttemptCounts:
    """Enroll everybody, then make every genuine and impostor attempt.

    A private client lifts each probe once, for all its attempts. A genuine attempt that gets no
    decision is a rejection, and a refused enrollment makes its genuine attempts such.
    """
    counts = AttemptCounts()
    lifted: dict[Photos, Probe | str] = {}

    def accepted(subject: str, photos: Photos) -> bool:
        probe: Photos | Probe | str = photos
        if isinstance(client, PrivateClient):
            if photos not in lifted:
                try:
                    lifted[photos] = client.lift(photos, face=face)
                except LiftFailed as error:
                    lifted[photos] = f"lift: {error.message.split(':')[0]}"
            probe = lifted[photos]
        if isinstance(probe, str):
            counts.other_answers[probe] += 1
            return False
        try:
            return client.verify(subject, probe, level=level, face=face).accepted  # type: ignore[arg-type]
        except ServiceError as error:
            counts.other_answers[f"{error.status} {error.code}"] += 1
            return False

    for person in people:
        try:
            client.enroll(person.name, person.enroll, face=face)
        except (ServiceError, LiftFailed) as error:
            counts.refused_enrollments[person.name] = str(error)
    for person in people:
        for photos in person.bursts:
            counts.add(accepted(person.name, photos), genuine=True)
    enrolled = [person for person in people if person.name not in counts.refused_enrollments]
    for person, photos in impostor_attempts(enrolled, impostors):
        counts.add(accepted(person.name, photos), genuine=False)
    return counts


@dataclass(frozen=True)
class Request:
    """A verification as bytes, to be sent any number of times."""

    subject: str
    content_type: str
    body: bytes

    @property
    def path(self) -> str:
        """Where it is posted."""
        return f"/v1/subjects/{self.subject}/verify"

    def with_key(self, holder_key: bytes) -> "Request":
        """Return the same request with a holder's key as its first field."""
        key = base64.urlsafe_b64encode(holder_key).decode()
        if self.content_type == "application/json":
            body = f'{{"holder_key": "{key}", '.encode() + self.body[1:]
        else:
            name = 'Content-Disposition: form-data; name="holder_key"'
            body = f"--{BOUNDARY}\r\n{name}\r\n\r\n{key}\r\n".encode() + self.body
        return Request(self.subject, self.content_type, body)

    def send(self, http: httpx.Client) -> httpx.Response:
        """Post it."""
        headers = {"Content-Type": self.content_type}
        return http.post(self.path, content=self.body, headers=headers)


def requests_of(
    kind: str, people: Sequence[Person], args: argparse.Namespace, url: str, token: str
) -> list[Request]:
    """Make a verification of one of :data:`KINDS` of every person's probes."""
    pack = ModelPack.load(args.pack, threads=1)
    made = []
    with PrivateClient(url, token, pack=args.pack, dim=args.probe_dim) as client:
        for person in people:
            for photo in person.probes:
                data = photo.read_bytes()
                if kind == "photo":
                    content = f"multipart/form-data; boundary={BOUNDARY}"
                    made.append(Request(person.name, content, _form(data, args.level)))
                    continue
                if kind == "template":
                    template = client.lift(data, face="dominant").template
                    fields: dict[str, Any] = {"template": base64.b64encode(template).decode()}
                else:
                    fields = {"embedding": pack.embed_photo(data).embedding.tolist()}
                body = json.dumps({**fields, "level": args.level}).encode()
                made.append(Request(person.name, "application/json", body))
    return made


def _form(photo: bytes, level: str) -> bytes:
    head = (
        f'--{BOUNDARY}\r\nContent-Disposition: form-data; name="level"\r\n\r\n{level}\r\n'
        f'--{BOUNDARY}\r\nContent-Disposition: form-data; name="image"; '
        'filename="x.jpg"\r\nContent-Type: image/jpeg\r\n\r\n'
    )
    return head.encode() + photo + f"\r\n--{BOUNDARY}--\r\n".encode()


def accepted_requests(http: httpx.Client, requests: Sequence[Request]) -> list[Request]:
    """Leave out those that are rejected: under the lockout they would stop their subject."""
    return [
        request
        for request in requests
        if (answer := request.send(http)).status_code == 200
        and answer.json()["decision"] == "accept"
    ]
