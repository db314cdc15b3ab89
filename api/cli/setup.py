"""``veilface setup``: from a pack and photos to a service that is judged and ready to start."""

import os
import shlex
import sys
import time
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from api.cli.calibrate import suspicious_lines
from api.cli.console import demo_notice, emit, message, say, share_done
from api.cli.decoys import like_sample, photos_of
from api.cli.descriptors import Aligned, Flip, bulk_pack, each_person_once, extract
from api.cli.errors import CommandError, UsageError
from api.cli.inputs import load_decoys
from api.cli.master_keys import is_from_file
from api.cli.options import AsJson, takes_settings
from api.cli.photo_folders import find_photos, labelled_people
from api.cli.setup_files import (
    api_key_file,
    keep_api_key,
    master_key_source,
    report_master_key,
    report_step,
    write_settings,
)
from api.cli.verdict import verdict_lines
from api.process.preparation import (
    CalibratedFolder,
    acquired,
    calibrate_folder,
    default_probe_dims,
    make_generator,
)
from api.process.roles import (
    Roles,
    promises,
    resolved_rates,
    split_faces,
    split_people,
    with_several,
)
from api.service.opening import file_sealer, open_contract, open_keyring, weak_privacy
from api.settings import DEFAULT_CONFIG_FILE, Settings, config_file
from models.extraction import Extraction
from models.pack import ModelPack
from templates.contract.document import Contract
from templates.decoys import DecoyGenerator, DecoySource
from templates.keys.sealing import MasterKeyring
from templates.space.lifting import Strategy
from verify import CalibrationOptions, LabelledFolder
from verify.datasets import visible
from verify.evaluation.attributes import resembling_rows
from verify.own_decoys import SAME_PHOTO

CACHES = "setup-*.cache"


@takes_settings("pack", "providers", "data_dir", "master_key_file", "accept_weak_privacy")
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
            "fitted to them. May be given several times."
        ),
    ],
    like: Annotated[
        list[Path] | None,
        typer.Option(
            help="Folder of 300 photos or more of further people of the kind that will be "
            "enrolled, whom decoys are adapted to. Unset: people of PEOPLE whom the calibration "
            "can spare."
        ),
    ] = None,
    aligned: Aligned = False,
    flip: Flip = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Show the plan and what it can promise, and stop.")
    ] = False,
    serve: Annotated[
        bool, typer.Option("--serve", help="Start the service at the end (`veilface serve`).")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Prepare a service from a model pack and folders of photos, and judge it.

    With --faces alone nobody has to be labelled. Thresholds then assume that users look like those
    faces, and how many genuine photos are rejected is not measured.

    Makes the master key apart from the data, splits the people by the names of their folders so
    that no name is in two roles, builds the decoys, calibrates, makes an API key, and writes
    `veilface.toml`, which `veilface serve` reads. What is there already is kept: a run that was
    stopped goes on when it is started again. Exit status 1: there is no threshold; the templates
    are not private, and `serve` will refuse them without --accept-weak-privacy; or a settings
    file of somebody else has `serve` start another service.

    Example: `veilface setup --faces fairface/train --pack buffalo_l`
    """
    pack = bulk_pack(settings, flip=flip, why="a service embeds faces with a model pack")
    if people is None and like:
        raise UsageError("--like adapts the decoys to people like those of PEOPLE: give PEOPLE too")
    labelled = None if people is None else _labelled(people)
    roles = assign_roles(labelled, faces, like or [])
    can, cannot = promises(roles, n=pack.info.n)
    plan = {
        **_plan(roles, pack, settings),
        "labelled": labelled is not None,
        "can": can,
        "cannot": cannot,
    }
    resolves = bool(resolved_rates(roles.calibration))
    if not as_json:
        _tell_plan(plan)
    elif dry_run or not resolves:
        emit(plan)
    if not resolves:
        raise CommandError(
            f"there is nothing to serve: {people or faces[0]} resolves no rate of false matches"
        )
    if dry_run:
        return
    made: dict[str, str] = {}
    report_master_key(made, settings)
    keyring = open_keyring(settings)
    contract = _prepared(
        labelled, roles, pack, keyring, settings, made, like=like or [], aligned=aligned
    )
    key = keep_api_key(settings, keyring, made)
    misled = write_settings(settings, made)
    weakness = weak_privacy(contract)
    refused = weakness is not None and not settings.accept_weak_privacy
    notice = demo_notice(pack.info.embedder_sha256, n=pack.info.n)
    if as_json:
        verdict = None if contract.verdict is None else contract.verdict.to_json()
        emit({**plan, "steps": made, "verdict": verdict, "servable": not refused, **notice})
    else:
        for line in verdict_lines(contract.verdict)[:2]:
            say(line)
        say(f"API key with the rights {', '.join(sorted(key.rights))}: {plan['api_key_file']}")
    if refused:
        message(
            f"error: `veilface serve` refuses this contract: {weakness}. Remove it and the decoys, "
            "and set up again with more photos; or accept it knowingly: run this again with "
            "--accept-weak-privacy"
        )
    if misled is not None:
        message(f"error: {misled}")
    if refused or misled is not None:
        raise typer.Exit(1)
    if as_json and not serve:
        return
    # Imported here: a server takes long to load.
    from api.cli.serve import service_url

    if not as_json:
        if not serve:
            say("Start it: veilface serve")
        _tell_calls(service_url(settings), api_key_file(settings))
    if serve:
        # Anew: this process has run the models, and what accelerators have begun outlives no fork.
        sys.stdout.flush()
        os.execv(sys.executable, [sys.executable, "-P", "-m", "veilface", "serve"])  # noqa: S606


def assign_roles(
    labelled: LabelledFolder | None, faces: Sequence[Path], like: Sequence[Path]
) -> Roles:
    """Give every photo one role; people are told apart by the names of their folders.

    Without ``labelled`` each of the faces is a person of its own.

    Raises
    ------
    CommandError
        No face is left to fit decoys to, or no photo of ``like``.
    """
    if labelled is None:
        kept, calibration = split_faces(photos_of(faces, frozenset())[0])
        if not kept:
            raise CommandError("--faces has too few photos to fit decoys to")
        return Roles(kept, (), calibration)
    albums: dict[str, list[Path]] = {}
    for path, name in zip(labelled.paths, labelled.identities, strict=True):
        albums.setdefault(name, []).append(path)
    names, left_out = frozenset(albums), 0
    sample: Sequence[Path]
    if like:
        sample, left_out = photos_of(like, names)
        calibration = albums
        names |= {path.parent.name for path in sample if path.parent not in like}
        if not sample:
            raise CommandError("everybody in --like is in PEOPLE too; name folders of others")
    else:
        sample, calibration = split_people(albums)
    others, more = photos_of(faces, names)
    taken = {path.resolve() for path in (*labelled.paths, *sample)}
    kept = tuple(path for path in others if path.resolve() not in taken)
    if not kept:
        raise CommandError("everybody in --faces is in PEOPLE or --like; name folders of others")
    return Roles(kept, tuple(sample), calibration, left_out + more + len(others) - len(kept))


def _labelled(people: Path) -> LabelledFolder:
    if people.is_dir() and not any(entry.is_dir() for entry in visible(people)):
        photos = len(find_photos(people))
        raise CommandError(
            f"{people} has {photos:,} photos and no folder for a person: nobody is labelled. "
            "Thresholds are set on people who are told apart, each in a subfolder with two photos "
            "or more; 80 people with three resolve a false match rate of 1 in 1,000. Unlabelled "
            "photos serve as --faces, and as --like"
        )
    return labelled_people(people)


def _plan(roles: Roles, pack: ModelPack, settings: Settings) -> dict[str, Any]:
    info = pack.info
    return {
        "pack": {
            "name": info.name,
            "n": info.n,
            "detector": None if info.detector is None else info.detector.kind,
        },
        "faces": len(roles.faces),
        "sample": len(roles.sample),
        "left_out": roles.left_out,
        "people": len(roles.calibration),
        "people_with_several_photos": with_several(roles.calibration),
        "photos": roles.photos,
        "decoys_file": str(settings.resolved_decoys_file),
        "contract_file": str(settings.resolved_contract_file),
        "contract_kept": settings.resolved_contract_file.exists(),
        "master_key": master_key_source(settings),
        "master_key_file": str(settings.resolved_master_key_file)
        if is_from_file(settings)
        else None,
        "api_key_file": str(api_key_file(settings)),
        "settings_file": str(config_file() or DEFAULT_CONFIG_FILE),
    }


def _tell_plan(plan: dict[str, Any]) -> None:
    pack = plan["pack"]
    detector = pack["detector"] or "none: photos must be aligned crops"
    say(f"Pack:       {pack['name']}, {pack['n']} numbers per embedding, detector {detector}")
    adapted = f", adapted to {plan['sample']:,} photos" if plan["sample"] else ""
    say(f"Decoys:     {plan['faces']:,} faces{adapted}")
    alone = "" if plan["labelled"] else ", each of --faces taken for a person"
    say(f"Thresholds: {plan['people']:,} people, {plan['photos']:,} photos{alone}")
    if plan["left_out"]:
        say(f"Left out:   {plan['left_out']:,} photos of people who have another role")
    files = [path for name, path in plan.items() if name.endswith("_file") and path is not None]
    say(f"Files:      {', '.join(files)}")
    for sentence in plan["can"]:
        say(f"Can be promised:    {sentence}.")
    for sentence in plan["cannot"]:
        say(f"Cannot be promised: {sentence}.")
    if plan["contract_kept"]:
        say(
            f"These are promises of a contract made anew. {plan['contract_file']} is there and "
            "kept: what it promises is in its own verdict."
        )


def _tell_calls(service: str, key_file: Path) -> None:
    """Show the page, and the two calls that a newcomer makes first, ready to paste."""
    say(f"Page:     open {service}/ and sign in with the key in {key_file}")
    key = f'-H "Authorization: Bearer $(cat {shlex.quote(str(key_file))})"'
    person = f"{service}/v1/subjects/anna"
    say(
        f"Enroll:   curl -X PUT {person}/enrollment {key} -F images=@anna1.jpg -F images=@anna2.jpg"
    )
    say(f"Verify:   curl -X POST {person}/verify {key} -F image=@anna3.jpg")


def _prepared(
    labelled: LabelledFolder | None,
    roles: Roles,
    pack: ModelPack,
    keyring: MasterKeyring,
    settings: Settings,
    made: dict[str, str],
    *,
    like: Sequence[Path],
    aligned: bool,
) -> Contract:
    """Build the decoys and calibrate, or keep what is there."""
    path, sealer = settings.resolved_contract_file, file_sealer(keyring)
    decoys_kept = report_step(made, "decoys", settings.resolved_decoys_file)
    contract_kept = path.exists()
    source = load_decoys(settings.resolved_decoys_file, sealer, pack) if decoys_kept else None
    if contract_kept:
        report_step(made, "contract", path)
        contract = open_contract(settings, keyring)
        if source is None:
            raise CommandError(f"{path} has lost its decoys; remove it to make both anew")
        served = source.reduced(contract.binding.axes)
        contract.binding.require_source(source_id=served.source_id, made_with=source.made_with)
        _drop_caches(settings)
        return contract
    # Sealed, and only while this runs: so that a run that is stopped goes on.
    cache = settings.data_dir / CACHES.replace("*", roles.digest[:16])
    if source is not None:
        _require_same_roles(settings, cache)
    calibrated_on = [photo for album in roles.calibration.values() for photo in album]
    photos = calibrated_on if source is not None else [*roles.faces, *roles.sample, *calibrated_on]
    message(f"... embedding {len(photos):,} photos")
    began = time.monotonic()
    extraction = extract(pack, photos, aligned=aligned, settings=settings, cache=cache)
    seconds = max(time.monotonic() - began, 1e-3)
    speed = (extraction.attempts - extraction.cached) / seconds
    before = f", {extraction.cached:,} embedded before" if extraction.cached else ""
    message(f"... {acquired(extraction)}{before}, {speed:.0f} photos a second")
    if labelled is None:
        extraction = each_person_once(extraction)
    people = part_of(extraction, calibrated_on)
    if source is None:
        folders = like or ([] if labelled is None else [labelled.root])
        source = _fitted(extraction, roles, people, pack, folders=folders)
        source.save(settings.resolved_decoys_file)
    report_step(made, "contract", path)
    names = [name for name, album in roles.calibration.items() for _ in album]
    root = settings.data_dir if labelled is None else labelled.root
    folder = LabelledFolder(root, tuple(calibrated_on), tuple(names), ())
    done = _calibrated(folder, people, pack, source)
    for line in suspicious_lines(done.report, "put the photos of one person into one folder"):
        message(line)
    contract = done.contract
    contract.save(path, sealer)
    _drop_caches(settings)
    return contract


def _drop_caches(settings: Settings) -> None:
    """Delete the embeddings of this run, or of one that was stopped after its contract."""
    for pattern in (CACHES, f".{CACHES}.*"):  # the second: drafts of a run that was killed
        for file in settings.data_dir.glob(pattern):
            file.unlink()


def _require_same_roles(settings: Settings, cache: Path) -> None:
    """Refuse decoys of another split; those of another command are the caller's affair."""
    others = [file for file in settings.data_dir.glob(CACHES) if file != cache]
    if cache.exists():
        return
    if others:
        raise CommandError(
            f"photos were added or removed since {settings.resolved_decoys_file} was made, so that "
            "somebody may be in two roles: remove that file to build the decoys anew"
        )
    message(
        "note: the decoys are of another command: see to it that nobody in PEOPLE is among the "
        "photos that they were made of"
    )


def part_of(extraction: Extraction, photos: Collection[Path]) -> Extraction:
    """Take the photos of one role out of an extraction."""
    chosen = set(photos)
    rows = [row for row, path in enumerate(extraction.paths) if path in chosen]
    return Extraction(
        extraction.descriptors[rows],
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
        rows = resembling_rows(faces.descriptors, others.descriptors, cosine=SAME_PHOTO)
        twice |= {faces.paths[row] for row in rows}
    if twice:
        message(f"note: {len(twice):,} of --faces are photos of people in another role: left out")
        faces = part_of(faces, set(faces.paths) - twice)
    return make_generator(faces, pack, like=like_sample(sample, folders) if sample.paths else None)


def _calibrated(
    folder: LabelledFolder, extraction: Extraction, pack: ModelPack, source: DecoySource
) -> CalibratedFolder:
    with share_done("calibrating") as report:
        return calibrate_folder(
            folder,
            extraction,
            pack=pack,
            source=source,
            strategy=Strategy.ADVERSARIAL,
            options=CalibrationOptions(probe_dims=(0, *default_probe_dims(None))),
            progress=lambda _what, share: report(share),
        )
