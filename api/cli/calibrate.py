"""``veilface calibrate``: thresholds for stated false match rates."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from api.cli import flags
from api.cli.bulk import BULK, Bulk, each_person_once, listed_numbers
from api.cli.calibration import DEFAULT_PROBE_DIM, calibrate_folder
from api.cli.console import demo_notice, message, share_done
from api.cli.errors import UsageError
from api.cli.files import read_names
from api.cli.liveness import set_liveness_threshold, with_liveness_of
from api.cli.options import reports
from api.cli.photo_folders import people_or_faces
from api.cli.results import Result, Table
from api.cli.verdict import shown_rate, verdict_lines
from api.settings import Settings
from templates.contract.binding import MAX_M
from templates.contract.document import Calibration, Contract
from templates.contract.levels import photos_in_words
from templates.distances import Metric
from templates.space.lifting import Strategy
from verify import CalibrationOptions, CalibrationReport
from verify.calibration import SUSPICIOUS_ABOVE
from verify.calibration_mode import Protocol
from verify.evaluation.labels_file import read_labels
from verify.group_rates import PhotoLabels
from verify.preparation import acquired, acquired_json

MOST_SHOWN = 20


@reports(*BULK)
def calibrate(
    folder: Annotated[
        Path | None,
        typer.Argument(
            help="Labelled faces, one subfolder for each person. Or faces that nobody labelled, "
            "in no subfolder: each photo counts as another person."
        ),
    ] = None,
    *,
    settings: Settings,
    decoys: flags.Decoys = None,
    out: Annotated[
        Path | None,
        typer.Option(help="The contract file. Unset: `contract.json` in `data_dir`."),
    ] = None,
    strategy: Annotated[
        Strategy, typer.Option(help="How templates are lifted.")
    ] = Strategy.ADVERSARIAL,
    dim: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=MAX_M,
            help="Dimension m of stored templates. Unset: chosen with --axes, so that templates "
            "are private and the fewest genuine probes are rejected.",
        ),
    ] = None,
    axes: Annotated[
        int | None,
        typer.Option(min=2, help="Leading axes of faces that are kept. Unset: chosen with --dim."),
    ] = None,
    probe_dims: Annotated[
        str | None,
        typer.Option(
            help="Dimensions of lifted probes that clients may send, as `2,4,8`, or `none`, which "
            f"is quicker. Unset: {DEFAULT_PROBE_DIM}, or --dim where that is smaller."
        ),
    ] = None,
    metric: Annotated[Metric, typer.Option(help="The distance that decides.")] = Metric.SPHERICAL,
    protocol: Annotated[
        Protocol,
        typer.Option(
            help="`ten-fold` adds the paper's threshold of best accuracy, on random pairs, as a "
            "level."
        ),
    ] = "fmr",
    aligned: flags.Aligned = False,
    flip: flags.Flip = False,
    cache: flags.Cache = None,
    exclude_people: flags.Exclude = None,
    labels: flags.Labels = None,
    worst_group: Annotated[
        bool, typer.Option("--worst-group", help="Levels keep their FMR in each group, too.")
    ] = False,
    liveness: Annotated[
        Path | None,
        typer.Option(
            help="Instead of people, photos as for `evaluate liveness`: sets only the liveness "
            "threshold of the contract file."
        ),
    ] = None,
    bpcer: Annotated[
        float,
        typer.Option(min=1e-4, max=0.5, help="With --liveness: live photos that may be refused."),
    ] = 0.05,
    seed: flags.Seed = 0,
) -> Result:
    """Calibrate on labelled people, and write the contract file.

    80 people with two photos or more each resolve FMR 1e-2 and 1e-3; a level that the data cannot
    resolve is left out. Of faces that nobody labelled, rejections are not measured.
    docs/thresholds.md explains it.

    Example: `veilface calibrate lfw --pack buffalo_l --decoys decoys.veil --out contract.json
    --strategy adversarial`
    """
    path = out or settings.resolved_contract_file
    if liveness is not None and folder is None:
        return set_liveness_threshold(liveness, path, settings, bpcer=bpcer)
    if folder is None or liveness is not None:
        raise UsageError("give the folder of labelled people, or --liveness and its photos")
    dims: tuple[int, ...] = (DEFAULT_PROBE_DIM,)
    if probe_dims is not None:
        is_none = probe_dims.strip() == "none"
        dims = () if is_none else listed_numbers(probe_dims, "--probe-dims", most=MAX_M)
    bulk = Bulk(settings, aligned=aligned, flip=flip, cache_file=cache)
    n = bulk.pack.info.n
    if not (dim or 1) < (axes or n) <= n:
        raise UsageError(f"--dim must lie below --axes, and --axes be at most {n}")
    if worst_group and labels is None:
        raise UsageError("--worst-group needs to know the groups: give --labels")
    known = None if labels is None else read_labels(labels)
    source = bulk.decoys(decoys)
    found = people_or_faces(folder)
    excluded = read_names(exclude_people)
    below = {path.relative_to(found.root).as_posix() for path in found.paths}
    if unknown := sorted(excluded.difference(found.identities, below)):
        message(f"note: --exclude-people: {len(unknown):,} match nothing, as {unknown[0]!a}")
    labelled = found.without(excluded)
    extraction = bulk.extract(labelled.paths)
    if labelled.people == len(labelled):
        extraction = each_person_once(extraction)
    groups = None
    if known is not None:
        names = [photo.relative_to(labelled.root).as_posix() for photo in extraction.paths]
        columns = {attribute: known.column(attribute, names) for attribute in known.attributes}
        groups = PhotoLabels(columns, "a label file")
    with share_done("calibrating") as report:
        done = calibrate_folder(
            labelled,
            extraction,
            pack=bulk.pack,
            source=source,
            strategy=strategy,
            axes=axes,
            m=dim,
            options=CalibrationOptions(
                protocol=protocol,
                metric=metric,
                probe_dims=(0, *dims),
                worst_group=worst_group,
                seed=seed,
            ),
            labels=groups,
            progress=report,
        )
    contract = with_liveness_of(path, done.contract, bulk)
    contract.save(path, bulk.sealer)
    return Result(
        {
            "out": path,
            **demo_notice(bulk.pack.info),
            "contract": contract.to_json(),
            "failure_to_acquire": acquired_json(extraction),
            "chosen": done.point.chosen,
            "tried": done.point.tried,
            "suspicious_above": SUSPICIOUS_ABOVE,
            **asdict(done.report),
        },
        [
            *map(levels_table, contract.calibrations),
            *_group_table(contract),
            *suspicious(done.report),
            *(f"Not set: {sentence}." for sentence in done.report.unresolved),
            *(f"Not in the rule of the worst group: {one}." for one in done.report.left_out),
            f"{acquired(extraction)}.",
            f"{path}: contract {contract.contract_id[:16]}.",
            f"m = {done.point.dim} of {done.point.axes} axes: {done.point.chosen}.",
            *verdict_lines(contract.verdict),
        ],
    )


def levels_table(calibration: Calibration) -> Table:
    """Show what one calibration found."""
    photos = photos_in_words(calibration.probe_photos)
    lifted = calibration.mode == "s2s"
    kind = f"lifted probes m={calibration.probe_m}" if lifted else f"raw probes of {photos}"
    rows = [
        (
            level.name,
            f"{level.threshold:.3f}",
            shown_rate(level.fmr),
            shown_rate(level.fnmr),
            ", ".join(
                f"{number}: {100 * rate.value:.3g} %"
                for number, rate in sorted(level.fnmr_by_photos.items())
            ),
        )
        for level in calibration.levels
    ]
    columns = ("level", "score", "FMR seen (95 %)", "FNMR seen (95 %)", "FNMR by photos enrolled")
    return Table(f"{kind}, {calibration.metric} distance", columns, rows)


def _group_table(contract: Contract) -> list[Table]:
    """Show the rates of every group at the default level, for one photo; --json has all."""
    level = contract.calibration("p2s").level(contract.default_level)
    if not level.groups:
        return []
    title = f"by group at {level.name}, probes of one photo; * too few trials to be judged"
    rows = [
        (
            one.attribute,
            one.group,
            shown_rate(one.fmr) + ("" if one.fmr_judged else " *"),
            shown_rate(one.frr) + ("" if one.frr_judged else " *"),
        )
        for one in level.groups
    ]
    return [Table(title, ("attribute", "group", "FMR within (95 %)", "FRR (95 %)"), rows)]


def suspicious(report: CalibrationReport) -> list[Table]:
    """Show the pairs of people who may be one, most alike first."""
    title = (
        f"suspiciously alike (cosine above {SUSPICIOUS_ABOVE:g}): put one person into one folder"
    )
    rows = [(pair.first, pair.second, f"{pair.cosine:.3f}") for pair in report.suspicious]
    return [Table(title, ("person", "person", "cosine"), rows[:MOST_SHOWN])] if rows else []
