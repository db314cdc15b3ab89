"""``calibrate --liveness`` and ``evaluate liveness``, on drawn faces and a graph of one product."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from api.service.opening import file_sealer
from models.alignment import template
from models.demo import DEMO_NOTICE
from models.pack import ModelPack
from models.synthetic import draw_face, encode_photo
from templates.contract.document import Contract
from templates.keys.sealing import MasterKeyring
from tests.api.cli.conftest import key_file, run
from tests.models.graphs import fixed_face_detector, mean_liveness

BOX = (16.0, 8.0, 96.0, 108.0)
# Blue speaks for a live face, red against it.
WEIGHTS = np.array([[0.0, 0.03, 0.0], [0.0, 0.0, 0.0], [0.03, 0.0, 0.0]])
PEOPLE = range(1, 6)


def yellowed(picture: np.ndarray) -> np.ndarray:
    return (picture * [1.0, 0.95, 0.6]).astype(np.uint8)


@pytest.fixture
def liveness_pack(world, tmp_path) -> Path:
    """The demo model with a detector that sees one face, aligned as the drawn photos are."""
    folder = Path(shutil.copytree(world.pack, tmp_path / "liveness-pack"))
    (folder / "det.onnx").write_bytes(fixed_face_detector(BOX, template(112)))
    (folder / "2.7_80x80_mean.onnx").write_bytes(mean_liveness(WEIGHTS))
    return folder


@pytest.fixture
def photos(tmp_path) -> Path:
    """Five people: five live photos, a print of two others, a perfect copy of one more."""
    root = tmp_path / "booth"
    for place in ("live", "spoof/print", "spoof/copy"):
        (root / place).mkdir(parents=True)
    for person in PEOPLE:
        for shot in range(5):
            name = f"{person:04}_{shot}.png"
            (root / "live" / name).write_bytes(encode_photo(draw_face(person, shot)))
        for shot in (5, 6):
            attack = encode_photo(yellowed(draw_face(person, shot)))
            (root / "spoof/print" / f"{person:04}_{shot}.png").write_bytes(attack)
        copy = encode_photo(draw_face(person, 7))
        (root / "spoof/copy" / f"{person:04}_7.png").write_bytes(copy)
    black = encode_photo(np.zeros((112, 112, 3), np.uint8))
    (root / "spoof/print/0001_9.png").write_bytes(black)
    return root


def scores(pack: Path, root: Path) -> dict[str, float]:
    """Of each photo with a face, by its name below the root."""
    loaded = ModelPack.load(pack)
    return {
        path.relative_to(root).as_posix(): loaded.embed_photo(
            path.read_bytes(), quality=None, liveness=True
        ).liveness
        for path in sorted(root.rglob("*.png"))
        if path.name != "0001_9.png"
    }


def saved(data: Path) -> Contract:
    sealer = file_sealer(MasterKeyring.load(key_file(data)))
    return Contract.load(data / "contract.json", sealer)


def test_a_threshold_is_set_and_stays_through_the_next_calibration(
    veilface, data, world, liveness_pack, photos
):
    before = saved(data)
    ran = veilface(
        *("calibrate", "--liveness", photos, "--bpcer", "0.2", "--pack", liveness_pack, "--json")
    )
    assert ran.status == 0, ran.stderr
    contract = saved(data)
    assert contract.contract_id == before.contract_id == ran.json["contract_id"]
    assert contract.calibrations == before.calibrations
    assert ran.json["liveness"] == contract.liveness.to_json()
    assert ran.json["notice"] == DEMO_NOTICE
    assert contract.liveness.graphs == ModelPack.load(liveness_pack).liveness.graphs
    of = scores(liveness_pack, photos)
    threshold = contract.liveness.threshold
    for species, rate in contract.liveness.apcer.items():
        inside = [value for name, value in of.items() if name.startswith(f"spoof/{species}/")]
        assert (rate.errors, rate.trials) == (sum(v >= threshold for v in inside), len(inside))
    live = [value for name, value in of.items() if name.startswith("live/")]
    assert (contract.liveness.bpcer.errors, contract.liveness.bpcer.trials) == (5, 25)
    assert sum(value < threshold for value in live) == 5
    assert contract.liveness.calibrated_on["attacks_without_face"] == {"copy": 0, "print": 1}
    again = veilface(
        *("calibrate", world.labelled, "--pack", liveness_pack, "--dim", "4", "--aligned"),
        *("--probe-dims", "none", "--seed", "1", "--json"),
    )
    assert again.status == 0, again.stderr
    assert saved(data).liveness == contract.liveness
    assert again.json["contract"]["liveness"] == contract.liveness.to_json()


def test_what_is_reported_is_what_the_scores_and_the_verifier_say(
    veilface, data, world, liveness_pack, photos, tmp_path
):
    set_on = veilface("calibrate", "--liveness", photos, "--bpcer", "0.2", "--pack", liveness_pack)
    assert set_on.status == 0, set_on.stderr
    assert "liveness bpcer errors: 5\n" in set_on.stdout
    out = tmp_path / "out"
    contract = saved(data)
    ran = veilface(
        *("evaluate", "liveness", photos, "--pack", liveness_pack, "--bpcer", "0.4,0.01"),
        *("--out", out, "--json"),
    )
    assert ran.status == 0, ran.stderr
    results = json.loads((out / "results.json").read_text())
    said = {"notice": DEMO_NOTICE, "out": str(out), "files": ran.json["files"]}
    assert {**results, **said} == ran.json
    assert sorted(ran.json["files"]) == sorted(path.name for path in out.iterdir())
    assert {path.name for path in out.iterdir()} == {*("results.json", "results.csv", "results.md")}
    rows = {(row["operating_point"], row["species"]): row for row in results["rows"]}
    assert set(rows) == {
        (point, species) for point in ("contract", "bpcer-0.4") for species in ("copy", "print")
    }
    assert rows["contract", "copy"]["threshold"] == contract.liveness.threshold
    assert any("BPCER 0.01" in sentence for sentence in results["refused"])
    assert results["failures"] == [
        {
            "image": "0001_9.png",
            "code": "no_face",
            "reason": results["failures"][0]["reason"],
        }
    ]

    # A perfect copy of a person's photo is that person to the comparison: who passes the
    # comparison is who passes `veilface verify`, and only liveness can stop them.
    facts = results["verification"]
    assert (facts["measured"], facts["enrolled_subjects"], facts["left_out"]) == (True, 5, [])
    assert facts["level"] == contract.default_level
    copies = rows["contract", "copy"]
    assert copies["iapmr_without_liveness"]["trials"] == 5
    assert copies["iapmr_without_liveness"]["errors"] >= 3
    assert copies["iapmr"]["errors"] <= copies["apcer"]["errors"]
    assert facts["frr"]["trials"] == 10
    alone = ("--data-dir", tmp_path / "nothing", "--out", out, "--bpcer", "0.2")
    shown = run("evaluate", "liveness", photos, "--pack", liveness_pack, *alone)
    assert shown.status == 0, shown.stderr
    assert "IAPMR was not measured: it takes the contract" in shown.stdout


def test_a_threshold_of_other_graphs_is_not_applied(
    veilface, data, liveness_pack, photos, tmp_path
):
    veilface("calibrate", "--liveness", photos, "--bpcer", "0.2", "--pack", liveness_pack)
    graph = liveness_pack / "2.7_80x80_mean.onnx"
    graph.rename(liveness_pack / "4.0_80x80_mean.onnx")
    ran = veilface(
        *("evaluate", "liveness", photos, "--pack", liveness_pack, "--out", tmp_path / "out"),
    )
    assert ran.status == 1
    assert "other liveness graphs" in ran.stderr


@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        (["calibrate"], 2, "labelled people, or --liveness"),
        (["calibrate", "{photos}", "--liveness", "{photos}"], 2, "or --liveness"),
        (["calibrate", "--liveness", "{photos}", "--bpcer", "1"], 2, "--bpcer"),
        (["calibrate", "--liveness", "{photos}", "--bpcer", "0.01"], 1, "25 live photos cannot"),
        (["calibrate", "--liveness", "{photos}", "--out", "new.json"], 1, "people first"),
        (["calibrate", "--liveness", "{photos}/live"], 1, "lies beside live/"),
        (["evaluate", "liveness", "{photos}", "--bpcer", "x"], 2, "--bpcer takes rates"),
        (["evaluate", "liveness", "{photos}", "--bpcer", "0.01"], 1, "no threshold to report at"),
        (["evaluate", "liveness", "nowhere"], 1, "not there"),
    ],
)
def test_mistakes_are_named(veilface, liveness_pack, photos, arguments, status, said):
    given = [argument.format(photos=photos) for argument in arguments]
    ran = veilface(*given, "--pack", liveness_pack)
    assert (ran.status, said in ran.stderr) == (status, True), ran.stderr


def test_a_pack_without_liveness_is_refused(veilface, world, photos):
    for command in (("calibrate", "--liveness", photos), ("evaluate", "liveness", photos)):
        ran = veilface(*command, "--pack", world.pack)
        assert ran.status == 1
        assert "no liveness graph" in ran.stderr


def test_a_folder_named_liveness_is_a_data_set_by_its_path(veilface, tmp_path, monkeypatch):
    (tmp_path / "liveness").mkdir()
    monkeypatch.chdir(tmp_path)
    ran = veilface("evaluate", "./liveness", "--pack", "none")
    assert "no protocol" in ran.stderr
