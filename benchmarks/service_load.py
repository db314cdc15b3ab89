"""The service under load: requests per second, latencies, memory, and what it adds to the models.

Starts ``veilface serve`` on real decoys and a real contract, enrolls people of LFW, and sends their
own photos, embeddings and lifted probes from 1, 8 and 64 connections of another process, which
shares the cores with the server. All probes are genuine, so that few are rejected; the lockout is
in force, and the rate limits are off (both are in the report). The CPU seconds of the server are
those of its processes, over the requests that were decided; beside them stand the CPU seconds of
the bare models (detection, alignment, embedding of the decoded photo), measured before and after
in this process.

Example
-------
::

    python -m benchmarks.service_load --work FOLDER --seconds 20
    python -m benchmarks.service_load --work FOLDER --kind embedding --clients 8 --requests 100000
"""

import argparse
import http.client
import json
import multiprocessing
import os
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import httpx
import numpy as np
import psutil

from benchmarks.deployment import database, service, settings_of, veilface
from benchmarks.end_to_end import (
    LiftingClient,
    Person,
    enroll_photos,
    people_of,
    prepare,
    with_clear_faces,
)
from benchmarks.request_overhead import bare_inference
from models.decoding import decode_image
from models.pack import ModelPack

LEVEL = "fmr-1e-3"
BOUNDARY = "veilface-load"


@dataclass(frozen=True)
class Prepared:
    """One probe, ready to be sent any number of times."""

    subject: str
    kind: str
    body: bytes

    @property
    def content_type(self) -> str:
        """Content type of the body."""
        if self.kind == "photo":
            return f"multipart/form-data; boundary={BOUNDARY}"
        return "application/json"


def prepared_probes(
    kind: str, people: Sequence[Person], client: httpx.Client, pack: ModelPack, dim: int
) -> list[Prepared]:
    """Make the probes of one kind, of every person's photos that were not enrolled."""
    lifting = LiftingClient.connect(client, pack) if kind == "template" else None
    made = []
    for person in people:
        for photo in person.probes:
            if kind == "photo":
                body = _form(photo.read_bytes())
            else:
                if lifting is not None:
                    sent: dict[str, Any] = {"template": lifting.template([photo], dim)}
                else:
                    sent = {"embedding": pack.embed_photo(photo.read_bytes()).embedding.tolist()}
                body = json.dumps({**sent, "level": LEVEL}).encode()
            made.append(Prepared(person.name, kind, body))
    return made


def _form(photo: bytes) -> bytes:
    head = (
        f'--{BOUNDARY}\r\nContent-Disposition: form-data; name="level"\r\n\r\n{LEVEL}\r\n'
        f'--{BOUNDARY}\r\nContent-Disposition: form-data; name="image"; '
        'filename="x.jpg"\r\nContent-Type: image/jpeg\r\n\r\n'
    )
    return head.encode() + photo + f"\r\n--{BOUNDARY}--\r\n".encode()


def send_all(
    url: str,
    token: str,
    probes: Sequence[Prepared],
    clients: int,
    requests: int | None,
    seconds: float | None,
    results: Any,
) -> None:
    """Send from ``clients`` connections until the requests or the seconds are over."""
    place = urlsplit(url)
    outcomes: Counter[str] = Counter()
    latencies: list[float] = []
    lock = threading.Lock()
    turns = iter(range(10**9))
    started = time.perf_counter()

    def one() -> None:
        connection = http.client.HTTPConnection(str(place.hostname), place.port, timeout=120)
        seen: Counter[str] = Counter()
        times = []
        while True:
            with lock:
                turn = next(turns)
            if requests is not None and turn >= requests:
                break
            if seconds is not None and time.perf_counter() - started > seconds:
                break
            probe = probes[turn % len(probes)]
            body = probe.body
            headers = {"Authorization": f"Bearer {token}", "Content-Type": probe.content_type}
            before = time.perf_counter()
            connection.request("POST", f"/v1/subjects/{probe.subject}/verify", body, headers)
            answer = connection.getresponse()
            data = answer.read()
            times.append(time.perf_counter() - before)
            value = json.loads(data)
            seen[value["decision"] if answer.status == 200 else value["error"]["code"]] += 1
        connection.close()
        with lock:
            outcomes.update(seen)
            latencies.extend(times)

    threads = [threading.Thread(target=one) for _ in range(clients)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    results.put((dict(outcomes), latencies, time.perf_counter() - started))


def run_load(
    url: str,
    token: str,
    probes: Sequence[Prepared],
    processes: Callable[[], list[psutil.Process]],
    *,
    clients: int,
    requests: int | None = None,
    seconds: float | None = None,
) -> dict[str, Any]:
    """Send from a process of its own; rates, latencies, and CPU and memory of the server."""
    context = multiprocessing.get_context("spawn")
    results = context.Queue()
    before = cpu_seconds(processes())
    sender = context.Process(
        target=send_all, args=(url, token, probes, clients, requests, seconds, results)
    )
    sender.start()
    outcomes, latencies, took = results.get()
    sender.join()
    used = cpu_seconds(processes()) - before
    decided = outcomes.get("accept", 0) + outcomes.get("reject", 0)
    p50, p95, p99 = np.percentile(latencies, [50, 95, 99]) * 1000
    return {
        "clients": clients,
        "answers": outcomes,
        "requests_per_second": round(len(latencies) / took, 1),
        "p50_ms": round(p50, 1),
        "p95_ms": round(p95, 1),
        "p99_ms": round(p99, 1),
        "server_cpu_ms_per_decision": round(1000 * used / max(decided, 1), 2),
        "server_rss_mib": rss_mib(processes()),
        "server_pss_mib": pss_mib(processes()),
    }


def cpu_seconds(processes: Sequence[psutil.Process]) -> float:
    """User and system seconds of processes that live."""
    return sum(float(sum(process.cpu_times()[:2])) for process in processes)


def rss_mib(processes: Sequence[psutil.Process]) -> float:
    """Resident memory of processes, together."""
    total: int = sum(process.memory_info().rss for process in processes)
    return round(total / 2**20, 1)


def pss_mib(processes: Sequence[psutil.Process]) -> float:
    """Resident memory of processes, where what several share counts once (Linux)."""
    total: int = sum(process.memory_full_info().pss for process in processes)
    return round(total / 2**20, 1)


def bare_cpu_ms(pack: ModelPack, people: Sequence[Person], rounds: int) -> float:
    """Mean CPU milliseconds of detection, alignment and embedding of one decoded photo."""
    images = [decode_image(p.read_bytes()) for person in people for p in person.probes]
    for image in images[:5]:
        bare_inference(pack, image)
    started = time.process_time()
    for turn in range(rounds):
        bare_inference(pack, images[turn % len(images)])
    return 1000 * (time.process_time() - started) / rounds


def main() -> None:
    """Run the load and print the figures as JSON."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--pack", type=Path, help="default: DATA/packs/w600k_mbf")
    parser.add_argument("--work", type=Path, required=True, help="keeps decoys and contract")
    parser.add_argument("--kind", default="embedding,template,photo")
    parser.add_argument("--clients", default="1,8,64")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--requests", type=int, help="memory run: requests instead of seconds")
    parser.add_argument("--database", choices=["sqlite", "postgresql"], default="sqlite")
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--dim", type=int, default=64)
    parser.add_argument("--probe-dim", type=int, default=8)
    parser.add_argument("--people", type=int, default=40)
    parser.add_argument("--bare-rounds", type=int, default=300)
    args = parser.parse_args()
    args.pack = args.pack or args.data / "packs" / "w600k_mbf"
    args.cache, args.pool, args.strategy = None, False, "adversarial"
    args.work.mkdir(parents=True, exist_ok=True)
    limits = {
        "VEILFACE_ACCEPT_WEAK_PRIVACY": "true",
        "VEILFACE_RATE_LIMIT_KEY": "off",
        "VEILFACE_RATE_LIMIT_ADDRESS": "off",
        "VEILFACE_QUEUE_LIMIT": "96",
        "VEILFACE_ONNX_THREADS": "1",
    }
    with ExitStack() as stack:
        url = stack.enter_context(database(args.database, args.work))
        env = os.environ | limits | settings_of(args.work, args.pack, url)
        if not (args.work / "contract.json").exists():
            prepare(args, args.work, env)
        rights = [x for r in ("enroll", "verify", "embeddings") for x in ("--right", r)]
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
        enrolled = [p for p in people if enroll_photos(client, p, None).status_code < 300]
        report: dict[str, Any] = {
            "database": args.database,
            "workers": args.workers,
            "m": args.dim,
            "probe_m": args.probe_dim,
            "rate_limits": "off",
            "lockout_after": 5,
            "runs": {},
        }
        (server,) = (p for p in psutil.Process().children() if "serve" in p.cmdline())

        def processes() -> list[psutil.Process]:
            return [server, *server.children(recursive=True)]

        for kind in args.kind.split(","):
            probes = prepared_probes(kind, enrolled, client, pack, args.probe_dim)
            probes = accepted_probes(address, token, probes)
            runs = []
            for clients in map(int, args.clients.split(",")):
                if args.requests is not None:
                    for part in (10_000, args.requests - 10_000):
                        run = run_load(
                            address, token, probes, processes, clients=clients, requests=part
                        )
                        runs.append(run)
                    continue
                before = bare_cpu_ms(pack, enrolled, args.bare_rounds) if kind == "photo" else 0.0
                run = run_load(
                    address, token, probes, processes, clients=clients, seconds=args.seconds
                )
                if kind == "photo":
                    after = bare_cpu_ms(pack, enrolled, args.bare_rounds)
                    bare = (before + after) / 2
                    run["bare_models_cpu_ms"] = [round(before, 2), round(after, 2)]
                    run["cpu_ratio"] = round(run["server_cpu_ms_per_decision"] / bare, 3)
                runs.append(run)
            report["runs"][kind] = runs
    print(json.dumps(report, indent=2))


def accepted_probes(address: str, token: str, probes: Sequence[Prepared]) -> list[Prepared]:
    """Leave out probes that are rejected: under the lockout they would stop their subject."""
    kept = []
    with httpx.Client(base_url=address, timeout=120) as client:
        for probe in probes:
            answer = client.post(
                f"/v1/subjects/{probe.subject}/verify",
                content=probe.body,
                headers={"Authorization": f"Bearer {token}", "Content-Type": probe.content_type},
            )
            if answer.status_code == 200 and answer.json()["decision"] == "accept":
                kept.append(probe)
    return kept


if __name__ == "__main__":
    main()
