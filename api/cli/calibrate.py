"""``veilface calibrate``: thresholds for stated false match rates."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from api.cli.console import demo_notice, emit, message, say, share_done, show, table
from api.cli.descriptors import BULK, Aligned, Cache, Flip, bulk_pack, extract
from api.cli.errors import CommandError, UsageError
from api.cli.files import read_bounded, read_names
from api.cli.inputs import load_decoys
from api.cli.options import AsJson, takes_settings
from api.process.opening import file_sealer, open_keyring
from api.process.preparation import (
    DEFAULT_DIM,
    DEFAULT_PROBE_DIM,
    acquired,
    acquired_json,
    calibrate_folder,
    default_probe_dims,
)
from api.settings import Settings
from attacks.likelihood import share_found
from templates.contract.document import Calibration, Contract, Rate
from templates.distances import Metric
from templates.space.lifting import Strategy
from verify import CalibrationOptions, CalibrationReport, labelled_folder

MOST_SHOWN = 20
LEAST_DECOYS = 24
"""Fewer decoys in a template are noted: its foot point, taken for a descriptor, matches a fresh
photo of the person too often. At raw FMR 1e-3 on LFW: 20 % at 16 decoys, 8 % at 24, 4 % at 32.
Even where decoys are spread just as the people are, other attacks need more (docs/privacy.md)."""


MOST_FOUND = 0.1
"""Share of descriptors found by the decoys' statistics from which on it is noted."""


class Protocol(StrEnum):
    """How levels are set."""

    FMR = "fmr"
    TEN_FOLD = "ten-fold"


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(calibrate)


@takes_settings(*BULK)
def calibrate(
    folder: Annotated[
        Path,
        typer.Argument(
            help="Labelled faces: one subfolder for each person, with photos in it (as LFW has "
            "them).",
            show_default=False,
        ),
    ],
    *,
    settings: Settings,
    decoys: Annotated[
        Path | None,
        typer.Option(
            help="The file of `decoys build`. Unset: `decoys.veil` in `data_dir`.",
            show_default=False,
        ),
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
        int, typer.Option(min=1, max=128, help="Dimension m of stored templates.")
    ] = DEFAULT_DIM,
    probe_dims: Annotated[
        str | None,
        typer.Option(
            help="Dimensions of lifted probes that clients may send, for example `2,4,8`; `none` "
            "for none, which is quicker. Raw probes, such as photos, are always calibrated. Unset: "
            f"{DEFAULT_PROBE_DIM}, or --dim where that is smaller.",
            show_default=False,
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
            help="People to leave out, such as those in a test: a folder whose subfolders are "
            "named like them, or a text file with a name on each line.",
            show_default=False,
        ),
    ] = None,
    aliases: Annotated[
        Path | None,
        typer.Option(
            help="People who appear under two names: a text file, `second name,first name` on each "
            "line.",
            show_default=False,
        ),
    ] = None,
    photos: Annotated[
        int, typer.Option(min=1, max=10, help="Most photos averaged into one template.")
    ] = 3,
    seed: Annotated[int, typer.Option(min=0, help="Seed for the random choices.")] = 0,
    as_json: AsJson = False,
) -> None:
    """Calibrate on labelled people, and write the contract file.

    Needs: a model pack, a decoys file, and photos of people with two photos or more each. 80
    people resolve FMR 1e-2 and 1e-3; lower targets need more people, and those that the data
    cannot resolve are refused. The contract file belongs to the master key that is in force.

    Example: `veilface calibrate lfw --pack buffalo_l --decoys decoys.veil --out contract.json
    --strategy adversarial --dim 32`
    """
    dims = default_probe_dims(dim) if probe_dims is None else parse_dims(probe_dims)
    pack = bulk_pack(settings, flip=flip, why="a contract is bound to a model pack")
    if dim >= pack.info.n:
        raise UsageError(f"--dim must be below the {pack.info.n} numbers of an embedding")
    labelled = labelled_folder(folder)
    name_of = dict(zip(labelled.paths, labelled.identities, strict=True))
    keyring = open_keyring(settings)
    sealer = file_sealer(keyring)
    source = load_decoys(decoys or settings.resolved_decoys_file, sealer, pack)
    exclude = frozenset() if exclude_people is None else read_names(exclude_people)
    extraction = extract(pack, labelled.paths, aligned=aligned, settings=settings, cache=cache)
    with share_done("calibrating") as report:
        done = calibrate_folder(
            labelled,
            extraction,
            pack=pack,
            source=source,
            strategy=strategy,
            m=dim,
            options=CalibrationOptions(
                protocol="ten-fold" if protocol is Protocol.TEN_FOLD else "fmr",
                metric=metric,
                probe_dims=(0, *dims),
                photos_per_enrollment=photos,
                seed=seed,
            ),
            exclude=exclude,
            aliases={} if aliases is None else read_aliases(aliases),
            progress=lambda _what, share: report(share),
        )
    path = out or settings.resolved_contract_file
    done.contract.save(path, sealer)
    share_rate = None
    if strategy.needs_decoys:
        share_rate = share_found(
            extraction.descriptors,
            [name_of[path] for path in extraction.paths],
            source,
            strategy=strategy,
            m=dim,
            cosine=done.report.consistency.match_cosine,
            seed=seed,
        )
    for note in (concealment_note(strategy, dim), likeness_note(share_rate, strategy, dim)):
        if note:
            message(f"note: {note}")
    notice = demo_notice(pack.info.embedder_sha256, n=pack.info.n)
    if as_json:
        emit(
            {
                "out": str(path),
                **notice,
                "contract": done.contract.public(),
                "failure_to_acquire": acquired_json(extraction),
                "found_by_decoy_likelihood": None if share_rate is None else share_rate.to_json(),
                **_report_json(done.report),
            }
        )
        return
    for calibration in done.contract.calibrations:
        show(levels_table(calibration))
    _tell(done.contract, done.report)
    say(f"{acquired(extraction)}.")
    say(f"{path}: contract {done.contract.contract_id[:16]}.")


def concealment_note(strategy: Strategy, m: int) -> str | None:
    """Say what templates show whose directions have too few decoys among them, or None."""
    if strategy.decoys(m) >= LEAST_DECOYS:
        return None
    return (
        f"templates of strategy {strategy} and dimension {m} conceal little: the point of each "
        "template nearest to the origin shows the face; use --strategy adversarial and "
        f"--dim {DEFAULT_DIM} or more"
    )


def likeness_note(rate: Rate | None, strategy: Strategy, m: int) -> str | None:
    """Say that the decoys are spread unlike the people, where their statistics give faces away."""
    if rate is None or rate.value <= MOST_FOUND:
        return None
    return (
        f"from {100 * rate.value:.0f} % of the templates of these people ({rate.errors} of "
        f"{rate.trials}, {strategy}, m = {m}), who has the decoy generator finds the embedding: "
        "the decoys are spread unlike these people. Build the decoys from thousands of other "
        "people's photos of the same kind, then calibrate again: this line says what a change "
        "gains (docs/privacy.md)"
    )


def parse_dims(text: str) -> tuple[int, ...]:
    """Read ``2,4,8``, or ``none``.

    Raises
    ------
    UsageError
        Something else, or a dimension twice.
    """
    if text.strip() == "none":
        return ()
    parts = [part.strip() for part in text.split(",") if part.strip()]
    if not parts or not all(part.isdecimal() and 1 <= int(part) <= 128 for part in parts):
        raise UsageError(
            "--probe-dims takes dimensions from 1 to 128, separated by commas, or none"
        )
    dims = tuple(int(part) for part in parts)
    if len(set(dims)) != len(dims):
        raise UsageError("--probe-dims names a dimension twice")
    return dims


def read_aliases(file: Path) -> dict[str, str]:
    """Read ``second name,first name`` lines."""
    text = read_bounded(file, 16 * 2**20).decode("utf-8", errors="replace")
    names: dict[str, str] = {}
    for number, line in enumerate(text.splitlines(), start=1):
        if not line.strip() or line.startswith("#"):
            continue
        second, comma, first = (part.strip() for part in line.partition(","))
        if not (second and comma and first):
            raise CommandError(f"{file.name}, line {number}: expected `second name,first name`")
        names[second] = first
    return names


def levels_table(calibration: Calibration) -> Any:
    """Show what one calibration found."""
    kind = "raw probes" if calibration.mode == "p2s" else f"lifted probes m={calibration.probe_m}"
    columns = ("level", "similarity", "cohort score", "FMR seen (95 %)", "FNMR seen (95 %)")
    listing = table(f"{kind}, {calibration.metric} distance", *columns)
    for level in calibration.levels:
        listing.add_row(
            level.name,
            f"{level.similarity_threshold:.4f}",
            f"{level.cohort_threshold:.3f}",
            shown_rate(level.fmr),
            shown_rate(level.fnmr),
        )
    return listing


def shown_rate(rate: Rate) -> str:
    """Write a rate with its counts and interval."""
    return (
        f"{100 * rate.value:.3g} % ({rate.errors}/{rate.trials}; "
        f"{100 * rate.ci_low:.2g}-{100 * rate.ci_high:.2g} %)"
    )


def _tell(contract: Contract, report: CalibrationReport) -> None:
    for sentence in report.unresolved:
        say(f"Not set: {sentence}.")
    if report.suspicious:
        say(
            f"{len(report.suspicious)} pairs of people are suspiciously alike (cosine above "
            f"{report.suspicious_above:g}); look at them, and name the same people in --aliases:"
        )
        for pair in report.suspicious[:MOST_SHOWN]:
            say(f"  {pair.first},{pair.second}  {pair.cosine:.3f}")
        if len(report.suspicious) > MOST_SHOWN:
            message(f"note: {len(report.suspicious) - MOST_SHOWN} more; see --json")
    consistency = report.consistency
    say(
        f"Default level: {contract.default_level}. Photos of one enrollment must agree to "
        f"{contract.photo_consistency:.3f}: {shown_rate(consistency.refused)} of the genuine sets "
        f"do not; {shown_rate(consistency.fmr)} of the pairs of two people do."
    )


def _report_json(report: CalibrationReport) -> dict[str, Any]:
    return {
        "photo_consistency": {
            "threshold": report.consistency.threshold,
            "fmr": report.consistency.fmr.to_json(),
            "refused": report.consistency.refused.to_json(),
        },
        "unresolved": list(report.unresolved),
        "suspicious_above": report.suspicious_above,
        "suspicious": [
            {"first": pair.first, "second": pair.second, "cosine": pair.cosine}
            for pair in report.suspicious
        ],
        "ten_fold": [
            {
                "accuracy_mean": folds.accuracy_mean,
                "accuracy_std": folds.accuracy_std,
                "threshold_mean": folds.threshold_mean,
            }
            for folds in report.ten_folds
        ],
    }
