"""Who is compared with whom in a calibration: enrollments, genuine probes, impostor pairs."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Indices = NDArray[np.int64]

GROUP = 50


@dataclass(frozen=True, eq=False, repr=False)
class TrialPlan:
    """One enrollment per person, and which photos probe it.

    Parameters
    ----------
    people
        Names, in the order of their indices.
    person_of : (N,) int64
        Person of every photo.
    enrolled
        For every person, the photos that are averaged into the one template.
    genuine : (G,) int64
        Photos that are not enrolled and whose person is: the genuine probes. Nobody's own
        enrollment photo is ever a genuine probe.
    """

    people: tuple[str, ...]
    person_of: Indices
    enrolled: tuple[Indices, ...]
    genuine: Indices


def plan_trials(
    identities: Sequence[str], *, photos_per_enrollment: int, rng: np.random.Generator
) -> TrialPlan:
    """Split every person's photos into enrollment and probes.

    A person with k ≥ 2 photos is enrolled on ``min(photos_per_enrollment, k - 1)`` of them,
    chosen at random, and probed by the others. A person with one photo is enrolled on it and
    gives impostor trials only.
    """
    if photos_per_enrollment < 1:
        raise ValueError("an enrollment needs at least one photo")
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
    return TrialPlan(
        people=tuple(map(str, people)),
        person_of=person_of.astype(np.int64).reshape(-1),
        enrolled=tuple(enrolled),
        genuine=np.concatenate(genuine) if genuine else np.empty(0, dtype=np.int64),
    )


def enrolled_means(descriptors: NDArray[np.float32], plan: TrialPlan) -> NDArray[np.float32]:
    """Average and normalise every person's enrolled photos, (people, n)."""
    means = np.stack(
        [descriptors[photos].mean(axis=0, dtype=np.float64) for photos in plan.enrolled]
    )
    return np.asarray(means / np.linalg.norm(means, axis=1, keepdims=True), dtype=np.float32)


def chosen_photos(
    identities: Sequence[str], *, exclude: Collection[str], aliases: Mapping[str, str]
) -> tuple[Indices, list[str]]:
    """Leave out excluded people, and count two names of one person as one.

    Parameters
    ----------
    exclude
        Names to leave out, for instance those that a test uses.
    aliases
        Maps a name to the one that the same person is better known by.

    Returns
    -------
    photos
        Indices that stay.
    names
        Their people.
    """
    named = [aliases.get(name, name) for name in identities]
    gone = {aliases.get(name, name) for name in exclude}
    photos = [index for index, name in enumerate(named) if name not in gone]
    return np.asarray(photos, dtype=np.int64), [named[index] for index in photos]


def impostor_groups(
    plan: TrialPlan, probes: int, *, pairs: int, rng: np.random.Generator, size: int = GROUP
) -> Iterator[tuple[slice, Indices]]:
    """Split ``probes`` into groups, and draw for each the people it is compared with.

    A group meets all of its people, drawn without repetition, so that its comparisons are one
    matrix product; the next group meets others. Together about ``pairs`` comparisons. Those of a
    probe with its own person are among them, and are no impostor trials.
    """
    people_each = min(len(plan.people), -(-pairs // probes))
    for start in range(0, probes, size):
        people = np.sort(rng.choice(len(plan.people), size=people_each, replace=False))
        yield slice(start, min(start + size, probes)), people.astype(np.int64)
