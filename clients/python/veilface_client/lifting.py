"""``veilface lift`` on this machine, and what it needs of the service."""

import base64
import binascii
import json
import os
import re
import secrets
import shutil
import tempfile
import threading
import weakref
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from veilface_client import child
from veilface_client.calls import Face
from veilface_client.child import Canceller
from veilface_client.errors import LiftFailed, LiftUnavailable
from veilface_client.lifts import Enrollable, Probe
from veilface_client.results import Contract, Generator

_PASSED_ON = ("PATH", "HOME", "TMPDIR", "LANG", "LC_ALL", "NUMBA_CACHE_DIR", "OMP_NUM_THREADS")
_ERROR = re.compile(r"^error: (.*)$", flags=re.MULTILINE)


@dataclass(frozen=True)
class LiftInputs:
    """The files that lifting under one contract needs."""

    contract_id: str
    contract: Path
    generator: Path


class Lifter:
    """Runs the command; keeps its inputs in a folder of its own, readable by nobody else.

    Parameters
    ----------
    pack
        The user's model pack.
    command
        The executable; a bare name is looked for on the path.
    dim
        Dimension of probes; None: the largest that the contract takes.
    limit_s
        The longest that one call may take, in seconds.
    environment
        Variables that the command gets beside the few that every program needs.
    """

    def __init__(
        self,
        pack: str | os.PathLike[str],
        *,
        command: str | os.PathLike[str],
        dim: int | None,
        limit_s: float,
        environment: Mapping[str, str] | None,
    ) -> None:
        self._pack = str(Path(pack).absolute())
        executable = shutil.which(command)
        self._command = None if executable is None else str(Path(executable).absolute())
        self._sought = os.fspath(command)
        self._dim = dim
        self._limit_s = limit_s
        passed_on = {name: os.environ[name] for name in _PASSED_ON if name in os.environ}
        self._environment = {"PYTHONNOUSERSITE": "1", **passed_on, **(environment or {})}
        self._lock = threading.Lock()
        self._inputs: LiftInputs | None = None
        self._make_folder()

    @property
    def folder(self) -> Path:
        """Where the inputs are: contract and generator, never a photo or a template."""
        return Path(self._folder)

    @property
    def inputs(self) -> LiftInputs | None:
        """What :meth:`keep` kept last; None where its files are gone, as cleaners of /tmp do."""
        inputs = self._inputs
        if inputs is None or not self._folder_is_ours():
            return None
        return inputs if inputs.contract.is_file() and inputs.generator.is_file() else None

    def close(self) -> None:
        """Remove the folder."""
        self._remove_folder()

    def _make_folder(self) -> None:
        self._folder = tempfile.mkdtemp(prefix="veilface-")
        self._made = os.lstat(self._folder)
        # Also at the end of the process; but that of a forked child is not the end of this one.
        self._remove_folder = weakref.finalize(self, _remove, self._folder, os.getpid())

    def _folder_is_ours(self) -> bool:
        """Whether it is there, and nobody else has made one of its name in the meantime."""
        try:
            status = os.lstat(self._folder)
        except OSError:
            return False
        return (status.st_uid, status.st_mode) == (self._made.st_uid, self._made.st_mode)

    def keep(self, contract: Contract, generator: Generator) -> LiftInputs:
        """Put inputs into the folder, in place of earlier ones; make the folder if needed."""
        with self._lock:
            if not self._folder_is_ours():
                # Its old name may be somebody else's by now.
                self._remove_folder.detach()
                self._make_folder()
            stem = self.folder / contract.contract_id
        inputs = LiftInputs(
            contract.contract_id, stem.with_suffix(".json"), stem.with_suffix(".generator")
        )
        for path, data in ((inputs.contract, contract.raw), (inputs.generator, generator.data)):
            # Whole or not at all: another thread may be lifting with this very file.
            part = path.with_name(f"{path.name}.{secrets.token_hex(4)}")
            part.write_bytes(data)
            part.replace(path)
        self._inputs = inputs
        return inputs

    def enrollment(
        self,
        inputs: LiftInputs,
        photos: Sequence[bytes],
        *,
        face: Face | None,
        canceller: Canceller,
    ) -> Enrollable:
        """Return a template of these photos."""
        return Enrollable.of(
            self._lift(inputs, photos, face=face, canceller=canceller), inputs.contract_id
        )

    def probe(
        self,
        inputs: LiftInputs,
        photos: Sequence[bytes],
        *,
        face: Face | None,
        canceller: Canceller,
    ) -> Probe:
        """Return a probe of these photos."""
        dim = [] if self._dim is None else ["--dim", str(self._dim)]
        # A probe on stdout is always signed. It gets a key that is nobody's: the client's own
        # never leaves this process, and the client signs anew for each sending.
        nobodys = f"vf_{secrets.token_hex(6)}_{secrets.token_hex(32)}"
        template = self._lift(
            inputs,
            photos,
            "--probe", "--subject", "unsigned", *dim,
            face=face,
            canceller=canceller,
            environment={"VEILFACE_API_KEY": nobodys},
        )  # fmt: skip
        return Probe.of(template, inputs.contract_id)

    def _lift(
        self,
        inputs: LiftInputs,
        photos: Sequence[bytes],
        *options: str,
        face: Face | None,
        canceller: Canceller,
        environment: Mapping[str, str] | None = None,
    ) -> bytes:
        if self._command is None:
            raise LiftUnavailable(
                f"there is no command {self._sought}; install veilface, or say where it is"
            )
        command = self._command
        names: list[str] = []

        def argv(paths: Sequence[str]) -> list[str]:
            names.extend(Path(path).name for path in paths)
            # As one word each: a pack called --help is a pack.
            return [
                command, "lift", *options, "--out=-", f"--pack={self._pack}",
                f"--contract={inputs.contract}", f"--generator={inputs.generator}",
                *([] if face is None else [f"--face={face}"]), "--", *paths,
            ]  # fmt: skip

        done = child.run(
            argv,
            photos,
            environment={**self._environment, **(environment or {})},
            folder=str(inputs.contract.parent),
            limit_s=self._limit_s,
            canceller=canceller,
        )
        if done.status != 0:
            raise LiftFailed(_sentence(done.errors, names), status=done.status)
        return _template_of(done.output)


def _remove(folder: str, creator: int) -> None:
    if os.getpid() == creator:
        shutil.rmtree(folder, ignore_errors=True)


def _template_of(output: bytes) -> bytes:
    try:
        body: dict[str, Any] = json.loads(output)
        return base64.b64decode(body["template"], validate=True)
    except (ValueError, KeyError, TypeError, binascii.Error, RecursionError):
        raise LiftFailed("`veilface lift` wrote something else than a template") from None


def _sentence(errors: bytes, names: Sequence[str]) -> str:
    """Return the sentence of the command, with positions in place of file descriptors."""
    match = _ERROR.search(errors.decode(errors="replace"))
    if match is None:
        return "`veilface lift` failed, and did not say why"
    text = match[1]
    for number, name in enumerate(names, start=1):
        text = re.sub(rf"(?<![\w.]){re.escape(name)}(?=[:,;])", f"photo {number}", text)
    return text
