"""``veilface calibrate --liveness``: the liveness threshold of a contract that is there."""

from dataclasses import replace
from pathlib import Path

from api.cli.console import demo_notice, message
from api.cli.descriptors import bulk_pack
from api.cli.errors import CommandError, UsageError
from api.cli.evaluate_liveness import require_liveness, score_with_progress
from api.cli.results import Result, Table
from api.cli.verdict import shown_rate
from api.service.opening import file_sealer, open_keyring
from api.settings import Settings
from models.pack import ModelPack
from templates.contract.document import Contract
from templates.errors import VeilfaceError
from templates.keys.sealing import Sealer
from verify.evaluation.liveness.presentations import read_presentations
from verify.evaluation.liveness.rates import calibrate_liveness


def set_liveness_threshold(data: Path, file: Path, settings: Settings, *, bpcer: float) -> Result:
    """Set the threshold at a BPCER on live photos, and store it in a contract file."""
    if not 0 < bpcer < 1:
        raise UsageError("--bpcer takes a rate between 0 and 1")
    presented = read_presentations(data, attacks=False)
    if not file.is_file():
        raise CommandError(
            f"{file} is not there: calibrate on labelled people first; --liveness adds a threshold "
            "to that contract"
        )
    sealer = file_sealer(open_keyring(settings))
    contract = Contract.load(file, sealer)
    flip = bool(contract.binding.preprocessing["flip"])
    pack = bulk_pack(settings, flip=flip, why="liveness graphs are part of a model pack")
    liveness = require_liveness(pack)
    contract.binding.require_embedder(
        embedder_sha256=pack.info.embedder_sha256,
        preprocessing=pack.info.preprocessing,
        n=pack.info.n,
    )
    scored = score_with_progress(pack, presented)
    calibration = calibrate_liveness(scored, liveness.graphs, target=bpcer)
    replace(contract, liveness=calibration).save(file, sealer)
    notice = demo_notice(pack.info.embedder_sha256, n=pack.info.n)
    worst = calibration.worst_species
    species = [(name, "APCER", shown_rate(rate)) for name, rate in calibration.apcer.items()]
    return Result(
        {
            **notice,
            "out": file,
            "contract_id": contract.contract_id,
            "liveness": calibration,
        },
        [
            Table(
                f"liveness, threshold {calibration.threshold:.4g}",
                ("photos", "error", "seen"),
                [("live", "BPCER", shown_rate(calibration.bpcer)), *species],
            ),
            "No attack photos: what passes at this threshold was not measured."
            if worst is None
            else f"Worst species: {worst}, of which {shown_rate(calibration.apcer[worst])} pass. "
            "Other photos give other rates: `veilface evaluate liveness`.",
            f"{file}: contract {contract.contract_id[:16]}.",
        ],
    )


def with_liveness_of(file: Path, contract: Contract, pack: ModelPack, sealer: Sealer) -> Contract:
    """Keep the liveness threshold of the contract file that a new calibration replaces.

    It belongs to the liveness graphs, not to the templates: kept where the pack still has them.
    """
    if not file.is_file():
        return contract
    try:
        liveness = Contract.load(file, sealer).liveness
    except VeilfaceError:  # another format or another master key: it is replaced
        return contract
    if liveness is None:
        return contract
    if pack.liveness is None or liveness.graphs != pack.liveness.graphs:
        message(
            f"The liveness threshold of {file} is dropped: the pack has other liveness graphs. Run "
            "`veilface calibrate --liveness`."
        )
        return contract
    return replace(contract, liveness=liveness)
