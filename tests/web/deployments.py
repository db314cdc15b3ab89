"""The services that the page is looked at with: the demo's, and one with a real pack."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from api.demo.people import Scale
from api.demo.run import run_demo
from api.demo.storage import KEY_FILE
from api.service.opening import file_sealer, open_keyring
from api.settings import Settings
from models.pack import ModelPack
from templates.contract.document import Contract
from templates.distances.blas import single_threaded
from tests.api.deployment import deploy, images
from tests.api.real_people import calibrated_on_lfw
from tests.clients.conftest import Running, started
from tests.marked_heads import frame, write_marked_pack
from tests.web.served import Served, serving
from verify.preparation import recorded_of

DECOY_FACES = 110
PEOPLE = 32
SMALL = Scale(
    enrolled=2, strangers=1, decoy_people=110, calibration_people=50, calibration_photos=4
)
WHO, OTHER = "Ashanti", "Antonio_Palocci"
ANNA = 1
"""The marked head that :func:`moving_service` knows as anna."""


@contextmanager
def demo_service(folder: Path) -> Iterator[Served]:
    """Serve what `make demo` leaves, by the command that it prints; person-1 is erased."""
    with single_threaded():
        outcome = run_demo(folder, scale=SMALL)
    assert outcome.faults == ()
    token = (folder / "api-key").read_text().strip()
    config = str(folder / "veilface.toml")
    master_key = folder / KEY_FILE
    settings = Settings(
        data_dir=folder, pack=folder / "pack", demo=True, master_key_file=master_key
    )
    file, sealer = settings.resolved_contract_file, file_sealer(open_keyring(settings))
    # Their own templates score above 4.3, strangers' below 2.9 (20,000 templates).
    _beyond_chance(Contract.load(file, sealer), 3.9).save(file, sealer)
    with serving(folder, settings, "--config", config, token=token) as served:
        yield served


@contextmanager
def real_service(folder: Path, pack: Path, aligned: Path) -> Iterator[Served]:
    """Serve a real pack, calibrated on a small share of LFW without the two people, and audited."""
    settings = Settings(data_dir=folder / "data", pack=pack)
    settings.data_dir.mkdir(parents=True)
    calibrated = calibrated_on_lfw(
        settings,
        pack,
        aligned,
        without=(WHO, OTHER),
        decoy_faces=DECOY_FACES,
        people=PEOPLE,
        m=16,
        targets=(1e-1, 1e-2),
    )
    # Their own templates score above 9.9, strangers' below 3.6 (2,000 templates).
    contract = _beyond_chance(calibrated, 6.0)
    contract.save(settings.resolved_contract_file, file_sealer(open_keyring(settings)))
    options = {"--data-dir": settings.data_dir, "--pack": pack}
    flags = [str(part) for option in options.items() for part in option]
    with serving(folder, settings, *flags) as served:
        yield served


@contextmanager
def private_service(folder: Path, pack: Path, **settings: Any) -> Iterator[Running]:
    """Serve a real pack to pages, with a threshold that decides by no chance."""
    # Lifted here, other photos of the person score above 11.9, those of others below 6.6 (4,800).
    changes = {"serve_pack": True, "threshold": 9.0, "rate_limit_address": "off", **settings}
    deployment = deploy(folder, pack=pack, **changes)
    deployment.allow_templates()
    recorded = recorded_of(ModelPack.load(pack, threads=1))
    contract = replace(deployment.contract, recorded=recorded)
    sealer = file_sealer(open_keyring(deployment.settings))
    contract.save(deployment.settings.resolved_contract_file, sealer)
    with started(deployment, folder) as service:
        yield service


@contextmanager
def moving_service(folder: Path) -> Iterator[Served]:
    """Serve anna, and ask for head movements."""
    pack = write_marked_pack(folder / "pack")
    deployment = deploy(folder, pack=pack)
    flags = ["--data-dir", str(folder / "data"), "--pack", str(pack)]
    flags += ["--liveness", "active"]
    unlocked = {"VEILFACE_LOCKOUT_AFTER": "0"}
    with serving(folder, deployment.settings, *flags, token=deployment.token, **unlocked) as served:
        with served.client() as client:
            files = images(frame(person=ANNA))
            assert client.put("/v1/subjects/anna/enrollment", files=files).status_code == 201
        yield served


def _beyond_chance(contract: Contract, threshold: float) -> Contract:
    """A threshold that no stranger of the tests reaches: at 1e-2 one in a hundred would."""
    return replace(
        contract,
        calibrations=tuple(
            replace(
                each,
                levels=tuple(replace(level, threshold=threshold) for level in each.levels),
                calibration_id="",
            )
            for each in contract.calibrations
        ),
    )
