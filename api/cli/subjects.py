"""``veilface enroll`` and ``veilface verify``: on this machine, against the store itself."""

from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer

from api.cli import flags
from api.cli.console import demo_notice, message, progress
from api.cli.errors import CommandError, UsageError, sentence
from api.cli.files import naming_photo, read_photos
from api.cli.options import STORE, reports
from api.cli.photo_folders import albums_of
from api.cli.results import Result, Table
from api.http.audit import operator
from api.http.errors import ApiError
from api.service.opening import prepare_database, weak_privacy
from api.service.runtime import Runtime
from api.settings import DEFAULT_TENANT, Settings
from enroll.enroller import MAX_PHOTOS
from models.errors import ModelError
from models.pack import ModelPack
from models.selection import FacePolicy
from templates.errors import StoreBusy, StoreUnavailable, VeilfaceError
from templates.store.audit_log import Entry
from templates.store.identifiers import checked_subject_id
from templates.store.schema import Source
from verify import MAX_PROBE_PHOTOS, probe_of_photos

LOCAL = (*STORE, "pack", "providers", "onnx_threads")


@reports(*LOCAL)
def enroll(
    subject: Annotated[str | None, typer.Argument(help="Id of the person.")] = None,
    photos: Annotated[
        list[Path] | None, typer.Argument(help=f"1 to {MAX_PHOTOS} photos of that person.")
    ] = None,
    *,
    settings: Settings,
    people: Annotated[
        Path | None,
        typer.Option(
            "--from",
            metavar="PEOPLE",
            help="Enroll many: a folder with a subfolder of photos for each person, whose name is "
            "the id, or a CSV file `subject,photo`, with paths relative to it.",
        ),
    ] = None,
    tenant: flags.Tenant = DEFAULT_TENANT,
    face: flags.Face = FacePolicy.DOMINANT,
) -> Result:
    """Enroll a person from photos, or replace their enrollment; or enroll many with --from.

    Needs what `serve` needs; the service may run meanwhile. Three photos are better than one. Under
    a hybrid+ contract enroll over REST, which takes the attributes. With --from, exit status 1
    means that somebody was not enrolled; the others are.

    Example: `veilface enroll alice alice-1.jpg alice-2.jpg alice-3.jpg --pack buffalo_l`
    """
    if (people is None) == (subject is None) or (subject is not None and not photos):
        raise UsageError("name a person and 1 to 10 photos; or many people with --from, alone")
    albums, left_out = ({}, {}) if people is None else albums_of(people)
    with _opened(settings, tenant) as entrance:
        if subject is not None:
            facts = entrance.enroll(checked_subject_id(subject), photos or [], face)
            result = Result({**facts, "tenant": entrance.tenant, **demo_notice(entrance.pack.info)})
        else:
            result = _enroll_all(entrance, albums, left_out, face)
        if (weakness := weak_privacy(entrance.runtime.contract)) is not None:
            message(f"note: privacy is not proven: {weakness}")
    return result


@dataclass(frozen=True)
class _Entrance:
    """What enrolls and verifies: the deployment, its pack, and a tenant's name."""

    runtime: Runtime
    pack: ModelPack
    tenant: str

    def enroll(self, subject: str, photos: Sequence[Path], face: FacePolicy) -> dict[str, Any]:
        """Enroll somebody from photos; returned is what ``--json`` says of it."""
        data = read_photos(photos, most=MAX_PHOTOS)
        epoch = self.runtime.current_epoch(self.tenant)
        with naming_photo(photos):
            enrollment = epoch.enroller.from_photos(self.pack, data, policy=face)
        replaced = self.runtime.put(
            self.tenant,
            subject,
            epoch,
            enrollment,
            source=Source.PHOTOS,
            photos=len(photos),
            by=operator(),
        )
        return {
            "subject_id": subject,
            "template_id": enrollment.template_id,
            "contract_id": enrollment.contract_id,
            "replaced": replaced,
            "photos": len(photos),
        }


@contextmanager
def _opened(settings: Settings, tenant: str) -> Iterator[_Entrance]:
    """Open the deployment; only the default tenant is made where it is missing."""
    with closing(Runtime.open(settings)) as runtime:
        prepare_database(runtime.store)
        if runtime.pack is None:
            raise UsageError("photos need a model pack; name it with --pack")
        tenants = runtime.store.tenants
        known = tenants.create(tenant) if tenant == DEFAULT_TENANT else tenants.get(tenant)
        yield _Entrance(runtime, runtime.pack, known.name)


def _enroll_all(
    entrance: _Entrance, albums: dict[str, list[Path]], left_out: dict[str, str], face: FacePolicy
) -> Result:
    """Enroll everybody who can be, and say who could not and why.

    Where the database fails, nobody else is tried, and all who remain have its reason.
    """
    enrolled: list[dict[str, Any]] = []
    failed = dict(left_out)
    outage: str | None = None
    with progress("enrolling people", len(albums)) as advance:
        for subject, photos in albums.items():
            try:
                if outage is None:
                    enrolled.append(entrance.enroll(subject, photos[:MAX_PHOTOS], face))
                else:
                    failed[subject] = outage
            except (VeilfaceError, ModelError, OSError) as error:
                failed[subject] = sentence(error)
                if isinstance(error, StoreUnavailable) and not isinstance(error, StoreBusy):
                    outage = failed[subject]
            advance(1)
    used = sum(one["photos"] for one in enrolled)
    people = len(enrolled) + len(failed)
    report: list[str | Table] = [
        f"Enrolled {len(enrolled):,} of {people:,} people, from {used:,} photos."
    ]
    if failed:
        several = "A photo that shows several faces may be taken with --face largest."
        report[:0] = [Table("Not enrolled", ("person", "why"), [*failed.items()]), several]
    return Result(
        {
            "tenant": entrance.tenant,
            "enrolled": enrolled,
            "failed": [{"subject_id": name, "message": why} for name, why in failed.items()],
            **demo_notice(entrance.pack.info),
        },
        report,
        status=1 if failed else 0,
    )


@reports(*LOCAL)
def verify(
    subject: Annotated[str, typer.Argument(help="Id of the person.")],
    photos: Annotated[list[Path], typer.Argument(help=f"1 to {MAX_PROBE_PHOTOS} photos to check.")],
    *,
    settings: Settings,
    level: Annotated[
        str | None, typer.Option(help="Security level. Unset: the contract's default.")
    ] = None,
    tenant: flags.Tenant = DEFAULT_TENANT,
    face: flags.Face = FacePolicy.DOMINANT,
) -> Result:
    """Check whether photos show a person; exit status 0 if accepted, 1 if rejected.

    Exit status 3 means that no decision was made, and stderr says why. Needs what `serve` needs;
    the service may run meanwhile. The decision goes into the audit log; it neither counts towards
    the subject's lockout nor is stopped by it. It takes no holder's key, so it rejects everybody
    whose enrollment has one.

    Example: `veilface verify alice now-1.jpg now-2.jpg now-3.jpg --pack buffalo_l --level fmr-1e-4`
    """
    data = read_photos(photos, most=MAX_PROBE_PHOTOS)
    with _opened(settings, tenant) as entrance:
        runtime, pack = entrance.runtime, entrance.pack
        read = runtime.read(entrance.tenant, subject)
        if read is None:
            raise CommandError(f"nobody is enrolled as {subject!r} in tenant {entrance.tenant}")
        template, verifier = read[0], read[1].verifier
        try:
            level = runtime.levels.in_force(level)
        except ApiError as error:
            raise UsageError(error.message) from None
        with naming_photo(photos):
            probe = probe_of_photos(pack, runtime.contract, data, passive=False, policy=face)
        decision = verifier.decide_embedding(
            probe.embedding, template, level=level, photos=probe.photos
        ).with_advice(clear=probe.clear)
        outcome = "accept" if decision.accepted else "reject"
        # Another action than the service's: what an operator tries is not counted by the lockout.
        pseudonym = runtime.store.signer.pseudonym(entrance.tenant, subject)
        entry = Entry("verify-locally", outcome, operator(), entrance.tenant, pseudonym)
        runtime.store.audit_log.record(entry)
    names = ("reason", "level", "fmr", "contract_id", "calibration_id", "advice")
    facts = {name: getattr(decision, name) for name in names}
    return Result(
        {"decision": outcome, **facts, **demo_notice(pack.info)},
        status=0 if decision.accepted else 1,
    )
