"""Whether the time of an answer tells who is enrolled.

One connection asks a running service about enrolled subjects and about ones that do not exist, in
turn, with the probe of a stranger, in an order drawn at random, many times. All are rejected in the
same words; this compares how long it took. So it does for subjects whose templates need a holder's
key, with a key that is not theirs, with theirs, and without one; beside it those that do not exist
are asked about with a key, and without. There are about forty of each kind: a template that was
read just before is read faster. The lockout is off (with it the sixth attempt on either is
refused), and so are the rate limits.

The test, chosen before the first run: the area under the ROC curve of an attacker who calls the
slower answer "enrolled" (the Mann-Whitney statistic over n²), with a 95 % interval by DeLong's
variance. 0.5 is guessing. The verdict is "indistinguishable" where the whole interval lies within
0.47 to 0.53, "distinguishable" where it does not contain 0.5, and "undecided" otherwise. The
figures of the first and of the second half stand beside it, because a machine drifts.
"""

import argparse
import time

import httpx
import numpy as np
from numpy.typing import NDArray

from benchmarks import deployment
from benchmarks.people import KINDS, Request, clear_people, requests_of
from models.pack import ModelPack
from veilface_client import Client, new_holder_key

BOUND = 0.03
COMPARED = {
    "enrolled": ("enrolled", "unknown"),
    "needs a key, another was sent": ("other key", "unknown, key"),
    "needs a key, it was sent": ("right key", "unknown, key"),
    "needs a key, none was sent": ("no key", "unknown"),
    "enrolled, a key was sent": ("enrolled, key", "unknown, key"),
}


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    deployment.add_options(parser)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--pairs", type=int, default=4000)
    parser.add_argument("--seed", type=int, default=0)


def auc(slow: NDArray[np.float64], fast: NDArray[np.float64]) -> tuple[float, float, float]:
    """Area under the ROC curve of "slower means enrolled", with DeLong's 95 % interval.

    Parameters
    ----------
    slow, fast : (a,), (b,) float64
        Latencies of the enrolled and of the unknown subject.
    """
    above = np.searchsorted(np.sort(fast), slow, side="left")
    equal = np.searchsorted(np.sort(fast), slow, side="right") - above
    places_slow = (above + equal / 2) / len(fast)
    below = np.searchsorted(np.sort(slow), fast, side="right")
    tied = below - np.searchsorted(np.sort(slow), fast, side="left")
    places_fast = (len(slow) - below + tied / 2) / len(slow)
    area = float(places_slow.mean())
    spread = np.sqrt(places_slow.var(ddof=1) / len(slow) + places_fast.var(ddof=1) / len(fast))
    return area, area - 1.96 * float(spread), area + 1.96 * float(spread)


def compare(known: NDArray[np.float64], unknown: NDArray[np.float64]) -> dict[str, object]:
    """The figures of one kind of probe."""
    area, low, high = auc(known, unknown)
    if low >= 0.5 - BOUND and high <= 0.5 + BOUND:
        conclusion = "indistinguishable"
    else:
        conclusion = "undecided" if low <= 0.5 <= high else "distinguishable"
    half = len(known) // 2
    halves = (auc(known[part], unknown[part])[0] for part in (slice(half), slice(half, None)))
    return {
        "pairs": len(known),
        "median known, ms": f"{1000 * float(np.median(known)):.3f}",
        "median unknown, ms": f"{1000 * float(np.median(unknown)):.3f}",
        "AUC": f"{area:.4f} ({low:.4f}-{high:.4f})",
        "of the halves": ", ".join(f"{value:.4f}" for value in halves),
        "conclusion": conclusion,
    }


def measure(args: argparse.Namespace) -> list[dict[str, object]]:
    """Return a row for each kind of probe and each case."""
    rng = np.random.default_rng(args.seed)
    rows: list[dict[str, object]] = []
    with deployment.running(args) as service, service.http() as http:
        pack = ModelPack.load(args.pack, threads=1)
        stranger, *people = clear_people(args, pack)
        half = len(people) // 2
        right, other = new_holder_key(), new_holder_key()
        with Client(service.url, service.token) as client:
            for person in people[:half]:
                client.enroll(person.name, person.enroll)
            for person in people[half : 2 * half]:
                client.enroll(person.name, person.enroll, holder_key=right)
        # A key without `enroll` is not told who is not enrolled.
        outsider = deployment.key_of(service.env, "verify", "embeddings")
        http.headers["Authorization"] = f"Bearer {outsider}"
        enrolled = [person.name for person in people[:half]]
        keyed = [person.name for person in people[half : 2 * half]]
        unknown = ["x" + name[1:] for name in enrolled]
        cases: dict[str, tuple[list[str], bytes | None]] = {
            "enrolled": (enrolled, None),
            "enrolled, key": (enrolled, other),
            "unknown": (unknown, None),
            "unknown, key": (unknown, other),
            "other key": (keyed, other),
            "right key": (keyed, right),
            "no key": (keyed, None),
        }
        for kind in args.kinds:
            probe = requests_of(kind, [stranger], args, service.url, service.token)[0]
            for subjects, key in cases.values():
                for subject in subjects:
                    ask(http, subject, probe, key)
            times = {case: np.empty(args.pairs) for case in cases}
            for turn in range(args.pairs):
                for case in rng.permutation(list(cases)):
                    subjects, key = cases[case]
                    times[case][turn] = ask(http, subjects[turn % len(subjects)], probe, key)
            rows += [
                {"probe": kind, "case": name, **compare(times[known], times[beside])}
                for name, (known, beside) in COMPARED.items()
            ]
    return rows


def ask(http: httpx.Client, subject: str, probe: Request, key: bytes | None) -> float:
    """Seconds until the answer, which must be a rejection."""
    request = Request(subject, probe.content_type, probe.body)
    if key is not None:
        request = request.with_key(key)
    started = time.perf_counter()
    answer = request.send(http)
    took = time.perf_counter() - started
    if answer.status_code != 200 or answer.json()["decision"] != "reject":
        raise SystemExit(f"not a rejection: {answer.text}")
    return took
