"""Probes that are presented to templates, as the service checks and scores them."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from attacks.attack import Attack, Probes
from attacks.bed import Testbed
from attacks.outcomes import AttackOutcome, Leaked, Property, joined, share_of, unproven
from attacks.rotations import rotations_of, turned_probes
from templates.contract.document import Calibration
from templates.contract.nobody import Nobody
from templates.distances import paired_distances, pairwise_distances, similarity
from templates.errors import InvalidEmbedding
from templates.space.embedding import unit_rows
from templates.space.subspace import SubspaceBatch
from verify.cohort import Probes as Sent
from verify.cohort import expected_similarity

WITH_KEY, WITHOUT_KEY = "with the key", "without the key"


def presented(attack: Attack, bed: Testbed) -> list[AttackOutcome]:
    """Present probes to the victims' templates, or to their renewed ones, after the input checks.

    Probes that are made from a stolen template are presented with its rotation known, and without:
    the service turns what it is sent once more. The latter are judged where the same is accepted
    with the key.
    """
    targets = bed.renewed if attack.breaks is Property.RENEWABILITY else bed.templates
    rows = []
    for made in attack.run(bed):
        if not isinstance(made, Probes):
            raise TypeError(f"{attack.name} must yield probes")
        if not attack.needs.template:
            rows += _presented(attack, bed, made.sent, targets, made.variant, Leaked.DATABASE)
            continue
        with_key, without = (joined(made.variant, name) for name in (WITH_KEY, WITHOUT_KEY))
        turned = turned_probes(made.sent, rotations_of(bed, "replay", "template", len(targets)))
        known = _presented(attack, bed, made.sent, targets, with_key, Leaked.HOLDER_KEYS)
        secret = _presented(attack, bed, turned, targets, without, Leaked.MASTER_KEY)
        rows += known
        rows += [
            replace(row, unjudged=unproven(control, WITH_KEY))
            for row, control in zip(secret, known, strict=True)
        ]
    return rows


def _presented(
    attack: Attack,
    bed: Testbed,
    probes: Sent,
    targets: SubspaceBatch,
    variant: str,
    leaked: Leaked,
) -> list[AttackOutcome]:
    """Count who accepts; empty where the calibration lacks the service's default level."""
    calibration = bed.lifted if isinstance(probes, SubspaceBatch) else bed.points
    levels = () if calibration is None else calibration.levels
    level = next((one for one in levels if one.name == bed.level.name), None)
    if calibration is None or level is None:
        return []
    passed = passes_checks(probes, calibration)
    paired = len(probes) > 1  # probe i meets template i, or the only probe meets all
    accepted = scored(probes, targets, bed.nobody, calibration, paired=paired) >= level.threshold
    hits = (accepted if paired else accepted[0]) & passed
    return [
        attack.row(
            bed,
            variant=variant,
            leaked=leaked,
            level=level.name,
            measured=share_of(hits),
            chance=level.stated_fmr,
            details={
                "mode": calibration.mode,
                "refused_by_the_input_checks": int(np.count_nonzero(~passed)),
            },
        )
    ]


def scored(
    probes: Sent,
    templates: SubspaceBatch,
    nobody: Nobody,
    calibration: Calibration,
    *,
    paired: bool = False,
) -> NDArray[np.float64]:
    """Score as ``verify.Verifier`` does, (P, T), or (P,) where probe i meets template i only.

    Neither probes nor templates are rotated: a rotation of both changes nothing.
    """
    compare = paired_distances if paired else pairwise_distances
    metric, steps = calibration.metric, calibration.steps
    similarities = similarity(compare(probes, templates, metric=metric, steps=steps))
    means, spreads = expected_similarity(probes, nobody, metric=metric, steps=steps)
    if not paired:
        means, spreads = means[:, None], spreads[:, None]
    return np.asarray((similarities - means) / spreads, dtype=np.float64)


def passes_checks(probes: Sent, calibration: Calibration) -> NDArray[np.bool_]:
    """Return which probes, (P,), pass the service's input checks."""
    if isinstance(probes, SubspaceBatch):
        low, high = calibration.foot_point_norm or (1.0, 0.0)
        return np.asarray((low <= probes.foot_norms) & (probes.foot_norms <= high))
    passed = np.ones(len(probes), dtype=np.bool_)
    for row, probe in enumerate(probes):
        try:
            unit_rows(probe, n=probes.shape[1], most=1)
        except InvalidEmbedding:
            passed[row] = False
    return passed
