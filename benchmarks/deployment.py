"""A deployment for a benchmark: the installed command, a fresh database, a running service."""

import os
import secrets
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
from sqlalchemy import create_engine, text
from sqlalchemy.engine import make_url

VEILFACE = Path(sys.executable).with_name("veilface")
_START_S = 600.0
"""For a service to get ready: on a busy machine, the imports alone take a minute."""
DEFAULT_POSTGRES = "postgresql://postgres@127.0.0.1:5432/postgres"


def veilface(*arguments: str | Path, env: dict[str, str]) -> str:
    """Run the installed command; its standard output. A failure ends the benchmark."""
    done = subprocess.run(
        [str(VEILFACE), *map(str, arguments)], env=env, text=True, capture_output=True, check=False
    )
    if done.returncode:
        raise SystemExit(f"veilface {arguments[0]} failed: {done.stderr.strip()}")
    return done.stdout


def settings_of(
    work: Path, pack: Path, url: str, *, made: Path | None = None, master_key: Path | None = None
) -> dict[str, str]:
    """Settings of a deployment in ``work``; decoys, contract and master key are in ``made``."""
    made = made or work
    return {
        "VEILFACE_DATA_DIR": str(work),
        "VEILFACE_DATABASE_URL": url,
        "VEILFACE_PACK": str(pack),
        "VEILFACE_DECOYS_FILE": str(made / "decoys.veil"),
        "VEILFACE_CONTRACT_FILE": str(made / "contract.json"),
        "VEILFACE_MASTER_KEY_FILE": str(master_key or made / "master.key"),
    }


def free_port() -> int:
    """A local port that nobody listens on now."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        port: int = listener.getsockname()[1]
        return port


@contextmanager
def database(kind: str, work: Path) -> Iterator[str]:
    """A fresh SQLite file, or a fresh PostgreSQL database that is dropped afterwards."""
    if kind == "sqlite":
        yield f"sqlite:///{work / 'veilface.db'}"
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


@contextmanager
def service(
    env: dict[str, str], *, workers: int, log: Path, port: int | None = None
) -> Iterator[str]:
    """``veilface serve`` on a free port; yields its base URL once it is ready."""
    port = port or free_port()
    with log.open("wb") as sink:
        process = subprocess.Popen(
            [str(VEILFACE), "serve", "--port", str(port), "--workers", str(workers)],
            env=env,
            stdout=sink,
            stderr=sink,
        )
        url = f"http://127.0.0.1:{port}"
        try:
            end = time.monotonic() + _START_S
            while time.monotonic() < end:
                if process.poll() is not None:
                    raise SystemExit(f"veilface serve ended: {log.read_text()[-2000:]}")
                try:
                    if httpx.get(f"{url}/health/ready", timeout=5).status_code == 200:
                        break
                except httpx.TransportError:
                    pass
                time.sleep(0.25)
            else:
                raise SystemExit(f"the service did not become ready: {log.read_text()[-2000:]}")
            yield url
        finally:
            process.terminate()
            process.wait()
