"""Agreement with InsightFace at an equal canvas, against a plain statement of what it does.

The package itself is not installed: it asks for `opencv-python`, which would replace the headless
OpenCV of every other test.
"""

import cv2
import numpy as np
import onnxruntime
import pytest
from skimage.transform import SimilarityTransform

from models.alignment import TEMPLATE_112
from models.boxes import ranked
from models.decoding import decode_image
from models.pack import ModelPack

SQUEEZES = [(1.0, 1.0), (0.6, 1.0), (1.0, 0.55), (0.83, 1.0)]


class InsightFace:
    """One face of one picture: the detector's letterbox and points, alignment, embedding."""

    def __init__(self, folder, info):
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = 1
        options.log_severity_level = 3
        self.detector, self.embedder = (
            onnxruntime.InferenceSession(folder / name, options)
            for name in (info.detector.file, info.embedder_file)
        )

    def keypoints(self, image, size):
        height, width = image.shape[:2]
        if height > width:
            new_height, new_width = size, int(size / (height / width))
        else:
            new_height, new_width = int(size * (height / width)), size
        canvas = np.zeros((size, size, 3), np.uint8)
        canvas[:new_height, :new_width] = cv2.resize(image, (new_width, new_height))
        blob = ((canvas - np.float32(127.5)) / np.float32(128)).transpose(2, 0, 1)[None]
        outputs = self.detector.run(None, {self.detector.get_inputs()[0].name: blob})
        outputs = [output.reshape(-1, output.shape[-1]) for output in outputs]
        best = None
        for stride in (8, 16, 32):
            cells = 2 * (size // stride) ** 2
            score, box, points = (
                next(o for o in outputs if o.shape == (cells, wide)) for wide in (1, 4, 10)
            )
            for k in np.flatnonzero(score[:, 0] >= 0.5):
                row, column = divmod(k // 2, size // stride)
                corner = np.array([column, row]) * stride
                x1, y1 = corner - box[k, :2] * stride
                x2, y2 = corner + box[k, 2:] * stride
                found = (score[k, 0], (x1, y1, x2, y2), corner + points[k].reshape(5, 2) * stride)
                if best is None or found[0] > best[0]:
                    best = found
        return None if best is None else best[2] / (new_height / height)

    def embedding(self, image, keypoints):
        transform = SimilarityTransform.from_estimate(keypoints, TEMPLATE_112)
        crop = cv2.warpAffine(image, transform.params[:2], (112, 112), borderValue=0.0)
        blob = ((crop - np.float32(127.5)) / np.float32(127.5)).transpose(2, 0, 1)[None]
        (row,) = self.embedder.run(None, {self.embedder.get_inputs()[0].name: blob})[0]
        return row / np.linalg.norm(row)


def worst(pack, reference, photos, size):
    """Greatest difference of a key point in pixels, least cosine, and pictures compared."""
    points, cosines = [], []
    for photo in photos:
        for across, down in SQUEEZES:
            image = cv2.resize(photo, None, fx=across, fy=down, interpolation=cv2.INTER_AREA)
            faces = pack._detector.detect_once(image, (size, size))
            expected = reference.keypoints(image, size)
            assert (expected is None) == (not faces)
            if not faces:
                continue
            points.append(np.abs(faces[0].keypoints - expected).max())
            ours = pack.embed(pack.align(image, faces[0])[None])[0]
            cosines.append(ours @ reference.embedding(image, expected))
    return max(points), min(cosines), len(cosines)


@pytest.mark.parametrize("size", [320, 640])
def test_points_and_descriptors_are_those_of_insightface(size, mbf_pack_dir, lfw_photos):
    pack = ModelPack.load(mbf_pack_dir, threads=1)
    reference = InsightFace(mbf_pack_dir, pack.info)
    paths = sorted(lfw_photos.glob("*/*_0001.jpg"))[::20]
    photos = [decode_image(path.read_bytes()) for path in paths]
    points, cosine, compared = worst(pack, reference, photos, size)
    assert compared == len(photos) * len(SQUEEZES)
    assert points < 0.01
    assert cosine > 0.9999


def test_the_service_takes_those_points_unless_the_face_fills_the_photo(mbf_pack_dir, lfw_photos):
    pack = ModelPack.load(mbf_pack_dir, threads=1)
    for path in sorted(lfw_photos.glob("*/*_0002.jpg"))[:6]:
        image = decode_image(path.read_bytes())
        (size,) = set(pack.info.detector.input_size)
        once = ranked(pack._detector.detect_once(image, (size, size)), image.shape)[0]
        np.testing.assert_array_equal(pack.detect(image)[0].keypoints, once.keypoints)
