import pytest

from attacks.outcomes import AttackOutcome, Leaked
from attacks.renewability import renew
from attacks.stored.second_moments import ATTACK, Guesser
from attacks.system import System


@pytest.fixture(scope="module")
def rows(system: System) -> dict[str, AttackOutcome]:
    guesses = {ATTACK: Guesser(system)(system.templates)}
    return {f"{each.attack}: {each.variant}": each for each in renew(system, guesses=guesses)}


def test_the_same_photos_give_the_stolen_template_again(rows: dict[str, AttackOutcome]) -> None:
    """Whatever point of it is sent is accepted, and with a secret rotation none is."""
    name = "a point of the old template"
    leaked = rows[f"renewal-replay: same photos, old rotation leaked, {name}"]
    assert (leaked.measured.value, leaked.leaked) == (1.0, Leaked.HOLDER_KEYS)
    assert rows[f"renewal-replay: new photos, old rotation leaked, {name}"].measured.value < 0.5
    secret = rows[f"renewal-replay: same photos, old rotation secret, {name}"]
    assert secret.measured.value <= 1 / 40
    assert secret.leaked is Leaked.MASTER_KEY


def test_an_old_template_is_a_credential_while_its_rotation_is_known(weak_system: System) -> None:
    """Random lifting, whose templates can be presented whole: nearest points are the descriptor."""
    rows = {each.variant: each for each in renew(weak_system, guesses={})}
    name = "old template as a lifted probe"
    for photos in ("same photos", "new photos"):
        leaked = rows[f"{photos}, old rotation leaked, {name}"]
        assert leaked.measured.value > 0.9
        assert leaked.details["refused_by_the_input_checks"] == 0
        assert rows[f"{photos}, old rotation secret, {name}"].measured.value <= 1 / 40


def test_a_part_of_an_old_template_passes_the_input_checks(rows: dict[str, AttackOutcome]) -> None:
    """Its own foot point is too short for a lifted probe of fewer dimensions."""
    row = rows["renewal-replay: same photos, old rotation leaked, old template as a lifted probe"]
    assert row.details["refused_by_the_input_checks"] == 0


def test_guesses_are_presented_and_open_what_they_are_near_to(system: System) -> None:
    perfect = {"the truth": system.victims.enrolled}
    rows = {each.variant: each for each in renew(system, guesses=perfect)}
    for photos in ("same photos", "new photos"):
        row = rows[f"{photos}, old rotation leaked, likeliest guess, the truth"]
        assert row.measured.value > 0.9
        assert row.leaked is Leaked.HOLDER_KEYS
    assert not any("secret, likeliest" in variant for variant in rows)


def test_foot_points_under_a_secret_rotation_open_nothing(rows: dict[str, AttackOutcome]) -> None:
    row = rows["renewal-replay: new photos, old rotation secret, old foot point"]
    assert row.measured.value <= 1 / 40


def test_a_secret_rotation_is_judged_by_what_the_leaked_one_opens(
    rows: dict[str, AttackOutcome],
) -> None:
    for name, row in rows.items():
        if row.leaked is Leaked.MASTER_KEY:
            assert row.judged == rows[name.replace("secret", "leaked")].succeeds
        else:
            assert row.judged
    assert rows[
        "renewal-replay: same photos, old rotation secret, a point of the old template"
    ].judged
