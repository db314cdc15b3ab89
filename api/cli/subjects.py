"""``veilface enroll`` and ``veilface verify``: on this machine, against the store itself."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer

from api.cli.console import counted, demo_notice, message
from api.cli.errors import CommandError, UsageError
from api.cli.files import read_photo
from api.cli.options import LOCAL, Tenant
from api.cli.results import Result, reports
from api.http.audit import operator
from api.http.errors import ApiError
from api.service.opening import weak_privacy
from api.service.runtime import Runtime
from api.settings import Settings
from enroll.enroller import MAX_PHOTOS, Holder
from models.errors import PhotoRejected
from models.pack import ModelPack
from models.selection import FacePolicy
from templates.decoys import Attributes
from templates.keys.holder_key import (
    new_holder_key,
    read_holder_key,
    write_holder_key,
)
from templates.space.agreement import InconsistentImages
from templates.store.audit_log import Entry
from templates.store.subject_rows import Source
from templates.store.subjects import Precondition
from verify import MAX_PROBE_PHOTOS, probe_of_photos

Subject = Annotated[str, typer.Argument(help="Id of the person.")]
Face = Annotated[
    FacePolicy,
    typer.Option(
        help="A photo with several faces: use the largest if it covers the middle and has twice "
        "the area of every other; use the largest wherever it is; or refuse the photo."
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
    subject: Subject,
    photos: Annotated[
        list[Path],
        typer.Argument(help=f"1 to {MAX_PHOTOS} photos of that person."),
    ],
    *,
    settings: Settings,
    gender: Annotated[
        str | None,
        typer.Option(help="For a hybrid+ contract: used for lifting, never stored."),
    ] = None,
    race: Annotated[
        str | None,
        typer.Option(help="For a hybrid+ contract: used for lifting, never stored."),
    ] = None,
    tenant: Tenant = None,
    face: Face = FacePolicy.SINGLE,
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
    """Enroll a person from photos, or replace their enrollment.

    Needs: what `serve` needs (contract, decoys, pack); the service may run meanwhile. All photos
    must show the same person. Only the private template is stored. With a holder's key it accepts
    nobody without that key, which is not stored: who loses the file enrolls again.

    Example: `veilface enroll alice alice-1.jpg alice-2.jpg alice-3.jpg --pack buffalo_l`
    """
    if len(photos) > MAX_PHOTOS:
        raise UsageError(f"an enrollment has 1 to {MAX_PHOTOS} photos, not {len(photos)}")
    if no_replace and replace is not None:
        raise UsageError("give --no-replace or --replace, not both")
    may_replace_all = not no_replace and replace is None
    if holder_key_file is not None and new_holder_key_file is not None:
        raise UsageError("give --holder-key-file or --new-holder-key-file, not both")
    if new_holder_key_file is not None:
        holder_key: bytearray | None = new_holder_key()
    else:
        holder_key = None if holder_key_file is None else read_holder_key(holder_key_file)
    data = [read_photo(photo, settings.max_image_bytes) for photo in photos]
    with _opened(settings, tenant) as (runtime, pack, name):
        epoch = runtime.epoch(name)
        with _named(photos):
            enrollment = runtime.enroller(name, epoch).from_photos(
                pack,
                data,
                attributes=Attributes(gender, race),
                holder=None if holder_key is None else Holder(holder_key, name, subject),
                policy=face,
                limits=runtime.image_limits,
            )
        if new_holder_key_file is not None and holder_key is not None:
            # Before the enrollment, which is of no use without it.
            write_holder_key(new_holder_key_file, holder_key)
        stored = runtime.put(
            name,
            subject,
            epoch,
            enrollment,
            source=Source.PHOTOS,
            photos=len(photos),
            precondition=None if may_replace_all else Precondition(replace),
            by=operator(),
        )
        if (weakness := weak_privacy(runtime.contract)) is not None:
            message(f"note: privacy is not proven: {weakness}")
    notice = demo_notice(pack.info.embedder_sha256, n=pack.info.n)
    done = "Enrolled" if stored.created else "Replaced the enrollment of"
    return Result(
        {
            "subject_id": subject,
            "tenant": name,
            "template_id": stored.template_id,
            "contract_id": enrollment.contract_id,
            "replaced": not stored.created,
            "holder_key": enrollment.holder_salt is not None,
            "photos": len(photos),
            **notice,
        },
        f"{done} {subject} from {counted(len(photos), 'photo')}; stored {len(enrollment.wire)} "
        "bytes.",
    )


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
    tenant: Tenant = None,
    face: Face = FacePolicy.SINGLE,
    holder_key_file: HolderKeyFile = None,
) -> Result:
    """Check whether photos show a person; exit status 0 if accepted, 1 if rejected.

    Several photos must show one person; they are averaged, and the right person is rejected less
    often. Exit status 2 is wrong usage, such as a missing photo; 3 means that no decision was made,
    and stderr says why. Needs: what `serve` needs; the service may run meanwhile. The decision goes
    into the audit log; it neither counts towards the subject's lockout nor is stopped by it. An
    enrollment that was made with a holder's key rejects everybody without the same one.

    Example: `veilface verify alice now-1.jpg now-2.jpg now-3.jpg --pack buffalo_l --level fmr-1e-4`
    """
    if len(photos) > MAX_PROBE_PHOTOS:
        raise UsageError(f"a verification takes 1 to {MAX_PROBE_PHOTOS} photos, not {len(photos)}")
    holder_key = None if holder_key_file is None else read_holder_key(holder_key_file)
    data = [read_photo(photo, settings.max_image_bytes) for photo in photos]
    with _opened(settings, tenant) as (runtime, pack, name):
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
                passive=False, policy=face, limits=runtime.image_limits,
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
def _opened(settings: Settings, tenant: str | None) -> Iterator[tuple[Runtime, ModelPack, str]]:
    """Open the deployment; with its pack, and the tenant's name.

    Only the default tenant is made where it is missing.
    """
    runtime = Runtime.open(settings)
    try:
        if runtime.pack is None:
            raise UsageError("photos need a model pack; name it with --pack")
        tenants, name = runtime.store.tenants, tenant or settings.default_tenant
        known = tenants.create(name) if name == settings.default_tenant else tenants.get(name)
        yield runtime, runtime.pack, known.name
    finally:
        runtime.close()
