"""deploy/veilface.service under a systemd that runs, installed as docs/deploy.md says."""

import json
import re
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from tests.api.deployment import bearer, deploy, images, photo
from tests.api.server_process import ROOT
from tests.pages import block_under
from tests.patience import PATIENCE_S, wait_until
from tests.reliability.hosts import Network
from tests.reliability.systemd import Machine

pytestmark = pytest.mark.long

SETTINGS = block_under("deploy.md", "systemd", "toml")
INSTALL = block_under("deploy.md", "systemd", "sh")
MAKE_KEY = block_under("deploy.md", "systemd", "sh", 1)
UNIT = (ROOT / "deploy" / "veilface.service").read_text()
PYTHON = "/opt/veilface/bin/python"
URL = "http://127.0.0.1:8421"
# In place of pip, which would ask a registry: the packages that the tests run with.
PACKAGES = f"""
echo /opt/python/lib > /etc/ld.so.conf.d/python.conf
ldconfig
/opt/python/bin/python3.{sys.version_info.minor} -m venv --without-pip /opt/veilface
printf '/opt/source\\n/opt/packages\\n' > $(echo /opt/veilface/lib/python3*/site-packages)/all.pth
install -m 0755 veilface /opt/veilface/bin/veilface
"""
ONE_WORKER = """
[Service]
ExecStart=
ExecStart=/opt/veilface/bin/veilface serve
"""


@pytest.fixture
def machine(tmp_path: Path) -> Iterator[Machine]:
    """A machine without a network, and the files that an operator brings."""
    with Network(0), Machine(tmp_path) as made:
        deploy(tmp_path, data_dir=tmp_path / "veilface-data")
        here = made.root / "tmp" / "here"
        for name in ("veilface-data", "veilface-data-keys"):
            shutil.copytree(tmp_path / name, here / name)
        shutil.copytree(tmp_path / "tiny", made.root / "srv" / "veilface" / "buffalo_l")
        # The other two are of PostgreSQL and Redis.
        (here / "veilface.toml").write_text(SETTINGS.splitlines()[0])
        (here / "deploy").symlink_to("/opt/source/deploy")
        program = Path(sys.executable).with_name("veilface").read_text()
        (here / "veilface").write_text(program.replace(sys.executable, PYTHON))
        yield made


def install(machine: Machine, enable: str = "enable --now") -> None:
    """Run the page's commands, without PostgreSQL's and in the end with this one of systemctl."""
    others = r"^(make|python3|/opt/veilface/bin/pip|runuser -u postgres) .*\n"
    commands = re.sub(others, "", INSTALL, flags=re.M)
    assert commands.count("enable --now") == 1
    commands = PACKAGES + commands.replace("enable --now", enable)
    machine.run("sh", "-euc", f"cd /tmp/here\n{commands}")


class Unit:
    """The service, as its operator sees it."""

    def __init__(self, machine: Machine) -> None:
        self._machine = machine

    def __getitem__(self, name: str) -> str:
        return self._machine.run("systemctl", "show", "--property", name, "--value", "veilface")

    def log(self) -> list[str]:
        """What it said since its last start."""
        since = f"_SYSTEMD_INVOCATION_ID={self['InvocationID']}"
        return self._machine.run("journalctl", "--output=cat", since).splitlines()

    def processes(self) -> set[str]:
        """Of its control group."""
        group = f"/sys/fs/cgroup{self['ControlGroup']}/cgroup.procs"
        return set(self._machine.run("cat", group).split())

    def is_healthy(self) -> bool:
        """Whether the check passes that the page runs."""
        config = "VEILFACE_CONFIG=/etc/veilface/veilface.toml"
        check = f"{config} {PYTHON} -m veilface.healthcheck && echo healthy"
        return self._machine.run("sh", "-c", check, check=False).endswith("healthy")

    def wait_for(self, workers: int, restarts: int = 0) -> None:
        """Return when all workers serve; fail where systemd had to start them more often."""

        def serve() -> bool:
            assert self["NRestarts"] == str(restarts), self.log()
            return any(line.startswith("Veilface listens on") for line in self.log())

        wait_until(serve, what="the service", every_s=0.2)
        wait_until(self.is_healthy, what="its health check")

        def started() -> int:
            return sum('"event": "started"' in line for line in self.log())

        wait_until(lambda: started() == workers, what="all workers")


def decisions(http: httpx.Client, subject: str) -> list[str]:
    """Of a verification by person 1, and of one by person 2."""
    shown = [images(photo(person, 1), name="image") for person in (1, 2)]
    answers = [http.post(f"/v1/subjects/{subject}/verify", files=each) for each in shown]
    return [answer.json()["decision"] for answer in answers]


def takes_requests() -> bool:
    """Whether it says that it is ready, within a second.

    While workers finish their requests, their supervisor's socket takes connections that nobody
    answers; and they are cut off after 20 seconds.
    """
    try:
        answer = httpx.get(f"{URL}/health/ready", timeout=1, trust_env=False)
    except httpx.TransportError:
        return False
    return answer.status_code == httpx.codes.OK


def enroll_during_a_restart(http: httpx.Client, machine: Machine, subject: str) -> None:
    """Send half of the request, let the service be told to stop, and send the rest."""
    unit = Unit(machine)
    before, processes = unit["MainPID"], unit.processes()
    path = f"/v1/subjects/{subject}/enrollment"
    request = http.build_request("PUT", path, files=images(photo(1)))
    body = request.read()

    def halves() -> Iterator[bytes]:
        yield body[:500]
        machine.run("systemctl", "restart", "--no-block", "veilface")
        wait_until(lambda: unit["ActiveState"] == "deactivating" and not takes_requests())
        yield body[500:]

    answer = http.put(path, content=halves(), headers=request.headers)
    assert answer.status_code == 201, answer.text
    wait_until(lambda: unit["MainPID"] not in (before, "0"), what="the next service")
    assert not processes & unit.processes()


def test_the_service_starts_serves_comes_back_and_stops(machine: Machine) -> None:
    unit = Unit(machine)
    override = machine.root / "etc/systemd/system/veilface.service.d/override.conf"
    override.parent.mkdir()
    override.write_text(ONE_WORKER)
    install(machine)
    unit.wait_for(workers=1)
    machine.run("sh", "-euc", MAKE_KEY)
    token = machine.run("cat", "/var/lib/veilface/api-key")
    with httpx.Client(
        base_url=URL, headers=bearer(token), timeout=PATIENCE_S, trust_env=False
    ) as http:
        enrolled = http.put("/v1/subjects/ann/enrollment", files=images(photo(1)))
        assert enrolled.status_code == 201, enrolled.text
        assert decisions(http, "ann") == ["accept", "reject"]

        override.unlink()
        machine.run("systemctl", "daemon-reload")
        for subject in ("ben", "cas"):
            enroll_during_a_restart(http, machine, subject)
            unit.wait_for(workers=2)
            assert decisions(http, subject) == ["accept", "reject"]

        processes = unit.processes()
        machine.run("kill", "-KILL", unit["MainPID"])
        wait_until(lambda: unit["NRestarts"] == "1", what="the start by systemd")
        unit.wait_for(workers=2, restarts=1)
        assert not processes & unit.processes()
        assert decisions(http, "ann") == ["accept", "reject"]

    folders = ["/var/lib/veilface"]
    modes = machine.run("stat", "--format=%a %U", *folders, "/var/lib/veilface/veilface.db")
    assert modes.splitlines() == ["700 veilface", "600 veilface"]
    for pid in unit.processes():
        said = machine.run("cat", f"/proc/{pid}/status", f"/proc/{pid}/limits")
        for line in (r"NoNewPrivs:\t1", r"Seccomp:\t2", r"CapBnd:\t0+", r"Max core .* 0 +0 .*"):
            assert re.search(f"^{line}$", said, re.M), said
    machine.run("systemctl", "stop", "veilface")
    ended = [unit[name] for name in ("ActiveState", "Result", "TasksCurrent")]
    assert ended == ["inactive", "success", "[not set]"]


ATTEMPTS = """
import ctypes, errno, json, mmap, os, socket
from pathlib import Path

libc = ctypes.CDLL(None, use_errno=True)

def call(name, argument):
    if getattr(libc, name)(argument) == -1:
        raise OSError(ctypes.get_errno(), name)

def outcome(attempt):
    try:
        attempt()
    except OSError as error:
        return errno.errorcode[error.errno]
    return "done"

own = Path("own")
own.touch()
mode = oct(own.stat().st_mode & 0o777)
Path("outcomes.json").write_text(json.dumps({
    "write elsewhere": outcome(Path("/srv/open/file").touch),
    "read in a home": outcome(Path("/home/open/file").read_bytes),
    "read what others keep for a while": outcome(Path("/tmp/open").read_bytes),
    "open a device": outcome(Path("/dev/open").read_bytes),
    "see other processes": outcome(Path("/proc/1/status").read_bytes),
    "ask the kernel about the network": outcome(
        lambda: socket.socket(socket.AF_NETLINK, socket.SOCK_RAW)
    ),
    "make a namespace": outcome(lambda: call("unshare", 0x10000000)),
    "change its personality": outcome(lambda: call("personality", 0x0040000)),
    "change its priority": outcome(lambda: os.nice(1)),
    "lend its rights by a file": outcome(lambda: own.chmod(0o4755)),
    "execute what it wrote": outcome(lambda: mmap.mmap(-1, 4096, prot=7)),
    "mode of its files": mode,
}))
"""
REFUSED = {
    "write elsewhere": "EROFS",
    "read in a home": "EACCES",
    "read what others keep for a while": "ENOENT",
    "open a device": "ENOENT",
    "see other processes": "ENOENT",
    "ask the kernel about the network": "EAFNOSUPPORT",
    "make a namespace": "EPERM",
    "change its personality": "EPERM",
    "change its priority": "EPERM",
    "lend its rights by a file": "EPERM",
    "execute what it wrote": "EPERM",
    "mode of its files": "0o600",
}
LOOSE = """
[Service]
Type=oneshot
User=veilface
WorkingDirectory=/var/lib/veilface
ExecStart=
"""


def test_the_unit_refuses_what_the_service_does_not_need(machine: Machine) -> None:
    install(machine, "enable")
    (machine.root / "opt/attempts.py").write_text(ATTEMPTS)
    machine.run("install", "-d", "-m", "0777", "/srv/open", "/home/open")
    for path in ("home/open/file", "tmp/open", "dev/open"):
        (machine.root / path).touch(mode=0o644)
    folder = machine.root / "var/lib/veilface"

    def outcomes(unit: str) -> dict[str, str]:
        unit = re.sub("^ExecStart=.*", f"ExecStart={PYTHON} /opt/attempts.py", unit, flags=re.M)
        unit = unit.replace("Type=exec", "Type=oneshot")
        (machine.root / "etc/systemd/system/attempts.service").write_text(unit)
        machine.run("systemctl", "daemon-reload")
        machine.run("systemctl", "start", "attempts")
        (folder / "own").unlink()
        return dict(json.loads((folder / "outcomes.json").read_text()))

    assert outcomes(UNIT) == REFUSED
    assert outcomes(LOOSE) == dict.fromkeys(REFUSED, "done") | {"mode of its files": "0o644"}
    analysis = ["systemd-analyze", "security", "--threshold=15", "--no-pager", "veilface.service"]
    machine.run(*analysis)
