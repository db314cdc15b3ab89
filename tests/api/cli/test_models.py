from models.demo import DEMO_NOTICE, demo_model_sha256
from tests.api.cli.conftest import run


def test_the_demo_pack_is_usable_and_says_what_it_is(world):
    ran = run("models", "inspect", world.pack)
    assert ran.status == 0
    assert "embedder" in ran.stdout
    assert DEMO_NOTICE in ran.stderr
    told = run("models", "inspect", world.pack, "--json").json
    assert told["usable"]
    assert told["graphs"][0]["sha256"] == demo_model_sha256()
    assert told["pack"]["n"] == 256
    assert told["pack"]["detector"] is None


def test_a_pack_without_an_embedder_is_status_1(mbf_pack_dir, tmp_path):
    detector = next(path for path in mbf_pack_dir.glob("*.onnx") if "det" in path.name)
    (tmp_path / detector.name).symlink_to(detector)
    ran = run("models", "inspect", tmp_path, "--json")
    assert ran.status == 1
    assert ran.json["usable"] is False
    assert "no embedder" in ran.json["reason"]
    assert ran.json["graphs"][0]["role"].startswith("scrfd")


def test_a_real_pack_is_usable(mbf_pack_dir):
    told = run("models", "inspect", mbf_pack_dir, "--json")
    assert told.status == 0
    assert told.json["pack"]["n"] == 512
    assert DEMO_NOTICE not in told.stderr
