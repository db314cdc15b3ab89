"""The service under a mixed load for hours: memory and latencies, minute by minute.

Starts ``veilface serve`` with two workers on PostgreSQL, enrolls people of LFW, and sends a steady
mixture of requests: single photos, bursts of three, lifted probes, embeddings, enrollments of
guests, erasures of the oldest guest. Requests start at their times whatever the answers do, so that
a service that falls behind shows it in the latencies. At every full minute the anonymous memory of
the service's processes is read, what workers share with their supervisor counted once: a share in
libraries would move with whatever else runs.

The test, chosen before the first run, when it was of private memory: the mean of the last ten
minutes is at most 2 % above that of the ten minutes after the first ten, and every answer is a
decision, or what was asked for. Else the exit status is 1.

Example
-------
::

    python -m benchmarks.soak --work FOLDER --minutes 120 --rate 3 --figure FOLDER
"""

import argparse
import json
import os
import random
import threading
import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import psutil
from matplotlib.figure import Figure

from benchmarks.deployment import database, service, settings_of, veilface
from benchmarks.end_to_end import (
    UNLIMITED,
    Person,
    enroll_photos,
    people_of,
    prepare,
    verify_photos,
    with_clear_faces,
)
from benchmarks.service_load import Prepared, accepted_probes, prepared_probes
from models.pack import ModelPack
from verify.evaluation.figures.style import HUES, house_style, panels, write

MIX = {"photo": 30, "burst": 15, "template": 25, "embedding": 20, "enroll": 6, "erase": 4}
"""Share of the requests, in %. Fewer erasures than enrollments: the guests grow in number."""
WARM_UP_MINUTES = 10
GROWTH_LIMIT = 0.02


class Load:
    """Sends one request of a kind, and keeps its time and its outcome."""

    def __init__(self, client: httpx.Client, token: str, people: Sequence[Person]) -> None:
        self._client = client
        self._token = token
        self._people = people
        self._probes: dict[str, list[Prepared]] = {}
        self._guests: deque[str] = deque()
        self._made = 0
        self._lock = threading.Lock()
        self.outcomes: Counter[str] = Counter()
        self.seconds: dict[int, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))

    def prepare(self, address: str, pack: ModelPack, probe_dim: int) -> None:
        """Make the probes, and leave out those that the service rejects."""
        for kind in ("photo", "template", "embedding"):
            made = prepared_probes(kind, self._people, self._client, pack, probe_dim)
            self._probes[kind] = accepted_probes(address, self._token, made)

    def send(self, kind: str, minute: int, draw: random.Random, due: float) -> None:
        """Send one request; its seconds count from when it was due."""
        try:
            answer = self._request(kind, draw)
            if answer is None:
                return
            value = answer.json()
            outcome = str(
                value["error"]["code"] if answer.is_error else value.get("decision", "done")
            )
        except httpx.TransportError as error:
            outcome = type(error).__name__
        with self._lock:
            self.outcomes[f"{kind}: {outcome}"] += 1
            self.seconds[minute][kind].append(time.perf_counter() - due)

    def _request(self, kind: str, draw: random.Random) -> httpx.Response | None:
        if kind == "enroll":
            with self._lock:
                self._made += 1
                guest = f"guest-{self._made}"
            person = draw.choice(self._people)
            answer = enroll_photos(self._client, Person(guest, person.enroll, []), None)
            if answer.is_success:
                with self._lock:
                    self._guests.append(guest)
            return answer
        if kind == "erase":
            with self._lock:
                if not self._guests:
                    return None
                guest = self._guests.popleft()
            return self._client.delete(f"/v1/subjects/{guest}")
        if kind == "burst":
            person = draw.choice([p for p in self._people if len(p.probes) >= 2])
            photos = (*person.probes[:2], person.enroll[0])
            return verify_photos(self._client, person.name, photos, "fmr-1e-3")
        probe = draw.choice(self._probes[kind])
        return self._client.post(
            f"/v1/subjects/{probe.subject}/verify",
            content=probe.body,
            headers={"Content-Type": probe.content_type},
        )


def soak(
    load: Load, processes: Callable[[], list[psutil.Process]], *, minutes: int, rate: float
) -> list[dict[str, Any]]:
    """Send ``rate`` requests a second for so many minutes; a row for each minute."""
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
                memory.append(anonymous_mib(processes()))
            (kind,) = draw.choices(kinds, weights)
            threads.submit(load.send, kind, minute, random.Random(turn), due)
    memory.append(anonymous_mib(processes()))
    return [
        {
            "minute": minute + 1,
            "anonymous_mib": mib,
            "requests": sum(map(len, load.seconds[minute].values())),
            "ms": {
                kind: [round(1000 * float(x), 1) for x in np.percentile(times, [50, 95])]
                for kind, times in sorted(load.seconds[minute].items())
            },
        }
        for minute, mib in enumerate(memory)
    ]


def anonymous_mib(processes: Sequence[psutil.Process]) -> float:
    """Memory of processes that is of no file; what several share counts once (Linux)."""
    kib = 0
    for process in processes:
        parts = Path(f"/proc/{process.pid}/smaps_rollup").read_text().splitlines()
        kib += sum(int(part.split()[1]) for part in parts if part.startswith("Pss_Anon:"))
    return round(kib / 2**10, 1)


def growth(rows: Sequence[dict[str, Any]]) -> float | None:
    """Growth of the last ten minutes' mean over that of the ten after the first ten, a ratio."""
    mib = [row["anonymous_mib"] for row in rows]
    if len(mib) < 3 * WARM_UP_MINUTES:
        return None
    base = float(np.mean(mib[WARM_UP_MINUTES : 2 * WARM_UP_MINUTES]))
    return float(np.mean(mib[-WARM_UP_MINUTES:])) / base - 1


def failures(outcomes: Mapping[str, int]) -> dict[str, int]:
    """Answers that are neither a decision nor what was asked for."""
    expected = ("accept", "reject", "done")
    return {name: n for name, n in outcomes.items() if name.split(": ")[1] not in expected}


def figure(rows: Sequence[dict[str, Any]]) -> Figure:
    """Memory above, latencies of every kind below, by minute."""
    with house_style():
        drawn, (memory, latency) = panels(2, 1, widths=[8.0], heights=[2.6, 3.4])
        minutes = [row["minute"] for row in rows]
        memory[0].plot(minutes, [row["anonymous_mib"] for row in rows], color=HUES[0])
        memory[0].set(ylabel="anonymous, MiB", ylim=(0, None))
        for hue, kind in zip(HUES, MIX, strict=False):
            seen = [row for row in rows if kind in row["ms"]]
            latency[0].plot(
                [row["minute"] for row in seen],
                [row["ms"][kind][0] for row in seen],
                color=hue,
                label=kind,
            )
        latency[0].set(xlabel="minute", ylabel="median, ms", yscale="log")
        latency[0].yaxis.set_major_formatter("{x:g}")
        latency[0].legend(ncols=3)
    return drawn


def main() -> None:
    """Run the load and print the figures as JSON."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--pack", type=Path, help="default: DATA/packs/w600k_mbf")
    parser.add_argument("--work", type=Path, required=True, help="keeps decoys and contract")
    parser.add_argument("--minutes", type=int, default=120)
    parser.add_argument("--rate", type=float, default=3.0, help="requests a second")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--database", choices=["sqlite", "postgresql"], default="postgresql")
    parser.add_argument("--dim", type=int, default=160)
    parser.add_argument("--probe-dim", type=int, default=4)
    parser.add_argument("--people", type=int, default=40)
    parser.add_argument("--figure", type=Path, help="folder for soak.svg and soak.png")
    args = parser.parse_args()
    args.pack = args.pack or args.data / "packs" / "w600k_mbf"
    args.cache, args.pool, args.strategy = None, False, "adversarial"
    args.work.mkdir(parents=True, exist_ok=True)
    with ExitStack() as stack:
        url = stack.enter_context(database(args.database, args.work))
        env = os.environ | UNLIMITED | settings_of(args.work, args.pack, url)
        if not (args.work / "contract.json").exists():
            prepare(args, args.work, env)
        rights = [x for r in ("enroll", "verify", "erase", "embeddings") for x in ("--right", r)]
        token = json.loads(veilface("keys", "create", "--json", *rights, env=env))["token"]
        address = stack.enter_context(
            service(env, workers=args.workers, log=args.work / "serve.log")
        )
        client = stack.enter_context(
            httpx.Client(
                base_url=address, headers={"Authorization": f"Bearer {token}"}, timeout=120
            )
        )
        pack = ModelPack.load(args.pack, threads=1)
        people = with_clear_faces(people_of(args.data / "lfw" / "photos")[: args.people], pack)
        load = Load(client, token, [p for p in people if enroll_photos(client, p, None).is_success])
        load.prepare(address, pack, args.probe_dim)
        (server,) = (p for p in psutil.Process().children() if "serve" in p.cmdline())
        rows = soak(
            load,
            lambda: [server, *server.children(recursive=True)],
            minutes=args.minutes,
            rate=args.rate,
        )
    report = {
        "database": args.database,
        "workers": args.workers,
        "m": args.dim,
        "rate": args.rate,
        "mix_percent": MIX,
        "answers": dict(load.outcomes),
        "growth": growth(rows),
        "growth_limit": GROWTH_LIMIT,
        "minutes": rows,
    }
    if args.figure:
        write(figure(rows), args.figure, "soak")
    print(json.dumps(report, indent=2))
    grown = report["growth"]
    if failures(load.outcomes) or (grown is not None and grown > GROWTH_LIMIT):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
