"""How the command line tells whether a contract is private, accurate, and so for every group."""

from typing import cast

from templates.contract.levels import Rate, photos_in_words
from templates.contract.verdict import Judgement, Verdict

_MANY = 0.25
"""From this rate on, tenths are counted: 40 % as 1 in 2 would be wrong by a quarter."""


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
    # As measured: docs/results/children.md.
    children = "Of children below about ten years no level holds that was set on adults."
    return [*plain_lines(verdict), f"{_groups_line(groups)} {children}"]


def _groups_line(groups: Judgement | None) -> str:
    if groups is None:
        return (
            "Groups: not measured: nobody is labelled (`veilface calibrate` takes --labels), or "
            "too few in every group."
        )
    basis = groups.basis
    photos = photos_in_words(cast("int", basis["probe_photos"]))
    few = "" if groups.shortfall is None else f" Not enough to pass: {groups.shortfall}."
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
    share = f"none of the {opened.trials} people attacked"
    if opened.errors:
        share = f"about {_one_in(opened)} people"
    text = (
        f"Privacy: {said}. If the database and the master key are both stolen, {share} could be "
        f"recognised elsewhere ({opened.errors} of {opened.trials})."
    )
    if privacy.shortfall is not None:
        text += f" This is not enough to prove it: {privacy.shortfall}."
    if strangers:
        text += (
            " The share is measured on people of --faces. Yours may be of another kind: of LFW's "
            "people it was 1 in 7 to 1 in 12 (docs/privacy.md). Give PEOPLE like yours to measure "
            "it for them."
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
    rejected, basis = accuracy.rate, accuracy.basis
    enrolled, shown = (basis[name] or "all" for name in ("enrolled_photos", "probe_photos"))
    share = _one_in(rejected) if rejected.errors else "none of the"
    text = (
        f"Accuracy: {share} genuine attempts failed ({rejected.errors} of {rejected.trials}), with "
        f"{enrolled} photos enrolled and {shown} shown."
    )
    if accuracy.shortfall is not None:
        text += f" Few were measured: {accuracy.shortfall}."
    if failures := basis.get("photos_not_acquired"):
        text += f" Not counted: {failures:,} of {basis['photos']:,} photos without a usable face."
    return text


def _one_in(rate: Rate) -> str:
    """Write a rate that is not zero as ``1 in 14``, or as ``9 in 10`` if large."""
    if rate.value >= _MANY:
        return f"{int(10 * rate.value + 0.5)} in 10"
    return f"1 in {1 / rate.value:,.0f}"
