import io

import cv2
import numpy as np
import pytest
from PIL import Image

from models.alignment import align
from models.boxes import Face, ranked
from models.decoding import decode_image
from models.detection import RETRY_BORDER, find_faces, letterbox
from models.detectors import Scrfd, YuNet
from models.errors import ModelError
from models.pack import ModelPack
from models.selection import FacePolicy
from models.sessions import Tensor

STRIDES = (8, 16, 32)


class Replay:
    """A session that answers with prepared arrays and keeps what it was fed."""

    name = "replay.onnx"
    inputs = (Tensor("x", (1, 3, None, None)),)

    def __init__(self, answer):
        self.answer = answer
        self.fed = []

    def run(self, feeds, outputs=None):
        (blob,) = feeds.values()
        self.fed.append(blob)
        return self.answer(blob, outputs)


@pytest.mark.parametrize("enlarge", [True, False])
@pytest.mark.parametrize(
    ("shape", "filled", "scale"),
    [
        ((1000, 679), (640, 434), 640 / 1000),  # 434.56 columns: cut, not rounded
        ((679, 1000), (434, 640), 434 / 679),  # 434.56 rows, and the scale is that of 434
        ((1000, 13), (640, 8), 640 / 1000),
        ((13, 1000), (8, 640), 8 / 13),
    ],
)
def test_letterbox_cuts_to_whole_pixels_as_insightface_does(shape, filled, scale, enlarge):
    canvas, seen = letterbox(np.full((*shape, 3), 9, np.uint8), (640, 640), enlarge=enlarge)
    assert seen == scale
    rows, columns = (np.flatnonzero(canvas.any(axis=(axis, 2))) for axis in (1, 0))
    assert (rows[-1] + 1, columns[-1] + 1) == filled


def scrfd_answer(hits, *, batched=False, anchors=2):
    """Nine outputs at 64 x 64 with candidates ``(stride, row, column, anchor, score)``."""

    def answer(blob, _outputs):
        rows, columns = blob.shape[2:]
        outputs = {1: [], 4: [], 10: []}
        for stride in STRIDES:
            cells = (rows // stride) * (columns // stride) * anchors
            arrays = {w: np.zeros((cells, w), np.float32) for w in outputs}
            for s, row, column, anchor, score in hits:
                if s == stride:
                    k = (row * (columns // stride) + column) * anchors + anchor
                    arrays[1][k] = score
                    arrays[4][k] = [1, 0.5, 2, 3]
                    arrays[10][k] = np.arange(10) / 4
            for width, array in arrays.items():
                outputs[width].append(array[None] if batched else array)
        return [*outputs[10], *outputs[1], *outputs[4]]  # the order is not to be relied on

    return answer


@pytest.mark.parametrize("batched", [False, True])
@pytest.mark.parametrize("anchors", [1, 2])
def test_scrfd_decodes_distances_from_the_cell(batched, anchors):
    hits = [(16, 1, 2, anchors - 1, 0.9), (8, 7, 0, 0, 0.49)]
    session = Replay(scrfd_answer(hits, batched=batched, anchors=anchors))
    detector = Scrfd(session, size=64)
    image = np.full((32, 32, 3), 255, np.uint8)  # enlarged by 2
    (face,) = detector.detect_once(image, (64, 64))
    corner = np.array([2 * 16, 1 * 16])
    expected = np.array([*(corner - [16, 8]), *(corner + np.array([32, 48]))]) / 2
    np.testing.assert_allclose(face.box, expected)
    points = (corner + np.arange(10).reshape(5, 2) / 4 * 16) / 2
    np.testing.assert_allclose(face.keypoints, points)
    assert face.score == pytest.approx(0.9)


def test_scrfd_input_is_rgb_minus_half_over_128_on_a_zero_canvas():
    session = Replay(scrfd_answer([]))
    image = np.zeros((32, 64, 3), np.uint8)
    image[..., 0], image[..., 2] = 255, 10
    Scrfd(session, size=64).detect_once(image, (64, 64))
    blob = session.fed[0][0]
    np.testing.assert_allclose(blob[:, 0, 0], (np.array([255, 0, 10]) - 127.5) / 128)
    np.testing.assert_allclose(blob[:, -1, -1], -127.5 / 128)


def test_scrfd_refuses_outputs_that_do_not_fit_the_canvas():
    session = Replay(lambda blob, o: scrfd_answer([])(np.zeros((1, 3, 72, 64)), o))
    with pytest.raises(ModelError, match="stride 8 do not fit"):
        Scrfd(session).detect_once(np.zeros((9, 9, 3), np.uint8), (64, 64))


@pytest.mark.parametrize(
    ("output", "value"), [(6, np.inf), (6, np.nan), (6, -1.0), (0, 0.0), (0, -np.inf)]
)
def test_scrfd_drops_candidates_that_no_face_can_be(output, value):
    """Boxes (6) that are endless or empty, points (0) that coincide or are endless."""

    def answer(blob, outputs):
        arrays = scrfd_answer([(8, 1, 1, 0, 0.9)])(blob, outputs)
        arrays[output][:] = value
        return arrays

    detector = Scrfd(Replay(answer))
    assert detector.detect_once(np.zeros((64, 64, 3), np.uint8), (64, 64)) == []


def test_yunet_decodes_centres_and_log_sides():
    def answer(blob, outputs):
        assert blob.shape == (1, 3, 64, 96)
        np.testing.assert_array_equal(blob[0, :, 0, 0], [30, 20, 10])  # BGR, 0...255
        arrays = {}
        for name in outputs:
            role, stride = name.split("_")
            width = {"cls": 1, "obj": 1, "bbox": 4, "kps": 10}[role]
            arrays[name] = np.zeros(
                (1, (64 // int(stride)) * (96 // int(stride)), width), np.float32
            )
        k = 1 * (96 // 16) + 3  # row 1, column 3 at stride 16
        arrays["cls_16"][0, k], arrays["obj_16"][0, k] = 0.9, 0.8
        arrays["cls_8"][0, 5], arrays["obj_8"][0, 5] = 0.5, 0.6  # sqrt(0.3) < 0.6
        arrays["bbox_16"][0, k] = [0.5, 0.25, np.log(2), np.log(3)]
        arrays["kps_16"][0, k] = np.arange(10) / 4
        return [arrays[name] for name in outputs]

    image = np.zeros((40, 70, 3), np.uint8)
    image[...] = [10, 20, 30]
    (face,) = YuNet(Replay(answer)).detect_once(image, (640, 640))
    assert face.score == pytest.approx(np.sqrt(0.72))
    centre = np.array([3.5, 1.25]) * 16
    np.testing.assert_allclose(
        face.box, [*(centre - [16, 24]), *(centre + np.array([16, 24]))], rtol=1e-5
    )
    np.testing.assert_allclose(
        face.keypoints, np.array([3, 1]) * 16 + np.arange(10).reshape(5, 2) * 4, rtol=1e-5
    )


class Sight:
    """Sees faces, given as shares of the picture, of 8 to 450 pixels on the canvas; and blobs.

    A blob is seen only in the enlarged picture that a canvas of 640 shows, as an ear is.
    ``on_main`` has the scores of faces there, where they are not 0.9.
    """

    kind, score_threshold, recommended_score = "sight", 0.5, 0.6

    def __init__(
        self, *faces, blobs=(), sizes=((640, 640), (320, 320)), enlarge=True, on_main=None
    ):
        self.faces, self.blobs, self.sizes, self.enlarge = faces, blobs, sizes, enlarge
        self.on_main = on_main or {}
        self.passes = []

    def canvas(self, image, size):
        return size if self.enlarge else tuple(map(min, size, image.shape[:2]))

    def detect_once(self, image, size):
        self.passes.append(size[0])
        height, width = image.shape[:2]
        shape = np.array([width, height, width, height], np.float32)
        scale = min(size[0] / height, size[1] / width, np.inf if self.enlarge else 1.0)
        seen = [(face, self.on_main.get(face, 0.9)) for face in self.faces]
        seen = [(face, score if size[0] == 640 else 0.8) for face, score in seen]
        if size[0] == 640:
            seen += [(blob, 0.9) for blob in self.blobs]
        boxes = [(np.array(shares, np.float32) * shape, score) for shares, score in seen]
        return [
            Face(box, score, np.tile(box[:2], (5, 1)))
            for box, score in boxes
            if 8 <= (box[2:] - box[:2]).max() * scale <= 450 and score >= 0.5
        ]


TIGHT = (0.1, 0.05, 0.85, 0.95)
MODEST = (0.3, 0.3, 0.6, 0.7)
ASIDE = (0.65, 0.3, 0.9, 0.6)
EAR = (0.02, 0.4, 0.2, 0.6)
FAR = (0.9, 0.02, 0.93, 0.06)  # 13 pixels at 320


def boxes_of(faces, shape):
    height, width = shape
    shares = [face.box / [width, height, width, height] for face in faces]
    return sorted(tuple(round(float(share), 4) for share in box) for box in shares)


@pytest.mark.parametrize("shape", [(250, 250), (320, 200), (800, 800), (4000, 3000)])
@pytest.mark.parametrize("blobs", [(), (EAR,)])
def test_a_face_that_fills_the_picture_is_found_whatever_else_is(shape, blobs):
    detector = Sight(TIGHT, blobs=blobs)
    faces = find_faces(detector, np.zeros((*shape, 3), np.uint8))
    assert boxes_of(faces, shape) == [TIGHT]


def test_a_face_that_both_canvases_show_counts_once():
    half = (0.0, 0.0, 0.09, 0.09)  # 29 pixels at 320: seen there, and small enough for 640
    faces = find_faces(Sight(TIGHT, half), np.zeros((800, 800, 3), np.uint8))
    assert boxes_of(faces, (800, 800)) == [half, TIGHT]


@pytest.mark.parametrize("score", [0.0, 0.55])
def test_a_face_that_the_main_canvas_is_not_sure_of_is_looked_at_again(score):
    """It counts once, with the points of the near canvas; what is sure keeps those of the main."""
    detector = Sight(MODEST, ASIDE, on_main={ASIDE: score})
    faces = find_faces(detector, np.zeros((800, 800, 3), np.uint8))
    assert boxes_of(faces, (800, 800)) == [MODEST, ASIDE]
    assert [face.score for face in faces] == [0.9, 0.8]
    assert detector.passes == [128, 640, 320]


def test_a_blob_does_not_hide_a_face_that_the_main_canvas_misses():
    detector = Sight(MODEST, blobs=(EAR,), on_main={MODEST: 0.0})
    faces = find_faces(detector, np.zeros((800, 800, 3), np.uint8))
    assert boxes_of(faces, (800, 800)) == [EAR, MODEST]


class Picky:
    """Finds a face only from the ``wanted``-th look on."""

    kind, score_threshold, recommended_score = "picky", 0.5, 0.6
    sizes = ((640, 640), (320, 320))

    def __init__(self, wanted):
        self.wanted, self.seen = wanted, []

    def canvas(self, image, size):
        return size

    def detect_once(self, image, size):
        if size[0] == 128:
            return []
        self.seen.append((image, size))
        if len(self.seen) != self.wanted:
            return []
        height, width = image.shape[:2]
        middle = np.array([width / 2, height / 2], np.float32)
        return [Face(np.concatenate([middle - 5, middle + 5]), 0.9, np.tile(middle, (5, 1)))]


@pytest.mark.parametrize("wanted", [1, 2, 3])
@pytest.mark.parametrize("shape", [(100, 60), (1500, 1000)])
def test_looks_again_near_and_then_in_a_border(wanted, shape):
    image = np.full((*shape, 3), 255, np.uint8)
    detector = Picky(wanted)
    (face,) = find_faces(detector, image)
    assert len(detector.seen) == wanted
    if wanted == 2:
        assert detector.seen[1][1] == (320, 320)
    if wanted == 3:
        bordered = detector.seen[2][0]
        assert bordered[0].max() == 0
        assert max(bordered.shape) <= 640 * (1 + 2 * RETRY_BORDER) + 1
        across = bordered[bordered.shape[0] // 2].min(axis=1)
        assert (across == 0).mean() == pytest.approx(0.8 / 1.8, abs=0.03)
    # The middle of the picture, however it was looked at.
    np.testing.assert_allclose(face.keypoints[0], [shape[1] / 2, shape[0] / 2], atol=1)


def jpeg(pixels: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "JPEG", quality=95)
    return file.getvalue()


def tight_and_bystander(photo: np.ndarray, face: Face, other: np.ndarray, margin: float):
    """Cut ``face`` out with a margin, enlarge to 900 pixels, put ``other`` into a corner."""
    reach = margin * max(face.width, face.height)
    edges = np.clip(face.box + np.array([-reach, -reach, reach, reach]), 0, len(photo)).astype(int)
    crop = photo[edges[1] : edges[3], edges[0] : edges[2]]
    factor = 900 / max(crop.shape[:2])
    size = (round(crop.shape[1] * factor), round(crop.shape[0] * factor))
    crop = cv2.resize(crop, size, interpolation=cv2.INTER_CUBIC)
    alone = crop.copy()
    small = cv2.resize(other[50:200, 65:185], (72, 90), interpolation=cv2.INTER_AREA)
    crop[:90, :72] = small
    points = (face.keypoints - edges[:2]) * np.divide(size, (edges[2:] - edges[:2]))
    return alone, crop, points


def tight_photos(pack, photos, margins):
    """Tight photos without and with a bystander, and the descriptor of the right crop of each."""
    for index, photo in enumerate(photos):
        faces = ranked(pack._detector.detect_once(photo, (320, 320)), photo.shape)
        other = photos[(index + 1) % len(photos)]
        for margin in margins:
            alone, both, points = tight_and_bystander(photo, faces[0], other, margin)
            for picture in (alone, both):
                yield picture, pack.embed(align(picture, points, size=112)[None])[0]


PACKS = ["w600k_mbf", "yunet_mobilefacenet128"]


@pytest.mark.parametrize("name", PACKS)
def test_a_bystander_is_never_taken_for_a_face_that_fills_the_photo(name, shared_data, lfw_photos):
    """On one canvas of 640 SCRFD sees the bystander alone: the cosine is that of two strangers."""
    pack = ModelPack.load(shared_data / "packs" / name, threads=1)
    photos = [decode_image(p.read_bytes()) for p in sorted(lfw_photos.glob("*/*_0001.jpg"))[:3]]
    pictures = list(tight_photos(pack, photos, margins=(0.05,)))
    for picture, right in pictures:
        for policy in (FacePolicy.DOMINANT, FacePolicy.LARGEST):
            assert pack.embed_photo(jpeg(picture), policy=policy).embedding @ right > 0.8


def test_yunet_finds_the_left_eye_left_of_the_right_one_above_nose_and_mouth(
    yunet_pack_dir, lfw_photos
):
    pack = ModelPack.load(yunet_pack_dir, threads=1)
    photo = decode_image(min(lfw_photos.glob("*/*_0001.jpg")).read_bytes())
    (face, *_) = ranked(pack.detect(photo), photo.shape)
    left, right, nose, *mouth = face.keypoints
    assert left[0] < nose[0] < right[0]
    assert max(left[1], right[1]) < nose[1] < min(corner[1] for corner in mouth)
