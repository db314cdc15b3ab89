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

Example
-------
::

    python -m benchmarks.timing_oracle --work FOLDER --pairs 4000   # a folder of service_load
"""

import argparse
import base64
import json
import os
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
import numpy as np
from numpy.typing import NDArray

from benchmarks.deployment import database, service, settings_of, veilface
from benchmarks.end_to_end import (
    UNLIMITED,
    enroll_photos,
    people_of,
    prepare,
    with_clear_faces,
)
from benchmarks.service_load import BOUNDARY, Prepared, prepared_probes
from models.pack import ModelPack

BOUND = 0.03
COMPARED = {
    "enrolled": ("enrolled", "unknown"),
    "needs a key, another was sent": ("other key", "unknown, key"),
    "needs a key, it was sent": ("right key", "unknown, key"),
    "needs a key, none was sent": ("no key", "unknown"),
    "enrolled, a key was sent": ("enrolled, key", "unknown, key"),
}


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


def compare(known: NDArray[np.float64], unknown: NDArray[np.float64]) -> dict[str, Any]:
    """The figures of one kind of probe."""
    area, low, high = auc(known, unknown)
    if low >= 0.5 - BOUND and high <= 0.5 + BOUND:
        verdict = "indistinguishable"
    else:
        verdict = "undecided" if low <= 0.5 <= high else "distinguishable"
    half = len(known) // 2
    return {
        "pairs": len(known),
        "median_ms_enrolled": round(1000 * float(np.median(known)), 3),
        "median_ms_unknown": round(1000 * float(np.median(unknown)), 3),
        "auc": round(area, 4),
        "auc_95": [round(low, 4), round(high, 4)],
        "auc_first_half": round(auc(known[:half], unknown[:half])[0], 4),
        "auc_second_half": round(auc(known[half:], unknown[half:])[0], 4),
        "verdict": verdict,
    }


def ask(
    client: httpx.Client, token: str, subject: str, probe: Prepared, key: str | None = None
) -> float:
    """Seconds until the answer, which must be a rejection."""
    headers = {"Authorization": f"Bearer {token}", "Content-Type": probe.content_type}
    body = probe.body if key is None else with_key(probe, key)
    started = time.perf_counter()
    answer = client.post(f"/v1/subjects/{subject}/verify", content=body, headers=headers)
    took = time.perf_counter() - started
    if answer.status_code != 200 or answer.json()["decision"] != "reject":
        raise SystemExit(f"not a rejection: {answer.text}")
    return took


def with_key(probe: Prepared, key: str) -> bytes:
    """Return the body of a probe with a holder's key as its first field."""
    if probe.kind != "photo":
        return b'{"holder_key": "' + key.encode() + b'", ' + probe.body.lstrip()[1:]
    field = f'--{BOUNDARY}\r\nContent-Disposition: form-data; name="holder_key"\r\n\r\n{key}\r\n'
    return field.encode() + probe.body


def main() -> None:
    """Ask, and print the figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--pack", type=Path, help="default: DATA/packs/w600k_mbf")
    parser.add_argument("--work", type=Path, required=True, help="keeps decoys and contract")
    parser.add_argument("--kind", default="embedding,template,photo")
    parser.add_argument("--pairs", type=int, default=4000)
    parser.add_argument("--database", choices=["sqlite", "postgresql"], default="sqlite")
    parser.add_argument("--dim", type=int, default=64)
    parser.add_argument("--probe-dim", type=int, default=8)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    args.pack = args.pack or args.data / "packs" / "w600k_mbf"
    args.cache, args.pool, args.strategy = None, False, "adversarial"
    rng = np.random.default_rng(args.seed)
    args.work.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        url = stack.enter_context(database(args.database, args.work))
        env = os.environ | settings_of(args.work, args.pack, url) | UNLIMITED
        if not (args.work / "contract.json").exists():
            prepare(args, args.work, env)
        rights = [x for r in ("enroll", "verify", "embeddings") for x in ("--right", r)]
        token = json.loads(veilface("keys", "create", "--json", *rights, env=env))["token"]
        outsider = [x for r in ("verify", "embeddings") for x in ("--right", r)]
        asking = json.loads(veilface("keys", "create", "--json", *outsider, env=env))["token"]
        address = stack.enter_context(service(env, workers=1, log=args.work / "serve.log"))
        client = stack.enter_context(httpx.Client(base_url=address, timeout=60))
        client.headers["Authorization"] = f"Bearer {token}"
        pack = ModelPack.load(args.pack, threads=1)
        stranger, *people = with_clear_faces(people_of(args.data / "lfw" / "photos"), pack)
        half = len(people) // 2
        victims, keyed = people[:half], people[half : 2 * half]
        right, other = (base64.urlsafe_b64encode(os.urandom(32)).decode() for _ in range(2))
        for person in victims:
            enroll_photos(client, person, None).raise_for_status()
        for person in keyed:
            enroll_photos(client, person, None, holder_key=right).raise_for_status()
        enrolled = [person.name for person in victims]
        needing_key = [person.name for person in keyed]
        unknown = ["x" + name[1:] for name in enrolled]
        cases: dict[str, tuple[list[str], str | None]] = {
            "enrolled": (enrolled, None),
            "enrolled, key": (enrolled, other),
            "unknown": (unknown, None),
            "unknown, key": (unknown, other),
            "other key": (needing_key, other),
            "right key": (needing_key, right),
            "no key": (needing_key, None),
        }
        report: dict[str, Any] = {"database": args.database, "lockout": "off", "kinds": {}}
        for kind in args.kind.split(","):
            probe = prepared_probes(kind, [stranger], client, pack, args.probe_dim)[0]
            for subjects, key in cases.values():
                for subject in subjects:
                    ask(client, asking, subject, probe, key)
            times = {case: np.empty(args.pairs) for case in cases}
            for turn in range(args.pairs):
                for case in rng.permutation(list(cases)):
                    subjects, key = cases[case]
                    subject = subjects[turn % len(subjects)]
                    times[case][turn] = ask(client, asking, subject, probe, key)
            report["kinds"][kind] = {
                name: compare(times[known], times[beside])
                for name, (known, beside) in COMPARED.items()
            }
    print(json.dumps(report, indent=2))


if __name__ == "__main__":
    main()
