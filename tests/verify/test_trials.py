import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tests.verify.synthetic import draw_people
from verify.trials import GROUP, impostor_groups, plan_trials, probe_sets

names = st.lists(st.sampled_from(["a", "b", "c", "d"]), min_size=1, max_size=30)


@given(names, st.integers(1, 4), st.integers(0, 3))
def test_no_photo_probes_the_template_it_is_part_of(
    identities: list[str], photos: int, seed: int
) -> None:
    plan = plan_trials(identities, photos_per_enrollment=photos, rng=np.random.default_rng(seed))
    assert [plan.people[p] for p in plan.person_of] == identities
    for person, enrolled in enumerate(plan.enrolled):
        owned = {i for i, name in enumerate(identities) if name == plan.people[person]}
        probes = {int(i) for i in plan.genuine if plan.person_of[i] == person}
        assert set(map(int, enrolled)) | probes == owned
        assert not set(map(int, enrolled)) & probes
        assert len(enrolled) == min(photos, max(1, len(owned) - 1))


def test_of_many_people_those_with_several_photos_are_compared() -> None:
    names = ["a", "b", "b", "c", "d", "d", "d", "e", "f"]
    plan = plan_trials(
        names, photos_per_enrollment=2, rng=np.random.default_rng(0), most_templates=4
    )
    assert len(plan.compared) == 4
    assert {1, 3} < set(plan.compared.tolist())
    assert plan.template_of[plan.compared].tolist() == [0, 1, 2, 3]
    assert np.count_nonzero(plan.template_of < 0) == 2
    assert sorted(names[photo] for photo in plan.genuine) == ["b", "d"]
    fewer = plan_trials(
        names, photos_per_enrollment=2, rng=np.random.default_rng(0), most_templates=1
    )
    assert set(fewer.person_of[fewer.genuine]) == set(fewer.compared.tolist()) < {1, 3}


def test_each_group_of_probes_meets_distinct_people_of_its_own() -> None:
    plan = plan_trials(list("abcdefgh"), photos_per_enrollment=1, rng=np.random.default_rng(0))
    groups = impostor_groups(plan, 2 * GROUP + 1, pairs=400, rng=np.random.default_rng(1))
    assert groups.shape == (3, 4)
    assert all(len(set(people)) == 4 for people in groups.tolist())
    assert len({tuple(people) for people in groups.tolist()}) > 1
    everybody = impostor_groups(plan, 11, pairs=10**6, rng=np.random.default_rng(1))
    assert everybody.tolist() == [list(range(8))]


def test_sets_of_photos_are_runs_around_a_circle() -> None:
    names = ["a"] * 6 + ["b"] * 5 + ["c"] * 3 + ["d"]
    plan = plan_trials(names, photos_per_enrollment=3, rng=np.random.default_rng(0))
    enrolled = set(np.concatenate(plan.enrolled).tolist())
    single = probe_sets(plan, 1, most=100, rng=np.random.default_rng(0))
    assert sorted(single.photos[:, 0]) == list(range(len(names)))
    assert sorted(single.photos[: single.genuine, 0]) == sorted(plan.genuine)
    double = probe_sets(plan, 2, most=100, rng=np.random.default_rng(0))
    sets = [frozenset(row) for row in double.photos.tolist()]
    assert all(len(row) == 2 and len({names[photo] for photo in row}) == 1 for row in sets)
    # Three left of "a" give three runs of two, two left of "b" one; all photos 6, 5 and 3.
    assert double.genuine == 3 + 1
    assert all(not row & enrolled for row in sets[: double.genuine])
    assert len(set(sets[: double.genuine])) == double.genuine
    assert len(set(sets[double.genuine :])) == len(sets) - double.genuine == 6 + 5 + 3
    few = probe_sets(plan, 2, most=5, rng=np.random.default_rng(0))
    assert (few.genuine, len(few.photos)) == (4, len(sets))
    assert len(set(few.impostor.tolist())) == 5
    assert single.impostor.tolist() == list(range(len(names)))
    descriptors = np.eye(len(names), dtype=np.float32)
    means = double.means(descriptors, slice(None))
    np.testing.assert_allclose(np.linalg.norm(means, axis=1), 1, rtol=1e-6)
    assert [frozenset(np.flatnonzero(row).tolist()) for row in means] == sets


def test_impostors_are_one_of_everybody_before_a_second_of_anybody() -> None:
    names = ["often"] * 60 + [f"p{person}" for person in range(20) for _ in range(3)]
    plan = plan_trials(names, photos_per_enrollment=2, rng=np.random.default_rng(0))
    for photos in (1, 2):
        for turns in (1, 2, 3):
            most = turns * len(plan.people)
            drawn = probe_sets(plan, photos, most=most, rng=np.random.default_rng(turns))
            assert len(set(drawn.impostor.tolist())) == most
            owners = plan.person_of[drawn.photos[drawn.impostor, 0]]
            assert np.bincount(owners).tolist() == [turns] * len(plan.people)
    first, second = (
        probe_sets(plan, 2, most=21, rng=np.random.default_rng(seed)).impostor for seed in (0, 1)
    )
    assert first.tolist() != second.tolist()


def test_only_genuine_sets_of_photos_that_disagree_are_refused() -> None:
    people = draw_people(8, photos=(6,))
    plan = plan_trials(people.names, photos_per_enrollment=1, rng=np.random.default_rng(0))
    left = [photo for photo in plan.genuine if plan.person_of[photo] == 0]
    people.descriptors[left[0]] *= -1
    sets = probe_sets(plan, 3, most=10**6, rng=np.random.default_rng(0))
    refused = sets.disagreeing(people.descriptors, consistency=0.0)
    holds_it = (sets.photos[: sets.genuine] == left[0]).any(axis=1)
    assert refused.tolist() == holds_it.tolist()
    assert 0 < holds_it.sum() < sets.genuine < len(sets.photos)
    single = probe_sets(plan, 1, most=10**6, rng=np.random.default_rng(0))
    assert not single.disagreeing(people.descriptors, consistency=1.0).any()
