"""How the command line tells whether a contract is private, accurate, and so for every group."""

from collections.abc import Mapping
from typing import Any, cast

from attacks.operating_point import ACCURACY_LIMIT, OperatingPoint, rejected_as_advised
from templates.contract.document import Contract, Rate
from templates.contract.levels import photos_in_words
from templates.contract.verdict import Judgement, Verdict


def shown_rate(rate: Rate) -> str:
    """Write a rate with its counts and interval."""
    return (
        f"{100 * rate.value:.3g} % ({rate.errors}/{rate.trials}; "
        f"{100 * rate.ci_low:.2g}-{100 * rate.ci_high:.2g} %)"
    )


def verdict_lines(verdict: Verdict | None) -> list[str]:
    """Say in a line each how private and how accurate a contract is, also in the worst group."""
    if verdict is None:
        return ["Privacy:  not measured.", "Accuracy: not judged.", "Groups:   not measured."]
    privacy, accuracy = verdict.privacy, verdict.accuracy
    m, basis = privacy.basis["m"], accuracy.basis
    return [
        f"Privacy:  {privacy.status}. A thief with {_attacker(privacy)} finds a match for "
        f"{shown_rate(privacy.rate)} of the templates at m = {m}; limit "
        f"{100 * privacy.limit:.3g} %.{_unlimited(privacy)}{_shortfall(privacy)}"
        f"{_default_dim(privacy)}",
        f"Accuracy: {accuracy.status}. {shown_rate(accuracy.rate)} of genuine probes are rejected "
        f"at {basis['level']}, with {basis['enrolled_photos']} photos enrolled and "
        f"{basis['probe_photos']} shown; limit {100 * accuracy.limit:.3g} %."
        f"{_not_acquired(accuracy)}{_shortfall(accuracy)}",
        f"{_groups_line(verdict.groups)} {_CHILDREN}",
    ]


# As measured: docs/thresholds.md "Children".
_CHILDREN = "Of children below about ten years no level holds that was set on adults."


def _groups_line(groups: Judgement | None) -> str:
    if groups is None:
        return (
            "Groups:   not measured: nobody is labelled (`veilface calibrate` takes --labels or "
            "--fairface), or too few in every group."
        )
    basis = groups.basis
    photos = photos_in_words(cast("int", basis["probe_photos"]))
    return (
        f"Groups:   {groups.status}. Worst is {basis['attribute']} {basis['group']}: "
        f"{shown_rate(groups.rate)} of its impostor probes of {photos} "
        f"match at {basis['level']}; limit {100 * groups.limit:.3g} %. "
        f"Groups by {basis['groups_from']}; lifted probes are not in it."
    )


def private_mode_weakness(contract: Contract) -> str | None:
    """Say that too many single photos are rejected where browsers lift them, or None.

    Browsers lift to the largest dimension that is calibrated; the limit is the one on accuracy.
    """
    lifted = [entry for entry in contract.calibrations if entry.mode == "s2s"]
    calibration = max(lifted, key=lambda entry: entry.probe_m, default=None)
    levels = () if calibration is None else calibration.levels
    for level in levels:
        enrolled, rate = rejected_as_advised(level)
        if level.name == contract.default_level and rate.value > ACCURACY_LIMIT:
            return (
                f"{shown_rate(rate)} of genuine probes of one photo, lifted in the browser, are "
                f"rejected at {level.name}, with {enrolled or 'any number of'} photos enrolled; "
                f"the limit is {100 * ACCURACY_LIMIT:.3g} %. Have three photos shown, not one (of "
                "those the contract has no figure), or build decoys that are like your people "
                "(`veilface decoys build --like`) and calibrate again"
            )
    return None


def improvements(contract: Contract, point: OperatingPoint) -> list[str]:
    """Say what more photos and more decoys bought, and what would help where a verdict fails."""
    by_dim = ", ".join(
        f"{100 * judgement.rate.value:.3g} % at {m}" for m, judgement in point.tried.items()
    )
    by_photos = ", ".join(
        f"{100 * level.fnmr.value:.3g} % with {calibration.probe_photos}"
        for calibration in contract.calibrations
        if calibration.mode == "p2s"
        for level in calibration.levels
        if level.name == contract.default_level
    )
    lines = [
        f"False non-matches at {contract.default_level} by photos of a probe: {by_photos}.",
        f"Templates that a thief finds a match for, by dimension: {by_dim}.",
    ]
    if contract.verdict is not None:
        lines += [*_more_faces(contract.verdict.privacy), *_more_photos(contract)]
    if contract.verdict is not None and contract.verdict.privacy.status == "FAIL":
        lines.append(
            "To make it private: build the decoys from more photos, of people like these "
            "(`veilface decoys build … --like PEOPLE`)"
            + ("; no dimension that was tried is private" if len(point.tried) > 1 else "")
            + "."
        )
    if contract.verdict is not None and contract.verdict.accuracy.status == "FAIL":
        lines.append(
            "To make it accurate: enroll and verify with more photos; decoys that are more like "
            "these people allow a smaller dimension."
        )
    groups = None if contract.verdict is None else contract.verdict.groups
    if groups is not None and groups.status == "FAIL":
        held = any(each.calibrated_on.get("worst_group") for each in contract.calibrations)
        lines.append(
            "That group has too few trials for --worst-group to heed it: calibrate on more people "
            "of it, or put labels into wider ranges."
            if held
            else "To hold every group of people to the target: calibrate with --worst-group, at "
            "the price of more false non-matches."
        )
    return lines


def _more_faces(privacy: Judgement) -> list[str]:
    """Say what decoys of more faces would leave to a thief, as ``attacks.more_faces`` measured."""
    measured: Any = privacy.basis.get("decoys_of_these_people")
    share: Any = privacy.basis.get("twice_the_decoy_faces")
    if not measured or share is None:
        return []
    rows = [(row["decoy_faces"], Rate.from_json(row["found"])) for row in measured]
    faces, twice = " and ".join(f"{number:,}" for number, _ in rows), 2 * rows[-1][0]
    return [
        f"More faces: decoys of {faces} photos of people like these instead of yours leave "
        + " and ".join(f"{100 * rate.value:.3g}" for _, rate in rows)
        + f" % of the templates to a thief with {measured[0]['thief_faces']:,} others; "
        f"{twice:,} would leave about {100 * share:.2g} %, by extrapolation."
    ]


def _more_photos(contract: Contract) -> list[str]:
    """Say what photos bought, of an enrollment and of a probe, where accuracy is close."""
    if contract.verdict is None or not contract.verdict.accuracy.close:
        return []
    basis = contract.verdict.accuracy.basis
    rates = {
        (enrolled, calibration.probe_photos): rate.value
        for calibration in contract.calibrations
        if calibration.mode == "p2s"
        for level in calibration.levels
        if level.name == contract.default_level
        for enrolled, rate in (level.frr_by_photos or level.fnmr_by_photos).items()
    }
    shown, enrolled = (
        ", ".join(
            f"{100 * rate:.3g} % with {pair[which]}"
            for pair, rate in sorted(rates.items())
            if pair[1 - which] == basis[other]
        )
        for which, other in ((1, "enrolled_photos"), (0, "probe_photos"))
    )
    return [
        f"More photos: of {basis['enrolled_photos']} enrolled, rejected are {shown} shown; of "
        f"{basis['probe_photos']} shown, {enrolled} enrolled."
    ]


def _default_dim(privacy: Judgement) -> str:
    """Say that nothing speaks for the dimension."""
    if privacy.basis.get("m_is") != "default, as none passes":
        return ""
    return " No dimension that was tried passes, so m is a default, no result of these people."


def _unlimited(privacy: Judgement) -> str:
    """Say what unlimited faces find, or that nobody looked."""
    if privacy.shortfall is not None or not isinstance(privacy.basis.get("attacker_faces"), int):
        return ""
    estimate = privacy.basis.get("unlimited")
    if isinstance(estimate, Mapping):
        share = Rate.from_json(estimate["found"]).value
        return f" Unlimited faces: about {100 * share:.2g} %, on drawn people; not judged."
    return (
        " Unlimited faces are not simulated: that is done where the share is above half of "
        "its limit."
    )


def _not_acquired(accuracy: Judgement) -> str:
    failures, photos = (accuracy.basis.get(name) for name in ("photos_not_acquired", "photos"))
    if not (isinstance(failures, int) and isinstance(photos, int) and failures):
        return ""
    return f" Not counted: {failures:,} of {photos:,} photos without a usable face."


def _shortfall(judgement: Judgement) -> str:
    return "" if judgement.shortfall is None else f" Not enough to pass: {judgement.shortfall}."


def _attacker(privacy: Judgement) -> str:
    faces = privacy.basis.get("attacker_faces")
    return f"{faces:,} faces of other people" if isinstance(faces, int) else "unlimited faces"
