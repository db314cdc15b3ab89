import pytest

from api.service.opening import file_sealer
from models.demo import DEMO_NOTICE
from templates.contract.document import Contract
from templates.decoys import DecoyGenerator
from templates.keys.sealing import MasterKeyring
from tests.api.cli.conftest import AXES, DIM, PROBE_DIM, key_file


def test_the_contract_is_what_serve_loads(world):
    contract = Contract.load(
        world.data / "contract.json", file_sealer(MasterKeyring.load(key_file(world.data)))
    )
    assert contract.contract_id == world.calibrated["contract"]["contract_id"]
    assert (contract.binding.axes, contract.binding.m) == (AXES, DIM)
    assert str(contract.binding.strategy) == "adversarial"
    decoys = DecoyGenerator.load(world.data / "decoys.veil")
    assert decoys.source_id == world.built["source_id"]
    assert contract.binding.decoy_source_id == decoys.reduced(AXES).source_id
    assert [(entry.mode, entry.probe_m) for entry in contract.calibrations] == [
        ("p2s", 0),
        ("s2s", PROBE_DIM),
    ]
    assert contract.recorded["pack"] == "pack"


def test_the_demo_model_is_named_and_the_cohort_is_not_shown(world):
    assert world.calibrated["notice"] == DEMO_NOTICE
    assert "cohort" not in world.calibrated["contract"]
    level = world.calibrated["contract"]["calibrations"][0]["levels"][0]
    assert level["name"] == "fmr-1e-2"
    assert level["fmr"]["errors"] / level["fmr"]["trials"] <= 0.01
    assert level["fnmr"]["errors"] / level["fnmr"]["trials"] <= 0.1
    assert world.calibrated["failure_to_acquire"]["photos"] == 200
    privacy = world.calibrated["contract"]["verdict"]["privacy"]
    assert (privacy["status"], privacy["basis"]["victims"]) == ("NOT SHOWN", 25)
    assert (world.calibrated["chosen"], world.calibrated["tried"]) == ("asked for", [])
    assert (
        world.calibrated["consistency"]["threshold"]
        == world.calibrated["contract"]["photo_consistency"]
    )


def test_people_are_left_out_and_ten_fold_adds_a_level(world, veilface, data, tmp_path):
    listing = tmp_path / "names.txt"
    listing.write_text("person-6000\nperson-6001\nperson-6002/0.png\nperson-6oo3\n")
    ran = veilface(
        *("calibrate", world.labelled, "--pack", world.pack, "--axes", "32", "--dim", "4"),
        *("--exclude-people", listing, "--protocol", "ten-fold", "--strategy", "hybrid"),
        *("--out", tmp_path / "contract.json"),
    )
    assert ran.status == 0, ran.stderr
    assert "accuracy" in ran.stdout
    assert DEMO_NOTICE in ran.stderr
    # Hybrid lifting with m = 4 has two decoys.
    assert "\nPrivacy: not proven. " in ran.stdout
    contract = Contract.load(
        tmp_path / "contract.json", file_sealer(MasterKeyring.load(key_file(data)))
    )
    facts = contract.calibration("p2s").calibrated_on
    assert (facts["people"], facts["photos"], facts["excluded_photos"]) == (48, 191, 9)
    assert "--exclude-people: 1 match nothing, as 'person-6oo3'" in ran.stderr
    # Half of the people are attacked with the faces of the others.
    assert contract.verdict.privacy.basis["victims"] == 24
    assert contract.calibration("p2s").level("accuracy").target_fmr is None


def test_decoys_of_the_people_themselves_are_refused(world, veilface, tmp_path):
    own = tmp_path / "own.veil"
    built = veilface("decoys", "build", world.labelled, "--pack", world.pack, "--out", own)
    assert built.status == 0, built.stderr
    ran = veilface(
        *("calibrate", world.labelled, "--pack", world.pack, "--decoys", own, "--dim", "8"),
        *("--out", tmp_path / "contract.json"),
    )
    assert ran.status == 1
    said = " ".join(ran.stderr.split())
    assert "of these" in said
    assert "Build the decoys from other people's photos of the same kind" in said
    assert not (tmp_path / "contract.json").exists()


def test_faces_that_nobody_labelled_set_thresholds_and_show_no_accuracy(
    world, veilface, data, tmp_path
):
    faces, path = tmp_path / "faces", tmp_path / "contract.json"
    faces.mkdir()
    for number, photo in enumerate(sorted(world.labelled.glob("*/0.png"))):
        (faces / f"{number}.png").write_bytes(photo.read_bytes())
    (faces / "twice.png").write_bytes(sorted(world.labelled.glob("*/1.png"))[0].read_bytes())
    ran = veilface(
        *("calibrate", faces, "--pack", world.pack, "--axes", "32", "--dim", "8"),
        *("--probe-dims", "none", "--out", path),
    )
    assert ran.status == 0, ran.stderr
    contract = Contract.load(path, file_sealer(MasterKeyring.load(key_file(data))))
    (calibration,) = contract.calibrations
    # Some drawn people look alike, and one photo is of a person who is there already.
    left = calibration.calibrated_on["people"]
    assert 40 <= left <= 50
    assert f"note: {51 - left} of 51 photos look like another one, and are left out" in ran.stderr
    assert [level.fnmr.trials for level in calibration.levels] == [0] * len(calibration.levels)
    assert contract.verdict.accuracy is None
    assert contract.verdict.privacy.basis["victims"] == left // 2
    assert "Accuracy: not measured: nobody is labelled with two photos." in ran.stdout


def test_labels_give_rates_by_group_and_thresholds_that_hold_in_each(
    world, veilface, data, tmp_path
):
    kinds = ["first"] * 20 + ["few"] * 2 + ["others"] * 28
    rows = [f"person-{6000 + i},{kind}" for i, kind in enumerate(kinds)]
    (tmp_path / "labels.csv").write_text("\n".join(["path,kind", *rows]) + "\n")
    out = tmp_path / "contract.json"
    ran = veilface(
        *("calibrate", world.labelled, "--pack", world.pack, "--axes", "32", "--dim", "8"),
        *("--probe-dims", "none"),
        *("--labels", tmp_path / "labels.csv", "--worst-group", "--out", out),
    )
    assert ran.status == 0, ran.stderr
    contract = Contract.load(out, file_sealer(MasterKeyring.load(key_file(data))))
    (calibration,) = contract.calibrations
    assert calibration.calibrated_on["groups_from"] == "a label file"
    assert calibration.calibrated_on["worst_group"] is True
    level = calibration.level("fmr-1e-2")
    counts = {one.group: (one.fmr.trials, one.frr.trials, one.fmr_judged) for one in level.groups}
    # Four photos of each person, one of them genuine, against the others of the group.
    assert counts == {
        "few": (8 * 1, 2, False),
        "first": (80 * 19, 20, True),
        "others": (112 * 27, 28, True),
    }
    judged = [one.fmr.value for one in level.groups if one.fmr_judged]
    assert contract.verdict.groups.rate.value == max(judged) <= 0.01
    assert contract.verdict.groups.limit == 0.02
    assert "by group at fmr-1e-2, probes of one photo" in ran.stdout
    assert "rule of the worst group: raw probes of one photo: FMR 0.01 needs 1000 " in ran.stdout
    assert "kind few (8)." in ran.stdout
    last = ran.stdout.splitlines()[-1]
    assert last.startswith("Groups: PASS. Worst is kind ")
    assert last.endswith("no level holds that was set on adults.")


@pytest.mark.parametrize(
    ("arguments", "status", "said"),
    [
        (("--strategy", "random"), 1, "templates of strategy random conceal nothing"),
        (("--probe-dims", "none,2"), 2, "--probe-dims takes whole numbers from 1 to 192"),
        (("--probe-dims", "193"), 2, "--probe-dims takes whole numbers from 1 to 192"),
        (("--dim", "8", "--axes", "8"), 2, "--dim must lie below --axes"),
        (("--worst-group",), 2, "give --labels"),
    ],
)
def test_what_cannot_be_calibrated_is_refused(world, veilface, tmp_path, arguments, status, said):
    path = tmp_path / "contract.json"
    ran = veilface("calibrate", world.labelled, "--pack", world.pack, *arguments, "--out", path)
    assert (ran.status, said in ran.stderr) == (status, True), ran.stderr
    assert not path.exists()
