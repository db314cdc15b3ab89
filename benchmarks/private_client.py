"""FRR and FMR of the real private client against a server without a pack, beside photos.

One contract, two services. The first has the model pack: photos 1-3 of every person are sent to it,
then photos 4-5 against the person (genuine) and against other people (impostor), as in
``benchmarks.end_to_end``. The second has no pack at all: ``veilface_client.PrivateClient`` embeds
and lifts the same photos on the client's side, once each, and sends templates. A probe is verified
against all its subjects, so the attempts are the same. An enrollment that is refused counts as
failed genuine attempts.

Example
-------
::

    python -m benchmarks.private_client --data ../shared/data --dim 4 --work private-client-run
"""

import argparse
import json
import os
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from statistics import median
from typing import TypeVar

import httpx

from benchmarks.deployment import database, service, veilface
from benchmarks.end_to_end import (
    UNLIMITED,
    AttemptCounts,
    Person,
    attempt_all,
    impostor_attempts,
    people_of,
    prepare,
)
from veilface_client import LiftFailed, PrivateClient, Probe, ServiceError

T = TypeVar("T")


def private_outcome(
    client: PrivateClient, people: Sequence[Person], *, level: str, impostors: int, at_once: int
) -> tuple[AttemptCounts, list[float]]:
    """Enroll and verify everybody by lifted templates; also the seconds of every lift.

    The seconds of an enrollment include that of its one small request.
    """
    counts = AttemptCounts()
    seconds: list[float] = []

    def timed(work: Callable[[], T]) -> T | str:
        started = time.perf_counter()
        try:
            return work()
        except ServiceError as error:
            return f"{error.status} {error.code}"
        except LiftFailed as error:
            return f"lift: {error.message.split(':')[0]}"
        finally:
            seconds.append(time.perf_counter() - started)

    def enrolled(person: Person) -> str | None:
        done = timed(lambda: client.enroll(person.name, person.enroll, face="largest"))
        return done if isinstance(done, str) else None

    def lifted(photo: Path) -> Probe | str:
        return timed(lambda: client.lift(photo, face="largest"))

    def accepted(subject: str, probe: Probe | str) -> bool:
        if isinstance(probe, str):
            counts.other_answers[probe] += 1
            return False
        try:
            return client.verify(subject, probe, level=level).accepted
        except ServiceError as error:
            counts.other_answers[f"{error.status} {error.code}"] += 1
            return False

    with ThreadPoolExecutor(at_once) as pool:
        for person, refused in zip(people, pool.map(enrolled, people), strict=True):
            if refused is not None:
                counts.refused_enrollments[person.name] = refused
        photos = [photo for person in people for photo in person.probes]
        probes = dict(zip(photos, pool.map(lifted, photos), strict=True))
    for person in people:
        for photo in person.probes:
            counts.genuine += 1
            counts.genuine_rejected += not accepted(person.name, probes[photo])
    there = [person for person in people if person.name not in counts.refused_enrollments]
    for person, (photo,) in impostor_attempts(there, impostors):
        counts.impostor += 1
        counts.impostor_accepted += accepted(person.name, probes[photo])
    return counts, seconds


def key_of(env: dict[str, str]) -> str:
    """An API key that may enroll and verify, with photos and with templates."""
    rights = [word for right in ("enroll", "verify", "embeddings") for word in ("--right", right)]
    veilface("db", "template-enrollment", "--allow", env=env)
    token: str = json.loads(veilface("keys", "create", "--json", *rights, env=env))["token"]
    return token


def command_line(description: str) -> argparse.ArgumentParser:
    """Options of a measurement of clients that lift."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--pack", type=Path, help="default: DATA/packs/w600k_mbf")
    parser.add_argument("--strategy", default="adversarial")
    parser.add_argument("--dim", type=int, default=4)
    parser.add_argument("--probe-dim", type=int, help="default: that of the templates")
    parser.add_argument("--level", default="fmr-1e-3")
    parser.add_argument(
        "--work", type=Path, required=True, help="keep everything that is made here"
    )
    parser.add_argument("--cache", type=Path, help="sealed embeddings, shared between runs")
    return parser


def prepared(args: argparse.Namespace) -> dict[str, str]:
    """Fill in what was not asked; make decoys and contract; return the service's environment."""
    args.pack = args.pack or args.data / "packs" / "w600k_mbf"
    args.probe_dim = args.probe_dim or args.dim
    args.pool = False
    args.work.mkdir(parents=True, exist_ok=True)

    ours = {name: value for name, value in os.environ.items() if not name.startswith("VEILFACE_")}
    env = ours | {
        "VEILFACE_DATA_DIR": str(args.work),
        "VEILFACE_DECOYS_FILE": str(args.work / "decoys.veil"),
        "VEILFACE_CONTRACT_FILE": str(args.work / "contract.json"),
        "VEILFACE_MASTER_KEY_FILE": str(args.work / "master.key"),
        **UNLIMITED,
    }
    if not (args.work / "contract.json").exists():
        prepare(args, args.work, env)
    return env


def main() -> None:
    """Run both paths and print their figures as JSON."""
    parser = command_line(__doc__.splitlines()[0])
    parser.add_argument("--impostors", type=int, default=20, help="other people for each probe")
    parser.add_argument("--at-once", type=int, default=2, help="lifts at the same time")
    args = parser.parse_args()
    env = prepared(args)
    people = people_of(args.data / "lfw" / "photos")

    with ExitStack() as stack:
        with_pack = env | {
            "VEILFACE_DATABASE_URL": fresh_database(stack, args.work / "photos"),
            "VEILFACE_PACK": str(args.pack),
        }
        log = args.work / "photos.log"
        address = stack.enter_context(service(with_pack, workers=1, log=log))
        headers = {"Authorization": f"Bearer {key_of(with_pack)}"}
        http = stack.enter_context(httpx.Client(base_url=address, headers=headers, timeout=120))
        photos = attempt_all(
            http,
            people,
            level=args.level,
            face="largest",
            impostors=args.impostors,
            attributes=None,
            lifting=None,
            probe_dim=0,
            clients=2,
        )

    with ExitStack() as stack:
        packless = env | {"VEILFACE_DATABASE_URL": fresh_database(stack, args.work / "private")}
        log = args.work / "private.log"
        address = stack.enter_context(service(packless, workers=1, log=log))
        client = stack.enter_context(
            PrivateClient(address, key_of(packless), pack=args.pack, dim=args.probe_dim)
        )
        if client.contract().photos:
            raise SystemExit("the server of the private client has a pack: this measures nothing")
        started = time.perf_counter()
        private, lifts = private_outcome(
            client, people, level=args.level, impostors=args.impostors, at_once=args.at_once
        )
        took = time.perf_counter() - started

    report = {
        "pack": args.pack.name,
        "strategy": args.strategy,
        "m": args.dim,
        "probe_m": args.probe_dim,
        "level": args.level,
        "people": len(people),
        "photos_sent_to_a_server_with_a_pack": photos.summary(),
        "private_client_and_a_server_without_one": private.summary(),
        "lift": {
            "calls": len(lifts),
            "at_once": args.at_once,
            "median_s": round(median(lifts), 2),
            "longest_s": round(max(lifts), 2),
            "all_and_attempts_s": round(took, 1),
        },
    }
    print(json.dumps(report, indent=2))


def fresh_database(stack: ExitStack, folder: Path) -> str:
    """The URL of a new SQLite database in a folder of its own."""
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.iterdir():
        old.unlink()
    return stack.enter_context(database("sqlite", folder))


if __name__ == "__main__":
    main()
