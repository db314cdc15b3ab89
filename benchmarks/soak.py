"""The service under a mixed load for hours: memory and latencies.

Two workers answer a steady mixture of requests: single photos, bursts of three, lifted probes,
embeddings, enrollments of guests, erasures of the oldest guest. Requests start at their times
whatever the answers do, so that a service that falls behind shows it in the latencies. At every
full minute the anonymous memory of the service's processes is read, what they share counted once: a
share in libraries would move with whatever else runs.

The test, chosen before the first run: the mean of the last ten minutes is at most 2 % above that of
the ten minutes after the first ten, and every answer is a decision, or what was asked for.
"""

import argparse
import random
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor

import httpx
import numpy as np

from benchmarks import deployment
from benchmarks.people import Person, accepted_requests, clear_people, requests_of
from models.pack import ModelPack
from veilface_client import Client, Retries, VeilfaceError

MIX = {"photo": 30, "burst": 15, "template": 25, "embedding": 20, "enroll": 6, "erase": 4}
"""Share of the requests, in %. Fewer erasures than enrollments: the guests grow in number."""
WARM_UP_MINUTES = 10
GROWTH_LIMIT = 0.02


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    deployment.add_options(parser)
    parser.set_defaults(database="postgresql")
    parser.add_argument("--minutes", type=int, default=120)
    parser.add_argument("--rate", type=float, default=3.0, help="requests a second")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--people", type=int, default=40)


class Load:
    """Sends requests of a kind, and keeps their times and outcomes."""

    def __init__(
        self, args: argparse.Namespace, service: deployment.Service, http: httpx.Client
    ) -> None:
        self.outcomes: Counter[str] = Counter()
        self.seconds: list[tuple[int, float]] = []
        self._http = http
        self._client = Client(service.url, service.token, retries=Retries(sendings=1))
        pack = ModelPack.load(args.pack, threads=1)
        self._people = clear_people(args, pack, args.people)
        for person in self._people:
            self._client.enroll(person.name, person.enroll)
        self._requests = {
            kind: accepted_requests(
                http, requests_of(kind, self._people, args, service.url, service.token)
            )
            for kind in ("photo", "template", "embedding")
        }
        self._guests: deque[str] = deque()
        self._made = 0
        self._lock = threading.Lock()

    def send(self, kind: str, minute: int, draw: random.Random, due: float) -> None:
        """Send one request; its seconds count from when it was due."""
        try:
            outcome = self._send(kind, draw)
        except (VeilfaceError, httpx.TransportError) as error:
            outcome = type(error).__name__
        with self._lock:
            self.outcomes[f"{kind}: {outcome}"] += 1
            self.seconds.append((minute, time.perf_counter() - due))

    def _send(self, kind: str, draw: random.Random) -> str:
        person: Person = draw.choice(self._people)
        if kind == "enroll":
            with self._lock:
                self._made += 1
                guest = f"guest-{self._made}"
            self._client.enroll(guest, person.enroll)
            with self._lock:
                self._guests.append(guest)
            return "done"
        if kind == "erase":
            with self._lock:
                guest = self._guests.popleft() if self._guests else "nobody"
            self._client.erase(guest)
            return "done"
        if kind == "burst":
            photos = (person.probes[0], *person.enroll[:2])
            return self._client.verify(person.name, photos, level="fmr-1e-3").decision
        answer = draw.choice(self._requests[kind]).send(self._http)
        value = answer.json()
        return str(value["error"]["code"] if answer.is_error else value["decision"])


def soak(load: Load, mib: Callable[[], float], *, minutes: int, rate: float) -> list[float]:
    """Send ``rate`` requests a second; return the memory at the end of each minute, in MiB."""
    draw = random.Random(0)  # of the order of requests only
    kinds, weights = list(MIX), list(MIX.values())
    memory: list[float] = []
    with ThreadPoolExecutor(32) as threads:
        started = time.perf_counter()
        for turn in range(int(minutes * 60 * rate)):
            due = started + turn / rate
            time.sleep(max(0.0, due - time.perf_counter()))
            minute = int(turn / rate / 60)
            if minute > len(memory):
                memory.append(mib())
            (kind,) = draw.choices(kinds, weights)
            threads.submit(load.send, kind, minute, random.Random(turn), due)
    return [*memory, mib()]


def growth(mib: Sequence[float]) -> float | None:
    """Growth of the last ten minutes' mean over that of the ten after the first ten, a ratio."""
    if len(mib) < 3 * WARM_UP_MINUTES:
        return None
    base = float(np.mean(mib[WARM_UP_MINUTES : 2 * WARM_UP_MINUTES]))
    return float(np.mean(mib[-WARM_UP_MINUTES:])) / base - 1


def failures(outcomes: Mapping[str, int]) -> dict[str, int]:
    """Answers that are neither a decision nor what was asked for."""
    expected = ("accept", "reject", "done")
    return {name: n for name, n in outcomes.items() if name.split(": ")[1] not in expected}


def measure(args: argparse.Namespace) -> list[dict[str, object]]:
    """Return a row for every ten minutes, and the verdict."""
    with deployment.running(args, workers=args.workers) as service, service.http() as http:
        load = Load(args, service, http)
        memory = soak(load, lambda: service.mib("Pss_Anon"), minutes=args.minutes, rate=args.rate)
    rows: list[dict[str, object]] = []
    for start in range(0, len(memory), WARM_UP_MINUTES):
        end = start + WARM_UP_MINUTES
        times = [seconds for minute, seconds in load.seconds if start <= minute < end]
        p50, p99 = np.percentile(times, [50, 99]) * 1000
        rows.append(
            {
                "minutes": f"{start}-{min(end, len(memory))}",
                "anonymous, MiB": round(float(np.mean(memory[start:end])), 1),
                "requests": len(times),
                "p50, ms": round(p50, 1),
                "p99, ms": round(p99, 1),
            }
        )
    grown, failed = growth(memory), failures(load.outcomes)
    passed = not failed and (grown is None or grown <= GROWTH_LIMIT)
    text = "too short" if grown is None else f"{100 * grown:+.1f} %"
    rows.append(
        {
            "minutes": "all",
            "anonymous, MiB": text,
            "requests": sum(load.outcomes.values()),
            "failed": failed or "none",
            "verdict": "PASS" if passed else "FAIL",
        }
    )
    return rows
