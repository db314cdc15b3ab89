"""``veilface enroll`` and ``veilface verify``: on this machine, against the store itself."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from api.cli.console import counted, demo_notice, message, progress
from api.cli.errors import CommandError, UsageError, sentence
from api.cli.files import read_photo
from api.cli.options import LOCAL, Tenant
from api.cli.photo_folders import Albums, albums_of
from api.cli.results import Result, Table, reports
from api.http.audit import operator
from api.http.errors import ApiError
from api.service.opening import weak_privacy
from api.service.runtime import Runtime
from api.settings import DEFAULT_TENANT, Settings
from enroll import Enrollment
from enroll.enroller import MAX_PHOTOS, Holder
from models.errors import ModelError, PhotoRejected
from models.pack import ModelPack
from models.selection import FacePolicy
from templates.decoys import Attributes
from templates.errors import StoreBusy, StoreUnavailable, VeilfaceError
from templates.keys.holder_key import (
    new_holder_key,
    read_holder_key,
    write_holder_key,
)
from templates.space.agreement import InconsistentImages
from templates.store.audit_log import Entry
from templates.store.identifiers import checked_subject_id
from templates.store.subject_rows import Source
from templates.store.subjects import Precondition
from verify import MAX_PROBE_PHOTOS, probe_of_photos

Subject = Annotated[str, typer.Argument(help="Id of the person.")]
Face = Annotated[
    FacePolicy,
    typer.Option(
        help="Which face counts in a photo of several: `dominant`, the largest if it covers the "
        "middle and has twice the area of every other; `largest`, wherever it is; `single`, none."
    ),
]
HolderKeyFile = Annotated[
    Path | None,
    typer.Option(
        help="Private file with the holder's key: 43 characters of base64url.", show_default=False
    ),
]


@reports(*LOCAL)
def enroll(
    subject: Annotated[
        str | None, typer.Argument(help="Id of the person.", show_default=False)
    ] = None,
    photos: Annotated[
        list[Path] | None,
        typer.Argument(help=f"1 to {MAX_PHOTOS} photos of that person.", show_default=False),
    ] = None,
    *,
    settings: Settings,
    people: Annotated[
        Path | None,
        typer.Option(
            "--from",
            metavar="PEOPLE",
            help="Enroll many: a folder with a subfolder of photos for each person, whose name is "
            f"the id; or a CSV file with the columns subject and photo. At most {MAX_PHOTOS} "
            "photos of each are taken.",
        ),
    ] = None,
    gender: Annotated[
        str | None,
        typer.Option(help="For a hybrid+ contract: used for lifting, never stored."),
    ] = None,
    race: Annotated[
        str | None,
        typer.Option(help="For a hybrid+ contract: used for lifting, never stored."),
    ] = None,
    tenant: Tenant = DEFAULT_TENANT,
    face: Face = FacePolicy.DOMINANT,
    holder_key_file: HolderKeyFile = None,
    new_holder_key_file: Annotated[
        Path | None,
        typer.Option(
            help="Make a holder's key, and write it into this file, which must not exist yet."
        ),
    ] = None,
    no_replace: Annotated[
        bool, typer.Option("--no-replace", help="Refuse a person who is enrolled already.")
    ] = False,
    replace: Annotated[
        str | None,
        typer.Option(
            metavar="TEMPLATE_ID", help="Replace the enrollment with this template id only."
        ),
    ] = None,
) -> Result:
    """Enroll a person from photos, or replace their enrollment; or enroll many with --from.

    Needs: what `serve` needs (contract, decoys, pack); the service may run meanwhile. Three photos
    are better than one. Only the private template is stored. With a holder's key it accepts nobody
    without that key, which is not stored: if the file is lost, the person enrolls again. With
    --from, exit status 1 means that somebody was not enrolled; the others are.

    Example: `veilface enroll alice alice-1.jpg alice-2.jpg alice-3.jpg --pack buffalo_l`
    """
    if no_replace and replace is not None:
        raise UsageError("give --no-replace or --replace, not both")
    precondition = None if not no_replace and replace is None else Precondition(replace)
    attributes = Attributes(gender, race)
    if people is not None:
        if subject is not None or replace or holder_key_file or new_holder_key_file:
            raise UsageError("--from enrolls many: no SUBJECT, --replace or holder's key beside it")
        albums = albums_of(people)
        with _opened(settings, tenant) as entrance:
            return _enrolled_all(entrance, albums, attributes, face, precondition)
    if subject is None or not photos:
        raise UsageError("name a person and 1 to 10 photos; or many people with --from")
    if len(photos) > MAX_PHOTOS:
        raise UsageError(f"an enrollment has 1 to {MAX_PHOTOS} photos, not {len(photos)}")
    if holder_key_file is not None and new_holder_key_file is not None:
        raise UsageError("give --holder-key-file or --new-holder-key-file, not both")
    if new_holder_key_file is not None:
        holder_key: bytearray | None = new_holder_key()
    else:
        holder_key = None if holder_key_file is None else read_holder_key(holder_key_file)
    with _opened(settings, tenant) as entrance:
        subject = checked_subject_id(subject)
        holder = None if holder_key is None else Holder(holder_key, entrance.tenant, subject)
        prepared = _prepared(entrance, photos, attributes, face, holder)
        if new_holder_key_file is not None and holder_key is not None:
            # Before the enrollment, which is of no use without it.
            write_holder_key(new_holder_key_file, holder_key)
        facts = _stored(entrance, subject, prepared, len(photos), precondition)
        _note_privacy(entrance.runtime)
    notice = demo_notice(entrance.pack.info.embedder_sha256, n=entrance.pack.info.n)
    done = "Replaced the enrollment of" if facts["replaced"] else "Enrolled"
    return Result(
        {
            **facts,
            "tenant": entrance.tenant,
            "holder_key": prepared[1].holder_salt is not None,
            **notice,
        },
        f"{done} {subject} from {counted(len(photos), 'photo')}; stored {len(prepared[1].wire)} "
        "bytes.",
    )


@dataclass(frozen=True)
class _Entrance:
    """What enrolls and verifies: the deployment, its pack, and a tenant's name."""

    runtime: Runtime
    pack: ModelPack
    tenant: str


_SEVERAL_FACES = "A photo that shows several faces may be taken with --face largest."


def _enrolled_all(
    entrance: _Entrance,
    albums: Albums,
    attributes: Attributes,
    face: FacePolicy,
    precondition: Precondition | None,
) -> Result:
    """Enroll everybody who can be, and say who could not and why.

    Where the database fails, nobody else is tried, and all who remain have its reason.
    """
    enrolled: list[dict[str, Any]] = []
    failed = [{"subject_id": name, "message": why} for name, why in albums.left_out.items()]
    outage: str | None = None
    with progress("enrolling people", len(albums.photos)) as advance:
        for subject, album in albums.photos.items():
            photos, why = album[:MAX_PHOTOS], outage
            try:
                if outage is None:
                    prepared = _prepared(entrance, photos, attributes, face, None)
                    enrolled.append(_stored(entrance, subject, prepared, len(photos), precondition))
            except (VeilfaceError, ModelError, OSError) as error:
                why = sentence(error)
                if isinstance(error, StoreUnavailable) and not isinstance(error, StoreBusy):
                    outage = why
            if why is not None:
                failed.append({"subject_id": subject, "message": why})
            advance(1)
    _note_privacy(entrance.runtime)
    info = entrance.pack.info
    notice = demo_notice(info.embedder_sha256, n=info.n)
    reasons = [(one["subject_id"], one["message"]) for one in failed]
    report: list[str | Table] = []
    if failed:
        report = [Table("Not enrolled", ("person", "why"), reasons), _SEVERAL_FACES]
    used = sum(one["photos"] for one in enrolled)
    people = len(enrolled) + len(failed)
    text = f"Enrolled {len(enrolled):,} of {people:,} people, from {counted(used, 'photo')}."
    return Result(
        {"tenant": entrance.tenant, "enrolled": enrolled, "failed": failed, **notice},
        [*report, text],
        status=1 if failed else 0,
    )


def _prepared(
    entrance: _Entrance,
    photos: Sequence[Path],
    attributes: Attributes,
    face: FacePolicy,
    holder: Holder | None,
) -> tuple[int, Enrollment]:
    """Make the template of some photos; returned with the epoch of its rotation."""
    runtime, pack, tenant = entrance.runtime, entrance.pack, entrance.tenant
    data = [read_photo(photo) for photo in photos]
    epoch = runtime.epoch(tenant)
    with _named(photos):
        return epoch, runtime.enroller(tenant, epoch).from_photos(
            pack,
            data,
            attributes=attributes,
            holder=holder,
            policy=face,
        )


def _stored(
    entrance: _Entrance,
    subject: str,
    prepared: tuple[int, Enrollment],
    photos: int,
    precondition: Precondition | None,
) -> dict[str, Any]:
    """Store the template of somebody; returned is what ``--json`` says of it."""
    epoch, enrollment = prepared
    stored = entrance.runtime.put(
        entrance.tenant,
        subject,
        epoch,
        enrollment,
        source=Source.PHOTOS,
        photos=photos,
        precondition=precondition,
        by=operator(),
    )
    return {
        "subject_id": subject,
        "template_id": stored.template_id,
        "contract_id": enrollment.contract_id,
        "replaced": not stored.created,
        "photos": photos,
    }


def _note_privacy(runtime: Runtime) -> None:
    if (weakness := weak_privacy(runtime.contract)) is not None:
        message(f"note: privacy is not proven: {weakness}")


@reports(*LOCAL)
def verify(
    subject: Subject,
    photos: Annotated[
        list[Path],
        typer.Argument(
            help=f"1 to {MAX_PROBE_PHOTOS} photos to check, of one person.", show_default=False
        ),
    ],
    *,
    settings: Settings,
    level: Annotated[
        str | None,
        typer.Option(
            help="Security level, not below the setting `lowest_level`. Unset: the contract's "
            "default."
        ),
    ] = None,
    tenant: Tenant = DEFAULT_TENANT,
    face: Face = FacePolicy.DOMINANT,
    holder_key_file: HolderKeyFile = None,
) -> Result:
    """Check whether photos show a person; exit status 0 if accepted, 1 if rejected.

    Several photos are averaged, which rejects the right person less often. Exit status 3 means that
    no decision was made, and stderr says why. Needs: what `serve` needs; the service may run
    meanwhile. The decision goes into the audit log; it neither counts towards the subject's lockout
    nor is stopped by it. An enrollment with a holder's key rejects everybody without the same one.

    Example: `veilface verify alice now-1.jpg now-2.jpg now-3.jpg --pack buffalo_l --level fmr-1e-4`
    """
    if len(photos) > MAX_PROBE_PHOTOS:
        raise UsageError(f"a verification takes 1 to {MAX_PROBE_PHOTOS} photos, not {len(photos)}")
    holder_key = None if holder_key_file is None else read_holder_key(holder_key_file)
    data = [read_photo(photo) for photo in photos]
    with _opened(settings, tenant) as entrance:
        runtime, pack, name = entrance.runtime, entrance.pack, entrance.tenant
        read = runtime.read(name, subject)
        if read is None:
            raise CommandError(f"nobody is enrolled as {subject!r} in tenant {name}")
        template, verifier = read[0], read[1].verifier
        try:
            level = runtime.levels.in_force(level)
        except ApiError as error:
            raise UsageError(error.message) from None
        with _named(photos):
            probe = probe_of_photos(
                pack, runtime.contract, data,
                passive=False, policy=face,
            )  # fmt: skip
        decision = verifier.decide_embedding(
            probe.embedding, template, holder_key=holder_key, level=level, photos=probe.photos
        ).with_advice(clear=probe.clear)
        outcome = "accept" if decision.accepted else "reject"
        # Another action than the service's: what an operator tries is not counted by the lockout.
        pseudonym = runtime.store.signer.pseudonym(name, subject)
        runtime.store.audit_log.record(
            Entry("verify-locally", outcome, operator(), name, pseudonym)
        )
    notice = demo_notice(pack.info.embedder_sha256, n=pack.info.n)
    advice = [] if decision.advice is None else [decision.advice]
    return Result(
        {
            "decision": outcome,
            "reason": decision.reason,
            "level": decision.level,
            "fmr": decision.fmr,
            "contract_id": decision.contract_id,
            "calibration_id": decision.calibration_id,
            **({"advice": decision.advice} if advice else {}),
            **notice,
        },
        [f"{outcome}: {subject}, level {decision.level}, FMR {decision.fmr:g}", *advice],
        status=0 if decision.accepted else 1,
    )


@contextmanager
def _named(photos: Sequence[Path]) -> Iterator[None]:
    """Say of what is wrong with a photo which file it is."""
    try:
        yield
    except PhotoRejected as error:
        raise CommandError(f"{photos[error.index].name}: {error.cause}") from None
    except InconsistentImages as error:
        raise CommandError(error.sentence([photo.name for photo in photos])) from None


@contextmanager
def _opened(settings: Settings, tenant: str) -> Iterator[_Entrance]:
    """Open the deployment.

    Only the default tenant is made where it is missing.
    """
    runtime = Runtime.open(settings)
    try:
        if runtime.pack is None:
            raise UsageError("photos need a model pack; name it with --pack")
        tenants = runtime.store.tenants
        known = tenants.create(tenant) if tenant == DEFAULT_TENANT else tenants.get(tenant)
        yield _Entrance(runtime, runtime.pack, known.name)
    finally:
        runtime.close()
