"""The demo: the real service, with people who do not exist.

Without weights it builds the demo model, draws faces, makes the decoys and the contract by the
code of the commands, starts ``veilface serve`` as its own process, and talks to it over HTTP as
any client would: enroll, verify, erase. With a pack and a folder of faces everything is real.

What is printed is computed from the answers and from the database's file; :attr:`Outcome.faults`
holds whatever did not go as promised.
"""

import contextlib
import shutil
import sqlite3
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx

from api.cli.calibration import DEFAULT_PROBE_DIM, calibrate_folder
from api.demo.people import Cast, Scale, drawn_cast, found_cast
from api.demo.service import running_service
from api.demo.storage import KEY_FILE, Stored, create_key, read_stored, rows_of
from api.http.errors import StartError
from api.http.receipts import read_receipt_key, verify_answer
from api.http.routes.drawn_people import ENROLLED_PHOTOS
from api.service.opening import file_sealer
from api.service.settings_file import Value, settings_text
from models.demo import build_demo_pack, is_demo_model
from models.extraction import Extraction, Extractor
from models.pack import ModelPack
from templates.contract.document import Contract
from templates.contract.verdict import Verdict
from templates.keys.sealing import MasterKeyring
from templates.space.lifting import Strategy
from verify import CalibrationOptions
from verify.preparation import make_generator

MARKER = "# Written by `veilface demo`, which replaces this folder when it runs again."

Say = Callable[[str], None]


@dataclass(frozen=True)
class Counts:
    """How the service answered attempts on one person."""

    name: str
    genuine_accepted: int
    genuine_trials: int
    impostors_accepted: int
    impostor_trials: int


@dataclass(frozen=True)
class Outcome:
    """Everything that the demo found out."""

    demo_model: bool
    folder: Path
    pack: str
    contract_id: str
    verdict: Verdict | None
    strategy: str
    people: tuple[Counts, ...]
    level: str
    stored: tuple[Stored, ...]
    erased: str
    receipt: dict[str, Any]
    rows_after_erasure: int
    refused_photos: tuple[str, ...]
    seconds: float
    faults: tuple[str, ...]


def run_demo(
    folder: Path,
    *,
    pack: Path | None = None,
    faces: Path | None = None,
    m: int = 16,
    scale: Scale | None = None,
    say: Say = lambda _: None,
) -> Outcome:
    """Run the demo and leave ``folder`` ready for ``veilface serve``.

    Parameters
    ----------
    folder
        Where the data go. An earlier demo there is replaced; any other folder that is not empty
        is refused.
    pack, faces
        A model pack and a folder ``Person/photo.jpg`` for a real run; both or none.
    m
        Dimension of the templates.
    scale
        Numbers of people and photos that are drawn.
    say
        Called with what is being done.
    """
    started = time.monotonic()
    if (pack is None) != (faces is None):
        raise StartError("a real run needs both --pack and --faces")
    size = scale or Scale()
    _prepare_folder(folder)
    with tempfile.TemporaryDirectory(prefix="veilface-demo-") as scratch:
        if pack is None or faces is None:
            say("building the demo model and drawing faces")
            pack = build_demo_pack(folder / "pack")
            cast = drawn_cast(folder / "people", Path(scratch), size)
        else:
            cast = found_cast(faces, size)
        contract = _calibrate(folder, pack, cast, m=m, say=say)
    _write_settings(folder, pack, demo=is_demo_model(contract.binding.embedder_sha256))
    say("starting the service")
    with running_service(folder, create_key(folder)) as client:
        return _play(client, folder, pack, contract, cast, say=say, started=started)


def _require_unserved(folder: Path) -> None:
    """Refuse to remove a database that a service has open: it would go on as if it were there."""
    path = folder / "veilface.db"
    if not path.exists():
        return
    with contextlib.closing(sqlite3.connect(path, timeout=0)) as database:
        try:
            # SQLite leaves the write-ahead log only where no other connection is open.
            database.execute("PRAGMA journal_mode = DELETE")
        except sqlite3.OperationalError:
            raise StartError(
                f"{folder} is being served: stop `veilface serve` there, or choose another folder"
            ) from None
        except sqlite3.DatabaseError:
            pass  # no database any more


def _prepare_folder(folder: Path) -> None:
    settings = folder / "veilface.toml"
    if folder.exists() and any(folder.iterdir()):
        if not (settings.is_file() and settings.read_text(encoding="utf-8").startswith(MARKER)):
            raise StartError(f"{folder} is not empty and not a demo; choose another folder")
        _require_unserved(folder)
        shutil.rmtree(folder)
    folder.mkdir(parents=True, exist_ok=True)
    # Written first, so that a demo that is interrupted can be replaced.
    settings.write_text(MARKER + "\n", encoding="utf-8")


def _calibrate(folder: Path, pack_path: Path, cast: Cast, *, m: int, say: Say) -> Contract:
    """Do what ``decoys build`` and ``calibrate`` do."""
    pack, labelled = ModelPack.load(pack_path), cast.calibration
    say(f"embedding {len(cast.decoys)} faces for the decoys")
    generator = make_generator(_extract(pack, cast.decoys), pack)
    generator.save(folder / "decoys.veil")
    say(f"embedding {len(labelled)} photos of {labelled.people} people for the calibration")
    extraction = _extract(pack, labelled.paths)
    say("calibrating on private templates")
    done = calibrate_folder(
        labelled,
        extraction,
        pack=pack,
        source=generator,
        strategy=Strategy.ADVERSARIAL,
        axes=generator.k,
        m=m,
        options=CalibrationOptions(
            photos_per_enrollment=ENROLLED_PHOTOS, probe_dims=(0, DEFAULT_PROBE_DIM)
        ),
    )
    keyring = MasterKeyring.create(folder / KEY_FILE)
    done.contract.save(folder / "contract.json", file_sealer(keyring))
    return done.contract


def _extract(pack: ModelPack, photos: Sequence[Path]) -> Extraction:
    extraction = Extractor(pack).extract(photos)
    if not len(extraction.embeddings):
        raise StartError("no photo gave an embedding; are these photos of faces?")
    return extraction


def _write_settings(folder: Path, pack: Path, *, demo: bool) -> None:
    values: dict[str, Value] = {
        "data_dir": folder,
        "master_key_file": folder / KEY_FILE,
        "pack": pack,
        **({"demo": True} if demo else {}),
    }
    text = settings_text(
        values,
        MARKER.removeprefix("# "),
        "The master key is beside the database only here: a deployment keeps the two apart.",
    )
    (folder / "veilface.toml").write_text(text, encoding="utf-8")


def _play(
    client: httpx.Client,
    folder: Path,
    pack: Path,
    contract: Contract,
    cast: Cast,
    *,
    say: Say,
    started: float,
) -> Outcome:
    say(f"enrolling {len(cast.enrolled)} people over HTTP")
    refused: list[str] = []
    enrolled: list[str] = []
    for name, photos in cast.enrolled.items():
        path = f"/v1/subjects/{name}/enrollment"
        answer = _send(client, "PUT", path, photos[:ENROLLED_PHOTOS], face=cast.face)
        if answer.status_code == httpx.codes.CREATED:
            enrolled.append(name)
        else:
            refused.append(f"{name} was not enrolled: {_code(answer)}")
    if not enrolled:
        raise StartError("nobody could be enrolled: " + "; ".join(refused))
    say("verifying genuine and impostor photos over HTTP")
    people = tuple(_verify(client, cast, name, refused) for name in cast.enrolled)
    stored = read_stored(folder, enrolled)
    say("erasing one person and checking the receipt")
    erased = enrolled[0]
    receipt, faults = _erase(client, erased, cast.enrolled[erased][-1])
    rows = rows_of(folder, erased)
    if rows:
        faults.append(f"{rows} rows of {erased} are left in the database after the erasure")
    binding = contract.binding
    return Outcome(
        demo_model=is_demo_model(binding.embedder_sha256),
        folder=folder,
        pack=pack.name,
        contract_id=contract.contract_id,
        verdict=contract.verdict,
        strategy=f"{binding.strategy}, m = {binding.m}, n = {binding.n}",
        people=people,
        level=contract.default_level,
        stored=stored,
        erased=erased,
        receipt=receipt,
        rows_after_erasure=rows,
        refused_photos=tuple(dict.fromkeys(refused)),
        seconds=time.monotonic() - started,
        faults=(*faults, *faults_of(people)),
    )


def _verify(client: httpx.Client, cast: Cast, name: str, refused: list[str]) -> Counts:
    """Show one subject photos of this person, and of all others; count who is accepted.

    A photo that cannot be used counts as rejected. The failed attempts are forgotten at the end:
    `veilface serve` would take them for a lock.
    """

    def accepted(photo: Path) -> bool:
        path = f"/v1/subjects/{name}/verify"
        answer = _send(client, "POST", path, [photo], face=cast.face)
        if answer.status_code != httpx.codes.OK:
            refused.append(f"{photo.parent.name}/{photo.name}: {_code(answer)}")
            return False
        return bool(answer.json()["decision"] == "accept")

    genuine = [accepted(photo) for photo in cast.probes(name)]
    others = [photo for other in cast.enrolled if other != name for photo in cast.probes(other)]
    impostors = [accepted(photo) for photo in (*others, *cast.strangers)]
    client.delete(f"/v1/subjects/{name}/lockout").raise_for_status()
    return Counts(name, sum(genuine), len(genuine), sum(impostors), len(impostors))


def _send(
    client: httpx.Client, method: str, path: str, photos: Sequence[Path], **fields: str
) -> httpx.Response:
    files = [("images", (photo.name, photo.read_bytes())) for photo in photos]
    return client.request(method, path, files=files, data=fields)


def _code(answer: httpx.Response) -> str:
    return str(answer.json()["error"]["code"]) if answer.is_error else ""


def _erase(client: httpx.Client, name: str, photo: Path) -> tuple[dict[str, Any], list[str]]:
    faults = []
    answer = client.delete(f"/v1/subjects/{name}")
    if answer.is_error:
        return {}, [f"{name} was not erased: {_code(answer)}"]
    public_key = read_receipt_key(client.get("/v1/contract").json()["receipt_key"])
    claims = verify_answer(answer.json(), public_key)
    if not claims["held"]:
        faults.append("the receipt says that nothing was held")
    if _code(_send(client, "POST", f"/v1/subjects/{name}/verify", [photo])) != "not_enrolled":
        faults.append(f"{name} still answers after the erasure")
    return claims, faults


def faults_of(people: Sequence[Counts]) -> list[str]:
    """Say who was rejected, or taken for others, in most attempts."""
    return [
        f"{one.name} was rejected in most genuine attempts"
        for one in people
        if 2 * one.genuine_accepted < one.genuine_trials
    ] + [
        f"most impostors were accepted as {one.name}"
        for one in people
        if 2 * one.impostors_accepted > one.impostor_trials
    ]
