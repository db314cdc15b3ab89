"""Rates by group in a contract: kept, sealed, optional, and bounded."""

import dataclasses
import json
from pathlib import Path

import pytest

from templates.contract.canonical import MAX_ITEMS, MAX_PARTS, too_many_parts
from templates.contract.document import MAX_CALIBRATIONS, Contract, Level, Rate
from templates.contract.levels import (
    MAX_GROUPS,
    MAX_LEVELS,
    MAX_PROBE_PHOTOS,
    GroupRates,
)
from templates.errors import ContractError, SealError
from tests.templates.contract.test_contract import (
    LIFTED,
    SEALER,
    make_binding,
    make_calibration,
    make_contract,
)

RATE = Rate(1, 1000, 0.0, 0.01)
WOMEN = GroupRates("gender", "Female", Rate(3, 400, 0.002, 0.02), RATE, True, False)
MEN = dataclasses.replace(WOMEN, group="Male", fmr=RATE)


def level(*groups: GroupRates, name: str = "fmr-1e-2") -> Level:
    return Level(name, 1e-2, 2.0, RATE, RATE, groups=groups)


def test_a_contract_keeps_its_groups_under_its_seal(tmp_path: Path) -> None:
    path = tmp_path / "contract.json"
    contract = make_contract(calibrations=(make_calibration(levels=(level(WOMEN, MEN),)),))
    contract.save(path, SEALER)
    assert Contract.load(path, SEALER).calibrations[0].levels[0].groups == (WOMEN, MEN)
    document = json.loads(path.read_text())
    document["calibrations"][0]["levels"][0]["groups"][0]["fmr"]["errors"] = 1
    path.write_text(json.dumps(document))
    with pytest.raises((ContractError, SealError)):
        Contract.load(path, SEALER)


def test_a_level_without_groups_is_written_as_before_there_were_any() -> None:
    """Its calibration's id, and so older files, depend on it."""
    assert level().to_json().keys() == {
        *("name", "target_fmr", "score_threshold", "fmr", "fnmr", "fnmr_by_photos"),
    }
    assert Level.from_json(level().to_json()) == level()
    assert Level.from_json(level(WOMEN, MEN).to_json()) == level(WOMEN, MEN)
    refusing = dataclasses.replace(level(), frr_by_photos={3: RATE})
    assert Level.from_json(refusing.to_json()) == refusing
    with pytest.raises(ContractError, match="1 to 10 photos"):
        dataclasses.replace(level(), frr_by_photos={11: RATE})


@pytest.mark.parametrize(
    "changes",
    [
        {"group": ""},
        {"group": "x" * 101},
        {"group": "\x1b[2J"},
        {"attribute": 3},
        {"fmr": {}},
        {"fmr_judged": 1},
        {"frr_judged": None},
        {"more": 1},
    ],
)
def test_hostile_groups_are_refused(changes: dict[str, object]) -> None:
    document = level(WOMEN).to_json() | {"groups": [WOMEN.to_json() | changes]}
    with pytest.raises(ContractError):
        Level.from_json(document)


@pytest.mark.parametrize("groups", [[], {}, None, [WOMEN.to_json()] * 2, [1]])
def test_hostile_lists_of_groups_are_refused(groups: object) -> None:
    with pytest.raises(ContractError):
        Level.from_json(level().to_json() | {"groups": groups})
    many = [dataclasses.replace(WOMEN, group=f"g{i}").to_json() for i in range(MAX_GROUPS + 1)]
    with pytest.raises(ContractError):
        Level.from_json(level().to_json() | {"groups": many})


def test_lifted_probes_have_no_groups() -> None:
    with pytest.raises(ContractError, match="raw probes"):
        make_calibration(**LIFTED, levels=(level(WOMEN),))


def test_one_photo_is_never_refused_for_disagreeing() -> None:
    with pytest.raises(ContractError, match="cannot disagree"):
        make_calibration(levels=(dataclasses.replace(level(), frr_by_photos={1: RATE}),))


def test_the_largest_contract_with_groups_is_read() -> None:
    groups = tuple(dataclasses.replace(WOMEN, group=f"g{i}") for i in range(MAX_GROUPS))
    rates = dict.fromkeys(range(1, 11), RATE)
    plain = [
        dataclasses.replace(level(name=f"level-{i}"), fnmr_by_photos=rates)
        for i in range(MAX_LEVELS)
    ]
    full = [dataclasses.replace(one, groups=groups) for one in plain]
    refusing = [dataclasses.replace(one, frr_by_photos=rates) for one in full]
    points = [
        make_calibration(levels=tuple(refusing if photos > 1 else full), probe_photos=photos)
        for photos in range(1, MAX_PROBE_PHOTOS + 1)
    ]
    lifted = [
        make_calibration(**LIFTED | {"probe_m": m}, levels=tuple(plain))
        for m in range(1, MAX_CALIBRATIONS + 1 - len(points))
    ]
    binding = make_binding(n=MAX_CALIBRATIONS + 2, axes=MAX_CALIBRATIONS + 2)
    largest = make_contract(
        binding=binding,
        calibrations=(*points, *lifted),
        default_level="level-0",
        recorded={str(i): i for i in range(MAX_ITEMS)},
    )
    assert not too_many_parts(json.dumps(largest.public()).encode(), MAX_PARTS)
