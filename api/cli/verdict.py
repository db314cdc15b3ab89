"""How the command line tells whether a contract is private, accurate, and so for every group."""

from typing import cast

from templates.contract.document import Rate
from templates.contract.levels import photos_in_words
from templates.contract.verdict import Judgement, Verdict


def shown_rate(rate: Rate) -> str:
    """Write a rate with its counts and interval."""
    if not rate.trials:
        return "not measured"
    return (
        f"{100 * rate.value:.3g} % ({rate.errors}/{rate.trials}; "
        f"{100 * rate.ci_low:.2g}-{100 * rate.ci_high:.2g} %)"
    )


def verdict_lines(verdict: Verdict | None) -> list[str]:
    """Say in a line each how private and how accurate a contract is, also in the worst group."""
    groups = None if verdict is None else verdict.groups
    return [*plain_lines(verdict), f"{_groups_line(groups)} {_CHILDREN}"]


# As measured: docs/results/children.md.
_CHILDREN = "Of children below about ten years no level holds that was set on adults."


def _groups_line(groups: Judgement | None) -> str:
    if groups is None:
        return (
            "Groups: not measured: nobody is labelled (`veilface calibrate` takes --labels), or "
            "too few in every group."
        )
    basis = groups.basis
    few = "" if groups.shortfall is None else f" Not enough to pass: {groups.shortfall}."
    photos = photos_in_words(cast("int", basis["probe_photos"]))
    return (
        f"Groups: {groups.status}. Worst is {basis['attribute']} {basis['group']}: "
        f"{shown_rate(groups.rate)} of its impostor probes of {photos} "
        f"match at {basis['level']}; limit {100 * groups.limit:.3g} %. "
        f"Groups by {basis['groups_from']}; lifted probes are not in it.{few}"
    )


def plain_lines(verdict: Verdict | None, *, strangers: bool = False) -> tuple[str, str]:
    """Say to somebody who knows no biometrics how private and how accurate a contract is.

    Every figure is the verdict's own, except for what was measured elsewhere, which is named so.
    ``strangers``: it was judged on faces that may not look like those who will be enrolled.
    """
    if verdict is None:
        return (
            "Privacy: not proven: nobody measured it. `veilface calibrate` does.",
            "Accuracy: not measured.",
        )
    return _plain_privacy(verdict.privacy, strangers), _plain_accuracy(verdict.accuracy)


def _plain_privacy(privacy: Judgement, strangers: bool) -> str:
    opened, proven = privacy.rate, privacy.status == "PASS"
    of_whom = " for people like those of --faces" if strangers else ""
    said = f"proven{of_whom}, against every attack that we know" if proven else "not proven"
    if opened.errors:
        share = (
            f"about {_one_in(opened, 'person', 'people')} could be recognised elsewhere "
            f"({opened.errors} of {opened.trials})"
        )
    else:
        share = f"none of the {opened.trials} people attacked could be recognised elsewhere"
    text = f"Privacy: {said}. If the database and the master key are both stolen, {share}."
    if privacy.shortfall is not None:
        text += f" This is not enough to prove it: {privacy.shortfall}."
    if strangers:
        text += (
            " The share is measured on people of --faces. Yours may be of another kind: of LFW's "
            "people, behind decoys of FairFace's faces, it was 1 person in 7 to 1 in 12 "
            "(docs/privacy.md, November 2026). Give PEOPLE like yours to measure it for them."
        )
    if not proven:
        text += (
            " It is lower with 600 photos or more of people like yours (PEOPLE, --like); "
            "docs/results/privacy.md has figures."
        )
    return text


def _plain_accuracy(accuracy: Judgement | None) -> str:
    if accuracy is None:
        return (
            "Accuracy: not measured: nobody is labelled with two photos. For that, give a folder "
            "with a subfolder of three photos for each of 80 people: `veilface setup PEOPLE …`."
        )
    enrolled, shown = (
        _IN_WORDS.get(str(accuracy.basis[name]), str(accuracy.basis[name]))
        for name in ("enrolled_photos", "probe_photos")
    )
    rejected = accuracy.rate
    if rejected.errors:
        verb = "are" if rejected.value >= _MANY else "is"
        share = f"{_one_in(rejected, 'genuine attempt', 'genuine attempts')} {verb} rejected"
        share += f" ({rejected.errors} of {rejected.trials})"
    else:
        share = f"none of {rejected.trials:,} genuine attempts is rejected"
    few = "" if accuracy.shortfall is None else f" Few were measured: {accuracy.shortfall}."
    few += _not_acquired(accuracy)
    return f"Accuracy: {share}, with {enrolled} photos enrolled and {shown} shown.{few}"


_IN_WORDS = {"1": "one", "2": "two", "3": "three", "None": "all"}


_MANY = 0.25
"""From this rate on, tenths are counted: 40 % as 1 in 2 would be wrong by a quarter."""


def _one_in(rate: Rate, one: str, several: str) -> str:
    """Write a rate that is not zero as ``1 person in 14``, or as ``9 in 10 people`` if large."""
    if rate.value >= _MANY:
        return f"{int(10 * rate.value + 0.5)} in 10 {several}"
    return f"1 {one} in {1 / rate.value:,.0f}"


_REMEDIES = {
    "privacy": "To make it private: build the decoys from more photos, of people like these "
    "(`veilface decoys build … --like PEOPLE`).",
    "accuracy": "To make it accurate: enroll and verify with more photos; decoys that are more "
    "like these people allow a smaller dimension.",
    "groups": "To hold every group of people to the target: calibrate with --worst-group, at "
    "the price of more false non-matches, on more people of that group.",
}


def improvements(verdict: Verdict) -> list[str]:
    """Say what would help where a judgement fails."""
    return [
        remedy
        for name, remedy in _REMEDIES.items()
        if (judged := getattr(verdict, name)) is not None and judged.status == "FAIL"
    ]


def _not_acquired(accuracy: Judgement) -> str:
    failures, photos = (accuracy.basis.get(name) for name in ("photos_not_acquired", "photos"))
    if not (isinstance(failures, int) and isinstance(photos, int) and failures):
        return ""
    return f" Not counted: {failures:,} of {photos:,} photos without a usable face."
