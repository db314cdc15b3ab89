"""A running service for a benchmark: decoys and contract, a fresh database, an API key."""

import argparse
import json
import os
import secrets
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx
import psutil
from sqlalchemy import create_engine, text
from sqlalchemy.engine import make_url

from tests.serving import serve

UNLIMITED = {
    "VEILFACE_LOCKOUT_AFTER": "0",
    "VEILFACE_RATE_LIMIT_KEY": "off",
    "VEILFACE_RATE_LIMIT_ADDRESS": "off",
    "VEILFACE_ONNX_THREADS": "1",
}
"""Settings under which every attempt is decided: rates and times are measured, not defences."""
DEFAULT_POSTGRES = "postgresql://postgres@127.0.0.1:5432/postgres"


@dataclass(frozen=True)
class Service:
    """A running service: where it is, a key of many rights, its environment and its process."""

    url: str
    token: str
    env: dict[str, str]
    process: psutil.Process

    def http(self) -> httpx.Client:
        """Return a client that sends the key."""
        headers = {"Authorization": f"Bearer {self.token}"}
        return httpx.Client(base_url=self.url, headers=headers, timeout=120)

    def processes(self) -> list[psutil.Process]:
        """Return the processes of the service, supervisor and workers."""
        return [self.process, *self.process.children(recursive=True)]

    def cpu_seconds(self) -> float:
        """Return the user and system seconds of the service's processes."""
        return sum(float(sum(process.cpu_times()[:2])) for process in self.processes())

    def mib(self, kind: str) -> float:
        """Return the memory of all processes from smaps, such as ``Rss``, ``Pss``, ``Pss_Anon``."""
        kib = 0
        for process in self.processes():
            lines = Path(f"/proc/{process.pid}/smaps_rollup").read_text().splitlines()
            kib += sum(int(line.split()[1]) for line in lines if line.startswith(f"{kind}:"))
        return round(kib / 2**10, 1)


def veilface(*arguments: str | Path, env: dict[str, str]) -> str:
    """Run the command; return its output. A failure ends the benchmark."""
    command = [sys.executable, "-m", "veilface", *map(str, arguments)]
    done = subprocess.run(command, env=env, text=True, stdout=subprocess.PIPE, check=False)
    if done.returncode:
        raise SystemExit(f"veilface {arguments[0]} failed")
    return done.stdout


def key_of(env: dict[str, str], *rights: str) -> str:
    """Make an API key of these rights."""
    words = [word for right in rights for word in ("--right", right)]
    token: str = json.loads(veilface("keys", "create", "--json", *words, env=env))["token"]
    return token


def add_options(parser: argparse.ArgumentParser, *, dim: int = 112) -> None:
    """Add the options of a deployment."""
    parser.add_argument("--data", type=Path, default=Path("../shared/data"))
    parser.add_argument("--pack", type=Path, help="default: DATA/packs/w600k_mbf")
    parser.add_argument(
        "--work", type=Path, help="folder of decoys and contract, kept for the next"
    )
    parser.add_argument("--database", choices=["sqlite", "postgresql"], default="sqlite")
    parser.add_argument("--dim", type=int, default=dim, help="of a contract that is made")
    parser.add_argument("--probe-dim", type=int, default=4, help="of lifted probes")
    parser.add_argument("--level", default="fmr-1e-3")


@contextmanager
def running(
    args: argparse.Namespace, *, workers: int = 1, with_pack: bool = True, **settings: str
) -> Iterator[Service]:
    """Run a service; decoys and contract are made where the working folder has none."""
    args.pack = args.pack or args.data / "packs" / "w600k_mbf"
    with ExitStack() as stack:
        fresh = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        args.work = args.work or fresh
        args.work.mkdir(parents=True, exist_ok=True)
        ours = {name: value for name, value in os.environ.items() if "VEILFACE_" not in name}
        env = ours | {
            "VEILFACE_DATA_DIR": str(args.work),
            "VEILFACE_DATABASE_URL": stack.enter_context(_database(args.database, fresh)),
            "VEILFACE_MASTER_KEY_FILE": str(args.work / "master.key"),
            **UNLIMITED,
            **{f"VEILFACE_{name.upper()}": value for name, value in settings.items()},
        }
        if not (args.work / "contract.json").exists():
            _prepare(args, env)
        if with_pack:
            env["VEILFACE_PACK"] = str(args.pack)
        veilface("db", "upgrade", env=env)
        token = key_of(env, "enroll", "verify", "erase", "embeddings")
        veilface("db", "template-enrollment", "--allow", env=env)
        url, process = stack.enter_context(serve(env, fresh / "serve.log", workers=workers))
        yield Service(url, token, env, psutil.Process(process.pid))


def _prepare(args: argparse.Namespace, env: dict[str, str]) -> None:
    """Make decoys and contract by the commands, people of the attempts left out."""
    decoys, cache = args.work / "decoys.veil", args.work / "cache.veil"
    faces, lfw = args.data / "fairface" / "train", args.data / "lfw"
    common = ("--pack", args.pack, "--cache", cache)
    veilface("decoys", "build", faces, *common, "--out", decoys, env=env)
    veilface(
        *("calibrate", lfw / "aligned112", "--aligned", *common, "--decoys", decoys),
        *("--dim", str(args.dim), "--probe-dims", str(args.probe_dim)),
        *("--exclude-people", lfw / "photos", "--out", args.work / "contract.json"),
        env=env,
    )


@contextmanager
def _database(kind: str, folder: Path) -> Iterator[str]:
    """Yield the URL of a fresh SQLite file, or of a PostgreSQL database that is dropped after."""
    if kind == "sqlite":
        yield f"sqlite:///{folder / 'veilface.db'}"
        return
    server = make_url(os.environ.get("VEILFACE_TEST_POSTGRES_URL", DEFAULT_POSTGRES)).set(
        drivername="postgresql+psycopg"
    )
    admin = create_engine(server, isolation_level="AUTOCOMMIT")
    name = f"veilface_bench_{secrets.token_hex(4)}"
    with admin.connect() as connection:
        connection.execute(text(f'CREATE DATABASE "{name}"'))
    try:
        yield server.set(database=name).render_as_string(hide_password=False)
    finally:
        with admin.connect() as connection:
            connection.execute(text(f'DROP DATABASE "{name}" WITH (FORCE)'))
        admin.dispose()
