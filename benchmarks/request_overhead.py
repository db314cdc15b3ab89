"""What one verification by photo costs beyond the bare models, in CPU and on the clock.

Every round sends one photo to a running service and, in turn, runs detection, alignment and
embedding alone on the same decoded photo in this process, with the same number of ONNX threads. The
figures are medians over the rounds, so that a noisy machine disturbs both alike.
"""

import argparse
import time
from statistics import median

import numpy as np
import numpy.typing as npt

from benchmarks import deployment
from benchmarks.people import clear_people, requests_of
from models.decoding import decode_image
from models.pack import ModelPack
from veilface_client import Client


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    deployment.add_options(parser)
    parser.add_argument("--rounds", type=int, default=200)


def bare_models(pack: ModelPack, image: npt.NDArray[np.uint8]) -> None:
    """Detect, align and embed one decoded photo."""
    face = max(pack.detect(image), key=lambda each: each.area)
    pack.embed(pack.align(image, face)[None])


def measure(args: argparse.Namespace) -> list[dict[str, object]]:
    """Return the medians of both, and the ratio."""
    with deployment.running(args) as service, service.http() as http:
        pack = ModelPack.load(args.pack, threads=1)
        people = clear_people(args, pack, 20)[:8]
        with Client(service.url, service.token) as client:
            for person in people:
                client.enroll(person.name, person.enroll)
        requests = requests_of("photo", people, args, service.url, service.token)
        images = [decode_image(p.read_bytes()) for person in people for p in person.probes]
        seconds: dict[str, list[float]] = {"bare models": [], "request": []}
        cpu: dict[str, float] = {"bare models": 0.0, "request": 0.0}
        for turn in range(-10, args.rounds):
            if turn == 0:
                seconds = {name: [] for name in seconds}
                cpu = dict.fromkeys(cpu, 0.0)
            started, before = time.perf_counter(), time.process_time()
            bare_models(pack, images[turn % len(images)])
            cpu["bare models"] += time.process_time() - before
            seconds["bare models"].append(time.perf_counter() - started)
            started, before = time.perf_counter(), service.cpu_seconds()
            requests[turn % len(requests)].send(http).raise_for_status()
            seconds["request"].append(time.perf_counter() - started)
            cpu["request"] += service.cpu_seconds() - before
    rows: list[dict[str, object]] = [
        {
            "": name,
            "median, ms": f"{1000 * median(seconds[name]):.2f}",
            "CPU, ms": f"{1000 * cpu[name] / args.rounds:.2f}",
        }
        for name in seconds
    ]
    ratios = [a / b for a, b in zip(seconds["request"], seconds["bare models"], strict=True)]
    rows.append(
        {
            "": "request / bare models",
            "median, ms": f"{median(ratios):.3f}",
            "CPU, ms": f"{cpu['request'] / cpu['bare models']:.3f}",
        }
    )
    return rows
