import hashlib
import subprocess
import sys
from collections.abc import Iterator

import cv2
import numpy as np
import onnxruntime as ort
import pytest

from models.demo import build_demo_pack, demo_model_bytes, demo_model_sha256
from models.errors import NoFace
from models.pack import ModelPack
from models.quality import QualityLimits
from models.synthetic import draw_face, draw_people, encode_photo

PEOPLE, PHOTOS = 100, 4


def normalised(faces: np.ndarray) -> np.ndarray:
    values = (faces.astype(np.float32) - 127.5) / 127.5
    return np.ascontiguousarray(values.transpose(0, 3, 1, 2))


@pytest.fixture(scope="module")
def session() -> ort.InferenceSession:
    return ort.InferenceSession(demo_model_bytes(), providers=["CPUExecutionProvider"])


@pytest.fixture(scope="module")
def faces() -> np.ndarray:
    return draw_people(range(PEOPLE), range(PHOTOS))


def pacman(mouth: float, size: int = 720) -> np.ndarray:
    """What Chromium's fake camera shows: a green field, a disc with a mouth, and a timer."""
    picture = np.full((size, size, 3), (0, 136, 0), np.uint8)
    middle, radius = (size // 2, size // 2), size // 4
    cv2.ellipse(picture, middle, (radius, radius), 0, 0, 360 - mouth, (75, 255, 24), -1)
    place = (size // 20, size // 12)
    cv2.putText(picture, "00 44", place, cv2.FONT_HERSHEY_SIMPLEX, size / 600, (75, 255, 24), 2)
    return cv2.resize(picture, (112, 112), interpolation=cv2.INTER_AREA)


def other_pictures() -> Iterator[np.ndarray]:
    rng = np.random.default_rng(0)
    yield from (pacman(mouth) for mouth in range(0, 180, 15))
    yield np.full((112, 112, 3), 128, np.uint8)
    yield np.repeat(np.linspace(0, 255, 112, dtype=np.uint8), 112 * 3).reshape(112, 112, 3)
    for cells in (3, 5, 8, 14, 28, 112):
        for _ in range(20):
            noise = rng.integers(0, 256, (cells, cells, 3)).astype(np.uint8)
            yield cv2.resize(noise, (112, 112), interpolation=cv2.INTER_CUBIC)
    for identity in range(40):
        face = draw_face(identity)
        yield from (face[::-1].copy(), np.roll(face, 20, axis=0), np.roll(face, 25, axis=1))


def test_the_demo_pack_takes_drawn_faces_and_nothing_else_for_faces(faces, tmp_path):
    pack = ModelPack.load(build_demo_pack(tmp_path / "pack"))
    for face in [*faces, draw_face(3, size=240)]:
        pack.crop_photo(encode_photo(face))
    limits = QualityLimits(min_sharpness=0, min_brightness=0, min_exposure=0, max_brightness=255)
    for picture in other_pictures():
        with pytest.raises(NoFace, match="no cartoon face was found"):
            pack.crop_photo(encode_photo(picture), quality=limits)
    pack.crop_photo(encode_photo(pacman(60)), quality=None)  # as public protocols take all


def test_the_file_is_the_same_in_another_process():
    program = "from models.demo import demo_model_sha256; print(demo_model_sha256())"
    seen = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    ).stdout.strip()
    assert seen == hashlib.sha256(demo_model_bytes()).hexdigest() == demo_model_sha256()


def test_embeddings_separate_drawn_people(session, faces):
    raw = session.run(None, {"image": normalised(faces)})[0]
    embeddings = raw / np.linalg.norm(raw, axis=1, keepdims=True)
    person = np.repeat(np.arange(PEOPLE), PHOTOS)
    pairs = np.triu_indices(len(faces), 1)
    scores = (embeddings @ embeddings.T)[pairs]
    is_genuine = (person[:, None] == person)[pairs]
    genuine, impostor = scores[is_genuine], scores[~is_genuine]
    for target, worst in ((1e-2, 0.02), (1e-3, 0.05)):
        threshold = np.quantile(impostor, 1 - target)
        assert (genuine < threshold).mean() <= worst
    assert abs(impostor.mean()) < 0.1
