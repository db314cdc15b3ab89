"""A PostgreSQL server of the tests' own, which they may stop and start."""

import os
import pwd
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import psycopg

from tests.patience import PATIENCE_S
from tests.ports import free_port

ACCOUNT = "postgres"


class NoPostgres(Exception):
    """The programs of PostgreSQL, or an account to run them under, are not on this machine."""


def _programs() -> Path:
    pg_config = shutil.which("pg_config")
    if pg_config is not None:
        folder = Path(subprocess.check_output([pg_config, "--bindir"], text=True).strip())
        if (folder / "pg_ctl").exists():
            return folder
    for folder in sorted(Path("/usr/lib/postgresql").glob("*/bin"), reverse=True):
        if (folder / "pg_ctl").exists():
            return folder
    raise NoPostgres("the programs initdb and pg_ctl of PostgreSQL are not on this machine")


class Cluster:
    """A throw-away server on a port of its own; it runs from the start of the block to its end.

    Parameters
    ----------
    address
        That it listens on, of a network of 256 addresses.
    port
        One that is free by default.
    access
        How whoever comes from the network shows who they are.
    """

    def __init__(
        self, address: str = "127.0.0.1", port: int | None = None, access: str = "trust"
    ) -> None:
        self._address = address
        self._access = access
        self._bin = _programs()
        # Root may not run the server. A short path: that of a socket has about 100 characters.
        self._account = ACCOUNT if os.geteuid() == 0 else None
        if self._account is not None:
            try:
                entry = pwd.getpwnam(self._account)
            except KeyError:
                raise NoPostgres(f"root runs no PostgreSQL, and {ACCOUNT} is unknown") from None
        self._folder = Path(tempfile.mkdtemp(prefix="veilface-pg-"))
        if self._account is not None:
            os.chown(self._folder, entry.pw_uid, entry.pw_gid)
        self.port = port or free_port()

    def __enter__(self) -> "Cluster":
        try:
            self._call("initdb", "-D", "data", "-A", "trust", "-U", "veilface", "-N", "-E", "UTF8")
            with (self._folder / "data" / "pg_hba.conf").open("a") as access:
                access.write(f"host all all {self._address}/24 {self._access}\n")
            self.start()
            with self.connect("postgres") as connection:
                connection.execute("CREATE DATABASE veilface")
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self.stop("immediate")
        finally:
            shutil.rmtree(self._folder)

    @property
    def url(self) -> str:
        """URL of its one database."""
        return f"postgresql://veilface@{self._address}:{self.port}/veilface"

    def connect(self, database: str = "veilface") -> "psycopg.Connection[tuple[Any, ...]]":
        """Connect by the socket, which is trusted; each statement is a transaction."""
        return psycopg.connect(
            host=str(self._folder),
            port=self.port,
            user="veilface",
            dbname=database,
            autocommit=True,
        )

    @property
    def runs(self) -> bool:
        """Whether the server runs."""
        return self._call("pg_ctl", "-D", "data", "status", check=False) == 0

    def start(self) -> None:
        """Start it, and return when it accepts connections."""
        settings = {
            "port": self.port,
            "listen_addresses": self._address,
            "unix_socket_directories": self._folder,
        }
        options = " ".join(f"-c {name}={value}" for name, value in settings.items())
        self._call("pg_ctl", "-D", "data", "-l", "log", "-o", options, "-w", "-t", "60", "start")

    def stop(self, mode: str) -> None:
        """Stop it, ``fast`` (sessions are ended) or ``immediate`` (as by a crash)."""
        if self.runs:
            self._call("pg_ctl", "-D", "data", "-m", mode, "-w", "-t", "60", "stop")
        deadline = time.monotonic() + PATIENCE_S
        while self.runs:
            if time.monotonic() > deadline:
                raise AssertionError("the PostgreSQL server does not stop")
            time.sleep(0.02)

    def _call(self, program: str, *arguments: str, check: bool = True) -> int:
        # Into a file: the server inherits the output, and a pipe would be open as long as it runs.
        with tempfile.TemporaryFile() as output:
            done = subprocess.run(
                [self._bin / program, *arguments],
                cwd=self._folder,
                user=self._account,
                env={"PATH": os.environ.get("PATH", ""), "LC_ALL": "C.UTF-8"},
                stdout=output,
                stderr=subprocess.STDOUT,
                timeout=PATIENCE_S,
            )
            output.seek(0)
            if check and done.returncode:
                raise AssertionError(f"{program} failed: {output.read().decode()}")
        return done.returncode
