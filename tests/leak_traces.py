"""A deployment in use, and every byte that it leaves behind.

:func:`exercise` starts the real service on a database, sends it good and bad requests, erases one
person, stops it, and keeps what was in every file, table and stream at each moment.
"""

import base64
import io
import itertools
import json
import os
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import psycopg
import sqlalchemy as sa
from numpy.typing import NDArray
from PIL import Image

from templates.contract.wire import decode, encode
from templates.decoys import client_source
from templates.keys.rotation import Rotation, TenantRotation
from templates.keys.sealing import MasterKeyring
from templates.space.lifting import Strategy, lift
from templates.store import TemplateStore
from templates.store.api_keys import Right
from tests.leak_material import PEOPLE, PROBE_M, Material, Photo
from tests.leak_places import (
    copied_tables,
    files_of,
    open_files,
    relation_files,
)
from tests.patience import PATIENCE_S

ROOT = Path(__file__).resolve().parent.parent
LEVEL = "fmr-1e-2"


@dataclass(frozen=True)
class Victim:
    """The person who is erased, as the database knew them."""

    subject_id: str
    row_id: str
    template_id: str
    pseudonym: str
    ciphertext: bytes = field(repr=False)
    wrapped_key: bytes = field(repr=False)

    @property
    def ciphertext_pieces(self) -> list[bytes]:
        """Pieces short enough that a page boundary spoils few."""
        return _pieces(self.ciphertext[1:])

    @property
    def key_pieces(self) -> list[bytes]:
        """Pieces of nonce and ciphertext; version and key id before them are everybody's."""
        return _pieces(self.wrapped_key[9:])


def _pieces(blob: bytes) -> list[bytes]:
    return [blob[at : at + 12] for at in range(0, len(blob) - 12, 12)]


@dataclass(frozen=True)
class OpenedTemplate:
    """The arrays of a decrypted template as they are on the wire: foot point, then basis."""

    rows: NDArray[np.float64] = field(repr=False)
    rotation: Rotation = field(repr=False)


@dataclass(repr=False)
class ServiceTraces:
    """What happened and what was left, by moment: running, erased, stopped, compacted."""

    kind: str
    material: Material
    database_url: str
    folder: Path
    subjects: list[str]
    token: str = ""
    holder_key: bytes = field(default_factory=lambda: secrets.token_bytes(32), repr=False)
    decisions: dict[str, list[str]] = field(default_factory=dict)
    refused: list[str] = field(default_factory=list)
    expected_refusals: list[str] = field(default_factory=list)
    refused_bodies: list[bytes] = field(default_factory=list)
    answers: bytes = b""
    running: dict[str, bytes] = field(default_factory=dict)
    erased: dict[str, bytes] = field(default_factory=dict)
    stopped: dict[str, bytes] = field(default_factory=dict)
    rows: dict[str, dict[str, bytes]] = field(default_factory=dict)
    values: dict[str, dict[str, list[list[bytes]]]] = field(default_factory=dict)
    relations: dict[str, dict[str, bytes]] = field(default_factory=dict)
    files_hidden: str = ""
    open_during_upload: dict[str, bytes] = field(default_factory=dict)
    templates: dict[str, OpenedTemplate] = field(default_factory=dict)
    lifted: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    victim: Victim = Victim("", "", "", "", b"", b"")
    contract_answer: Any = None
    receipt_answer: Any = None

    @property
    def pool(self) -> NDArray[np.float64]:
        """Every decoy."""
        return self.material.pool.astype(np.float64)

    def descriptors_of(self, subject: str) -> NDArray[np.float64]:
        """The unit mean of the photos that were enrolled, then that of each photo."""
        photos = self.material.enrolled[self.subjects.index(subject)]
        rows = np.array([photo.embedding for photo in photos], dtype=np.float64)
        mean = rows.mean(axis=0)
        return np.concatenate([(mean / np.linalg.norm(mean))[None], rows])

    @property
    def burst(self) -> list[Photo]:
        """Photos of one person that are verified together."""
        return self.material.enrolled[1][:2]

    @property
    def vectors(self) -> dict[str, NDArray[Any]]:
        """Every array that must not be found in the clear."""
        photos = list(itertools.chain(*self.material.enrolled))
        embedded = {f"embedding of enrolled photo {i}": p.embedding for i, p in enumerate(photos)}
        embedded |= {
            f"embedding of probe photo {i}": photo.embedding
            for i, photo in enumerate([*self.material.probes, self.material.large])
        }
        mean = np.mean([photo.embedding for photo in self.burst], axis=0, dtype=np.float64)
        embedded |= {"plain mean of a burst": mean, "mean of a burst": mean / np.linalg.norm(mean)}
        for number, subject in enumerate(self.subjects):
            rows = self.descriptors_of(subject)
            embedded[f"descriptor {number}"] = rows[0]
            embedded[f"plain mean {number}"] = rows[1:].mean(axis=0)
        embedded |= {f"decoy {i}": row for i, row in enumerate(self.pool)}
        embedded |= {f"lifted probe, row {i}": row for i, row in enumerate(self.lifted)}
        turned, stored = {}, {}
        rows = np.stack(list(embedded.values()))
        for number, template in enumerate(self.templates.values()):
            stored[f"template {number}, rotated"] = template.rows
            stored[f"template {number}"] = template.rotation.turned_back(template.rows)
            for name, row in zip(embedded, template.rotation.turned(rows), strict=True):
                turned[f"{name}, turned as template {number}"] = row
        inputs = {
            f"model input {i}": ((p.crop - self.material.mean) / self.material.scale).transpose(
                2, 0, 1
            )
            for i, p in enumerate([*photos, *self.material.probes, self.material.large])
        }
        return {**embedded, **turned, **stored, **inputs}

    @property
    def strings(self) -> dict[str, bytes]:
        """The photos as files, pixels and crops."""
        named = {}
        photos = [*itertools.chain(*self.material.enrolled), *self.material.probes]
        for number, photo in enumerate([*photos, self.material.large]):
            named[f"file {number}"] = photo.data
            for what, array in (("pixels", photo.pixels), ("crop", photo.crop)):
                named[f"{what} {number}"] = array.tobytes()
                named[f"{what} {number}, BGR"] = array[:, :, ::-1].tobytes()
                named[f"{what} {number}, planar"] = array.transpose(2, 0, 1).tobytes()
        return named

    def unseen_at(self, moment: str) -> dict[str, bytes]:
        """Everything there was at a moment; what was the same before is left out."""
        order = ["running", "erased", "stopped"]
        now = {**getattr(self, moment), **_named("table", self.rows.get(moment, {}))}
        now |= _named("relation file", self.relations.get(moment, {}))
        if moment == "running":
            now |= _named("open file", self.open_during_upload)
        if moment == "stopped":
            now["answers"] = self.answers
        before = order[: order.index(moment)]
        known = {content for each in before for content in getattr(self, each).values()}
        return {name: content for name, content in now.items() if content not in known}

    def database_bytes(self, moment: str) -> bytes:
        """The database: all of SQLite's files, or all rows of PostgreSQL's tables."""
        if self.kind == "postgres":
            return b"\0".join(self.rows[moment].values())
        files = getattr(self, moment)
        return b"\0".join(v for name, v in files.items() if name.startswith("data/veilface.db"))

    def is_temporary(self, target: str) -> bool:
        """Whether an open file is one that nobody meant to keep."""
        homes = (tempfile.gettempdir(), str(self.folder), "/memfd:")
        ours = (str(self.folder / "data"), str(self.folder / "out"), str(self.folder / "err"))
        return target.endswith("(deleted)") or (
            target.startswith(homes) and not target.startswith(ours)
        )


def _named(what: str, contents: dict[str, bytes]) -> dict[str, bytes]:
    return {f"{what} {name}": content for name, content in contents.items()}


def exercise(material: Material, folder: Path, *, database_url: str) -> ServiceTraces:
    """Live through the day on one database."""
    traces = ServiceTraces(
        kind="sqlite" if database_url.startswith("sqlite") else "postgres",
        material=material,
        database_url=database_url,
        folder=folder,
        subjects=[f"{secrets.token_hex(8)}.{number}" for number in range(PEOPLE)],
    )
    shutil.copytree(material.folder, folder / "data")
    (folder / "tmp").mkdir()
    (folder / "home").mkdir()
    ours = ("VEILFACE_", "XDG_", "ORT_")
    environment = {k: v for k, v in os.environ.items() if not k.startswith(ours)} | {
        "HOME": str(folder / "home"),
        "PYTHONUNBUFFERED": "1",
        "TMPDIR": str(folder / "tmp"),
        "VEILFACE_DATA_DIR": str(folder / "data"),
        "VEILFACE_MASTER_KEY_FILE": str(folder / "data" / "master.key"),
        "VEILFACE_DATABASE_URL": database_url,
        "VEILFACE_PACK": str(material.pack_dir),
        "VEILFACE_LOG_LEVEL": "debug",
    }
    with (folder / "out").open("wb") as out, (folder / "err").open("wb") as err:
        process = subprocess.Popen(
            [sys.executable, "-m", "veilface", "serve", "--port", "0", "--workers", "2"],
            cwd=ROOT, env=environment, stdout=out, stderr=err,
        )  # fmt: skip
    try:
        url = _await_ready(process, folder)
        rights = [word for right in Right for word in ("--right", right)]
        made = subprocess.run(
            [sys.executable, "-m", "veilface", "keys", "create", *rights, "--json"],
            cwd=ROOT, env=environment, check=True, capture_output=True,
        )  # fmt: skip
        traces.token = json.loads(made.stdout)["token"]
        subprocess.run(
            [sys.executable, "-m", "veilface", "db", "template-enrollment", "--allow"],
            cwd=ROOT, env=environment, check=True, capture_output=True,
        )  # fmt: skip
        headers = {"Authorization": f"Bearer {traces.token}"}
        with httpx.Client(base_url=url, headers=headers, timeout=PATIENCE_S) as client:
            client.event_hooks["response"] = [lambda answer: _keep(traces, answer)]
            _enroll_and_verify(traces, client, process.pid)
            _enroll_with_a_key(traces, client)
            _send_bad_requests(traces, client)
            _open_the_store(traces)
            _look(traces, "running")
            answer = client.delete(f"/v1/subjects/{traces.subjects[0]}")
            assert answer.status_code == 200, answer.text
            traces.receipt_answer = answer.json()
            assert client.get(f"/v1/subjects/{traces.subjects[0]}").status_code == 404
            traces.contract_answer = client.get("/v1/contract").json()
            _look(traces, "erased")
        process.send_signal(signal.SIGTERM)
        process.wait(timeout=PATIENCE_S)
    finally:
        process.kill()
        process.wait()
    _look(traces, "stopped")
    if traces.kind == "postgres":
        _compact(traces)
    return traces


def _await_ready(process: "subprocess.Popen[bytes]", folder: Path) -> str:
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline and process.poll() is None:
        told = (folder / "err").read_text()
        if "listens on " in told:
            url = told.split("listens on ", 1)[1].split()[0]
            try:
                if httpx.get(f"{url}/health/ready", timeout=PATIENCE_S).status_code == 200:
                    return url
            except httpx.TransportError:
                pass
        time.sleep(0.1)
    raise AssertionError((folder / "err").read_text())


def _keep(traces: ServiceTraces, answer: httpx.Response) -> None:
    traces.answers += answer.read() + b"\n" + repr(answer.headers).encode() + b"\n"


def form(*photos: Photo, name: str = "images") -> list[tuple[str, tuple[str, bytes, str]]]:
    """Photos for httpx's ``files=``."""
    return [(name, (f"{i}.jpg", photo.data, "image/jpeg")) for i, photo in enumerate(photos)]


def _enroll_and_verify(traces: ServiceTraces, client: httpx.Client, pid: int) -> None:
    material = traces.material
    for subject, photos in zip(traces.subjects, material.enrolled, strict=True):
        answer = client.put(f"/v1/subjects/{subject}/enrollment", files=form(*photos))
        assert answer.status_code == 201, answer.text

    def decide(kind: str, subject: str, **body: Any) -> None:
        path = f"/v1/subjects/{subject}/verify"
        for fields, sent in (("data", "files"), ("json", "json")):
            if sent in body:
                body[fields] = {"level": LEVEL, **body.get(fields, {})}
        answer = client.post(path, **body)
        assert answer.status_code == 200, answer.text
        traces.decisions.setdefault(kind, []).append(answer.json()["decision"])

    for number, subject in enumerate(traces.subjects):
        # Nearly orthogonal: who is only a little similar is let in by chance now and then. An
        # opposite face will not do, because a combination of decoys can turn its sign.
        face = traces.descriptors_of(subject)[0]
        others = [probe for i, probe in enumerate(material.probes) if i != number]
        stranger = min(others, key=lambda probe: abs(float(probe.embedding @ face)))
        decide("genuine", subject, files=form(material.probes[number], name="image"))
        decide("impostor", subject, files=form(stranger, name="image"))
    probe = material.probes[1].embedding
    decide("embedding", traces.subjects[1], json={"embedding": probe.astype(float).tolist()})
    decide("burst", traces.subjects[1], files=form(*traces.burst))
    rows = [photo.embedding.astype(float).tolist() for photo in traces.burst]
    decide("embeddings", traces.subjects[1], json={"embeddings": rows})
    wire = _lifted(traces)
    decide("lifted", traces.subjects[1], json={"template": base64.b64encode(wire).decode()})

    request = client.build_request(
        "POST", "/", files=form(material.large, name="image"), data={"level": LEVEL}
    )
    body = request.read()

    def slowly() -> Iterator[bytes]:
        yield body[: len(body) // 2]
        yield body[len(body) // 2 : -100]
        time.sleep(0.5)  # the workers have taken in what was sent
        traces.open_during_upload = open_files(pid)
        yield body[-100:]

    decide(
        "large upload",
        traces.subjects[1],
        content=slowly(),
        headers={
            "Content-Type": request.headers["Content-Type"],
            "Content-Length": str(len(body)),
        },
    )


def _enroll_with_a_key(traces: ServiceTraces, client: httpx.Client) -> None:
    """Somebody else, whose template needs a key; it is sent in each place where it may stand."""
    key = base64.urlsafe_b64encode(traces.holder_key).decode()
    path = f"/v1/subjects/{secrets.token_hex(8)}"
    photos = traces.material.enrolled[1]
    text = key.rstrip("=")
    answer = client.put(f"{path}/enrollment", files=form(*photos), data={"holder_key": text})
    assert (answer.status_code, answer.json()["holder_key"]) == (201, True), answer.text

    def verify(**options: Any) -> httpx.Response:
        return client.post(f"{path}/verify", **options)

    numbers = photos[0].embedding.astype(float).tolist()
    answers = [
        verify(files=form(photos[0], name="image"), data={"holder_key": text}),
        verify(json={"embedding": numbers, "holder_key": key}),
    ]
    assert [answer.json()["decision"] for answer in answers] == ["accept"] * 2
    assert verify(json={"embedding": numbers}).json()["decision"] == "reject"
    refused = [
        verify(json={"embedding": numbers, "holder_key": key[:-2]}),
        verify(json={"embedding": numbers}, params={"holder_key": key}),
    ]
    assert [answer.status_code for answer in refused] == [422] * 2


def _lifted(traces: ServiceTraces) -> bytes:
    """Lift a probe as a client does; keep its rows as things that must not be found."""
    material = traces.material
    lifted = lift(
        material.probes[1].embedding[None],
        strategy=Strategy.HYBRID,
        m=PROBE_M,
        source=client_source(material.source),
    )[0]
    traces.lifted = np.concatenate([lifted.foot[None], lifted.basis]).astype(np.float64)
    return encode(lifted, contract_id=material.contract_id)


def _send_bad_requests(traces: ServiceTraces, client: httpx.Client) -> None:
    """Each kind of refusal, with real numbers and real pictures in what is refused."""
    material = traces.material
    photos = material.probes
    subject = f"/v1/subjects/{traces.subjects[1]}"
    numbers = photos[1].embedding.astype(float).tolist()
    text = json.dumps(numbers)
    wire = _lifted(traces)
    foreign = wire.replace(material.contract_id.encode(), b"0" * 64)
    side_by_side = io.BytesIO()
    pair = np.concatenate([photos[1].pixels, photos[2].pixels], axis=1)
    Image.fromarray(pair).save(side_by_side, "JPEG", quality=95)
    both = {"images": ("pair.jpg", side_by_side.getvalue(), "image/jpeg")}
    faceless = io.BytesIO()
    Image.fromarray(photos[1].pixels[:40]).resize((250, 40)).save(faceless, "JPEG")

    def b64(data: bytes) -> str:
        return base64.b64encode(data).decode()

    def verify(expected: str, **body: Any) -> None:
        send(expected, "POST", f"{subject}/verify", **body)

    def enroll(expected: str, **body: Any) -> None:
        send(expected, "PUT", f"{subject}/enrollment", **body)

    def send(expected: str, method: str, path: str, **options: Any) -> None:
        answer = client.request(method, path, **options)
        traces.expected_refusals.append(expected)
        traces.refused.append(answer.json().get("error", {}).get("code", str(answer.status_code)))
        traces.refused_bodies.append(answer.content)

    wrong_key = {"Authorization": "Bearer " + traces.token[:-4] + "0000"}
    verify("unauthorized", json={"embedding": numbers}, headers=wrong_key)
    verify("malformed_request", content=f'{{"embedding": {text}'.encode(),
           headers={"Content-Type": "application/json"})  # fmt: skip
    verify("invalid_embedding", json={"embedding": [1.5 * number for number in numbers]})
    verify("invalid_embedding", json={"embedding": numbers[:-1]})
    verify("invalid_embedding", json={"embedding": [*numbers[:-1], 1e30]})
    verify("invalid_embedding", json={"embedding": text})
    verify("validation_failed", json={"embedding": numbers, "template": b64(wire)})
    verify("validation_failed", json={"embedding": numbers, text[:60]: 1})
    verify("validation_failed", json={"embedding": numbers}, params={"levle": text[:200]})
    verify("invalid_template", json={"template": b64(wire[:-10])})
    verify("invalid_template", json={"template": b64(wire)[:-3] + "!!!"})
    verify("contract_mismatch", json={"template": b64(foreign)})
    enroll("invalid_template", json={"template": b64(wire)})
    verify("uncalibrated", json={"embedding": numbers, "level": "fmr-1e-9"})
    send("not_enrolled", "POST", "/v1/subjects/nobody/verify", json={"embedding": numbers})
    send("not_found", "GET", f"/v1/{traces.subjects[1]}")
    send("method_not_allowed", "POST", subject)
    enroll("inconsistent_images", files=form(photos[1], photos[2]))
    enroll("too_many_images", files=form(*[photos[1]] * 11))
    enroll("multiple_faces", files=both)
    enroll("no_face", files={"images": ("x.jpg", faceless.getvalue(), "image/jpeg")})
    enroll("unsupported_image", files={"images": ("x.jpg", photos[1].data[:3000], "image/jpeg")})
    enroll("malformed_request", files=form(photos[1]), data={"attributes": text})
    enroll("request_too_large", json={"template": 2 * b64(material.large.data)})
    enroll("enrollment_conflict", files=form(photos[1]), headers={"If-None-Match": "*"})


def _open_the_store(traces: ServiceTraces) -> None:
    """Decrypt every template, and remember how the person to be erased is stored."""
    store = TemplateStore(
        traces.database_url, MasterKeyring.load(traces.folder / "data" / "master.key")
    )
    try:
        key = store.tenants.rotation_key("default", 1)
        rotation = TenantRotation(key, traces.material.pool.shape[1])
        for subject in traces.subjects:
            opened = store.subjects.get("default", subject)
            assert opened is not None
            subspace = decode(opened.wire).subspace
            m, n = subspace.basis.shape
            payload = np.frombuffer(opened.wire[-2 * n * (m + 1) :], dtype="<f2")
            rows = payload.astype(np.float64).reshape(m + 1, n)
            # The reader's foot point agrees: these are the arrays of the format, foot first.
            assert np.allclose(subspace.foot, rows[0], atol=1e-3)
            traces.templates[subject] = OpenedTemplate(rows, rotation.of(opened.template_id))
        pseudonym = store.signer.pseudonym("default", traces.subjects[0])
    finally:
        store.close()
    engine = sa.create_engine(_driver(traces.database_url))
    with engine.connect() as connection:
        row = connection.execute(
            sa.text(
                "SELECT id, template_id, ciphertext, wrapped_key FROM subjects "
                "WHERE subject_id = :subject"
            ),
            {"subject": traces.subjects[0]},
        ).one()
    engine.dispose()
    traces.victim = Victim(
        traces.subjects[0], row.id, row.template_id, pseudonym, row.ciphertext, row.wrapped_key
    )


def _driver(url: str) -> str:
    return url.replace("postgresql://", "postgresql+psycopg://")


def _look(traces: ServiceTraces, moment: str) -> None:
    """Keep every byte there is now."""
    if traces.kind == "postgres":
        with psycopg.connect(traces.database_url, autocommit=True) as connection:
            traces.rows[moment] = copied_tables(connection)
            try:
                traces.relations[moment] = relation_files(connection)
            except psycopg.errors.InsufficientPrivilege as error:
                traces.files_hidden = type(error).__name__
    setattr(traces, moment, files_of(traces.folder))
    traces.values[moment] = _values(traces)


def _compact(traces: ServiceTraces) -> None:
    store = TemplateStore(
        traces.database_url, MasterKeyring.load(traces.folder / "data" / "master.key")
    )
    try:
        store.database.compact()
    finally:
        store.close()
    if not traces.files_hidden:
        with psycopg.connect(traces.database_url, autocommit=True) as connection:
            traces.relations["compacted"] = relation_files(connection)


def _values(traces: ServiceTraces) -> dict[str, list[list[bytes]]]:
    """Every row of every table, each column as bytes."""
    engine = sa.create_engine(_driver(traces.database_url))
    tables = {}
    with engine.connect() as connection:
        for name in sa.inspect(connection).get_table_names():
            rows = connection.execute(sa.select(sa.text("*")).select_from(sa.table(name)))
            tables[name] = [
                [value if isinstance(value, bytes) else str(value).encode() for value in row]
                for row in rows
            ]
    engine.dispose()
    return tables
