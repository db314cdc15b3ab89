"""Who is compared with whom in a calibration: enrollments, genuine probes, impostor pairs."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from templates.space.agreement import weakest_split
from templates.space.embedding import normalised

Indices = NDArray[np.int64]

GROUP = 50
"""Lifted probes that meet the same people."""


@dataclass(frozen=True, eq=False, repr=False)
class TrialPlan:
    """One enrollment per person, and which photos probe it."""

    people: tuple[str, ...]  # in the order of their indices
    person_of: Indices  # (N,) person of every photo
    enrolled: tuple[Indices, ...]  # for every person, the photos that make the one template
    compared: Indices  # (T,) people whose templates are compared with, rising; others only probe
    genuine: Indices  # (G,) genuine probes: photos of people who are compared, never enrolled ones

    @cached_property
    def template_of(self) -> Indices:
        """Position of every person's template, (people,); -1 where there is none."""
        positions = np.full(len(self.people), -1, dtype=np.int64)
        positions[self.compared] = np.arange(len(self.compared))
        return positions


def plan_trials(
    identities: Sequence[str],
    *,
    photos_per_enrollment: int,
    rng: np.random.Generator,
    most_templates: int | None = None,
) -> TrialPlan:
    """Split every person's photos into enrollment and probes.

    A person with k ≥ 2 photos is enrolled on ``min(photos_per_enrollment, k - 1)`` of them,
    chosen at random, and probed by the others. A person with one photo is enrolled on it and
    gives impostor trials only.
    """
    people, person_of = np.unique(np.asarray(identities, dtype=np.str_), return_inverse=True)
    order = np.argsort(person_of, kind="stable")
    counts = np.bincount(person_of, minlength=len(people))
    enrolled: list[Indices] = []
    genuine: list[Indices] = []
    for photos in np.split(order, np.cumsum(counts)[:-1]):
        shuffled = rng.permutation(photos).astype(np.int64)
        take = min(photos_per_enrollment, max(1, len(photos) - 1))
        enrolled.append(np.sort(shuffled[:take]))
        genuine.append(np.sort(shuffled[take:]))
    compared = np.arange(len(people), dtype=np.int64)
    if most_templates is not None and len(people) > most_templates:
        order = rng.permutation(compared)
        order = order[np.argsort(counts[order] < 2, kind="stable")]
        compared = np.sort(order[:most_templates])
    probing = [genuine[person] for person in compared]
    return TrialPlan(
        people=tuple(map(str, people)),
        person_of=person_of.astype(np.int64).reshape(-1),
        enrolled=tuple(enrolled),
        compared=compared,
        genuine=np.concatenate(probing) if probing else np.empty(0, dtype=np.int64),
    )


@dataclass(frozen=True, eq=False, repr=False)
class ProbeSets:
    """Photos that are averaged into probes."""

    photos: Indices  # (P, k), of one person each
    genuine: int  # the first so many hold no photo that is enrolled
    impostor: Indices  # (R,), those that are compared with everybody else's template

    def means(self, embeddings: NDArray[np.float32], rows: slice | Indices) -> NDArray[np.float32]:
        """Average and normalise the embeddings of some sets."""
        if self.photos.shape[1] == 1:
            return embeddings[self.photos[rows, 0]]
        return unit_means(embeddings[self.photos[rows]])

    def disagreeing(
        self, embeddings: NDArray[np.float32], *, consistency: float
    ) -> NDArray[np.bool_]:
        """Tell which genuine sets a service refuses as photos of two people, (genuine,)."""
        if self.photos.shape[1] == 1:
            return np.zeros(self.genuine, dtype=np.bool_)
        agreements = [
            weakest_split(embeddings[photos]).agreement for photos in self.photos[: self.genuine]
        ]
        return np.array(agreements, dtype=np.float64) < consistency


def probe_sets(plan: TrialPlan, photos: int, *, most: int, rng: np.random.Generator) -> ProbeSets:
    """Choose sets of ``photos`` photos of one person, and ``most`` of them for impostor trials.

    A person's photos are put in a random order around a circle, and every run of ``photos`` of them
    is a set: as many sets as photos where those are more. Sets with photos that are enrolled make
    impostor trials only. Impostors are drawn from all sets, one of everybody before a second one of
    anybody: who has many photos weighs no more than others as far as ``most`` allows.
    """
    everybodys = np.split(
        np.argsort(plan.person_of, kind="stable"),
        np.cumsum(np.bincount(plan.person_of, minlength=len(plan.people)))[:-1],
    )
    left = [np.setdiff1d(everybodys[one], plan.enrolled[one]) for one in plan.compared]
    genuine = _runs(left, photos, rng)
    extra = _runs(everybodys, photos, rng)
    if photos == 1:
        extra = np.setdiff1d(extra, genuine)[:, None]
    sets = np.concatenate([genuine, extra])
    return ProbeSets(sets, len(genuine), _by_person(plan.person_of[sets[:, 0]], most, rng))


def _by_person(people: Indices, most: int, rng: np.random.Generator) -> Indices:
    """Draw ``most`` rows at random, in turns of one of each person, (P,) to (R,) rising."""
    order = rng.permutation(len(people)).astype(np.int64)
    order = order[np.argsort(people[order], kind="stable")]
    sizes = np.bincount(people)
    turn = np.arange(len(order)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    turns = rng.permutation(len(order))
    return np.sort(order[turns[np.argsort(turn[turns], kind="stable")]][:most])


def _runs(people: Sequence[Indices], length: int, rng: np.random.Generator) -> Indices:
    runs = [np.empty((0, length), dtype=np.int64)]
    for photos in people:
        if len(photos) >= length:
            shuffled = rng.permutation(photos).astype(np.int64)
            starts = np.arange(len(photos) if len(photos) > length else 1)
            runs.append(shuffled[(starts[:, None] + np.arange(length)) % len(photos)])
    return np.concatenate(runs)


def enrolled_means(embeddings: NDArray[np.float32], plan: TrialPlan) -> NDArray[np.float32]:
    """Average and normalise every person's enrolled photos, (people, n)."""
    return np.concatenate([unit_means(embeddings[photos][None]) for photos in plan.enrolled])


def unit_means(embeddings: NDArray[np.float32]) -> NDArray[np.float32]:
    """Average and normalise sets of embeddings, (S, k, n) to (S, n)."""
    means = embeddings.mean(axis=1, dtype=np.float64)
    return normalised(means).astype(np.float32)


def impostor_groups(
    plan: TrialPlan, probes: int, *, pairs: int, rng: np.random.Generator
) -> Indices:
    """Draw for each group of ``GROUP`` probes the people it is compared with, (groups, W).

    A group meets all of its people, drawn without repetition, so that its comparisons are one
    matrix product; the next group meets others. Together about ``pairs`` comparisons. Those of a
    probe with its own person are among them, and are no impostor trials.
    """
    people_each = min(len(plan.compared), -(-pairs // probes))
    groups = [
        np.sort(rng.choice(plan.compared, size=people_each, replace=False))
        for _ in range(0, probes, GROUP)
    ]
    return np.stack(groups).astype(np.int64)
