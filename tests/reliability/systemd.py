"""A machine of its own under systemd: PID 1 of new namespaces, on a root that is thrown away.

What it writes lies in memory, over this machine's files, which it only reads. It may not load
kernel modules, set clocks or change kernel parameters; what this machine enables is not started.
"""

import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

from tests.api.server_process import ROOT
from tests.patience import PATIENCE_S, wait_until
from tests.privileges import not_permitted

SYSTEMD = shutil.which("systemd", path="/usr/lib/systemd:/lib/systemd")
PATH = "PATH=/usr/local/sbin:/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"

# FOLDER INSIDE SYSTEMD [SOURCE TARGET]…: ends when its input does, and leaves nothing behind.
OUTSIDE = r"""
set -e
base=$1 inside=$2 systemd=$3 root=$1/root group=$1/groups/veilface$$
shift 3
mount -t tmpfs -o mode=0755 tmpfs "$base"
mkdir "$base/upper" "$base/work" "$base/groups" "$root"
mount -t overlay -o "lowerdir=/,upperdir=$base/upper,workdir=$base/work" overlay "$root"
for folder in run tmp dev etc/systemd/system; do
  mount -t tmpfs -o mode=0755 tmpfs "$root/$folder"
done
chmod 1777 "$root/tmp"
for shared in sys-kernel-debug sys-kernel-tracing sys-fs-fuse-connections dev-hugepages; do
  ln -s /dev/null "$root/etc/systemd/system/$shared.mount"
done
mkdir "$root/dev/pts" "$root/dev/shm"
for device in null zero full random urandom tty; do
  touch "$root/dev/$device"
  mount --bind "/dev/$device" "$root/dev/$device"
done
mount -t devpts -o newinstance,ptmxmode=0666,mode=0620 devpts "$root/dev/pts"
ln -s pts/ptmx "$root/dev/ptmx"
: > "$root/etc/fstab"
while [ $# -gt 0 ]; do
  mkdir -p "$root$2"
  mount --bind -o ro "$1" "$root$2"
  shift 2
done
mount -t cgroup2 cgroup2 "$base/groups"
mkdir "$group"
[ -w "$group/cgroup.kill" ] || { rmdir "$group"; echo "no cgroup.kill" >&2; exit 1; }
{ unshare --pid --fork sh -c 'echo 0 > "$1/cgroup.procs"; shift; exec "$@"' sh "$group" \
  unshare --cgroup --mount --uts --ipc sh -c "$inside" sh "$root" "$systemd" ||
  echo failed; } < /dev/null &
cat > /dev/null
echo 1 > "$group/cgroup.kill"
wait
while [ -d "$group" ]; do find "$group" -depth -type d -exec rmdir {} + || sleep 0.1; done
"""
# ROOT SYSTEMD: as PID 1; says which process it is outside.
INSIDE = r"""
set -e
read pid _ < /proc/self/stat
mount -t proc proc "$1/proc"
mount --bind -o ro "$1/proc/sys" "$1/proc/sys"
mount -t sysfs -o ro sysfs "$1/sys"
mount -t cgroup2 cgroup2 "$1/sys/fs/cgroup"
cd "$1"
pivot_root . .
umount -l .
# What is mounted for a service must reach it: systemd leaves this to those who start a container.
mount --make-rshared /
echo "$pid"
exec env -i container=veilface setpriv --bounding-set=-sys_module,-sys_time \
  "$2" --system --unit=basic.target > /dev/null
"""


def require_systemd() -> str:
    """Return systemd's path; skip without it, or fail where ``VEILFACE_REQUIRE_SYSTEMD=1``."""
    if SYSTEMD is None or shutil.which("systemd-analyze") is None:
        if os.environ.get("VEILFACE_REQUIRE_SYSTEMD") == "1":
            pytest.fail("systemd is not installed, and VEILFACE_REQUIRE_SYSTEMD=1 asks for it")
        pytest.skip("systemd is not installed")
    return SYSTEMD


class Machine:
    """Runs for the block, in the network namespace of the calling thread.

    It has this machine's Python in ``/opt/python``, its packages in ``/opt/packages``, and the
    repository in ``/opt/source``. Where this machine does not permit it, the test is skipped.
    """

    def __init__(self, folder: Path) -> None:
        self._systemd = require_systemd()
        if os.geteuid() != 0:
            not_permitted("systemd in namespaces needs root")
        self._folder = folder
        self._pid = 0

    def __enter__(self) -> "Machine":
        shown = {
            sys.base_prefix: "/opt/python",
            sysconfig.get_path("platlib"): "/opt/packages",
            str(ROOT): "/opt/source",
        }
        (self._folder / "root").mkdir()
        mounts = [path for pair in shown.items() for path in pair]
        command = ["sh", "-c", OUTSIDE, "sh", str(self._folder / "root"), INSIDE, self._systemd]
        errors = self._folder / "errors"
        with errors.open("w") as file:
            self._process = subprocess.Popen(
                ["unshare", "--mount", *command, *mounts],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=file,
                text=True,
                start_new_session=True,  # who interrupts the tests shall not end what cleans up
            )
        assert self._process.stdout is not None
        said = self._process.stdout.readline().strip()
        if not said.isdigit():
            self._process.communicate(timeout=PATIENCE_S)
            not_permitted(f"no systemd in namespaces: {errors.read_text().strip()}")
        self._pid = int(said)
        try:
            wait_until(self._runs, what="the machine's start")
        except BaseException:
            self._end()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        try:
            print(self.run("journalctl", "--no-pager", "--lines=100", check=False))
        finally:
            self._end()

    @property
    def root(self) -> Path:
        """Its files, as they are seen from here."""
        return Path(f"/proc/{self._pid}/root")

    def run(self, *program: str, check: bool = True) -> str:
        """Run a program there; return what it says."""
        there = ["nsenter", f"--target={self._pid}", "--mount", "--uts", "--ipc", "--pid"]
        ran = subprocess.run(
            [*there, "--cgroup", "--root", "--wd", "env", "-i", PATH, *program],
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=PATIENCE_S,
        )
        assert ran.returncode == 0 or not check, f"{program}: {ran.stdout}"
        return ran.stdout.strip()

    def _runs(self) -> bool:
        assert self._process.poll() is None
        assert self.root.exists(), "systemd ended"
        return self.run("systemctl", "is-system-running", check=False) in ("running", "degraded")

    def _end(self) -> None:
        self._process.communicate(timeout=PATIENCE_S)
        assert self._process.returncode == 0, (self._folder / "errors").read_text()
