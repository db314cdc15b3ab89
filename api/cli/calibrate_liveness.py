"""``veilface calibrate --liveness``: the liveness threshold of a contract that is there."""

from dataclasses import replace
from pathlib import Path

from api.cli.bulk import Bulk
from api.cli.console import demo_notice, message
from api.cli.errors import CommandError
from api.cli.evaluate_liveness import require_liveness, score_with_progress
from api.cli.results import Result, Table
from api.cli.verdict import shown_rate
from api.settings import Settings
from templates.contract.document import Contract
from templates.errors import VeilfaceError
from verify.evaluation.liveness.presentations import read_presentations
from verify.evaluation.liveness.rates import calibrate_liveness


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
    liveness = require_liveness(pack)
    contract.binding.require_embedder(
        embedder_sha256=pack.info.embedder_sha256,
        preprocessing=pack.info.preprocessing,
        n=pack.info.n,
    )
    scored = score_with_progress(pack, presented)
    calibration = calibrate_liveness(scored, liveness.graphs, target=bpcer)
    replace(contract, liveness=calibration).save(file, sealer)
    rates = [("live", "BPCER", calibration.bpcer)]
    rates += [(name, "APCER", rate) for name, rate in calibration.apcer.items()]
    return Result(
        {
            **demo_notice(pack.info),
            "out": file,
            "contract_id": contract.contract_id,
            "liveness": calibration,
        },
        [
            Table(
                f"liveness, threshold {calibration.threshold:.4g}",
                ("photos", "error", "seen"),
                [(photos, error, shown_rate(rate)) for photos, error, rate in rates],
            ),
            "Other photos give other rates: `veilface evaluate liveness`."
            if calibration.apcer
            else "No attack photos: what passes at this threshold was not measured.",
            f"{file}: contract {contract.contract_id[:16]}.",
        ],
    )


def with_liveness_of(file: Path, contract: Contract, bulk: Bulk) -> Contract:
    """Keep the liveness threshold of the contract file that a new calibration replaces.

    It belongs to the liveness graphs, not to the templates: kept where the pack still has them.
    """
    try:
        liveness = Contract.load(file, bulk.sealer).liveness if file.is_file() else None
    except VeilfaceError:  # another format or another master key: it is replaced
        liveness = None
    if liveness is None:
        return contract
    graphs = bulk.pack.liveness
    if graphs is None or liveness.graphs != graphs.graphs:
        message(
            f"The liveness threshold of {file} is dropped: the pack has other liveness graphs. Run "
            "`veilface calibrate --liveness`."
        )
        return contract
    return replace(contract, liveness=liveness)
