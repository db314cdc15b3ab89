"""The dimension of templates: the smallest at which they are private."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from attacks.privacy import Privacy
from templates.contract.document import Contract
from templates.contract.levels import Level, Rate
from templates.contract.verdict import Judgement

DIMS = (32, 48, 64, 96, 128, 160, 192)
"""Dimensions that are tried. Below 32 the foot point alone gives too many faces away."""
PRIVACY_LIMIT = 0.05
"""Most templates, as a share, that may give the strongest attacker a match for a fresh photo."""
LEAST_VICTIMS = 100
LEAST_FACES = 1_000
"""Of people and of the attacker's faces; with fewer, attacks that are known to work do not. On LFW
at m = 128, 194 faces found 13 of 40 people, and 3,512 more found 32 of the same."""
ACCURACY_LIMIT = 0.02
"""Largest false rejection rate of the default level, with the advised photos."""
GROUP_LIMIT = 2.0
"""Most that the FMR within a group of people may be, in multiples of the level's target."""
LAXEST_JUDGED = 1e-3
"""Largest target FMR of a default level at which accuracy is judged."""
ADVISED_PHOTOS = 3
"""Photos to enroll, and photos of a probe, that are advised: a camera takes them with one click."""


@dataclass(frozen=True)
class OperatingPoint:
    """A dimension, and what was measured at it and on the way to it.

    Parameters
    ----------
    dim
        The smallest that passes, and where none does, the one that was asked for instead.
    tried
        Privacy by dimension, in rising order.
    """

    dim: int
    tried: dict[int, Judgement]


def smallest_private(
    judge: Callable[[int], Judgement], dims: Sequence[int], *, otherwise: int
) -> OperatingPoint:
    """Find the smallest of some dimensions whose templates are private, by bisection.

    More decoys conceal better, so that a dimension above one that passes is taken to pass too.

    Parameters
    ----------
    otherwise
        The dimension to take where none passes; measured as well.
    """
    tried: dict[int, Judgement] = {}

    def passes(dim: int) -> bool:
        if dim not in tried:
            tried[dim] = judge(dim)
        return tried[dim].status == "PASS"

    low, high = 0, len(dims)
    while low < high:
        middle = (low + high) // 2
        if passes(dims[middle]):
            high = middle
        else:
            low = middle + 1
    dim = dims[low] if low < len(dims) else otherwise
    if dim not in tried:
        tried[dim] = judge(dim)
    return OperatingPoint(dim, dict(sorted(tried.items())))


def judge_privacy(privacy: Privacy, *, uncovered: str | None = None) -> Judgement:
    """Hold what the strongest attacker gets against its limit.

    Parameters
    ----------
    uncovered
        What an attacker of such templates has and none of these had, in a sentence; None: nothing.
    """
    strongest = privacy.strongest
    faces = max(theft.faces or 0 for theft in privacy.thefts)
    shortfall = uncovered
    if shortfall is None and (faces < LEAST_FACES or strongest.found.trials < LEAST_VICTIMS):
        shortfall = (
            f"{strongest.found.trials} people attacked with {faces} faces show little: calibrate "
            f"on so many that {LEAST_VICTIMS} are attacked with {LEAST_FACES:,} faces of the others"
        )
    return Judgement(
        strongest.found,
        PRIVACY_LIMIT,
        {
            "m": privacy.m,
            "attack": strongest.attack,
            "attacker_faces": strongest.faces,
            "attacks": [theft.to_json() for theft in privacy.thefts],
            "extrapolated": privacy.extrapolated,
        },
        shortfall,
    )


def judge_accuracy(contract: Contract, *, photos: int, not_acquired: int) -> Judgement:
    """Hold the FRR of the default level, with the advised photos, against its limit.

    It counts the probes that are refused because their photos do not agree. Photos without a usable
    face are no probes: a folder's tell nothing of a camera's. The verdict says how many there were.

    Parameters
    ----------
    photos, not_acquired
        Photos that the calibration was given, and those of them without a usable face.
    """
    name = contract.default_level
    calibration = contract.calibration("p2s", probe_photos=ADVISED_PHOTOS, level=name)
    level = calibration.level(name)
    shortfall = None
    if level.target_fmr is None or level.target_fmr > LAXEST_JUDGED:
        shortfall = f"so few people resolve no level stricter than {name}"
    enrolled, rate = rejected_as_advised(level)
    return Judgement(
        rate,
        ACCURACY_LIMIT,
        {
            "level": name,
            "enrolled_photos": enrolled,
            "probe_photos": calibration.probe_photos,
            "photos": photos,
            "photos_not_acquired": not_acquired,
        },
        shortfall,
    )


def rejected_as_advised(level: Level) -> tuple[int | None, Rate]:
    """Return the FRR of templates of the advised number of photos, or the next below it.

    Returns
    -------
    enrolled : int or None
        The number of photos; None where the level counts all templates together.
    rate : Rate
    """
    rates = level.frr_by_photos or level.fnmr_by_photos
    enrolled = max((p for p in rates if p <= ADVISED_PHOTOS), default=min(rates, default=None))
    return enrolled, level.fnmr if enrolled is None else rates[enrolled]


def judge_groups(contract: Contract) -> Judgement | None:
    """Hold the FMR within the worst group of people, at the default level, against its limit.

    The highest over raw probes of every number of photos, in groups with trials enough to judge;
    None where there is none: nobody was labelled, or all groups are small.
    """
    name = contract.default_level
    judged = [
        (group, level.target_fmr, calibration)
        for calibration in contract.calibrations
        for level in calibration.levels
        if level.name == name and level.target_fmr is not None
        for group in level.groups
        if group.fmr_judged
    ]
    if not judged:
        return None
    # Of equal rates the one with more trials is named: it is known best.
    worst, target, calibration = max(judged, key=lambda one: (one[0].fmr.value, one[0].fmr.trials))
    return Judgement(
        worst.fmr,
        GROUP_LIMIT * target,
        {
            "level": name,
            "attribute": worst.attribute,
            "group": worst.group,
            "probe_photos": calibration.probe_photos,
            "groups_from": calibration.calibrated_on.get("groups_from"),
        },
    )
