"""``veilface setup``: from a pack and photos to a service that is judged and ready to start.

Every step keeps what is there. Embeddings, which take the time, are kept in a sealed cache until
the contract is written, so that a run that was stopped goes on.
"""

import shlex
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Annotated

import typer
from sqlalchemy.engine import make_url

from api.cli import flags
from api.cli.bulk import Bulk, each_person_once
from api.cli.calibrate import MOST_SHOWN
from api.cli.calibration import DEFAULT_PROBE_DIM, calibrate_folder
from api.cli.console import demo_notice, message, share_done
from api.cli.decoys import like_sample
from api.cli.errors import CommandError, UsageError
from api.cli.models import usable
from api.cli.options import reports
from api.cli.photo_folders import find_photos, labelled_people
from api.cli.results import Result
from api.cli.roles import LEAST_PEOPLE, Roles, assign_faces, assign_roles, sets_thresholds
from api.cli.store import opened_store
from api.cli.verdict import plain_lines
from api.http.audit import operator
from api.service.settings_file import settings_text
from api.settings import DEFAULT_CONFIG_FILE, DEFAULT_TENANT, Settings, config_file, load_settings
from models.extraction import Extraction
from templates.contract.document import Contract
from templates.decoys import DecoyGenerator
from templates.keys.private_file import read_bounded, replace_private, replace_public
from templates.space.lifting import Strategy
from templates.store.api_keys import Right
from verify import CalibrationOptions
from verify.datasets import visible
from verify.evaluation.attributes import resembling_rows
from verify.preparation import SAME_PHOTO, acquired, make_generator

RIGHTS = (Right.ENROLL, Right.VERIFY, Right.ERASE, Right.SCORES, Right.ADMIN)
"""Of the operator's key: all that the page shows, and the calls for lockouts and audit log."""


@reports("pack", "providers", "data_dir", "master_key_file")
def setup(
    people: Annotated[
        Path | None,
        typer.Argument(
            help="Labelled photos, one subfolder for each person: of people like those who will be "
            "enrolled, but never enrolled. Unset: each photo of a part of --faces is a person."
        ),
    ] = None,
    *,
    settings: Settings,
    faces: Annotated[
        list[Path],
        typer.Option(help="Folder of photos of many other faces: decoys are fitted to them."),
    ],
    like: flags.Like = None,
    aligned: flags.Aligned = False,
    flip: flags.Flip = False,
) -> Result:
    """Prepare a service from a model pack and folders of photos, and judge it.

    With --faces alone, or with too few PEOPLE, thresholds assume that users look like those faces,
    and how many genuine photos are rejected is not measured.

    Makes the master key apart from the data, gives every person one role, builds the decoys,
    calibrates, makes an API key, and writes `veilface.toml`, which `veilface serve` reads. What is
    there already is kept, so a run that was stopped goes on. The service starts whatever the
    verdict at the end. Exit status 1: --faces are too few; or there is a settings file with which
    `serve` would start another service.

    Example: `veilface setup --faces fairface/train --pack buffalo_l`
    """
    cache = settings.data_dir / "setup.cache"
    bulk = Bulk(settings, aligned=aligned, flip=flip, cache_file=cache)
    pack = bulk.pack
    written = _settings_to_write(settings)
    roles = _roles(people, faces, like or [])
    counts = {
        "people": roles.calibration.people,
        "photos": len(roles.calibration),
        "faces": len(roles.faces),
        "sample": len(roles.sample),
        "left_out": roles.left_out,
    }
    message(f"... pack: {pack.info.name}, {usable(pack.info)}")
    message("... roles: " + ", ".join(f"{role} {count}" for role, count in counts.items()))
    # On whom a contract was judged that is kept, this call's arguments do not say.
    strangers = not (roles.is_labelled or settings.resolved_contract_file.exists())
    contract = _contract(roles, bulk, like or [])
    cache.unlink(missing_ok=True)
    key_file = kept_api_key(settings)
    if written is not None:
        replace_public(DEFAULT_CONFIG_FILE, written.encode())
    # Imported here: a server takes long to load.
    from api.cli.serve import service_url

    return Result(
        {
            "labelled": roles.is_labelled,
            **counts,
            "data_dir": settings.data_dir,
            "api_key_file": key_file,
            "settings_file": config_file(),
            "verdict": contract.verdict,
            **demo_notice(pack.info),
        },
        [
            f"API key with the rights {', '.join(sorted(RIGHTS))}: {key_file}",
            "Start it: veilface serve",
            *_calls(service_url(settings), key_file),
            *plain_lines(contract.verdict, strangers=strangers),
        ],
    )


def _settings_to_write(settings: Settings) -> str | None:
    """Return the text of the settings file; None where there is one that says the same.

    One with which `serve` would start another service is refused.
    """
    names = ["data_dir", "pack"]
    names += [one for one in ("master_key_file", "providers") if one in settings.model_fields_set]
    if settings.database_url is not None and make_url(settings.database_url).password is None:
        names.append("database_url")
    elif settings.database_url is not None:
        message("note: the database's URL has a password, and is in no file: give it to `serve`")
    text, file = _text_of(settings, names), config_file()
    if file is None:
        return text
    if _text_of(load_settings(), names) != text:
        raise CommandError(
            f"{file} is there, and with it `veilface serve` would start another service; it should "
            f"say\n{text}"
        )
    message(f"... settings: {file} is there and kept")
    return None


def _text_of(settings: Settings, names: Sequence[str]) -> str:
    values = {name: getattr(settings, name) for name in names}
    return settings_text(values, "Written by `veilface setup`; docs/settings.md has the rest.")


def _roles(people: Path | None, faces: Sequence[Path], like: Sequence[Path]) -> Roles:
    """Give every photo its role: by labelled people, or where these are too few by faces alone."""
    labelled = None
    if people is not None:
        if people.is_dir() and not any(entry.is_dir() for entry in visible(people)):
            raise CommandError(
                f"{people} has {len(find_photos(people)):,} photos and no folder for a person: "
                "nobody is labelled. Give each person a subfolder with two photos or more; "
                "unlabelled photos serve as --faces, and as --like"
            )
        labelled = labelled_people(people)
        roles = assign_roles(labelled, faces, like)
        count, photos = roles.calibration.people, len(roles.calibration)
        if sets_thresholds(count, photos):
            return roles
        message(
            f"note: {count} people with {photos} photos are too few to set a threshold by: 25 "
            f"resolve that 1 stranger in 100 is accepted, and {LEAST_PEOPLE} that 1 in 1,000 is: "
            "thresholds are set on --faces instead"
        )
    if like:
        raise UsageError(
            "--like adapts the decoys to people like those of PEOPLE, and PEOPLE are too few to "
            "judge them by: give more PEOPLE, or leave out --like"
        )
    return assign_faces(faces, labelled)


def _calls(service: str, key_file: Path) -> list[str]:
    """Show the page, and the two calls that a newcomer makes first, ready to paste."""
    key = f'-H "Authorization: Bearer $(cat {shlex.quote(str(key_file))})"'
    person = f"{service}/v1/subjects/anna"
    return [
        f"Page:     open {service}/ and sign in with the key in {key_file}",
        f"Enroll:   curl -X PUT {person}/enrollment {key} -F images=@anna1.jpg "
        "-F images=@anna2.jpg -F images=@anna3.jpg",
        f"Verify:   curl -X POST {person}/verify {key} -F images=@anna4.jpg -F images=@anna5.jpg",
    ]


def _is_kept(step: str, file: Path) -> bool:
    """Say whether a step's file is there and kept, which is returned, or is made now."""
    kept = file.exists()
    message(f"... {step}: {f'{file} is there and kept' if kept else f'making {file}'}")
    return kept


def _contract(roles: Roles, bulk: Bulk, like: Sequence[Path]) -> Contract:
    """Build the decoys and calibrate, or keep what is there."""
    settings = bulk.settings
    path, decoys = settings.resolved_contract_file, settings.resolved_decoys_file
    if settings.master_key_variable is None:
        _is_kept("master key", settings.resolved_master_key_file)
    sealer = bulk.sealer
    source = bulk.decoys(decoys) if _is_kept("decoys", decoys) else None
    if _is_kept("contract", path):
        contract = None if source is None else bulk.served_contract(source)
        if contract is None:
            raise CommandError(f"{path} is not of {decoys}; remove both to make them anew")
        return contract
    photos = [*roles.calibration.paths]
    if source is None:
        photos = [*roles.faces, *roles.sample, *photos]
    else:
        message("note: see to it that the decoys that were there were not made of PEOPLE")
    message(f"... embedding {len(photos):,} photos")
    extraction = bulk.extract(photos)
    message(f"... {acquired(extraction)}, {extraction.cached:,} embedded before")
    if not roles.is_labelled:
        extraction = each_person_once(extraction)
    people = part_of(extraction, roles.calibration.paths)
    fitted = None
    if source is None:
        folders = like or [roles.calibration.root]
        source = fitted = _fitted(extraction, roles, people, bulk, folders)
    with share_done("calibrating") as report:
        done = calibrate_folder(
            roles.calibration,
            people,
            pack=bulk.pack,
            source=source,
            strategy=Strategy.ADVERSARIAL,
            options=CalibrationOptions(probe_dims=(0, DEFAULT_PROBE_DIM)),
            progress=report,
        )
    # Photos of strangers have no folders to mend.
    for pair in done.report.suspicious[:MOST_SHOWN] if roles.is_labelled else ():
        message(f"note: {pair.first} and {pair.second} look alike: put one person into one folder")
    if fitted is not None:
        fitted.save(decoys)
    done.contract.save(path, sealer)
    return done.contract


def part_of(extraction: Extraction, photos: Collection[Path]) -> Extraction:
    """Take the photos of one role out of an extraction."""
    chosen = set(photos)
    rows = [row for row, path in enumerate(extraction.paths) if path in chosen]
    return Extraction(
        extraction.embeddings[rows],
        [extraction.paths[row] for row in rows],
        [failure for failure in extraction.failures if failure.path in chosen],
        cached=0,
    )


def _fitted(
    extraction: Extraction,
    roles: Roles,
    people: Extraction,
    bulk: Bulk,
    folders: Collection[Path],
) -> DecoyGenerator:
    """Fit the decoys, without faces that are photos of the people under another name."""
    faces, sample = part_of(extraction, roles.faces), part_of(extraction, roles.sample)
    twice = set()
    for others in (people, sample):
        rows = resembling_rows(faces.embeddings, others.embeddings, cosine=SAME_PHOTO)
        twice |= {faces.paths[row] for row in rows}
    if twice:
        message(f"note: {len(twice):,} of --faces are photos of people in another role: left out")
        faces = part_of(faces, set(faces.paths) - twice)
    like = like_sample(sample, folders) if sample.paths else None
    return make_generator(faces, bulk.pack, like=like)


def kept_api_key(settings: Settings) -> Path:
    """Return the private file with a key that the store takes; make one where there is none.

    It lies with the master key, not with the data.
    """
    file = settings.resolved_master_key_file.parent / "api-key"
    with opened_store(settings) as store:
        is_kept = _is_kept("API key", file)
        token = read_bounded(file, 4096).decode("ascii", "replace").strip() if is_kept else ""
        if store.api_keys.verify(token) is not None:
            return file
        if is_kept:
            message(f"... API key: the store does not take the one of {file}: making another")
        store.tenants.create(DEFAULT_TENANT)
        new = store.api_keys.create(DEFAULT_TENANT, RIGHTS, label="setup", by=operator())
        replace_private(file, f"{new.token}\n".encode())
    return file
