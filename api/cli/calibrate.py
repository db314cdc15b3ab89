"""``veilface calibrate``: thresholds for stated false match rates."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from api.cli.calibrate_liveness import set_liveness_threshold, with_liveness_of
from api.cli.calibration import DEFAULT_PROBE_DIM, calibrate_folder, default_probe_dims
from api.cli.console import counted, demo_notice, share_done
from api.cli.descriptors import BULK, Aligned, Cache, Flip, bulk_pack, each_person_once, extract
from api.cli.errors import UsageError
from api.cli.files import read_names
from api.cli.groups import group_tables, labels_of
from api.cli.inputs import listed_numbers, load_decoys
from api.cli.photo_folders import people_or_faces
from api.cli.results import Plan, Result, Table, reports
from api.cli.verdict import improvements, shown_rate, verdict_lines
from api.service.opening import file_sealer, open_keyring
from api.settings import Settings
from templates.contract.binding import MAX_M
from templates.contract.document import Calibration, Contract
from templates.distances import Metric
from templates.space.lifting import Strategy
from verify import CalibrationOptions, CalibrationReport
from verify.calibration import SUSPICIOUS_ABOVE
from verify.evaluation.labels_file import read_labels
from verify.preparation import acquired, acquired_json

MOST_SHOWN = 20


class Protocol(StrEnum):
    """How levels are set."""

    FMR = "fmr"
    TEN_FOLD = "ten-fold"


@reports(*BULK)
def calibrate(
    folder: Annotated[
        Path | None,
        typer.Argument(
            help="Labelled faces, one subfolder for each person. Or faces that nobody labelled, "
            "in no subfolder: each photo counts as another person. Not with --liveness."
        ),
    ] = None,
    *,
    settings: Settings,
    decoys: Annotated[
        Path | None,
        typer.Option(help="The file of `decoys build`. Unset: `decoys.veil` in `data_dir`."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="The contract file. Unset: `contract.json` in `data_dir`.", show_default=False
        ),
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
        typer.Option(
            min=2,
            help="Leading axes of faces that embeddings are projected on before they are lifted. "
            "Unset: chosen with --dim.",
        ),
    ] = None,
    probe_dims: Annotated[
        str | None,
        typer.Option(
            help="Dimensions of lifted probes that clients may send, for example `2,4,8`, or "
            "`none`, which is quicker; photos and embeddings are always calibrated. Unset: "
            f"{DEFAULT_PROBE_DIM}, or --dim where that is smaller."
        ),
    ] = None,
    metric: Annotated[Metric, typer.Option(help="The distance that decides.")] = Metric.SPHERICAL,
    protocol: Annotated[
        Protocol,
        typer.Option(help="`ten-fold` adds the paper's threshold of best accuracy as a level."),
    ] = Protocol.FMR,
    aligned: Aligned = False,
    flip: Flip = False,
    cache: Cache = None,
    exclude_people: Annotated[
        Path | None,
        typer.Option(
            help="People to leave out, such as those of a test: a folder with a subfolder for "
            "each, or a text file with a name on each line."
        ),
    ] = None,
    labels: Annotated[
        Path | None,
        typer.Option(
            help="A CSV `path,gender,race,age,...` of photos or people, as for `evaluate`: gives "
            "error rates by group."
        ),
    ] = None,
    worst_group: Annotated[
        bool,
        typer.Option(
            "--worst-group",
            help="Levels keep their FMR within each group, too, that has enough trials.",
        ),
    ] = False,
    photos: Annotated[
        int, typer.Option(min=1, max=10, help="Most photos averaged into one template.")
    ] = 3,
    liveness: Annotated[
        Path | None,
        typer.Option(
            help="Instead of people, photos as for `evaluate liveness`: sets only the liveness "
            "threshold of the contract file."
        ),
    ] = None,
    bpcer: Annotated[
        float,
        typer.Option(
            help="With --liveness: the share of live photos that may be taken for attacks."
        ),
    ] = 0.05,
    seed: Annotated[int, typer.Option(min=0, help="Seed for the random choices.")] = 0,
    _plan: Plan = None,
) -> Result:
    """Calibrate on labelled people, and write the contract file.

    Needs: a model pack, a decoys file, and photos of people with two photos or more each. 80
    people resolve FMR 1e-2 and 1e-3; a level that the data cannot resolve is left out. Of faces
    that nobody labelled, rejections are not measured. The contract file belongs to the master key
    that is in force. docs/thresholds.md explains it.

    Example: `veilface calibrate lfw --pack buffalo_l --decoys decoys.veil --out contract.json
    --strategy adversarial`
    """
    path = out or settings.resolved_contract_file
    if liveness is not None and folder is None:
        return set_liveness_threshold(liveness, path, settings, bpcer=bpcer)
    if folder is None or liveness is not None:
        raise UsageError("give the folder of labelled people, or --liveness and its photos")
    dims = default_probe_dims(dim) if probe_dims is None else parse_dims(probe_dims)
    pack = bulk_pack(settings, flip=flip, why="a contract is bound to a model pack")
    if dim is not None and dim >= pack.info.n:
        raise UsageError(f"--dim must be below the {pack.info.n} numbers of an embedding")
    if axes is not None and not (dim or 1) < axes <= pack.info.n:
        raise UsageError(f"--axes must lie above --dim, and be at most {pack.info.n}")
    if worst_group and labels is None:
        raise UsageError("--worst-group needs to know the groups: give --labels")
    known = None if labels is None else read_labels(labels)
    exclude = frozenset() if exclude_people is None else read_names(exclude_people)
    labelled = people_or_faces(folder).without(exclude)
    keyring = open_keyring(settings)
    sealer = file_sealer(keyring)
    source = load_decoys(decoys or settings.resolved_decoys_file, sealer, pack)
    extraction = extract(pack, labelled.paths, aligned=aligned, settings=settings, cache=cache)
    if labelled.people == len(labelled):
        extraction = each_person_once(extraction)
    groups = None if known is None else labels_of(extraction, known, labelled.root)
    with share_done("calibrating") as report:
        done = calibrate_folder(
            labelled,
            extraction,
            pack=pack,
            source=source,
            strategy=strategy,
            axes=axes,
            m=dim,
            options=CalibrationOptions(
                protocol="ten-fold" if protocol is Protocol.TEN_FOLD else "fmr",
                metric=metric,
                probe_dims=(0, *dims),
                photos_per_enrollment=photos,
                worst_group=worst_group,
                seed=seed,
            ),
            labels=groups,
            progress=lambda _what, share: report(share),
        )
    verdict = done.contract.verdict
    assert verdict is not None  # noqa: S101 - calibrate_folder judges
    contract = with_liveness_of(path, done.contract, pack, sealer)
    contract.save(path, sealer)
    notice = demo_notice(pack.info.embedder_sha256, n=pack.info.n)
    return Result(
        {
            "out": path,
            **notice,
            "contract": contract.to_json(),
            "failure_to_acquire": acquired_json(extraction),
            "chosen": done.point.chosen,
            "tried": done.point.tried,
            **_report_facts(done.report),
        },
        [
            *map(levels_table, done.contract.calibrations),
            *group_tables(done.contract),
            *_report_text(done.contract, done.report),
            f"{acquired(extraction)}.",
            f"{path}: contract {done.contract.contract_id[:16]}.",
            f"m = {done.point.dim} of {done.point.axes} axes: {done.point.chosen}.",
            *improvements(verdict),
            *verdict_lines(verdict),
        ],
    )


def parse_dims(text: str) -> tuple[int, ...]:
    """Read ``2,4,8``, or ``none``; :class:`UsageError` for anything else."""
    if text.strip() == "none":
        return ()
    return listed_numbers(text, "--probe-dims", least=1, most=128)


def levels_table(calibration: Calibration) -> Table:
    """Show what one calibration found."""
    photos = calibration.probe_photos
    kind = (
        f"lifted probes m={calibration.probe_m}"
        if calibration.mode == "s2s"
        else "raw probes of one photo"
        if photos == 1
        else f"raw probes, means of {photos} photos"
    )
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


def _report_text(contract: Contract, report: CalibrationReport) -> list[str]:
    consistency = report.consistency
    return [
        *(f"Not set: {sentence}." for sentence in report.unresolved),
        *(f"Not in the rule of the worst group: {sentence}." for sentence in report.left_out),
        *suspicious_lines(report),
        f"Default level: {contract.default_level}. Photos of one enrollment must agree to "
        f"{contract.photo_consistency:.3f}: {shown_rate(consistency.refused)} of the genuine sets "
        f"do not; {shown_rate(consistency.fmr)} of the pairs of two people do. Photos of one probe "
        f"must agree to {contract.probe_consistency:.3f}.",
    ]


def suspicious_lines(report: CalibrationReport) -> list[str]:
    """Name the pairs of people who may be one, most alike first."""
    pairs = report.suspicious
    if not pairs:
        return []
    more = f"  and {len(pairs) - MOST_SHOWN} more; see --json"
    return [
        f"Suspiciously alike, with a cosine above {SUSPICIOUS_ABOVE:g}: "
        f"{counted(len(pairs), 'pair')} of people; look at them, and put "
        "the photos of one person into one folder:",
        *(f"  {pair.first}, {pair.second}: {pair.cosine:.3f}" for pair in pairs[:MOST_SHOWN]),
        *([more] if len(pairs) > MOST_SHOWN else []),
    ]


def _report_facts(report: CalibrationReport) -> dict[str, Any]:
    consistency = report.consistency
    return {
        "photo_consistency": {
            "threshold": consistency.threshold,
            "probe_threshold": consistency.probe_threshold,
            "fmr": consistency.fmr,
            "refused": consistency.refused,
        },
        "unresolved": report.unresolved,
        "left_out_of_worst_group": report.left_out,
        "suspicious_above": SUSPICIOUS_ABOVE,
        "suspicious": report.suspicious,
        "ten_fold": [
            {
                "accuracy_mean": folds.accuracy_mean,
                "accuracy_std": folds.accuracy_std,
                "threshold_mean": folds.threshold_mean,
            }
            for folds in report.ten_folds
        ],
    }
