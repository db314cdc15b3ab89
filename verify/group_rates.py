"""Error rates by group of people in a calibration, and thresholds that hold in every group.

Groups are of people, not of photos: a template is made of several photos, and so may a probe be. A
person is in the group that most of their photos are labelled with. Which groups are judged is the
rule of :mod:`verify.evaluation.groups` (ISO/IEC 19795-10).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from templates.contract.levels import MAX_GROUPS, GroupRates, Level, check_group_names
from templates.errors import ContractError
from verify.evaluation.groups import MIN_GENUINE, fmr_judged, in_order
from verify.metrics import most_errors, rate, resolvable, threshold_at_fmr
from verify.thresholds import EXPECTED_ERRORS, Genuine, Impostors
from verify.trials import Indices


@dataclass(frozen=True, repr=False)
class PhotoLabels:
    """Labels of photos."""

    of: Mapping[str, Sequence[str | None]]  # by attribute, the label of every photo
    source: str  # in words, for the contract

    def __post_init__(self) -> None:
        groups = {(name, label) for name, column in self.of.items() for label in column if label}
        if not groups:
            raise ContractError(
                "the labels are of none of the photos: name these by their paths in the folder of "
                "people, or the people by their folders"
            )
        check_group_names({part for group in groups for part in group})
        if len(groups) > MAX_GROUPS:
            raise ContractError(
                f"the labels have {len(groups)} groups, and a contract holds {MAX_GROUPS}: leave "
                "attributes out, or put their values into ranges"
            )


@dataclass(frozen=True, eq=False, repr=False)
class PeopleGroups:
    """The people of a calibration by one attribute."""

    attribute: str
    names: tuple[str, ...]  # of its groups; ages in the order of years
    of: Indices  # (people,) number of each person's group; -1 where they have none

    def shared(self, pairs: Indices) -> Indices:
        """Number of the group that both people of (E, 2) pairs are in; -1 where there is none."""
        first, second = self.of[pairs[:, 0]], self.of[pairs[:, 1]]
        return np.where(first == second, first, -1)

    def impostor_trials(self, impostors: Impostors) -> list[int]:
        """Count the impostor trials within each group."""
        return [
            round(impostors.weighted_trials((self.of == number).astype(np.float64)))
            for number in range(len(self.names))
        ]


def people_groups(
    labels: PhotoLabels, person_of: Indices, *, people: int
) -> tuple[PeopleGroups, ...]:
    """Put people into groups; equal votes of their photos go to the group that comes first."""
    groups = []
    for attribute, column in labels.of.items():
        names = sorted({label for label in column if label}, key=in_order)
        number = {name: place for place, name in enumerate(names)}
        votes = np.zeros((people, len(names)), dtype=np.int64)
        for person, label in zip(person_of, column, strict=True):
            if label:
                votes[person, number[label]] += 1
        if names:
            of = np.where(votes.any(axis=1), votes.argmax(axis=1), -1)
            groups.append(PeopleGroups(attribute, tuple(names), of))
    return tuple(groups)


def group_rates(
    level: Level, groups: Sequence[PeopleGroups], impostors: Impostors, genuine: Genuine
) -> tuple[GroupRates, ...]:
    """Count FMR and FRR within each group at a level's threshold, with Wilson intervals.

    The intervals take trials as independent. Trials share people, so they are too narrow.
    """
    bound = np.float64(level.threshold)
    pairs = impostors.people_of(np.flatnonzero(impostors.scores >= bound))
    rejected = ~(genuine.scores >= bound) | genuine.refused
    rates = []
    for grouping in groups:
        matched, probed = grouping.shared(pairs), grouping.of[genuine.people]
        for number, trials in enumerate(grouping.impostor_trials(impostors)):
            own = probed == number
            probes = int(np.count_nonzero(own))
            rates.append(
                GroupRates(
                    attribute=grouping.attribute,
                    group=grouping.names[number],
                    fmr=rate(int(np.count_nonzero(matched == number)), trials),
                    frr=rate(int(np.count_nonzero(own & rejected)), probes),
                    fmr_judged=level.target_fmr is not None
                    and fmr_judged(trials, level.target_fmr),
                    frr_judged=probes >= MIN_GENUINE,
                )
            )
    return tuple(rates)


def worst_group_threshold(
    threshold: float, target: float, groups: Sequence[PeopleGroups], impostors: Impostors
) -> tuple[float, list[str]]:
    """Raise the threshold of all trials until no group's FMR exceeds the target, if at all.

    Also returns the groups whose impostor trials are too few, with their counts.

    A group is heeded where it has trials to *set* a threshold by, as for all of them together
    (``EXPECTED_ERRORS``); to be judged, a tenth of that is enough.
    """
    accepted = np.flatnonzero(impostors.scores >= np.float64(threshold))
    scores, pairs = impostors.scores[accepted], impostors.people_of(accepted)
    left_out = []
    for grouping in groups:
        group_of = grouping.shared(pairs)
        for number, trials in enumerate(grouping.impostor_trials(impostors)):
            own = scores[group_of == number]
            if not resolvable(target, trials, expected_errors=EXPECTED_ERRORS):
                left_out.append(f"{grouping.attribute} {grouping.names[number]} ({trials:,})")
            elif len(own) > most_errors(target, trials):
                threshold = max(threshold, threshold_at_fmr(own, target, trials=trials))
    return threshold, left_out
