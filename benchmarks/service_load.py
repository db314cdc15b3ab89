"""The service under load: requests a second, latencies, CPU and memory, beside the bare models.

People of LFW are enrolled, and their own photos, embeddings and lifted probes are sent from 1, 8
and 64 connections of another process, which shares the cores with the server. All probes are
genuine; the lockout is in force, and the rate limits are off. The CPU of the server is that of its
processes, over the requests that were decided; for photos it also stands over the CPU of the bare
models (detection, alignment, embedding of the decoded photo), measured before and after in this
process.
"""

import argparse
import http.client
import json
import multiprocessing
import threading
import time
from collections import Counter
from collections.abc import Sequence
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from benchmarks import deployment
from benchmarks.people import KINDS, Person, Request, accepted_requests, clear_people, requests_of
from benchmarks.request_overhead import bare_models
from models.decoding import decode_image
from models.pack import ModelPack
from veilface_client import Client


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    deployment.add_options(parser)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--clients", nargs="+", type=int, default=[1, 8, 64])
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--people", type=int, default=40)


def measure(args: argparse.Namespace) -> list[dict[str, object]]:
    """Return a row for each kind and number of clients."""
    rows = []
    with deployment.running(
        args, workers=args.workers, lockout_after="5", queue_limit="160"
    ) as service:
        pack = ModelPack.load(args.pack, threads=1)
        people = clear_people(args, pack, args.people)
        with Client(service.url, service.token) as client:
            for person in people:
                client.enroll(person.name, person.enroll)
        idle = service.mib("Pss")
        for kind in args.kinds:
            requests = requests_of(kind, people, args, service.url, service.token)
            with service.http() as connection:
                requests = accepted_requests(connection, requests)
            for clients in args.clients:
                bare = bare_cpu_ms(pack, people) if kind == "photo" else 0.0
                row = load(service, requests, clients, args.seconds)
                if kind == "photo":
                    bare = (bare + bare_cpu_ms(pack, people)) / 2
                    row["x bare models"] = f"{row['CPU a decision, ms'] / bare:.3f}"
                row["PSS, MiB (idle)"] = f"{service.mib('Pss')} ({idle})"
                rows.append({"probe": kind, **row})
    return rows


def load(
    service: deployment.Service, requests: Sequence[Request], clients: int, seconds: float
) -> dict[str, Any]:
    """Send from a process of its own; return a row."""
    context = multiprocessing.get_context("spawn")
    queue = context.Queue()
    before = service.cpu_seconds()
    sender = context.Process(
        target=send_all, args=(service.url, service.token, requests, clients, seconds, queue)
    )
    sender.start()
    answers, latencies, took = queue.get()
    sender.join()
    used = service.cpu_seconds() - before
    decided = answers.get("accept", 0) + answers.get("reject", 0)
    p50, p99 = np.percentile(latencies, [50, 99]) * 1000
    return {
        "clients": clients,
        "requests/s": round(len(latencies) / took, 1),
        "p50, ms": round(p50, 1),
        "p99, ms": round(p99, 1),
        "CPU a decision, ms": round(1000 * used / max(decided, 1), 2),
        "answers": ", ".join(f"{name} {count}" for name, count in sorted(answers.items())),
    }


def send_all(
    url: str, token: str, requests: Sequence[Request], clients: int, seconds: float, queue: Any
) -> None:
    """Send from ``clients`` connections until the seconds are over; put what came of it."""
    place = urlsplit(url)
    answers: Counter[str] = Counter()
    latencies: list[float] = []
    lock = threading.Lock()
    started = time.perf_counter()

    def one(client: int) -> None:
        connection = http.client.HTTPConnection(str(place.hostname), place.port, timeout=120)
        turn = client
        while time.perf_counter() - started < seconds:
            request = requests[turn % len(requests)]
            turn += clients
            headers = {"Authorization": f"Bearer {token}", "Content-Type": request.content_type}
            before = time.perf_counter()
            connection.request("POST", request.path, request.body, headers)
            answer = connection.getresponse()
            value = json.loads(answer.read())
            took = time.perf_counter() - before
            with lock:
                latencies.append(took)
                name = value["decision"] if answer.status == 200 else value["error"]["code"]
                answers[name] += 1
        connection.close()

    threads = [threading.Thread(target=one, args=(client,)) for client in range(clients)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    queue.put((dict(answers), latencies, time.perf_counter() - started))


def bare_cpu_ms(pack: ModelPack, people: Sequence[Person], rounds: int = 200) -> float:
    """Mean CPU milliseconds of detection, alignment and embedding of one decoded photo."""
    images = [decode_image(p.read_bytes()) for person in people for p in person.probes]
    for image in images[:5]:
        bare_models(pack, image)
    started = time.process_time()
    for turn in range(rounds):
        bare_models(pack, images[turn % len(images)])
    return 1000 * (time.process_time() - started) / rounds
