from models.demo import DEMO_NOTICE

STORED = ("--tenant", "default")


def test_enroll_then_accept_and_reject(world, veilface):
    enrolled = veilface("enroll", "ann", *world.photos(1, range(3)), "--pack", world.pack, "--json")
    assert enrolled.status == 0, enrolled.stderr
    assert enrolled.json["replaced"] is False
    assert enrolled.json["photos"] == 3
    assert DEMO_NOTICE in enrolled.stderr

    own = veilface("verify", "ann", *world.photos(1, range(3, 4)), "--pack", world.pack, "--json")
    assert own.status == 0, own.stderr
    assert own.json["decision"] == "accept"
    assert own.json["fmr"] == 0.01
    assert own.json["contract_id"] == world.calibrated["contract"]["contract_id"]
    assert "distance" not in own.json
    assert own.json["notice"] == enrolled.json["notice"] == DEMO_NOTICE
    assert DEMO_NOTICE in own.stderr

    other = veilface("verify", "ann", *world.photos(2, range(1)), "--pack", world.pack)
    assert other.status == 1
    assert other.stdout.startswith("reject: ann")

    again = veilface("enroll", "ann", *world.photos(1, range(1)), "--pack", world.pack, "--json")
    assert again.json["replaced"] is True


def test_what_stands_in_the_way_is_named(world, veilface, tmp_path):
    broken = tmp_path / "broken.png"
    broken.write_bytes(b"no picture")
    photo = world.photos(1, range(1))
    pack = ("--pack", world.pack)
    cases = [
        (("enroll", "ann", *photo, broken, *pack), 1, "broken.png"),
        (("enroll", "ann", *photo, tmp_path / "absent.png", *pack), 1, "No such file"),
        (("enroll", "ann", *photo, *world.photos(2, range(1)), *pack), 1, "same person"),
        (("enroll", "ann", *photo, *pack, "--tenant", "elsewhere"), 1, "no tenant"),
        (("enroll", "ann", *(photo * 11), *pack), 2, "1 to 10 photos"),
        (("enroll", "ann", *photo), 2, "--pack"),
    ]
    for arguments, status, said in cases:
        ran = veilface(*arguments)
        assert (ran.status, ran.stdout) == (status, ""), (arguments, ran)
        assert said in ran.stderr
        assert ran.stderr.startswith(("error: ", "note: "))


def test_a_verification_without_a_decision_is_no_rejection(world, veilface, tmp_path):
    veilface("enroll", "ann", *world.photos(1, range(3)), "--pack", world.pack)
    broken = tmp_path / "broken.png"
    broken.write_bytes(b"no picture")
    ann = ("verify", "ann", *world.photos(1, range(3, 4)))
    pack = ("--pack", world.pack)
    absent = tmp_path / "absent"
    cases = [
        (("verify", "ann", absent, *pack), 2, "no such photo"),
        (ann, 2, "--pack"),
        ((*ann, *pack, "--unknown-option"), 2, "No such option"),
        (("verify", "nobody", *world.photos(1, range(1)), *pack), 3, "nobody is enrolled as"),
        (("verify", "ann", broken, *pack), 3, "broken.png"),
        (("verify", "ann", tmp_path, *pack), 3, "Is a directory"),
        ((*ann, "--pack", absent), 3, "does not exist"),
        ((*ann, *pack, "--contract-file", absent), 3, "there is no contract file"),
        ((*ann, *pack, "--tenant", "elsewhere"), 3, "no tenant"),
        ((*ann, *pack, "--database-url", f"sqlite:///{absent}/no.db"), 3, "database"),
        ((*ann, *pack, "--database-url", "postgresql://127.0.0.1:1/no"), 3, "database"),
        ((*ann, *pack, "--onnx-threads", "-1"), 3, "onnx_threads"),
    ]
    for arguments, status, said in cases:
        ran = veilface(*arguments)
        assert (ran.status, ran.stdout) == (status, ""), (arguments, ran)
        assert said in ran.stderr


def test_an_unknown_level_names_those_there_are(world, veilface):
    veilface("enroll", "ann", *world.photos(1, range(3)), "--pack", world.pack)
    ran = veilface(
        *("verify", "ann", *world.photos(1, range(3, 4)), "--pack", world.pack),
        *("--level", "fmr-1e-9"),
    )
    assert ran.status == 3
    assert "fmr-1e-2" in ran.stderr
