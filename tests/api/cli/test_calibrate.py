import pytest

from api.cli.calibrate import concealment_note, likeness_note, parse_dims, read_aliases
from api.cli.errors import CommandError, UsageError
from api.process.opening import file_sealer
from models.demo import DEMO_NOTICE
from templates.contract.document import Contract
from templates.decoys import DecoyGenerator
from templates.keys.sealing import MasterKeyring
from templates.space.lifting import Strategy
from tests.api.cli.conftest import DIM, PROBE_DIM, key_file, run
from verify.metrics import rate


def test_the_contract_is_what_serve_loads(world):
    contract = Contract.load(
        world.data / "contract.json", file_sealer(MasterKeyring.load(key_file(world.data)))
    )
    assert contract.contract_id == world.calibrated["contract"]["contract_id"]
    assert contract.binding.m == DIM
    assert str(contract.binding.strategy) == "adversarial"
    assert contract.binding.decoy_source_id == world.built["source_id"]
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


def test_people_are_left_out_and_ten_fold_adds_a_level(world, veilface, data, tmp_path):
    listing = tmp_path / "names.txt"
    listing.write_text("person-6000\nperson-6001\n")
    ran = veilface(
        *("calibrate", world.labelled, "--pack", world.pack, "--dim", "4"),
        *("--exclude-people", listing, "--protocol", "ten-fold", "--strategy", "hybrid"),
        *("--out", tmp_path / "contract.json", "--photos", "2"),
    )
    assert ran.status == 0, ran.stderr
    assert "accuracy" in ran.stdout
    assert DEMO_NOTICE in ran.stderr
    # Hybrid lifting with m = 4 has two decoys.
    assert "nearest to the origin shows the face" in " ".join(ran.stderr.split())
    assert "conceal" not in ran.stdout
    contract = Contract.load(
        tmp_path / "contract.json", file_sealer(MasterKeyring.load(key_file(data)))
    )
    facts = contract.calibration("p2s").calibrated_on
    assert facts["people"] == 48
    assert facts["excluded_photos"] == 8
    assert contract.calibration("p2s").level("accuracy").target_fmr is None


def test_other_decoys_are_refused_in_a_sentence(world, veilface, tmp_path):
    ran = veilface(
        *("calibrate", world.labelled, "--pack", world.pack, "--decoys", tmp_path / "absent")
    )
    assert ran.status == 1
    assert "absent" in ran.stderr
    assert ran.stdout == ""


def test_decoys_of_another_space_are_refused(world, veilface, data, tmp_path):
    """As many numbers, but another preprocessing, another model, or nobody knows which."""
    base = ("calibrate", world.labelled, "--pack", world.pack, "--out", tmp_path / "contract.json")
    ran = veilface(*base, "--flip")
    assert ran.status == 1
    assert "build the decoys with this pack and the same --flip" in " ".join(ran.stderr.split())
    statistics = DecoyGenerator.load(data / "decoys.veil").statistics
    for made_with, said in (("5a" * 32, "another model"), (None, "do not say which model")):
        DecoyGenerator(statistics, made_with=made_with).save(tmp_path / "decoys.veil")
        ran = veilface(*base, "--decoys", tmp_path / "decoys.veil")
        assert ran.status == 1
        assert said in " ".join(ran.stderr.split())
    assert not (tmp_path / "contract.json").exists()


@pytest.mark.parametrize("kind", ["generator", "pool"])
def test_decoys_of_the_people_themselves_are_refused(world, veilface, tmp_path, kind):
    own = tmp_path / "own.veil"
    built = veilface(
        *("decoys", "build", world.labelled, "--pack", world.pack, "--kind", kind, "--out", own)
    )
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


def test_the_note_on_unlike_decoys_advises_only_what_helps():
    """A larger dimension left 73 % of the templates open: faces of the same kind come first."""
    note = likeness_note(rate(80, 100), Strategy.ADVERSARIAL, 64)
    assert "from 80 % of the templates of these people (80 of 100, adversarial, m = 64)" in note
    assert "other people's photos of the same kind" in note
    assert "--dim" not in note
    assert likeness_note(rate(10, 100), Strategy.ADVERSARIAL, 64) is None
    assert likeness_note(None, Strategy.RANDOM, 64) is None


def test_what_photos_of_one_enrollment_must_agree_to_is_told(world):
    told = world.calibrated["photo_consistency"]
    assert told["threshold"] == world.calibrated["contract"]["photo_consistency"]
    # Ten sets of three photos of each of 50 people; pairs of photos of two of them.
    assert told["refused"]["trials"] == 500
    assert told["refused"]["errors"] <= 10
    assert told["fmr"]["trials"] == 200 * 196 // 2


def test_lifted_probes_are_left_out_where_they_are_not_wanted(world, veilface, data, tmp_path):
    path = tmp_path / "contract.json"
    ran = veilface(
        *("calibrate", world.labelled, "--pack", world.pack, "--dim", "8", "--out", path),
        *("--probe-dims", "none"),
    )
    assert ran.status == 0, ran.stderr
    contract = Contract.load(path, file_sealer(MasterKeyring.load(key_file(data))))
    assert [entry.mode for entry in contract.calibrations] == ["p2s"]
    assert "do not" in ran.stdout


def test_a_folder_of_another_layout_is_refused(world, veilface, tmp_path):
    (tmp_path / "photo.jpg").write_bytes(b"x")
    ran = veilface("calibrate", tmp_path, "--pack", world.pack)
    assert ran.status == 1
    assert "expected root/Person/photo.jpg" in ran.stderr


def test_a_dimension_that_the_descriptor_does_not_have_is_refused(world, data):
    ran = run(
        *("calibrate", world.labelled, "--pack", world.pack, "--data-dir", data),
        *("--probe-dims", "2,2"),
    )
    assert ran.status == 2
    assert "twice" in ran.stderr


@pytest.mark.parametrize(
    ("strategy", "m", "noted"),
    [
        ("random", 64, True),
        ("adversarial", 23, True),
        ("adversarial", 24, False),
        ("sub-adversarial", 32, False),
        ("hybrid", 47, True),
        ("hybrid+", 48, False),
    ],
)
def test_templates_that_conceal_little_are_noted(strategy, m, noted):
    note = concealment_note(Strategy(strategy), m)
    assert (note is not None) == noted
    if note is not None:
        assert "use --strategy adversarial and --dim 64 or more" in note


@pytest.mark.parametrize(("text", "dims"), [("none", ()), ("2,4, 8", (2, 4, 8)), ("16", (16,))])
def test_probe_dimensions_are_read(text, dims):
    assert parse_dims(text) == dims


@pytest.mark.parametrize("text", ["", "0", "2;4", "a", "-1", "129", "none,2"])
def test_wrong_probe_dimensions_are_refused(text):
    with pytest.raises(UsageError):
        parse_dims(text)


def test_aliases_are_read(tmp_path):
    file = tmp_path / "aliases.csv"
    file.write_text("# second, first\nBill_C,William_C\n\n")
    assert read_aliases(file) == {"Bill_C": "William_C"}
    file.write_text("only one name\n")
    with pytest.raises(CommandError, match="line 1"):
        read_aliases(file)
