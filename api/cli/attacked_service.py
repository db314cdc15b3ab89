"""The service under attack: ``veilface serve`` as a process of its own, with victims enrolled.

The audit's climbing attackers talk to it over HTTP, as an attacker with an API key would. It lives
in a temporary folder that only its owner may enter, with keys of its own, and is gone afterwards.
"""

import base64
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import httpx
import numpy as np
from numpy.typing import NDArray

from api.demo.service import running_service
from api.http.errors import StartError
from api.process.opening import file_sealer
from attacks.hill_climbing import Answer
from templates.contract.document import Contract
from templates.decoys import DecoyGenerator, DecoyPool, DecoySource
from templates.distances import similarity
from templates.keys.private_file import replace_public
from templates.keys.probe_signature import signed_probe
from templates.keys.sealing import MasterKeyring
from templates.store import Right, TemplateStore

Ask = Callable[[NDArray[np.float32]], Answer]

UNLIMITED = """\
lockout_after = 0
rate_limit_key = "off"
rate_limit_address = "off"
"""
"""Settings without which the attack would end at the first lockout: it measures what is left to
gain where an operator has switched these defences off, or an attacker is patient."""

_TENANT = "default"


@contextmanager
def attacked_service(
    contract: Contract, source: DecoySource | None, templates: Sequence[bytes]
) -> Iterator[tuple[list[Ask], list[Ask]]]:
    """Start the service, and enroll one subject for each template.

    Parameters
    ----------
    templates
        Wire bytes, un-rotated; the service rotates and stores them.

    Yields
    ------
    with_scores, decisions_only
        For each subject a callable that sends a unit embedding, float32 of shape (n,), with a key
        that has the right ``scores``, and with one that has not.

    Raises
    ------
    StartError
        The service does not start, or refuses a template.
    """
    with leaves_on_sigterm(), tempfile.TemporaryDirectory(prefix="veilface-audit-") as name:
        folder = Path(name)
        keyring = MasterKeyring.create(folder / "master.key")
        contract.save(folder / "contract.json", file_sealer(keyring))
        if isinstance(source, DecoyGenerator):
            source.save(folder / "decoys.veil")
        elif isinstance(source, DecoyPool):
            source.save(folder / "decoys.veil", file_sealer(keyring))
        quoted = str(folder).replace("\\", "\\\\").replace('"', '\\"')
        configuration = (
            f'data_dir = "{quoted}"\nmaster_key_file = "{quoted}/master.key"\n{UNLIMITED}'
            "accept_weak_privacy = true\n"
        )
        replace_public(folder / "veilface.toml", configuration.encode())
        with running_service(folder) as client:
            store = TemplateStore(f"sqlite:///{folder / 'veilface.db'}", keyring)
            try:
                store.tenants.set_template_enrollment(_TENANT, True)
                rights = [Right.VERIFY, Right.EMBEDDINGS]
                tokens = [
                    store.api_keys.create(_TENANT, chosen, label=label, expires_at=None).token
                    for label, chosen in (
                        ("climber with scores", [*rights, Right.SCORES]),
                        ("climber without", rights),
                    )
                ]
            finally:
                store.close()
            subjects = [_enroll(client, i, wire) for i, wire in enumerate(templates)]
            with_scores, without = (
                [_asker(client, subject, token) for subject in subjects] for token in tokens
            )
            yield with_scores, without


@contextmanager
def leaves_on_sigterm() -> Iterator[None]:
    """Let SIGTERM end the block as an exception does, so that nothing of it is left behind.

    Python dies of the signal otherwise, and leaves the service running and its keys on disk. In
    another thread than the main one, which takes no signals, nothing changes.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def leave(number: int, _frame: object) -> None:
        raise SystemExit(128 + number)

    before = signal.signal(signal.SIGTERM, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _enroll(client: httpx.Client, number: int, wire: bytes) -> str:
    subject = f"victim-{number}"
    answer = client.put(
        f"/v1/subjects/{subject}/enrollment",
        json={"template": base64.b64encode(wire).decode("ascii")},
    )
    if answer.status_code != httpx.codes.CREATED:
        raise StartError(f"the service refused a victim's template: {_code(answer)}")
    return subject


def _asker(client: httpx.Client, subject: str, token: str) -> Ask:
    def ask(probe: NDArray[np.float32]) -> Answer:
        answer = client.post(
            f"/v1/subjects/{subject}/verify",
            json=signed_probe(token, subject, probe),
            headers={"Authorization": f"Bearer {token}"},
        )
        if answer.status_code != httpx.codes.OK:
            raise StartError(f"the service refused a climber's probe: {_code(answer)}")
        body = answer.json()
        distance = body.get("distance")
        return Answer(
            accepted=body["decision"] == "accept",
            score=None if distance is None else float(similarity(float(distance))),
        )

    return ask


def _code(answer: httpx.Response) -> str:
    try:
        return str(answer.json()["error"]["code"])
    except (ValueError, KeyError, TypeError):
        return f"status {answer.status_code}"
