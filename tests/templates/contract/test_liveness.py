"""The liveness threshold of a contract: what it belongs to, and what its seal covers."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from templates.contract.document import Contract, LivenessCalibration, Rate
from templates.errors import ContractError, SealError, Uncalibrated
from tests.templates.contract.test_contract import SEALER, make_contract

GRAPHS = ("0a" * 32, "1b" * 32)


@pytest.fixture
def liveness() -> LivenessCalibration:
    return LivenessCalibration(
        graphs=GRAPHS,
        threshold=0.75,
        bpcer=Rate(15, 300, 0.03, 0.08),
        target_bpcer=0.05,
        apcer={"print": Rate(3, 100, 0.01, 0.08), "screen": Rate(9, 100, 0.05, 0.16)},
        calibrated_on={"dataset": "booth", "subjects": None},
    )


def test_a_contract_keeps_its_liveness_threshold(
    tmp_path: Path, liveness: LivenessCalibration
) -> None:
    contract = replace(make_contract(), liveness=liveness)
    contract.save(tmp_path / "contract.json", SEALER)
    assert Contract.load(tmp_path / "contract.json", SEALER).liveness == liveness
    assert contract.public()["liveness"] == liveness.to_json()
    assert contract.contract_id == make_contract().contract_id
    assert [entry.calibration_id for entry in contract.calibrations] == [
        entry.calibration_id for entry in make_contract().calibrations
    ]


def test_a_contract_without_one_is_written_as_before(tmp_path: Path) -> None:
    make_contract().save(tmp_path / "contract.json", SEALER)
    assert "liveness" not in json.loads((tmp_path / "contract.json").read_text())
    assert Contract.load(tmp_path / "contract.json", SEALER).liveness is None


def test_an_edited_threshold_is_refused(tmp_path: Path, liveness: LivenessCalibration) -> None:
    path = tmp_path / "contract.json"
    replace(make_contract(), liveness=liveness).save(path, SEALER)
    document = json.loads(path.read_text())
    document["liveness"]["threshold"] = 0.0
    path.write_text(json.dumps(document))
    with pytest.raises(SealError):
        Contract.load(path, SEALER)
    del document["liveness"]
    path.write_text(json.dumps(document))
    with pytest.raises(SealError):
        Contract.load(path, SEALER)


def test_at_the_threshold_is_live(liveness: LivenessCalibration) -> None:
    assert liveness.is_live(0.75)
    assert not liveness.is_live(0.7499)
    assert not liveness.is_live(float("nan"))
    assert liveness.worst_species == "screen"
    assert replace(liveness, apcer={}).worst_species is None


def test_other_graphs_are_refused(liveness: LivenessCalibration) -> None:
    liveness.require_graphs(GRAPHS)
    for other in (GRAPHS[:1], GRAPHS[::-1], (), (*GRAPHS, "2c" * 32)):
        with pytest.raises(Uncalibrated, match="calibrate --liveness"):
            liveness.require_graphs(other)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("graphs", []),
        ("graphs", list(GRAPHS[::-1])),
        ("graphs", [GRAPHS[0], GRAPHS[0]]),
        ("graphs", ["0A" * 32]),
        ("graphs", [1]),
        ("threshold", "0.5"),
        ("target_bpcer", 0),
        ("target_bpcer", 1),
        ("bpcer", {}),
        ("bpcer", Rate(0, 0, 0.0, 1.0).to_json()),
        ("apcer", []),
        ("apcer", {"": Rate(0, 9, 0.0, 1.0).to_json()}),
        ("apcer", {"a/b": Rate(0, 9, 0.0, 1.0).to_json()}),
        ("apcer", {str(n): Rate(0, 9, 0.0, 1.0).to_json() for n in range(65)}),
        ("calibrated_on", None),
        ("policy", "off"),
        ("more", 1),
    ],
)
def test_a_broken_entry_is_refused(liveness: LivenessCalibration, key: str, value: object) -> None:
    with pytest.raises(ContractError):
        LivenessCalibration.from_json({**liveness.to_json(), key: value})
