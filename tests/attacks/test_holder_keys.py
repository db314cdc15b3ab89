import numpy as np
import pytest

from attacks.holder_keys import (
    THEFTS,
    guess_from_few_decoys,
    guess_with_and_without_holder_keys,
)
from attacks.outcomes import AttackOutcome, Leaked
from attacks.stored.foot_point import foot_points
from attacks.stored.second_moments import ATTACK, Guesser
from attacks.system import System
from attacks.verdict import judge
from templates.space.subspace import SubspaceBatch


@pytest.fixture(scope="module")
def rows(weak_system: System) -> dict[tuple[str, Leaked], AttackOutcome]:
    """Random lifting: whoever opens a template has the descriptor."""
    guesses = {"foot-point": foot_points, ATTACK: Guesser(weak_system)}
    found = guess_with_and_without_holder_keys(weak_system, guesses)
    return {(each.attack, each.leaked): each for each in found}


def test_without_the_key_every_guess_is_at_chance_and_with_it_none_is(
    rows: dict[tuple[str, Leaked], AttackOutcome],
) -> None:
    assert len(rows) == 4
    # Few faces tell the likeliest of a span without decoys only roughly.
    for attack, least in (("foot-point", 0.9), (ATTACK, 0.4)):
        kept, stolen = rows[attack, Leaked.MASTER_KEY], rows[attack, Leaked.HOLDER_KEYS]
        assert kept.measured.value <= 1 / 40
        assert abs(float(str(kept.details["cosine_to_truth_mean"]))) < 0.1
        assert stolen.measured.value > least
        assert (kept.judged, stolen.judged) == (True, False)


def test_without_the_key_a_guess_has_a_limit_of_next_to_nothing(
    rows: dict[tuple[str, Leaked], AttackOutcome],
) -> None:
    (verdict,) = judge(rows.values())
    (cell,) = verdict.cells
    assert cell.limit == "success-without-key"
    assert cell.excess <= 1 / 40


def test_where_the_key_gives_nothing_either_nothing_is_judged(
    system: System, strangers: np.ndarray
) -> None:
    foot, truth = guess_with_and_without_holder_keys(
        system, {"foot-point": lambda _: strangers, "truth": lambda seen: _of(system, seen)}
    )[:2]
    assert foot.unjudged == (
        "it proves nothing, for its control, holder's key stolen, does not succeed either"
    )
    assert truth.judged


def _of(system: System, seen: SubspaceBatch) -> np.ndarray:
    """The victims' descriptors, if these are their templates."""
    near = np.abs(seen.feet - system.templates.feet).max() < 0.01
    return system.victims.enrolled if near else seen.feet


def test_of_few_decoys_the_key_gives_the_person_away_and_nothing_without_it(
    system: System, weak_system: System
) -> None:
    rows = {(each.attack, each.leaked): each for each in guess_from_few_decoys(system)}
    assert len(rows) == 4
    for attack in ("foot-point", ATTACK):
        assert rows[attack, Leaked.MASTER_KEY].measured.value <= 1 / 40
        stolen = rows[attack, Leaked.HOLDER_KEYS]
        assert stolen.succeeds
        assert stolen.scheme == system.scheme
        assert "m = 4" in stolen.variant
    assert not any(each.judged for each in rows.values())
    assert guess_from_few_decoys(weak_system) == []  # of two dimensions itself


def test_a_stolen_key_gives_the_template_back(system: System) -> None:
    """To the rounding of float16; and each enrollment is turned in another way."""
    kept, stolen = (theft.of(system, system.templates, "test") for theft in THEFTS)
    assert isinstance(stolen, SubspaceBatch)
    np.testing.assert_allclose(stolen.feet, system.templates.feet, atol=1e-3)
    np.testing.assert_allclose(stolen.bases, system.templates.bases, atol=2e-3)
    np.testing.assert_allclose(kept.foot_norms, system.templates.foot_norms, atol=1e-3)
    cosines = np.einsum("ij,ij->i", foot_points(kept), foot_points(system.templates))
    assert abs(cosines.mean()) < 0.1
    again = THEFTS[0].of(system, system.templates, "another enrollment")
    assert abs(np.einsum("ij,ij->i", foot_points(kept), foot_points(again)).mean()) < 0.1
