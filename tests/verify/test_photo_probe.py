"""Which frames of a challenge are compared, and what is asked of the others."""

import weakref
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import models.pack
from models.decoding import decode_image
from models.errors import PhotoRejected
from models.pack import ModelPack
from templates.contract.document import Contract, LivenessCalibration
from templates.errors import Uncalibrated
from tests.api.deployment import RATE, make_contract, make_source
from tests.heads import POSES, head, performed
from tests.marked_heads import add_liveness, draw, encoded, frame, write_marked_pack
from verify.challenge import Movement
from verify.photo_probe import probe_of_frames, probe_of_photos

ASKED = (Movement.TURN_RIGHT, Movement.COME_CLOSER, Movement.LOOK_DOWN)


@pytest.fixture(scope="module")
def pack(tmp_path_factory: pytest.TempPathFactory) -> ModelPack:
    return ModelPack.load(write_marked_pack(tmp_path_factory.mktemp("pack")), threads=1)


@pytest.fixture(scope="module")
def contract(pack: ModelPack) -> Contract:
    return make_contract(pack, make_source(pack.info.n))


def frames_of(names: list[str]) -> list[bytes]:
    """Frames of one person that all differ, as those of a camera do."""
    return [frame(name, 1, background=100 + place) for place, name in enumerate(names)]


def dark() -> bytes:
    """A frame that looks ahead, below the least brightness of a photo."""
    picture = draw(head(), 1)
    grey = np.ptp(picture.astype(int), axis=2) == 0
    picture[grey] = picture[grey] // 20
    return encoded(picture)


def test_the_frames_that_look_ahead_are_averaged(pack: ModelPack, contract: Contract) -> None:
    names = performed(ASKED)
    frames = frames_of(names)
    probe = probe_of_frames(pack, contract, frames, ASKED, passive=False)
    # Who comes closer looks ahead, too.
    ahead = [f for f, name in zip(frames, names, strict=True) if name in ("front", "come_closer")]
    mean = np.mean([pack.embed_photo(each).embedding for each in ahead], axis=0)
    assert (probe.photos, probe.failure) == (5, None)
    np.testing.assert_allclose(probe.embedding, mean / np.linalg.norm(mean), atol=1e-5)


def test_a_photo_given_twice_counts_once(pack: ModelPack, contract: Contract) -> None:
    one, other = frame("front", 1), frame("come_closer", 1)
    photos = [one, one, other, one]
    assert probe_of_photos(pack, contract, photos, passive=False).photos == 2


def test_a_frame_that_is_not_good_enough_is_not_compared(
    pack: ModelPack, contract: Contract
) -> None:
    names = performed(ASKED)
    frames = frames_of(names)
    frames[2] = dark()
    assert names[2] == "front"
    with pytest.raises(PhotoRejected, match="not good enough"):
        probe_of_photos(pack, contract, [frames[2]], passive=False)
    assert probe_of_frames(pack, contract, frames, ASKED, passive=False).photos == 4
    # But the first one must be.
    with pytest.raises(PhotoRejected, match=r"photo 1 of 7: .*not good enough"):
        probe_of_frames(pack, contract, [frames[2], *frames[1:]], ASKED, passive=False)


@pytest.mark.parametrize("covered", [{"turn_right"}, {"turn_right", "look_down"}])
def test_points_that_move_over_a_face_that_does_not_turn_show_no_movement(
    pack: ModelPack, contract: Contract, covered: set[str]
) -> None:
    frames = [
        encoded(draw(head(**POSES[name]), 1, face=head() if name in covered else None))
        for name in performed(ASKED)
    ]
    failure = probe_of_frames(pack, contract, frames, ASKED, passive=False).failure
    assert failure == ("missing_movement" if len(covered) == 1 else "no_turn")


def test_no_frame_keeps_its_picture(
    tmp_path: Any, contract: Contract, monkeypatch: pytest.MonkeyPatch
) -> None:
    live = ModelPack.load(add_liveness(write_marked_pack(tmp_path)), threads=1)
    pictures: list[weakref.ref[NDArray[np.uint8]]] = []

    def still_there() -> Iterator[int]:
        return (place for place, picture in enumerate(pictures) if picture() is not None)

    def decode_alone(*args: Any, **options: Any) -> NDArray[np.uint8]:
        assert list(still_there()) == []
        picture = decode_image(*args, **options)
        pictures.append(weakref.ref(picture))
        return picture

    embed = live.embed

    def embed_alone(aligned: NDArray[np.uint8]) -> NDArray[np.float32]:
        assert list(still_there()) == []
        return embed(aligned)

    monkeypatch.setattr(models.pack, "decode_image", decode_alone)
    monkeypatch.setattr(live, "embed", embed_alone)
    graphs = live.liveness
    assert graphs is not None
    judged = replace(
        contract,
        liveness=LivenessCalibration(
            graphs=graphs.graphs, threshold=0.5, bpcer=RATE, target_bpcer=0.01
        ),
    )
    frames = [frame(name, 1) for name in performed(ASKED)]
    assert probe_of_frames(live, judged, frames, ASKED, passive=True).failure is None
    assert len(pictures) == len(frames)


def test_passive_needs_a_threshold(tmp_path: Any, pack: ModelPack, contract: Contract) -> None:
    with pytest.raises(PhotoRejected, match="no liveness graph"):
        probe_of_photos(pack, contract, [frame(person=1)], passive=True)
    frames = [frame(name, 1) for name in performed(ASKED)]
    with pytest.raises(PhotoRejected, match="no liveness graph"):
        probe_of_frames(pack, contract, frames, ASKED, passive=True)
    live = ModelPack.load(add_liveness(write_marked_pack(tmp_path)), threads=1)
    with pytest.raises(Uncalibrated, match="liveness"):
        probe_of_frames(live, contract, frames, ASKED, passive=True)
