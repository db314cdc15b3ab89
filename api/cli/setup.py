"""``veilface setup``: from a pack and photos to a service that is judged and ready to start.

Every step keeps what is there. Embeddings, which take the time, are kept in a sealed cache until
the contract is written, so that a run that was stopped goes on.
"""

import shlex
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from sqlalchemy.engine import make_url

from api.cli.calibrate import suspicious_lines
from api.cli.calibration import calibrate_folder, default_probe_dims
from api.cli.console import demo_notice, message, share_done
from api.cli.decoys import like_sample
from api.cli.descriptors import Aligned, Flip, bulk_pack, each_person_once, extract
from api.cli.errors import CommandError, UsageError
from api.cli.files import read_bounded
from api.cli.inputs import load_decoys
from api.cli.master_keys import is_from_file, opened_store
from api.cli.models import usable
from api.cli.photo_folders import find_photos, labelled_people
from api.cli.results import Result, reports
from api.cli.roles import Roles, assign_faces, assign_roles, resolved_rates, too_few
from api.cli.verdict import plain_lines
from api.http.audit import operator
from api.service.opening import file_sealer, open_contract, open_keyring
from api.service.settings_file import settings_text
from api.settings import DEFAULT_CONFIG_FILE, DEFAULT_TENANT, Settings, config_file, load_settings
from models.extraction import Extraction
from models.pack import ModelPack
from templates.contract.document import Contract
from templates.decoys import DecoyGenerator, DecoySource
from templates.keys.private_file import replace_private, replace_public
from templates.keys.sealing import MasterKeyring
from templates.space.lifting import Strategy
from templates.store.api_keys import Right
from verify import CalibrationOptions, LabelledFolder
from verify.datasets import visible
from verify.evaluation.attributes import resembling_rows
from verify.preparation import SAME_PHOTO, acquired, make_generator

RIGHTS = (Right.ENROLL, Right.VERIFY, Right.ERASE, Right.SCORES, Right.ADMIN)
"""Of the key that is made: all that the page shows, with distances, locks and the audit log."""
HEADER = "Written by `veilface setup`; docs/settings.md has the rest."


@reports("pack", "providers", "data_dir", "master_key_file")
def setup(
    people: Annotated[
        Path | None,
        typer.Argument(
            help="Labelled photos of people like those who will be enrolled, but never enrolled "
            "themselves: one subfolder for each person. Unset: thresholds are set on a part of "
            "--faces, each photo taken for another person.",
            show_default=False,
        ),
    ] = None,
    *,
    settings: Settings,
    faces: Annotated[
        list[Path],
        typer.Option(
            help="Folder of photos of many other faces, of any kind, at any depth: decoys are "
            "fitted to them. May be repeated."
        ),
    ],
    like: Annotated[
        list[Path] | None,
        typer.Option(
            help="Folder of 600 photos or more (at least 100 of 50 people) of further people of "
            "the kind that will be enrolled: decoys are adapted to them. Unset: people of PEOPLE "
            "whom the calibration can spare."
        ),
    ] = None,
    aligned: Aligned = False,
    flip: Flip = False,
) -> Result:
    """Prepare a service from a model pack and folders of photos, and judge it.

    With --faces alone nobody has to be labelled. Thresholds then assume that users look like those
    faces, and how many genuine photos are rejected is not measured. The same holds where PEOPLE are
    too few for any threshold.

    Makes the master key apart from the data, splits the people by the names of their folders so
    that no name is in two roles, builds the decoys, calibrates, makes an API key, and writes
    `veilface.toml`, which `veilface serve` reads. What is there already is kept, so a run that was
    stopped goes on. The service starts whatever the verdict at the end. Exit status 1: --faces are
    too few; or a settings file that is there has `serve` start another service.

    Example: `veilface setup --faces fairface/train --pack buffalo_l`
    """
    pack = bulk_pack(settings, flip=flip, why="a service embeds faces with a model pack")
    labelled = None if people is None else _labelled(people)
    roles = None if labelled is None else assign_roles(labelled, faces, like or [])
    if roles is None or not resolved_rates(roles.calibration):
        if roles is not None:
            note = too_few(roles.calibration)
            message(f"note: {note}: thresholds are set on --faces instead")
        if like:
            raise UsageError(
                "--like adapts the decoys to people like those of PEOPLE, and PEOPLE are too few "
                "to judge them by: give more PEOPLE, or leave out --like"
            )
        roles, labelled = assign_faces(faces, labelled), None
    if not resolved_rates(roles.calibration):
        why = too_few(roles.calibration)
        raise CommandError(f"there is nothing to serve: {why}; give more --faces")
    _say_plan(roles, pack)
    if is_from_file(settings):
        _is_kept("master key", settings.resolved_master_key_file)
    keyring = open_keyring(settings)
    cache = settings.data_dir / "setup.cache"
    # On whom a contract was judged that is kept, this call's arguments do not say.
    strangers = labelled is None and not settings.resolved_contract_file.exists()
    contract = _prepared(
        labelled, roles, pack, keyring, settings, like=like or [], aligned=aligned, cache=cache
    )
    cache.unlink(missing_ok=True)
    key_file = kept_api_key(settings, keyring)
    error = _write_settings(settings)
    text = [f"API key with the rights {', '.join(sorted(RIGHTS))}: {key_file}"]
    if error is None:
        # Imported here: a server takes long to load.
        from api.cli.serve import service_url

        text += ["Start it: veilface serve", *_calls(service_url(settings), key_file)]
    return Result(
        {
            "labelled": labelled is not None,
            "people": len(roles.calibration),
            "photos": roles.photos,
            "faces": len(roles.faces),
            "sample": len(roles.sample),
            "left_out": roles.left_out,
            "data_dir": settings.data_dir,
            "master_key_file": settings.resolved_master_key_file
            if is_from_file(settings)
            else None,
            "api_key_file": key_file,
            "settings_file": config_file(),
            "verdict": contract.verdict,
            **demo_notice(pack.info.embedder_sha256, n=pack.info.n),
        },
        [*text, *plain_lines(contract.verdict, strangers=strangers)],
        error=error,
    )


def api_key_file(settings: Settings) -> Path:
    """Where the API key is kept: with the master key, not with the data."""
    return settings.resolved_master_key_file.parent / "api-key"


def _labelled(people: Path) -> LabelledFolder:
    if people.is_dir() and not any(entry.is_dir() for entry in visible(people)):
        raise CommandError(
            f"{people} has {len(find_photos(people)):,} photos and no folder for a person: nobody "
            "is labelled. Give each person a subfolder with two photos or more; unlabelled photos "
            "serve as --faces, and as --like"
        )
    return labelled_people(people)


def _say_plan(roles: Roles, pack: ModelPack) -> None:
    adapted = f", adapted to {len(roles.sample):,} photos" if roles.sample else ""
    aside = f"; {roles.left_out:,} photos of people in another role left out"
    message(f"... pack: {pack.info.name}, {usable(pack.info)}")
    message(
        f"... roles: decoys of {len(roles.faces):,} faces{adapted}; thresholds on "
        f"{len(roles.calibration):,} people, {roles.photos:,} photos"
        f"{aside if roles.left_out else ''}"
    )


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


def _prepared(
    labelled: LabelledFolder | None,
    roles: Roles,
    pack: ModelPack,
    keyring: MasterKeyring,
    settings: Settings,
    *,
    like: Sequence[Path],
    aligned: bool,
    cache: Path,
) -> Contract:
    """Build the decoys and calibrate, or keep what is there."""
    path, decoys = settings.resolved_contract_file, settings.resolved_decoys_file
    sealer = file_sealer(keyring)
    decoys_kept = _is_kept("decoys", decoys)
    source: DecoySource | None = load_decoys(decoys, sealer, pack) if decoys_kept else None
    if _is_kept("contract", path):
        contract = open_contract(settings, keyring)
        if source is None:
            raise CommandError(f"{path} has lost its decoys; remove it to make both anew")
        contract.binding.require_source(source.reduced(contract.binding.axes))
        return contract
    if decoys_kept:
        message(
            "note: the decoys were there: see to it that nobody in PEOPLE is among the photos "
            "that they were made of"
        )
    name_of = {path: name for name, album in roles.calibration.items() for path in album}
    photos = [*name_of] if decoys_kept else [*roles.faces, *roles.sample, *name_of]
    message(f"... embedding {len(photos):,} photos")
    extraction = extract(pack, photos, aligned=aligned, settings=settings, cache=cache)
    message(f"... {acquired(extraction)}, {extraction.cached:,} embedded before")
    if labelled is None:
        extraction = each_person_once(extraction)
    people = part_of(extraction, name_of)
    if source is None:
        folders = like or ([] if labelled is None else [labelled.root])
        source = _fitted(extraction, roles, people, pack, folders=folders)
    root = settings.data_dir if labelled is None else labelled.root
    with share_done("calibrating") as report:
        done = calibrate_folder(
            LabelledFolder(root, tuple(name_of), tuple(name_of.values()), ()),
            people,
            pack=pack,
            source=source,
            strategy=Strategy.ADVERSARIAL,
            options=CalibrationOptions(probe_dims=(0, *default_probe_dims(None))),
            progress=lambda _what, share: report(share),
        )
    if labelled is not None:
        for line in suspicious_lines(done.report):
            message(line)
    if isinstance(source, DecoyGenerator) and not decoys_kept:
        source.save(decoys)
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
    pack: ModelPack,
    *,
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
    return make_generator(faces, pack, like=like_sample(sample, folders) if sample.paths else None)


def kept_api_key(settings: Settings, keyring: MasterKeyring) -> Path:
    """Return the private file with a key that the store takes; make one where there is none."""
    file = api_key_file(settings)
    with opened_store(settings, keyring) as store:
        is_there = file.exists()
        token = read_bounded(file, 4096).decode("ascii", "replace").strip() if is_there else ""
        if store.api_keys.verify(token) is not None:
            message(f"... API key: {file} is there and kept")
            return file
        why = f"the store does not take the one of {file}: making another"
        message(f"... API key: {why if is_there else f'making {file}'}")
        store.tenants.create(DEFAULT_TENANT)
        new = store.api_keys.create(DEFAULT_TENANT, RIGHTS, label="setup", by=operator())
        replace_private(file, f"{new.token}\n".encode())
    return file


def _write_settings(settings: Settings) -> str | None:
    """Write the settings file, or keep one that is there; say what is wrong with that, or None."""
    names = ["data_dir", "pack"]
    names += ["master_key_file"] if settings.master_key_file is not None else []
    if settings.database_url is not None:
        if make_url(settings.database_url).password is None:
            names.append("database_url")
        else:
            message(
                "note: the database's URL has a password, and is in no file: give it to `serve`"
            )
    if settings.providers != Settings.model_fields["providers"].default:
        names.append("providers")
    text = settings_text({name: getattr(settings, name) for name in names}, HEADER)
    file = config_file() or DEFAULT_CONFIG_FILE
    if not _is_kept("settings", file):
        replace_public(file, text.encode())
        return None
    served = load_settings()
    other = [name for name in names if _in_full(served, name) != _in_full(settings, name)]
    if not other:
        return None
    return (
        f"{file} was kept, and says something else of {', '.join(other)}, so that `veilface serve` "
        f"would not start what was set up here; it should say\n{text}"
    )


def _in_full(settings: Settings, name: str) -> Any:
    value = getattr(settings, name)
    return value.absolute() if isinstance(value, Path) else value
