import pytest

from attacks.outcomes import Scheme
from attacks.scene import stage
from attacks.stored import template_attacks
from tests.attacks.stored.staging import cast, generator, noise, scene


@pytest.mark.long
def test_all_attacks_run_in_order_and_report_their_progress() -> None:
    staged = scene("generator")
    seen: list[tuple[str, float]] = []
    photos = [noise(3, staged.templates.n, seed=row) for row in range(5)]
    outcomes = template_attacks(
        staged, photos=photos, progress=lambda what, share: seen.append((what, share))
    )
    names = [outcome.attack for outcome in outcomes]
    assert list(dict.fromkeys(names)) == [
        "foot-point",
        "known-database",
        "nearest-neighbour",
        "oracle",
        "intersection",
        "impersonation",
        "presentation",
    ]
    assert len({(outcome.attack, outcome.variant) for outcome in outcomes}) == len(outcomes)
    shares = [share for _, share in seen]
    assert shares == sorted(shares)
    assert shares[-1] == 1
    for outcome in outcomes:
        assert outcome.scheme == staged.scheme
        assert 0 <= outcome.chance < 0.1
        assert outcome.assumption.endswith(".")
        outcome.to_json()


def test_one_seed_stages_one_scene() -> None:
    first, second = (
        stage(
            cast(),
            Scheme("adversarial", "generator", 2),
            generator(),
            embedder_sha256="ab" * 32,
            preprocessing={"size": 112},
            pool_of_owners=False,
            seed=3,
        )
        for _ in range(2)
    )
    assert first.contract.calibrations == second.contract.calibrations
    assert first.raw_thresholds == second.raw_thresholds
