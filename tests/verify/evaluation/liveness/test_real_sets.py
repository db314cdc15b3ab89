"""Real graphs on real prints: a part of NUAA, where it is present."""

import csv
from pathlib import Path

import pytest

from models.pack import ModelPack
from verify.evaluation.liveness.presentations import read_presentations
from verify.evaluation.liveness.rates import apcer, calibrate_liveness, non_response
from verify.evaluation.liveness.scores import score_set
from verify.metrics import equal_error_rate

EACH = 20


@pytest.fixture
def some_of_nuaa(shared_data: Path, tmp_path: Path) -> Path:
    root = shared_data / "liveness" / "nuaa"
    with (tmp_path / "nuaa.csv").open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["path", "presentation", "subject"])
        for place, presentation in (("live", "live"), ("spoof/print", "print")):
            photos = sorted((root / place).glob("*.jpg"))
            for photo in photos[:: len(photos) // EACH][:EACH]:
                writer.writerow([photo, presentation, photo.name[:4]])
    return tmp_path / "nuaa.csv"


def test_minifasnet_tells_prints_from_faces(some_of_nuaa, minifasnet_pack_dir):
    pack = ModelPack.load(minifasnet_pack_dir)
    scored = score_set(pack, read_presentations(some_of_nuaa, attacks=True))
    assert non_response(scored, None).errors == non_response(scored, "print").errors == 0
    live, _ = scored.scored(None)
    prints, _ = scored.scored("print")
    assert len(live) == len(prints) == EACH
    # Of all 600 photos the rate is 0.3 %; a graph that is fed otherwise is near chance.
    assert equal_error_rate(live, prints)[0] <= 0.1
    calibration = calibrate_liveness(scored, pack.liveness.graphs, target=0.2)
    assert calibration.bpcer.errors == 4
    assert apcer(scored, "print", calibration.threshold).errors <= 2
