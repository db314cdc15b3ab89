"""``veilface setup``: from a pack and photos to a service that is judged and ready to start.

Every step keeps what is there. Embeddings, which take the time, are kept in a sealed cache until
the contract is written, so that a run that was stopped goes on.
"""

import os
import shlex
import sys
from collections.abc import Collection, Mapping, Sequence
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
from api.cli.options import AsJson, takes_settings
from api.cli.photo_folders import find_photos, labelled_people
from api.cli.results import Result, present
from api.cli.roles import Roles, assign_roles, promises, resolved_rates, too_few, with_several
from api.cli.verdict import plain_lines
from api.http.audit import operator
from api.service.opening import file_sealer, open_contract, open_keyring
from api.service.settings_file import settings_text
from api.settings import DEFAULT_CONFIG_FILE, DEFAULT_TENANT, Settings, config_file, load_settings
from models.extraction import Extraction
from models.pack import ModelPack
from templates.contract.document import Contract
from templates.decoys import DecoyGenerator, DecoySource
from templates.keys.private_file import create_private, replace_private, replace_public
from templates.keys.sealing import MasterKeyring
from templates.space.lifting import Strategy
from templates.store.api_keys import Right
from verify import CalibrationOptions, LabelledFolder
from verify.datasets import visible
from verify.evaluation.attributes import resembling_rows
from verify.own_decoys import SAME_PHOTO
from verify.preparation import acquired, make_generator

RIGHTS = (Right.ENROLL, Right.VERIFY, Right.ERASE, Right.SCORES, Right.ADMIN)
"""Of the key that is made: all that the page shows, with distances, locks and the audit log."""
HEADER = "Written by `veilface setup`; docs/settings.md has the rest."


@takes_settings("pack", "providers", "data_dir", "master_key_file")
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
    if people is None and like:
        raise UsageError("--like adapts the decoys to people like those of PEOPLE: give PEOPLE too")
    labelled = None if people is None else _labelled(people)
    roles = assign_roles(labelled, faces, like or [])
    if labelled is not None and not resolved_rates(roles.calibration):
        message(f"note: {too_few(roles.calibration)}: thresholds are set on --faces instead")
        if like:
            raise UsageError(
                "--like adapts the decoys to people like those of PEOPLE, and PEOPLE are too few "
                "to judge them by: give more PEOPLE, or leave out --like"
            )
        roles, labelled = assign_roles(None, faces, [], apart=labelled), None
    plan = _plan(roles, pack, settings, labelled=labelled is not None)
    nothing = None
    if not resolved_rates(roles.calibration):
        nothing = f"there is nothing to serve: {too_few(roles.calibration)}; give more --faces"
    if dry_run or nothing or not as_json:
        present(Result(plan, _plan_text(plan), error=nothing), json=as_json)
    if dry_run:
        return
    steps: dict[str, str] = {}
    if is_from_file(settings):
        _report(steps, "master key", settings.resolved_master_key_file)
    else:
        steps["master key"] = "given"
    keyring = open_keyring(settings)
    cache = settings.data_dir / "setup.cache"
    contract = _prepared(
        labelled, roles, pack, keyring, settings, steps,
        like=like or [], aligned=aligned, cache=cache,
    )  # fmt: skip
    cache.unlink(missing_ok=True)
    _keep_api_key(settings, keyring, steps)
    error = _write_settings(settings, steps)
    notice = demo_notice(pack.info.embedder_sha256, n=pack.info.n)
    facts = {
        **plan,
        "steps": steps,
        "verdict": contract.verdict,
        **notice,
    }
    key_file = api_key_file(settings)
    text = [f"API key with the rights {', '.join(sorted(RIGHTS))}: {key_file}"]
    if error is None:
        # Imported here: a server takes long to load.
        from api.cli.serve import service_url

        text += [] if serve else ["Start it: veilface serve"]
        text += _calls(service_url(settings), key_file)
    # On whom a contract was judged that is kept, this call's arguments do not say.
    strangers = labelled is None and steps["contract"] == "made"
    text += plain_lines(contract.verdict, strangers=strangers)
    present(Result(facts, text, error=error), json=as_json)
    if serve:
        # Anew: this process has run the models, and what accelerators have begun outlives no fork.
        sys.stdout.flush()
        os.execv(sys.executable, [sys.executable, "-P", "-m", "veilface", "serve"])  # noqa: S606


def api_key_file(settings: Settings) -> Path:
    """Where the API key is kept: with the master key, not with the data."""
    return settings.resolved_master_key_file.parent / "api-key"


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


def _plan(roles: Roles, pack: ModelPack, settings: Settings, *, labelled: bool) -> dict[str, Any]:
    info, contract = pack.info, settings.resolved_contract_file
    can, cannot = promises(roles, n=info.n)
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
        "decoys_file": settings.resolved_decoys_file,
        "contract_file": contract,
        "contract_kept": contract.exists(),
        "master_key_file": settings.resolved_master_key_file if is_from_file(settings) else None,
        "api_key_file": api_key_file(settings),
        "settings_file": config_file() or DEFAULT_CONFIG_FILE,
        "labelled": labelled,
        "can": can,
        "cannot": cannot,
    }


def _plan_text(plan: Mapping[str, Any]) -> list[str]:
    pack = plan["pack"]
    detector = pack["detector"] or "none: photos must be aligned crops"
    adapted = f", adapted to {plan['sample']:,} photos" if plan["sample"] else ""
    alone = "" if plan["labelled"] else ", each of --faces taken for a person"
    files = [str(path) for name, path in plan.items() if name.endswith("_file") and path]
    text = [
        f"Pack:       {pack['name']}, {pack['n']} numbers per embedding, detector {detector}",
        f"Decoys:     {plan['faces']:,} faces{adapted}",
        f"Thresholds: {plan['people']:,} people, {plan['photos']:,} photos{alone}",
        f"Files:      {', '.join(files)}",
        *(f"Can be promised:    {sentence}." for sentence in plan["can"]),
        *(f"Cannot be promised: {sentence}." for sentence in plan["cannot"]),
    ]
    if plan["left_out"]:
        text.append(f"Left out:   {plan['left_out']:,} photos of people who have another role")
    if plan["contract_kept"]:
        text.append(
            f"These are promises of a contract made anew. {plan['contract_file']} is there and "
            "kept: what it promises is in its own verdict."
        )
    return text


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


def _report(steps: dict[str, str], step: str, file: Path) -> bool:
    """Say whether a step's file is there and kept, which is returned, or is made now."""
    kept = file.exists()
    steps[step] = "kept" if kept else "made"
    message(f"... {step}: {f'{file} is there and kept' if kept else f'making {file}'}")
    return kept


def _prepared(
    labelled: LabelledFolder | None,
    roles: Roles,
    pack: ModelPack,
    keyring: MasterKeyring,
    settings: Settings,
    steps: dict[str, str],
    *,
    like: Sequence[Path],
    aligned: bool,
    cache: Path,
) -> Contract:
    """Build the decoys and calibrate, or keep what is there."""
    path, decoys = settings.resolved_contract_file, settings.resolved_decoys_file
    sealer = file_sealer(keyring)
    decoys_kept = _report(steps, "decoys", decoys)
    source: DecoySource | None = load_decoys(decoys, sealer, pack) if decoys_kept else None
    if _report(steps, "contract", path):
        contract = open_contract(settings, keyring)
        if source is None:
            raise CommandError(f"{path} has lost its decoys; remove it to make both anew")
        served = source.reduced(contract.binding.axes)
        contract.binding.require_source(source_id=served.source_id, made_with=source.made_with)
        return contract
    if decoys_kept:
        message(
            "note: the decoys were there: see to it that nobody in PEOPLE is among the photos "
            "that they were made of"
        )
    names: list[str] = []
    calibrated_on: list[Path] = []
    for name, album in roles.calibration.items():
        names += [name] * len(album)
        calibrated_on += album
    photos = calibrated_on if decoys_kept else [*roles.faces, *roles.sample, *calibrated_on]
    message(f"... embedding {len(photos):,} photos")
    extraction = extract(pack, photos, aligned=aligned, settings=settings, cache=cache)
    message(f"... {acquired(extraction)}, {extraction.cached:,} embedded before")
    if labelled is None:
        extraction = each_person_once(extraction)
    people = part_of(extraction, calibrated_on)
    if source is None:
        folders = like or ([] if labelled is None else [labelled.root])
        source = _fitted(extraction, roles, people, pack, folders=folders)
    root = settings.data_dir if labelled is None else labelled.root
    with share_done("calibrating") as report:
        done = calibrate_folder(
            LabelledFolder(root, tuple(calibrated_on), tuple(names), ()),
            people,
            pack=pack,
            source=source,
            strategy=Strategy.ADVERSARIAL,
            options=CalibrationOptions(probe_dims=(0, *default_probe_dims(None))),
            progress=lambda _what, share: report(share),
        )
    if labelled is not None:
        for line in suspicious_lines(done.report, "put the photos of one person into one folder"):
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


def _keep_api_key(settings: Settings, keyring: MasterKeyring, steps: dict[str, str]) -> None:
    """See to it that a private file holds a key that the store takes."""
    file = api_key_file(settings)
    with opened_store(settings, keyring) as store:
        is_there = file.exists()
        if is_there and store.api_keys.verify(read_token(file)) is not None:
            _report(steps, "API key", file)
            return
        steps["API key"] = "made"
        why = f"the store does not take the one of {file}: making another" if is_there else ""
        message(f"... API key: {why or f'making {file}'}")
        store.tenants.create(DEFAULT_TENANT)
        new = store.api_keys.create(DEFAULT_TENANT, RIGHTS, label="setup", by=operator())
        write = replace_private if is_there else create_private
        write(file, f"{new.token}\n".encode())


def read_token(file: Path) -> str:
    """Read the token of an API key from its file."""
    return read_bounded(file, 4096).decode("ascii", "replace").strip()


def _write_settings(settings: Settings, steps: dict[str, str]) -> str | None:
    """Write the settings file, or keep the one that is there.

    Returns
    -------
    str or None
        What is wrong where that file would have another service started.
    """
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
    if not _report(steps, "settings", file):
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
