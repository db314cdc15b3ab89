from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import minimize

from attacks.likelihood import likeliest_guesses
from attacks.outcomes import AttackOutcome, Knowledge
from attacks.renewability import renew
from attacks.stored.intersection import nearest_common_points
from attacks.system import System
from tests.verify.synthetic import unit


@pytest.fixture(scope="module")
def albums(system: System) -> list[np.ndarray]:
    """Four photos each of 30 further people."""
    rng = np.random.default_rng(6)
    n = system.templates.n
    centres = unit(rng.normal(size=(30, 1, n)))
    return list(unit(centres + 0.4 * unit(rng.normal(size=(30, 4, n)))))


@pytest.fixture(scope="module")
def rows(system: System, albums: list[np.ndarray]) -> dict[str, AttackOutcome]:
    return {f"{each.attack}: {each.variant}": each for each in renew(system, albums)}


def test_the_nearest_points_are_as_near_as_a_search_finds(system: System) -> None:
    """Middle of the nearest unit points of two templates, found by descent from random starts."""
    old = system.templates[:3]
    new = system.lift(system.victims.fresh[:3], "test of nearest points")
    middles = nearest_common_points([old, new])
    rng = np.random.default_rng(0)
    for index in range(3):
        p, d = old.feet[index].astype(float), old.bases[index].astype(float)
        q, e = new.feet[index].astype(float), new.bases[index].astype(float)
        s, t = old.radii[index], new.radii[index]

        def gap(angles: np.ndarray, p=p, d=d, q=q, e=e, s=s, t=t) -> float:
            u, v = angles[: len(d)], angles[len(d) :]
            x = p + s * (u / np.linalg.norm(u)) @ d
            return float(np.linalg.norm(x - q - t * (v / np.linalg.norm(v)) @ e))

        found = min(minimize(gap, rng.normal(size=old.m + new.m)).fun for _ in range(8))
        start = np.concatenate([d @ middles[index], e @ middles[index]])
        assert gap(start) <= found + 0.02


def test_two_lifts_of_one_descriptor_meet_in_it(rows: dict[str, AttackOutcome]) -> None:
    row = rows["renewal-intersection: same photos, same rotation"]
    assert float(str(row.details["cosine_to_truth_5_percent"])) > 0.999
    assert row.measured.value > 0.9
    assert row.judged


def test_two_photos_are_judged_by_a_third(system: System, albums: list[np.ndarray]) -> None:
    """The third photo alone decides: where it is of nobody, the same guesses match nobody."""

    def of(photos: list[np.ndarray]) -> AttackOutcome:
        (row,) = [
            each
            for each in renew(system, photos, guesses={})
            if each.variant == "new photos, same rotation"
        ]
        return row

    row = of(albums)
    guesses = nearest_common_points(
        [
            system.lift(np.stack([mine[0] for mine in albums]), "before a renewal"),
            system.lift(np.stack([mine[1] for mine in albums]), "after a renewal"),
        ]
    )
    third = np.stack([mine[2] for mine in albums])
    cosines = np.einsum("ij,ij->i", guesses, third)
    assert row.measured.value == np.mean(cosines >= system.raw_thresholds[system.level.name])
    assert row.measured.value > 0.2
    noise = unit(np.random.default_rng(7).normal(size=third.shape))
    replaced = [np.stack([a[0], a[1], z]) for a, z in zip(albums, noise, strict=True)]
    assert of(replaced).measured.value <= 1 / 30
    few = of([*albums[:19], albums[19][:2]])
    assert few.details["people"] == 19
    assert not few.judged


def test_without_photos_the_intersection_of_new_ones_is_left_out(system: System) -> None:
    variants = [each.variant for each in renew(system, guesses={})]
    assert "same photos, same rotation" in variants
    assert "new photos, same rotation" not in variants
    assert not any("new rotation" in variant for variant in variants)


def test_an_old_template_is_a_credential_while_its_rotation_is_known(weak_system: System) -> None:
    """Random lifting, whose templates can be presented whole: nearest points are the descriptor."""
    rows = {each.variant: each for each in renew(weak_system)}
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
        assert row.knowledge is Knowledge.KEY
    assert not any("secret, likeliest" in variant for variant in rows)


def test_the_likeliest_guesses_are_those_of_one_template(
    system: System, rows: dict[str, AttackOutcome]
) -> None:
    for name in likeliest_guesses(system, draws=1000):
        assert f"renewal-replay: new photos, old rotation leaked, likeliest guess, {name}" in rows


def test_foot_points_under_a_secret_rotation_open_nothing(rows: dict[str, AttackOutcome]) -> None:
    row = rows["renewal-replay: new photos, old rotation secret, old foot point"]
    assert row.measured.value <= 1 / 40


def test_noise_is_recovered_where_it_was_lifted_and_nobody_else(
    system: System, strangers: np.ndarray
) -> None:
    """Two lifts of noise meet in it; held against people who were not lifted, it matches nobody."""

    def intersected(fresh: np.ndarray) -> float:
        noise = replace(
            system,
            templates=system.lift(strangers, "noise"),
            victims=replace(system.victims, enrolled=strangers, fresh=np.ascontiguousarray(fresh)),
        )
        (row,) = [
            each for each in renew(noise, guesses={}) if each.attack == "renewal-intersection"
        ]
        return row.measured.value

    assert intersected(strangers) == 1.0
    assert intersected(strangers[::-1]) <= 1 / 40
