import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tests.verify.synthetic import draw_people
from verify.trials import chosen_photos, enrolled_means, impostor_groups, plan_trials

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


def test_means_are_unit_and_of_the_enrolled_photos() -> None:
    people = draw_people(9)
    plan = plan_trials(people.names, photos_per_enrollment=3, rng=np.random.default_rng(0))
    means = enrolled_means(people.descriptors, plan)
    for mean, photos in zip(means, plan.enrolled, strict=True):
        total = people.descriptors[photos].astype(float).sum(axis=0)
        np.testing.assert_allclose(mean, total / np.linalg.norm(total), atol=1e-6)


def test_impostor_groups_cover_all_probes_with_distinct_people() -> None:
    plan = plan_trials(
        ["a"] * 3 + ["b"] * 2 + list("cdefgh"),
        photos_per_enrollment=1,
        rng=np.random.default_rng(0),
    )
    groups = list(impostor_groups(plan, 11, pairs=40, rng=np.random.default_rng(1), size=3))
    assert [i for rows, _ in groups for i in range(rows.start, rows.stop)] == list(range(11))
    for _, people in groups:
        assert len(set(people.tolist())) == len(people) == 4
        assert set(people.tolist()) <= set(range(8))
    assert len({tuple(people) for _, people in groups}) > 1
    everybody = impostor_groups(plan, 11, pairs=10**6, rng=np.random.default_rng(1))
    assert all(len(people) == 8 for _, people in everybody)


def test_excluded_people_and_second_names() -> None:
    photos, people = chosen_photos(
        ["Ann", "Bob", "Anne", "Cid", "Robert"],
        exclude={"Cid", "Robert"},
        aliases={"Anne": "Ann", "Robert": "Bob"},
    )
    assert photos.tolist() == [0, 2]
    assert people == ["Ann", "Ann"]
