"""``veilface enroll`` and ``veilface verify``: on this machine, against the store itself."""

from pathlib import Path
from typing import Annotated, Any

import typer

from api.cli.console import demo_notice, emit, say
from api.cli.errors import CommandError, UsageError
from api.cli.files import read_bounded
from api.cli.options import LOCAL, AsJson, Tenant, takes_settings
from api.http.audit import operator
from api.http.errors import ApiError
from api.process.runtime import Runtime
from api.settings import Settings
from enroll.enroller import MAX_PHOTOS
from enroll.errors import InconsistentImages, PhotoRejected
from models.errors import ModelError
from models.pack import FacePolicy, ModelPack
from templates.decoys import Attributes
from templates.store.audit_log import Entry
from templates.store.subject_rows import Source

Subject = Annotated[str, typer.Argument(help="Id of the person.", show_default=False)]
Face = Annotated[
    FacePolicy,
    typer.Option(
        help="A photo with several faces: refuse it, or use the first by rank (large, and "
        "near the middle)."
    ),
]


def register(app: typer.Typer) -> None:
    """Add the commands."""
    app.command()(enroll)
    app.command()(verify)


@takes_settings(*LOCAL)
def enroll(
    subject: Subject,
    photos: Annotated[
        list[Path],
        typer.Argument(help=f"1 to {MAX_PHOTOS} photos of that person.", show_default=False),
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
    as_json: AsJson = False,
) -> None:
    """Enroll a person from photos, or replace their enrollment.

    Needs: what `serve` needs (contract, decoys, pack); the service may run meanwhile. All photos
    must show the same person. Only the private template is stored.

    Example: `veilface enroll alice alice-1.jpg alice-2.jpg alice-3.jpg --pack buffalo_l`
    """
    if len(photos) > MAX_PHOTOS:
        raise UsageError(f"an enrollment has 1 to {MAX_PHOTOS} photos, not {len(photos)}")
    data = [read_bounded(photo, settings.max_image_bytes) for photo in photos]
    runtime = Runtime.open(settings)
    try:
        pack = _required_pack(runtime)
        name = _tenant(runtime, tenant)
        epoch = runtime.epoch(name)
        try:
            enrollment = runtime.enroller(name, epoch).from_photos(
                pack,
                data,
                attributes=Attributes(gender, race),
                policy=face,
                limits=runtime.image_limits,
            )
        except PhotoRejected as error:
            raise CommandError(f"{photos[error.index].name}: {error.cause}") from None
        except InconsistentImages as error:
            raise CommandError(error.sentence([photo.name for photo in photos])) from None
        stored = runtime.put(
            name,
            subject,
            epoch,
            enrollment,
            source=Source.PHOTOS,
            photos=len(photos),
            by=operator(),
        )
        binding = runtime.contract.binding
        notice = demo_notice(binding.embedder_sha256, n=binding.n)
    finally:
        runtime.close()
    if as_json:
        emit(
            {
                "subject_id": subject,
                "tenant": name,
                "template_id": stored.template_id,
                "contract_id": enrollment.contract_id,
                "replaced": not stored.created,
                "photos": len(photos),
                **notice,
            }
        )
    else:
        done = "Enrolled" if stored.created else "Replaced the enrollment of"
        say(f"{done} {subject} from {len(photos)} photos; stored {len(enrollment.wire)} bytes.")


@takes_settings(*LOCAL)
def verify(
    subject: Subject,
    photo: Annotated[Path, typer.Argument(help="The photo to check.", show_default=False)],
    *,
    settings: Settings,
    level: Annotated[
        str | None,
        typer.Option(
            help="Security level, not below the setting `lowest_level`. Unset: the contract's "
            "default.",
            show_default=False,
        ),
    ] = None,
    tenant: Tenant = None,
    face: Face = FacePolicy.SINGLE,
    as_json: AsJson = False,
) -> None:
    """Check whether a photo shows a person; exit status 0 if accepted, 1 if rejected.

    Exit status 2 is wrong usage, such as a missing photo; 3 means that no decision was made, and
    stderr says why. Needs: what `serve` needs; the service may run meanwhile. The decision goes
    into the audit log; it neither counts towards the subject's lockout nor is stopped by it.

    Example: `veilface verify alice today.jpg --pack buffalo_l --level fmr-1e-4`
    """
    if not photo.exists():
        raise UsageError(f"no such photo: {photo}")
    data = read_bounded(photo, settings.max_image_bytes)
    runtime = Runtime.open(settings)
    try:
        pack = _required_pack(runtime)
        name = _tenant(runtime, tenant)
        read = runtime.read(name, subject)
        if read is None:
            raise CommandError(f"nobody is enrolled as {subject!r} in tenant {name}")
        found, room = read
        try:
            level = runtime.levels.in_force(level)
        except ApiError as error:
            raise UsageError(error.message) from None
        try:
            decision = room.verifier.decide_photo(
                pack, data, found.wire, level=level, policy=face, limits=runtime.image_limits
            )
        except ModelError as error:
            raise CommandError(f"{photo.name}: {error}") from None
        outcome = "accept" if decision.accepted else "reject"
        # Another action than the service's: what an operator tries is not counted by the lockout.
        pseudonym = runtime.store.signer.pseudonym(name, subject)
        runtime.store.audit_log.record(
            Entry("verify-locally", outcome, operator(), name, pseudonym)
        )
        binding = runtime.contract.binding
        notice = demo_notice(binding.embedder_sha256, n=binding.n)
    finally:
        runtime.close()
    answer: dict[str, Any] = {
        "decision": outcome,
        "reason": decision.reason,
        "level": decision.level,
        "fmr": decision.fmr,
        "contract_id": decision.contract_id,
        "calibration_id": decision.calibration_id,
        **notice,
    }
    if as_json:
        emit(answer)
    else:
        say(f"{answer['decision']}: {subject}, level {decision.level}, FMR {decision.fmr:g}")
    if not decision.accepted:
        raise typer.Exit(1)


def _required_pack(runtime: Runtime) -> ModelPack:
    if runtime.pack is None:
        raise UsageError("photos need a model pack; name it with --pack")
    return runtime.pack


def _tenant(runtime: Runtime, named: str | None) -> str:
    """Choose the tenant; only the default one is made where it is missing."""
    name = named or runtime.settings.default_tenant
    if name == runtime.settings.default_tenant:
        return runtime.store.tenants.create(name).name
    return runtime.store.tenants.get(name).name
