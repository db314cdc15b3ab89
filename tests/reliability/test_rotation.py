"""One command turns the templates of an earlier version while the service verifies."""

import json
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import httpx
import pytest

from api.service.opening import open_keyring, open_store
from api.service.runtime import Runtime
from templates.store import Source
from templates.store.audit_log import By
from tests.api.deployment import Deployment, bearer, deploy, images, photo
from tests.api.server_process import ROOT, Server
from tests.patience import PATIENCE_S
from tests.ports import free_port

pytestmark = pytest.mark.long

KILLS = 10
BATCH = 2
PEOPLE = {f"person-{number}": number for number in range(1, BATCH * KILLS + 4)}

# The command itself; where it is told to, it dies after its first transaction.
COMMAND = """
import os, signal, sys
from api.cli import main
from templates.store.rerotation import Rerotation
move, dies, batch = Rerotation.move, sys.argv.pop(1) == "dies", int(sys.argv.pop(1))

def in_small_batches(*arguments, **named):
    if dies:
        named["progress"] = lambda moved: os.kill(os.getpid(), signal.SIGKILL)
    return move(*arguments, **{**named, "batch": batch})

Rerotation.move = in_small_batches
main()
"""


class Verifications(threading.Thread):
    """Verifies every subject in turn, with a photo of its own and one of another person."""

    def __init__(self, service: Server) -> None:
        super().__init__(daemon=True)
        self._service = service
        self._ended = threading.Event()
        self._progress = threading.Condition()
        self.answers: list[tuple[str, int, str]] = []
        self.unexpected: list[str] = []

    def run(self) -> None:
        http = httpx.Client(
            base_url=self._service.url,
            headers=bearer(self._service.deployment.token),
            timeout=PATIENCE_S,
        )
        with http:
            while not self._ended.is_set():
                for name, person in PEOPLE.items():
                    for shown, decision in ((person, "accept"), (person + 100, "reject")):
                        self._verify(http, name, shown, decision)

    def _verify(self, http: httpx.Client, name: str, shown: int, decision: str) -> None:
        sent = images(photo(shown, 5), name="image")
        try:
            answer = http.post(f"/v1/subjects/{name}/verify", files=sent)
            told = answer.json().get("decision", answer.text)
        except httpx.HTTPError as error:
            told = repr(error)
        with self._progress:
            self.answers.append((name, shown, told))
            if told != decision:
                self.unexpected.append(f"{name}, photo of {shown}: {told}")
            self._progress.notify_all()

    def wait_for(self, more: int) -> None:
        """Return when so many more verifications were answered."""
        with self._progress:
            enough = len(self.answers) + more
            assert self._progress.wait_for(lambda: len(self.answers) >= enough, PATIENCE_S)

    def stop(self) -> None:
        self._ended.set()
        self.join(PATIENCE_S)


def rotate(deployment: Deployment, how: str, *flags: str) -> subprocess.CompletedProcess[str]:
    settings = deployment.settings
    return subprocess.run(
        [
            *(
                sys.executable,
                "-c",
                COMMAND,
                how,
                str(BATCH),
                "keys",
                "rotate-tenant",
                "--json",
                *flags,
            ),
            *("--data-dir", str(settings.data_dir)),
            *("--database-url", settings.resolved_database_url),
        ],
        cwd=ROOT,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.mark.parametrize("database_url", ["sqlite", "postgres"], indirect=True)
def test_a_running_service_is_moved_by_one_command_killed_ten_times(
    database_url: str, tmp_path: Path
) -> None:
    deployment = deploy(
        tmp_path,
        database_url=database_url,
        port=free_port(),
        workers=2,
        compute_slots=1,
        rate_limit_key="off",
        rate_limit_address="off",
    )
    runtime = Runtime.open(deployment.settings)
    try:
        enroller = runtime.enroller("default", 1)
        for name, person in PEOPLE.items():
            enrollment = enroller.from_photos(runtime.required_pack(), [photo(person)])
            runtime.put(
                "default",
                name,
                1,
                enrollment,
                source=Source.PHOTOS,
                photos=1,
                by=By("an operator"),
            )
    finally:
        runtime.close()
    store = open_store(deployment.settings, open_keyring(deployment.settings))
    try:
        with Server(deployment, tmp_path) as service:
            clients = [Verifications(service) for _ in range(2)]
            for client in clients:
                client.start()
            left = len(PEOPLE)
            for number in range(KILLS):
                clients[0].wait_for(4)
                # The first run makes the new key, the others go on.
                ran = rotate(deployment, "dies", *(["--finish"] if number else []))
                assert ran.returncode == -signal.SIGKILL, ran.stderr
                # One that a verification writes at this moment is left for the next run.
                remaining = store.rerotation.remaining("default")
                assert left - BATCH <= remaining <= left
                left = remaining
            assert left <= len(PEOPLE) - KILLS
            clients[0].wait_for(4)
            ran = rotate(deployment, "ends", "--finish")
            assert ran.returncode == 0, ran.stderr
            done = json.loads(ran.stdout)
            assert (done["moved"], done["enroll_again"]) == (left, [])
            assert done["rotations_dropped"] == 1
            # All of them once more, in their new rotations.
            clients[0].wait_for(2 * len(PEOPLE))
            for client in clients:
                client.stop()
                assert client.unexpected == []
        binding = deployment.contract.binding
        for name in PEOPLE:
            record = store.subjects.describe("default", name)
            assert record is not None
            assert record.contract_id == binding.contract_id
        assert store.audit_log.verify().intact
    finally:
        store.close()
