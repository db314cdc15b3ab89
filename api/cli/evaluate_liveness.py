"""``veilface evaluate liveness``: what the liveness graphs of a pack detect, and what not."""

from pathlib import Path
from typing import Annotated

import typer

from api.cli.console import demo_notice, message, progress
from api.cli.descriptors import BULK, bulk_pack
from api.cli.errors import CommandError, UsageError, require_extra
from api.cli.evaluation_report import write_results
from api.cli.inputs import listed, load_decoys
from api.cli.results import Plan, Result, Table, reports
from api.service.opening import file_sealer, open_keyring
from api.settings import Settings
from attacks.impostor_presentations import verify_presentations
from models.liveness import PassiveLiveness
from models.pack import ModelPack
from templates.contract.document import Contract
from verify.datasets import DatasetError
from verify.evaluation.liveness.document import (
    CONTRACT_POINT,
    document,
    markdown,
    row_cells,
)
from verify.evaluation.liveness.presentations import PresentationSet, read_presentations
from verify.evaluation.liveness.rates import threshold_at_bpcer
from verify.evaluation.liveness.scores import ScoredSet, VerifiedSet, score_set
from verify.evaluation.plan import Json
from verify.evaluation.provenance import model_facts
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
    contract: Annotated[
        Path | None,
        typer.Option(
            help="A contract file: its liveness threshold is applied, and, with the decoys, "
            "attacks go through the whole verification."
        ),
    ] = None,
    decoys: Annotated[
        Path | None,
        typer.Option(
            help="The contract's decoys. Unset: `decoys.veil` in `data_dir`, where it is."
        ),
    ] = None,
    bpcer: Annotated[
        str,
        typer.Option(help="Also set thresholds on these photos, at these BPCER."),
    ] = "0.01,0.05,0.1",
    level: Annotated[
        str | None,
        typer.Option(help="Level of the whole verification. Unset: the contract's default."),
    ] = None,
    out: Annotated[Path, typer.Option(help="Folder of the results.")] = Path("liveness"),
    _plan: Plan = None,
) -> Result:
    """Evaluate the pack's liveness graphs on live and attack photos (ISO/IEC 30107-3).

    Reports APCER by species, BPCER, photos without a face and, with a contract, its decoys and
    subjects, IAPMR. Writes results.json, results.csv and results.md to --out.
    docs/liveness.md says what such graphs cannot see.

    Example: `veilface evaluate liveness photos --pack buffalo_l --contract contract.json
    --out liveness-results`
    """
    require_extra("evaluate")
    targets = listed(bpcer, float, "--bpcer", expected="rates such as 0.01,0.05")
    if not all(0 < target < 1 for target in targets):
        raise UsageError("--bpcer takes rates between 0 and 1")
    if contract is None and (decoys is not None or level is not None):
        raise UsageError("--decoys and --level are of the whole verification: give --contract too")
    presented = read_presentations(data, attacks=True)
    pack = bulk_pack(settings, flip=False, why="liveness graphs are part of a model pack")
    liveness = require_liveness(pack)
    bound = None
    if contract is not None:
        bound = Contract.load(contract, file_sealer(open_keyring(settings)))
        if bound.binding.preprocessing["flip"]:
            pack = bulk_pack(settings, flip=True, why="")
    if bound is not None and bound.liveness is not None:
        bound.liveness.require_graphs(liveness.graphs)
    scored = score_with_progress(pack, presented)
    require_responses(scored)
    points, refused = _points(scored, bound, targets)
    verified, unverified = _verified(scored, pack, bound, settings, decoys=decoys, level=level)
    results = document(
        scored,
        model_facts(pack.info, recorded_of(pack)),
        liveness,
        points,
        contract=bound,
        verified=verified,
        unverified=unverified,
        refused=refused,
    )
    out.mkdir(parents=True, exist_ok=True)
    written = write_results(results, markdown(results), {}, out)
    notice = demo_notice(pack.info.embedder_sha256, n=pack.info.n)
    facts = results["verification"]
    return Result(
        {**notice, "out": out, "files": [path.name for path in written], **results},
        [
            _summary(results),
            *([] if facts["measured"] else [f"IAPMR was not measured: {facts['reason']}."]),
            *(f"Not reported: {sentence}." for sentence in refused),
            f"{out}: {', '.join(path.name for path in written)}.",
        ],
    )


def require_liveness(pack: ModelPack) -> PassiveLiveness:
    """Return the liveness graphs of a pack."""
    if pack.liveness is None:
        raise CommandError(
            f"the pack {pack.info.name} has no liveness graph: add one to its folder "
            "(docs/liveness.md), and look at it with `veilface models inspect`"
        )
    return pack.liveness


def score_with_progress(pack: ModelPack, presented: PresentationSet) -> ScoredSet:
    """Score photos under a progress bar; say how many have no face."""
    with progress("scoring photos", len(presented.presentations)) as advance:
        scored = score_set(pack, presented, progress=advance)
    if scored.failures:
        message(f"note: {len(scored.failures)} photos without a face are counted apart")
    return scored


def require_responses(scored: ScoredSet) -> None:
    """Refuse a set of which a whole side has no face."""
    attacks = [len(scored.scored(name)) for name in scored.presented.species]
    if not len(scored.scored(None)) or not any(attacks):
        raise CommandError(
            "a face was found in no live photo, or in no attack photo: are these whole frames with "
            "a face in them?"
        )


def _points(
    scored: ScoredSet, contract: Contract | None, targets: tuple[float, ...]
) -> tuple[dict[str, float], list[str]]:
    points: dict[str, float] = {}
    refused = []
    if contract is not None and contract.liveness is not None:
        points[CONTRACT_POINT] = contract.liveness.threshold
    elif contract is not None:
        refused.append(
            "the contract has no liveness threshold; `veilface calibrate --liveness` sets one"
        )
    for target in sorted(set(targets)):
        try:
            points[f"bpcer-{target:g}"] = threshold_at_bpcer(scored.scored(None), target)
        except DatasetError as error:
            refused.append(str(error))
    if not points:
        raise CommandError(f"no threshold to report at: {'; '.join(refused)}")
    return points, refused


def _verified(
    scored: ScoredSet,
    pack: ModelPack,
    contract: Contract | None,
    settings: Settings,
    *,
    decoys: Path | None,
    level: str | None,
) -> tuple[VerifiedSet | None, str | None]:
    """Verify the photos, or say why that was not done."""
    if contract is None:
        return None, "it takes a contract (--contract) and its decoys"
    if not any(one.subject for one in scored.presentations):
        return None, "nothing says whose faces the photos show; give a CSV with subjects"
    file = decoys or settings.resolved_decoys_file
    if decoys is None and not file.is_file():
        return None, "it takes the contract's decoys (--decoys)"
    source = load_decoys(file, file_sealer(open_keyring(settings)), pack)
    source = source.reduced(contract.binding.axes)
    verified = verify_presentations(scored, pack.info, contract, source, level=level)
    if not verified.enrolled:
        return None, (
            f"no subject has {verified.enrolled_photos} live photos that agree, to be enrolled by"
        )
    return verified, None


def _summary(results: Json) -> Table:
    live, attacks = results["dataset"]["live"], sum(results["dataset"]["attacks"].values())
    title = f"{results['dataset']['name']}: {live} live photos, {attacks} attacks"
    return Table(title, *row_cells(results["rows"]))
