import pytest

from attacks.outcomes import Scheme
from attacks.stored import template_attacks
from attacks.system import enroll_victims
from tests.attacks.stored.systems import generator, population, system_of


@pytest.mark.long
def test_all_attacks_run_in_order() -> None:
    system = system_of("generator")
    outcomes = template_attacks(system)
    names = [outcome.attack for outcome in outcomes]
    assert list(dict.fromkeys(names)) == [
        "foot-point",
        "nearest-neighbour",
        "oracle",
        "presentation",
    ]
    assert len({(outcome.attack, outcome.variant) for outcome in outcomes}) == len(outcomes)
    for outcome in outcomes:
        assert outcome.scheme == system.scheme
        assert 0 <= outcome.chance < 0.1
        assert outcome.assumption.endswith(".")
        outcome.to_json()


def test_one_seed_makes_one_system() -> None:
    first, second = (
        enroll_victims(
            population(),
            Scheme("adversarial", "generator", 2),
            generator(),
            embedder_sha256="ab" * 32,
            preprocessing={"size": 112},
            seed=3,
        )
        for _ in range(2)
    )
    assert first.contract.calibrations == second.contract.calibrations
    assert first.raw_thresholds == second.raw_thresholds
