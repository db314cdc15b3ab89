"""What a thief with and without the holders' keys gets from one template, and from several.

People, decoys and the attacker's faces are those of ``benchmarks.asked_and_linked``. The tables of
docs/privacy-leaks.md "What leaked" are what this prints.

Example
-------
::

    python -m benchmarks.what_leaked --data ../shared/data
"""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from time import process_time

import numpy as np
from numpy.typing import NDArray

from attacks.chosen_enrollment import chosen_enrollment
from attacks.databases import ACCOUNTS, link_databases
from attacks.holder_keys import (
    Guess,
    guess_from_few_decoys,
    guess_with_and_without_holder_keys,
)
from attacks.learned import invert
from attacks.likelihood import likeliest_guess
from attacks.linkage import foot_lengths, holder_rotations_of, link, linkage_outcome, turned
from attacks.outcomes import CONTROL, AttackOutcome, Leaked
from attacks.several_templates import enrolled, several_templates
from attacks.stored.foot_point import foot_points
from attacks.system import System
from attacks.unlinkability import unlinkability
from benchmarks.asked_and_linked import adapted_deployment, enrolled_deployment
from verify.comparisons import through_wire


def shown(outcome: AttackOutcome) -> str:
    """One line: what leaked, the attack, and its measure with interval and counts."""
    measured, details = outcome.measured, outcome.details
    beside = details.get("null_95_percent")
    return (
        f"{outcome.leaked} | {outcome.attack}, {outcome.variant} | {100 * measured.value:.1f} % "
        f"({100 * measured.ci_low:.1f}-{100 * measured.ci_high:.1f}) of {measured.trials}"
        + ("" if beside is None else f", null 95 % {100 * float(str(beside)):.1f} %")
    )


def lengths(system: System) -> list[AttackOutcome]:
    """Link two enrollments of the same photos under kept keys, by what no rotation hides."""
    first = enrolled(system, "the deployment's secret")
    contract_id, count = system.contract.contract_id, len(first)
    outcomes = []
    for name in ("the deployment's secret", "another secret"):
        sides = [
            through_wire(
                turned(side, holder_rotations_of(system, where, count)), contract_id=contract_id
            )
            for where, side in (("first", first), ("second", enrolled(system, name)))
        ]
        measured = unlinkability(foot_lengths(sides[0], sides[1])[None], seed=system.seed)
        outcomes.append(
            linkage_outcome(
                system,
                measured,
                attack="foot-lengths",
                variant=f"{name}, nearest for {measured.first_rank:.1%} of {count}",
                leaked=Leaked.MASTER_KEY,
                assumption="Two enrollments of the same photos under kept keys",
                unjudged=CONTROL,
            )
        )
    return outcomes


def attacks_on(
    system: System, albums: Sequence[NDArray[np.float32]], args: argparse.Namespace
) -> dict[str, Callable[[], list[AttackOutcome]]]:
    """Return the attacks, by name."""
    likeliest = likeliest_guess(system)

    def of_one() -> list[AttackOutcome]:
        guesses: dict[str, Guess] = {"foot-point": foot_points, "decoy-likelihood": likeliest}
        outcomes: list[AttackOutcome] = []
        if args.training_seconds:
            inverter, outcomes = invert(system, seconds=args.training_seconds, seed=args.seed)
            guesses["inverter"] = inverter
        outcomes += guess_with_and_without_holder_keys(system, guesses)
        return outcomes + guess_from_few_decoys(system)

    return {
        "one": of_one,
        "several": lambda: several_templates(system, albums, likeliest),
        "lengths": lambda: lengths(system),
        "linkage": lambda: link(system, liftings=1, most_people=args.linked),
        "databases": lambda: link_databases(
            system, accounts=tuple(args.accounts), most_people=args.linked
        ),
        "chosen": lambda: chosen_enrollment(system),
    }


def main() -> None:
    """Split, adapt, lift, attack, print."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--descriptors", type=Path, help=".npz of the crops: paths, descriptors")
    parser.add_argument("--victims", type=int, default=400)
    parser.add_argument("--linked", type=int, default=60, help="people: time grows with the square")
    parser.add_argument("--training-seconds", type=float, default=60.0, help="0: no inverter")
    parser.add_argument("--dim", type=int, default=160)
    parser.add_argument("--level", default="fmr-1e-3", help="that a match is judged at")
    parser.add_argument("--calibrating", type=int, default=1200, help="photos to calibrate on")
    parser.add_argument(
        "--accounts", type=int, nargs="+", default=list(ACCOUNTS), help="in both databases"
    )
    parser.add_argument(
        "--attacks",
        nargs="+",
        default=["one", "several", "lengths", "linkage", "databases", "chosen"],
    )
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    population, source, attacker = adapted_deployment(
        args.data, args.descriptors, victims=args.victims, seed=args.seed
    )
    calibrating = slice(0, args.calibrating)
    system = enrolled_deployment(
        replace(
            population,
            calibration=population.calibration[calibrating],
            names=population.names[calibrating],
        ),
        source,
        attacker,
        data=args.data,
        dim=args.dim,
        level=args.level,
        seed=args.seed,
    )
    print(f"{len(population.victims)} victims; {len(attacker)} faces of the attacker", flush=True)
    attacks = attacks_on(system, population.albums, args)
    for name in args.attacks:
        started = process_time()
        for outcome in attacks[name]():
            print(shown(outcome), flush=True)
        print(f"{name}: {process_time() - started:.0f} s of the processor", flush=True)


if __name__ == "__main__":
    main()
