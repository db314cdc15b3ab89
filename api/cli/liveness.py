"""What the liveness graphs of a pack detect: ``evaluate liveness`` and ``calibrate --liveness``."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from api.cli.bulk import BULK, Bulk, listed, write_document
from api.cli.console import demo_notice, message, progress
from api.cli.errors import CommandError, require_extra
from api.cli.options import Plan, reports
from api.cli.results import Result, Table
from api.settings import Settings
from attacks.impostor_presentations import ENROLLED_PHOTOS, verify_presentations
from models.liveness import PassiveLiveness
from models.pack import ModelPack
from templates.contract.document import Contract
from templates.errors import VeilfaceError
from verify.datasets import DatasetError
from verify.evaluation.liveness.document import (
    CONTRACT_POINT,
    document,
    markdown,
    row_cells,
)
from verify.evaluation.liveness.presentations import PresentationSet, read_presentations
from verify.evaluation.liveness.rates import calibrate_liveness, threshold_at_bpcer
from verify.evaluation.liveness.scores import ScoredSet, VerifiedSet, score_set
from verify.evaluation.provenance import model_facts
from verify.evaluation.tables import write_csv
from verify.preparation import recorded_of


@reports(*BULK)
def evaluate_liveness(
    data: Annotated[
        Path,
        typer.Argument(
            help="Photos: a folder with `live/` and `spoof/SPECIES/`, or a CSV "
            "`path,presentation[,subject]`, where presentation is `live` or a species."
        ),
    ],
    *,
    settings: Settings,
    bpcer: Annotated[
        str, typer.Option(help="Also set thresholds on these photos, at these BPCER.")
    ] = "0.01,0.05,0.1",
    out: Annotated[Path, typer.Option(help="Folder of the results.")] = Path("liveness"),
    _plan: Plan = None,
) -> Result:
    """Evaluate the pack's liveness graphs on live and attack photos (ISO/IEC 30107-3).

    Reports APCER by species, BPCER, photos without a face and, with subjects and the contract and
    decoys in `data_dir`, IAPMR of the whole verification. Writes results.json, results.csv and
    results.md to --out. docs/liveness.md says what such graphs cannot see.

    Example: `veilface evaluate liveness photos --pack buffalo_l --out liveness-results`
    """
    require_extra("evaluate")
    targets = listed(bpcer, _rate, "--bpcer", expected="rates between 0 and 1, as 0.01,0.05")
    presented = read_presentations(data, attacks=True)
    bulk = Bulk(settings)
    contract = None
    if settings.resolved_contract_file.is_file():
        contract = Contract.load(settings.resolved_contract_file, bulk.sealer)
        bulk = Bulk(settings, flip=bool(contract.binding.preprocessing["flip"]))
    pack = bulk.pack
    liveness = _require_liveness(pack)
    if contract is not None and contract.liveness is not None:
        contract.liveness.require_graphs(liveness.graphs)
    scored = _scored(pack, presented)
    points, refused = _points(scored, contract, targets)
    verified = _verified(scored, bulk, contract)
    results = document(
        scored,
        model_facts(pack.info, recorded_of(pack)),
        liveness,
        points,
        contract=contract,
        verified=None if isinstance(verified, str) else verified,
        unverified=verified if isinstance(verified, str) else None,
        refused=refused,
    )
    written = write_document(results, out, "results", markdown=markdown(results))
    files = [*(path.name for path in written), "results.csv"]
    write_csv(results["rows"], out / "results.csv")
    live, attacks = results["dataset"]["live"], sum(results["dataset"]["attacks"].values())
    title = f"{presented.name}: {live} live photos, {attacks} attacks"
    return Result(
        {**demo_notice(pack.info), "out": out, "files": files, **results},
        [
            Table(title, *row_cells(results["rows"])),
            *([f"IAPMR was not measured: {verified}."] if isinstance(verified, str) else []),
            *(f"Not reported: {sentence}." for sentence in refused),
            f"{out}: {', '.join(files)}.",
        ],
    )


def _rate(text: str) -> float:
    if not 0 < float(text) < 1:
        raise ValueError(text)
    return float(text)


def _require_liveness(pack: ModelPack) -> PassiveLiveness:
    """Return the liveness graphs of a pack."""
    if pack.liveness is None:
        raise CommandError(
            f"the pack {pack.info.name} has no liveness graph: add one to its folder "
            "(docs/liveness.md), and look at it with `veilface models inspect`"
        )
    return pack.liveness


def _scored(pack: ModelPack, presented: PresentationSet) -> ScoredSet:
    """Score photos under a progress bar; say how many have no face."""
    with progress("scoring photos", len(presented.presentations)) as advance:
        scored = score_set(pack, presented, progress=advance)
    if scored.failures:
        message(f"note: {len(scored.failures)} photos without a face are counted apart")
    return scored


def _points(
    scored: ScoredSet, contract: Contract | None, targets: Sequence[float]
) -> tuple[dict[str, float], list[str]]:
    """Thresholds to report at, and why there are none at others."""
    live = scored.scored(None)
    if not len(live) or not any(len(scored.scored(name)) for name in scored.presented.species):
        raise CommandError(
            "a face was found in no live photo, or in no attack photo: are these whole frames with "
            "a face in them?"
        )
    points: dict[str, float] = {}
    refused = []
    if contract is not None and contract.liveness is not None:
        points[CONTRACT_POINT] = contract.liveness.threshold
    elif contract is not None:
        refused.append(
            "the contract has no liveness threshold; `veilface calibrate --liveness` sets one"
        )
    for target in sorted(targets):
        try:
            points[f"bpcer-{target:g}"] = threshold_at_bpcer(live, target)
        except DatasetError as error:
            refused.append(str(error))
    if not points:
        raise CommandError(f"no threshold to report at: {'; '.join(refused)}")
    return points, refused


def _verified(scored: ScoredSet, bulk: Bulk, contract: Contract | None) -> VerifiedSet | str:
    """Verify the photos, or say why that was not done."""
    if contract is None or not bulk.settings.resolved_decoys_file.is_file():
        return "it takes the contract and the decoys of a deployment (--data-dir)"
    if not any(one.subject for one in scored.presentations):
        return "nothing says whose faces the photos show; give a CSV with subjects"
    source = bulk.decoys(None).reduced(contract.binding.axes)
    verified = verify_presentations(scored, bulk.pack.info, contract, source)
    if not verified.enrolled:
        return f"no subject has {ENROLLED_PHOTOS} live photos that agree, to be enrolled by"
    return verified


def set_liveness_threshold(data: Path, file: Path, settings: Settings, *, bpcer: float) -> Result:
    """Set the threshold at a BPCER on live photos, and store it in a contract file."""
    presented = read_presentations(data, attacks=False)
    if not file.is_file():
        raise CommandError(
            f"{file} is not there: calibrate on labelled people first; --liveness adds a threshold "
            "to that contract"
        )
    sealer = Bulk(settings).sealer
    contract = Contract.load(file, sealer)
    pack = Bulk(settings, flip=bool(contract.binding.preprocessing["flip"])).pack
    liveness = _require_liveness(pack)
    contract.binding.require_embedder(
        embedder_sha256=pack.info.embedder_sha256,
        preprocessing=pack.info.preprocessing,
        n=pack.info.n,
    )
    scored = _scored(pack, presented)
    calibration = calibrate_liveness(scored, liveness.graphs, target=bpcer)
    replace(contract, liveness=calibration).save(file, sealer)
    return Result(
        {
            **demo_notice(pack.info),
            "out": file,
            "contract_id": contract.contract_id,
            "liveness": calibration,
        }
    )


def with_liveness_of(file: Path, contract: Contract, bulk: Bulk) -> Contract:
    """Keep the liveness threshold of the contract file that a new calibration replaces.

    It belongs to the liveness graphs, not to the templates; with other graphs it is refused.
    """
    try:
        earlier = Contract.load(file, bulk.sealer) if file.is_file() else contract
    except VeilfaceError:  # another format or another master key: it is replaced
        earlier = contract
    return replace(contract, liveness=earlier.liveness)
