"""How the private client calls its command, and what it does when contracts change.

A spy stands in for ``veilface lift``, and a scripted service answers: for what real ones do not
show. ``test_private.py`` has the real ones.
"""

import asyncio
import dataclasses
import errno
import json
import os
import shutil
import stat
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
from pydantic import ValidationError

from tests.patience import wait_until
from veilface_client import (
    AsyncPrivateClient,
    ConnectionFailed,
    ContractMismatch,
    Enrollable,
    LiftFailed,
    LiftTimeout,
    LiftUnavailable,
    PrivateClient,
    Probe,
    Retries,
    Unavailable,
    UnexpectedAnswer,
)
from veilface_client import child as child_process

TOKEN = f"vf_{'0' * 12}_{'5e' * 32}"
CONTRACTS = ("a" * 64, "b" * 64)

SPY = """#!{python} -IS
import base64, json, os, sys
said = {{
    "argv": sys.argv[1:],
    "pid": os.getpid(),
    "environment": dict(os.environ),
    "folder": os.getcwd(),
    "photos": [],
    "descriptors": sorted(int(fd) for fd in os.listdir("/proc/self/fd")),
}}
for name in sys.argv[sys.argv.index("--") + 1 :]:
    with open(name, "rb") as file:
        said["photos"].append(base64.b64encode(file.read()).decode())
with open({log!r}, "a") as log:
    log.write(json.dumps(said) + "\\n")
contract = next(a for a in sys.argv if a.startswith("--contract=")).split("=", 1)[1]
lifted = json.load(open(contract))["contract_id"].encode()
{then}
print(json.dumps({{"template": base64.b64encode(lifted).decode(), "hmac": "x"}}))
"""


class Spy:
    """The command, and its calls."""

    def __init__(self, folder: Path, then: str = "") -> None:
        self.command, self._log = folder / "spy", folder / "spy.log"
        self.command.write_text(SPY.format(python=sys.executable, log=str(self._log), then=then))
        self.command.chmod(0o755)

    @property
    def calls(self) -> list[dict[str, Any]]:
        """How it was called."""
        if not self._log.exists():
            return []
        return [json.loads(line) for line in self._log.read_text().splitlines()]


@dataclasses.dataclass
class Changing:
    """A service whose contract changes as often as it is told, before a template arrives."""

    changes: int = 0
    stale_generators: int = 0
    refuse_always: bool = False
    contract: int = 0
    lost: int = 0
    overloaded: int = 0
    bodies: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    paths: list[str] = dataclasses.field(default_factory=list)

    def __call__(self, request: httpx.Request) -> httpx.Response:
        path = request.url.path
        self.paths.append(path)
        current = CONTRACTS[self.contract % 2]
        if path == "/v1/contract":
            return httpx.Response(200, json=contract_answer(current))
        if path == "/v1/contract/generator":
            stale = self.stale_generators > 0
            self.stale_generators -= stale
            named = "other" if stale else f"source-{current}"
            return httpx.Response(200, content=b"G", headers={"X-Decoy-Source-ID": named})
        body = json.loads(request.read())
        self.bodies.append(body)
        if self.changes:
            self.changes -= 1
            self.contract += 1
            return mismatch()
        if self.refuse_always:
            return mismatch()
        if self.overloaded:
            self.overloaded -= 1
            error = {"code": "overloaded", "message": "m", "details": {}}
            return httpx.Response(503, json={"error": error, "request_id": "r"})
        if self.lost:
            self.lost -= 1
            raise httpx.ReadError("broken")
        answer = {"contract_id": current, "request_id": "r"}
        if path.endswith("/enrollment"):
            return httpx.Response(
                201, json={**answer, "template_id": "t", "replaced": False, "images": []}
            )
        decided = {"decision": "accept", "reason": "match", "level": "l", "calibration_id": "k"}
        return httpx.Response(200, json={**answer, **decided})


def contract_answer(contract_id: str) -> dict[str, Any]:
    return {
        "contract_id": contract_id,
        "binding": {"decoy_source_id": f"source-{contract_id}"},
        "calibrations": [],
        "default_level": "l",
        "photos": False,
        "generator": True,
        "receipt_key": {"algorithm": "Ed25519", "key_id": "k", "public_key": "p"},
        "request_id": "r",
    }


def mismatch() -> httpx.Response:
    error = {"code": "contract_mismatch", "message": "m", "details": {}}
    return httpx.Response(409, json={"error": error, "request_id": "r"})


Make = Callable[..., PrivateClient]


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Make]:
    """Private clients of a scripted service, closed at the end."""
    made: list[PrivateClient] = []

    def client(service: Changing, command: Path, **options: Any) -> PrivateClient:
        made.append(
            PrivateClient(
                "http://service.test",
                TOKEN,
                pack=tmp_path / "pack",
                command=command,
                transport=httpx.MockTransport(service),
                retries=Retries(first_s=0.0),
                **options,
            )
        )
        return made[-1]

    yield client
    for each in made:
        each.close()


def test_how_the_command_is_called(
    tmp_path: Path, make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("VEILFACE_API_KEY", TOKEN)
    monkeypatch.setenv("VEILFACE_MASTER_KEY_FILE", "/secret")
    monkeypatch.setenv("PYTHONPATH", "/thief")
    spy = Spy(tmp_path)
    client = make(Changing(), spy.command, dim=4, lift_environment={"EXTRA": "1"})
    large = os.urandom(3 * 2**20)
    client.enroll("anna", [b"one", large], face="largest")
    client.verify("anna", b"probe", level="fmr-1e-2")
    enrollment, probe = spy.calls
    photos = enrollment["argv"][-2:]
    assert all(name.startswith("/dev/fd/") for name in photos)
    assert enrollment["argv"][:-2] == [
        "lift",
        "--out=-",
        f"--pack={tmp_path / 'pack'}",
        f"--contract={client.folder / (CONTRACTS[0] + '.json')}",
        f"--generator={client.folder / (CONTRACTS[0] + '.generator')}",
        "--face=largest",
        "--",
    ]
    assert [len(each) for each in enrollment["photos"]] == [4, 4 * 2**20]
    assert enrollment["folder"] == str(client.folder)
    assert len(enrollment["descriptors"]) == 3 + len(photos) + 1, "and that of the listing"
    assert probe["argv"][1:6] == ["--probe", "--subject", "unsigned", "--dim", "4"]
    for call in (enrollment, probe):
        environment = call["environment"]
        assert environment["EXTRA"] == "1"
        assert not {"VEILFACE_MASTER_KEY_FILE", "PYTHONPATH"} & environment.keys()
        assert TOKEN not in json.dumps(call)
        assert "5e" * 32 not in json.dumps(call)
    assert "VEILFACE_API_KEY" not in enrollment["environment"]
    assert probe["environment"]["VEILFACE_API_KEY"].startswith("vf_")


def test_photos_are_in_no_file(tmp_path: Path, make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    """Everything below the temporary folder, while the command runs."""
    seen = tmp_path / "seen"
    monkeypatch.setenv("TMPDIR", str(tmp_path / "tmp"))
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr("tempfile.tempdir", None)
    spy = Spy(
        tmp_path,
        then=f"""
import pathlib
found = [p for p in pathlib.Path({str(tmp_path / "tmp")!r}).rglob("*") if p.is_file()]
open({str(seen)!r}, "wb").write(b"|".join(p.read_bytes() for p in found))
""",
    )
    make(Changing(), spy.command).enroll("anna", b"marked-photo-bytes")
    assert CONTRACTS[0].encode() in seen.read_bytes(), "it looked where the client writes"
    assert b"marked-photo-bytes" not in seen.read_bytes()


def test_a_contract_that_changed_is_fetched_once_more(tmp_path: Path, make: Make) -> None:
    spy = Spy(tmp_path)
    service = Changing(changes=1)
    client = make(service, spy.command)
    assert client.enroll("anna", b"photo").contract_id == CONTRACTS[1]
    assert service.paths.count("/v1/contract") == 2
    assert len(spy.calls) == 2
    service.changes = 1
    assert client.verify("anna", b"photo").contract_id == CONTRACTS[0]
    assert service.paths.count("/v1/contract") == 3

    service.changes = 2
    with pytest.raises(ContractMismatch):
        client.enroll("anna", b"photo")
    assert len(spy.calls) == 6


def test_no_second_lift_where_the_contract_is_the_same(tmp_path: Path, make: Make) -> None:
    """The subject's stored template is of another contract: lifting again heals nothing."""
    spy = Spy(tmp_path)
    service = Changing(refuse_always=True)
    client = make(service, spy.command)
    for call in (lambda: client.enroll("anna", b"p"), lambda: client.verify("anna", b"p")):
        with pytest.raises(ContractMismatch):
            call()
    assert len(spy.calls) == 2


def test_a_resend_repeats_the_template_and_never_lifts_again(tmp_path: Path, make: Make) -> None:
    spy = Spy(tmp_path)
    service = Changing(lost=2)
    make(service, spy.command).enroll("anna", b"photo")
    assert len(service.bodies) == 3
    assert service.bodies[0] == service.bodies[1] == service.bodies[2]
    assert len(spy.calls) == 1


def test_a_probe_is_signed_anew_for_each_sending(tmp_path: Path, make: Make) -> None:
    spy = Spy(tmp_path)
    service = Changing(overloaded=2)
    client = make(service, spy.command)
    assert client.verify("anna", b"photo")
    assert len({body["nonce"] for body in service.bodies}) == 3
    assert len({body["hmac"] for body in service.bodies}) == 3
    assert len({body["template"] for body in service.bodies}) == 1
    assert len(spy.calls) == 1

    service.bodies.clear()
    service.lost = 1
    with pytest.raises(ConnectionFailed):
        client.verify("anna", b"photo")
    assert len(service.bodies) == 1, "it may have been decided"


def test_after_a_lost_answer_the_lift_is_repeated(tmp_path: Path, make: Make) -> None:
    spy = Spy(tmp_path)
    service = Changing(lost=4)
    client = make(service, spy.command)
    with pytest.raises(ConnectionFailed) as failed:
        client.enroll("anna", b"photo")
    lift = failed.value.lift
    assert isinstance(lift, Enrollable)
    assert "never with the photo" in failed.value.__notes__[0]
    assert client.enroll("anna", lift)
    assert len(service.bodies) == 5
    assert all(body == service.bodies[0] for body in service.bodies)
    assert len(spy.calls) == 1

    service.lost = 1
    with pytest.raises(ConnectionFailed) as failed:
        client.verify("anna", b"photo")
    probe = failed.value.lift
    assert isinstance(probe, Probe)
    assert client.verify("anna", probe)
    assert service.bodies[-1]["template"] == service.bodies[-2]["template"]
    assert len(spy.calls) == 2


def test_the_same_asynchronously(tmp_path: Path) -> None:
    spy = Spy(tmp_path)
    service = Changing(lost=2)

    async def scenario() -> None:
        async with AsyncPrivateClient(
            "http://service.test",
            TOKEN,
            pack=tmp_path / "pack",
            command=spy.command,
            transport=httpx.MockTransport(service),
            retries=Retries(sendings=1),
        ) as client:
            lift = await client.lift_enrollment(b"photo")
            for _ in range(2):
                with pytest.raises(ConnectionFailed) as failed:
                    await client.enroll("anna", lift)
                assert failed.value.lift is lift
            assert await client.enroll("anna", lift)

    asyncio.run(scenario())
    assert len(service.bodies) == 3
    assert len(spy.calls) == 1


def test_a_lift_is_sent_as_often_as_it_must_and_never_made_again(
    tmp_path: Path, make: Make
) -> None:
    spy = Spy(tmp_path)
    service = Changing()
    client = make(service, spy.command)
    lift = client.lift_enrollment([b"one", b"two"], face="largest")
    assert service.bodies == [], "nothing of it is sent"
    assert "--face=largest" in spy.calls[0]["argv"]
    for subject in ("anna", "anna", "bert"):
        client.enroll(subject, lift)
    assert len({body["template"] for body in service.bodies}) == 1
    with pytest.raises(ValidationError):
        lift.template = b"other"  # type: ignore[misc]

    service.changes = 1
    with pytest.raises(ContractMismatch) as failed:
        client.enroll("anna", lift)
    assert failed.value.lift is None, "repeating it heals nothing"
    assert len(spy.calls) == 1


def test_what_was_not_done_is_repeated_with_the_lift_too(tmp_path: Path, make: Make) -> None:
    spy = Spy(tmp_path)
    service = Changing(overloaded=4)
    client = make(service, spy.command)
    with pytest.raises(Unavailable) as failed:
        client.verify("anna", b"photo")
    assert isinstance(failed.value.lift, Probe)
    assert client.verify("anna", failed.value.lift)
    assert len(spy.calls) == 1


def test_files_that_are_gone_are_fetched_again(tmp_path: Path, make: Make) -> None:
    """Cleaners of /tmp remove what is old, and then the folder."""
    service = Changing()
    client = make(service, Spy(tmp_path).command)
    client.lift(b"photo")
    next(client.folder.glob("*.generator")).unlink()
    client.lift(b"photo")
    assert service.paths.count("/v1/contract") == 2

    first = client.folder
    shutil.rmtree(first)
    client.lift(b"photo")
    assert service.paths.count("/v1/contract") == 3
    assert stat.S_IMODE(client.folder.stat().st_mode) == 0o700

    # The same name, but not the folder that the client made.
    second = client.folder
    shutil.copytree(second, tmp_path / "copy")
    shutil.rmtree(second)
    shutil.copytree(tmp_path / "copy", second)
    second.chmod(0o755)
    client.lift(b"photo")
    assert service.paths.count("/v1/contract") == 4
    third = client.folder
    assert third != second
    client.close()
    assert not third.exists()
    shutil.rmtree(second)


def test_a_forked_child_leaves_the_folder_to_its_parent(tmp_path: Path) -> None:
    script = f"""
import os, sys
from veilface_client import PrivateClient
client = PrivateClient("http://service.test", {TOKEN!r}, pack="pack")
child = os.fork()
if child == 0:
    client.close()
    sys.exit()
os.waitpid(child, 0)
print(client.folder, client.folder.exists())
"""
    done = subprocess.run(
        [sys.executable, "-c", script],
        env={**os.environ, "TMPDIR": str(tmp_path)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    folder, existed = done.stdout.split()
    assert existed == "True"
    assert not Path(folder).exists(), "the parent removes it at its end"


def test_a_generator_of_another_contract(tmp_path: Path, make: Make) -> None:
    spy = Spy(tmp_path)
    make(Changing(stale_generators=2), spy.command).enroll("anna", b"photo")
    with pytest.raises(UnexpectedAnswer, match="generator"):
        make(Changing(stale_generators=3), spy.command).enroll("anna", b"photo")
    assert len(spy.calls) == 1


@pytest.mark.parametrize(
    ("then", "options", "kind", "said"),
    [
        ("sys.exit('error: no face was found')", {}, LiftFailed, "no face was found"),
        ("sys.exit('Traceback: vf_secret')", {}, LiftFailed, "did not say why"),
        ("print('[]'); sys.exit()", {}, LiftFailed, "something else"),
        ("print('{\"template\": 3}'); sys.exit()", {}, LiftFailed, "something else"),
        (
            "import time; time.sleep(100000)",
            {"lift_limit_s": 0.5},
            LiftTimeout,
            "longer than 0.5 s",
        ),
        ("while True: print('x' * 65536)", {}, LiftFailed, "did not say why"),
    ],
)
def test_a_command_that_fails(
    then: str,
    options: dict[str, float],
    kind: type[LiftFailed],
    said: str,
    tmp_path: Path,
    make: Make,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(child_process, "MOST_OUTPUT", 2**20)
    with pytest.raises(LiftFailed, match=said) as failed:
        make(Changing(), Spy(tmp_path, then).command, **options).enroll("anna", b"photo")
    assert type(failed.value) is kind
    assert "vf_secret" not in str(failed.value)


GRANDCHILD = """
import subprocess
other = subprocess.Popen(["sleep", "100000"], {options})
open({file!r}, "w").write(str(other.pid))
"""


def runs(pid: int) -> bool:
    """Whether a process is there and has not ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] not in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_the_limit_is_that_of_everything_that_the_command_started(
    tmp_path: Path, make: Make
) -> None:
    """The command has ended, and somebody else holds its output."""
    file = tmp_path / "grandchild"
    spy = Spy(tmp_path, GRANDCHILD.format(options="", file=str(file)))
    for limit in (1, 10, 100):
        with pytest.raises(LiftTimeout, match=f"longer than {limit} s"):
            make(Changing(), spy.command, lift_limit_s=limit).lift(b"photo")
        if file.exists() and file.read_text():
            break  # else this machine is so busy that the command was ended before it came so far
    wait_until(lambda: not runs(int(file.read_text())), what="the end of the grandchild")


def test_nothing_that_the_command_started_outlives_it(tmp_path: Path, make: Make) -> None:
    file = tmp_path / "grandchild"
    options = "stdin=-3, stdout=-3, stderr=-3"
    spy = Spy(tmp_path, GRANDCHILD.format(options=options, file=str(file)))
    assert make(Changing(), spy.command).lift(b"photo")
    wait_until(lambda: not runs(int(file.read_text())), what="the end of the grandchild")


def test_a_thread_that_cannot_start(
    tmp_path: Path, make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    spy = Spy(tmp_path, "import time; time.sleep(100000)")
    client = make(Changing(), spy.command)
    start = threading.Thread.start
    made: list[threading.Thread] = []

    def third_fails(self: threading.Thread) -> None:
        made.append(self)
        if len(made) == 3:
            raise RuntimeError("can't start new thread")
        start(self)

    before = len(list(Path("/proc/self/fd").iterdir()))
    monkeypatch.setattr(threading.Thread, "start", third_fails)
    with pytest.raises(RuntimeError, match="new thread"):
        client.lift_enrollment([b"photo", b"another"])
    assert len(list(Path("/proc/self/fd").iterdir())) == before


@pytest.mark.parametrize("failing", [1, 2, 3])
def test_too_many_open_files(
    failing: int, tmp_path: Path, make: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = make(Changing(), Spy(tmp_path).command)
    pipe, made = os.pipe, []

    def some() -> tuple[int, int]:
        made.append(None)
        if len(made) == failing:
            raise OSError(errno.EMFILE, "Too many open files")
        return pipe()

    before = len(list(Path("/proc/self/fd").iterdir()))
    monkeypatch.setattr(os, "pipe", some)
    with pytest.raises(LiftUnavailable, match="Too many open files"):
        client.lift_enrollment([b"photo", b"another"])
    assert len(list(Path("/proc/self/fd").iterdir())) == before


def test_a_lift_that_nobody_waits_for_is_ended(tmp_path: Path) -> None:
    spy = Spy(tmp_path, "import time; time.sleep(100000)")

    async def scenario() -> None:
        async with AsyncPrivateClient(
            "http://service.test",
            TOKEN,
            pack=tmp_path / "pack",
            command=spy.command,
            transport=httpx.MockTransport(Changing()),
        ) as client:
            calls = [client.lift(b"photo"), client.lift_enrollment(b"photo")]
            tasks = [asyncio.ensure_future(each) for each in calls]
            while len(spy.calls) < 2:
                await asyncio.sleep(0.05)
            for task in tasks:
                task.cancel()
                with pytest.raises(asyncio.CancelledError):
                    await task

    asyncio.run(scenario())
    # The end of the loop has waited for its threads, and those for the command.
    wait_until(
        lambda: not any(runs(call["pid"]) for call in spy.calls), what="the end of the lifts"
    )


def test_a_lift_that_is_given_up_before_it_starts(tmp_path: Path) -> None:
    canceller = child_process.Canceller()
    canceller.cancel()
    done = child_process.run(
        lambda names: ["sleep", "100000"],
        [],
        environment=os.environ,
        folder=str(tmp_path),
        limit_s=60,
        canceller=canceller,
    )
    assert done.status == -9


def test_a_command_that_never_reads(tmp_path: Path, make: Make) -> None:
    """The photo is larger than a pipe: writing it must end with the command."""
    command = tmp_path / "deaf"
    command.write_text("#!/bin/sh\necho 'error: not today' >&2\nexit 3\n")
    command.chmod(0o755)
    with pytest.raises(LiftFailed, match="not today") as failed:
        make(Changing(), command).enroll("anna", bytes(2**21))
    assert failed.value.status == 3


def test_no_command(tmp_path: Path, make: Make) -> None:
    with pytest.raises(LiftUnavailable, match="there is no command"):
        make(Changing(), tmp_path / "absent").enroll("anna", b"photo")
    broken = tmp_path / "broken"
    broken.write_text("#!/there/is/no/interpreter\n")
    broken.chmod(0o755)
    with pytest.raises(LiftUnavailable, match="cannot be started"):
        make(Changing(), broken).enroll("anna", b"photo")


def test_no_descriptors_are_left_open(tmp_path: Path, make: Make) -> None:
    client = make(Changing(), Spy(tmp_path).command)
    client.enroll("anna", b"photo")
    before = len(list(Path("/proc/self/fd").iterdir()))
    for _ in range(3):
        client.enroll("anna", [b"photo", b"another"])
    (tmp_path / "spy").write_text("#!/there/is/no/interpreter\n")
    with pytest.raises(LiftUnavailable):
        client.enroll("anna", b"photo")
    assert len(list(Path("/proc/self/fd").iterdir())) == before


def test_only_a_key_of_the_service_signs(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="API key") as refused:
        PrivateClient("http://service.test", "some-other-token", pack=tmp_path)
    assert "some-other-token" not in str(refused.value)
    assert repr(Probe(template=b"12345", contract_id="c")) == "<Probe of 5 bytes>"
