"""InsightFace ``.bin`` files."""

import pickle
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.verify.evaluation.layouts import bin_content, drawn
from verify import DatasetError
from verify.evaluation.readers import open_sets
from verify.evaluation.verification_set import VerificationSet
from verify.tenfold import FOLDS

pytestmark = pytest.mark.usefixtures("in_this_process")


def read(file: Path, content: object, protocol: int = 4) -> VerificationSet:
    file.write_bytes(pickle.dumps(content, protocol))
    (one,) = open_sets(file)
    return one


def test_photos_pairs_and_folds(tmp_path: Path) -> None:
    bins, same = bin_content()
    # Pair 3 uses photos of pairs 0 and 1 again.
    bins[6], bins[7] = bins[3], bins[0]
    benchmark = read(tmp_path / "CFP_FP.bin", (bins, same))
    assert (benchmark.name, benchmark.kind, benchmark.aligned) == ("cfp_fp", "bin", True)
    assert benchmark.people is None
    assert len(benchmark.pictures) == len(bins) - 2
    names = [picture.name for picture in benchmark.pictures]
    assert names[:8] == ["00000", "00001", "00002", "00003", "00004", "00005", "00008", "00009"]
    for pair in range(len(same)):
        for side, positions in enumerate((benchmark.first, benchmark.second)):
            assert benchmark.pictures[positions[pair]].read() == bins[2 * pair + side]
    np.testing.assert_array_equal(benchmark.same, same)
    np.testing.assert_array_equal(benchmark.folds, np.arange(len(same)) // 2)
    assert benchmark.protocol_files[0][0] == "CFP_FP.bin"


@pytest.mark.parametrize("protocol", range(6))
@pytest.mark.parametrize("form", ["bytes", "row", "column", "jpeg"])
def test_elements_and_protocols(tmp_path: Path, protocol: int, form: str) -> None:
    bins, same = bin_content()
    if form == "jpeg":
        bins = [drawn(number, kind="JPEG") for number in range(len(bins))]
    arrays = [np.frombuffer(photo, np.uint8) for photo in bins]
    elements = {"row": arrays, "column": [one[:, None] for one in arrays]}.get(form, bins)
    benchmark = read(tmp_path / "lfw.bin", (elements, same), protocol)
    assert [picture.read() for picture in benchmark.pictures] == bins


@pytest.mark.parametrize("protocol", range(6))
@pytest.mark.parametrize("kind", [bytearray, bytes])
@pytest.mark.parametrize("in_array", [False, True])
def test_byte_arrays_and_arrays_of_objects(
    tmp_path: Path, protocol: int, kind: type[bytes], in_array: bool
) -> None:
    bins, same = bin_content()
    photos: object = [kind(photo) for photo in bins]
    answers: object = same
    if in_array:
        array = np.empty(len(bins), dtype=object)
        array[:] = photos
        photos, answers = array, np.array(same, dtype=object)
    benchmark = read(tmp_path / "lfw.bin", (photos, answers), protocol)
    assert [picture.read() for picture in benchmark.pictures] == bins
    np.testing.assert_array_equal(benchmark.same, same)


@pytest.mark.parametrize(
    "answers",
    [
        [k % 2 == 0 for k in range(2 * FOLDS)],
        [np.bool_(k % 2 == 0) for k in range(2 * FOLDS)],
        [1 - k % 2 for k in range(2 * FOLDS)],
        tuple(np.int64(1 - k % 2) for k in range(2 * FOLDS)),
        np.arange(2 * FOLDS) % 2 == 0,
        (1 - np.arange(2 * FOLDS) % 2).astype(">i4"),
    ],
)
def test_answers(tmp_path: Path, answers: object) -> None:
    benchmark = read(tmp_path / "lfw.bin", [bin_content()[0], answers])
    np.testing.assert_array_equal(benchmark.same, np.arange(2 * FOLDS) % 2 == 0)


BINS, SAME = bin_content()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ((BINS[:-1], SAME), "39 photos and 20 answers; a pair needs two"),
        ((BINS[:-2], SAME), "38 photos and 20 answers"),
        ((BINS, SAME[:-1]), "40 photos and 19 answers"),
        (([], []), "0 photos and 0 answers"),
        ((BINS, [*SAME[:-1], 2]), "answer 19 is neither true nor false"),
        ((BINS, [*SAME[:-1], None]), "answer 19 is neither"),
        ((BINS, 3), "issame_list, is not a list"),
        ((3, SAME), "bins, is not a list"),
        (BINS, "two parts"),
        ((BINS, SAME, 3), "two parts"),
        ((BINS, sorted(SAME)), "fold 1 has no genuine pair"),
        (([b"GIF89a", *BINS[1:]], SAME), "photo 0 is neither JPEG nor PNG"),
        ((["text", *BINS[1:]], SAME), "photo 0 is neither bytes"),
        (([np.zeros((8, 8), np.uint8), *BINS[1:]], SAME), "photo 0 is neither bytes nor a row"),
        (([np.zeros(8, np.int8), *BINS[1:]], SAME), "photo 0 is neither bytes nor a row"),
        (([np.zeros(8), *BINS[1:]], SAME), "photo 0 is neither bytes nor a row"),
        (([np.array(["a"], object), *BINS[1:]], SAME), "photo 0 is neither bytes nor a row"),
        ((np.array([*BINS[:-1], None], object), SAME), "photo 39 is neither bytes"),
        (({"bins": BINS}, SAME), "bins, is not a list"),
    ],
)
def test_faults_are_named(tmp_path: Path, content: object, message: str) -> None:
    with pytest.raises(DatasetError, match=message):
        read(tmp_path / "lfw.bin", content)


class Touches:
    def __init__(self, file: Path) -> None:
        self.file = file

    def __reduce__(self) -> tuple[object, tuple[str, str]]:
        return open, (str(self.file), "w")


def test_nothing_runs(tmp_path: Path) -> None:
    marker = tmp_path / "ran"
    for content in (Touches(marker), (BINS, [*SAME, Touches(marker)])):
        with pytest.raises(DatasetError, match=r"asks for .*open"):
            read(tmp_path / "lfw.bin", content)
    assert not marker.exists()


def test_a_truncated_file_or_one_with_more_behind_it(tmp_path: Path) -> None:
    data = pickle.dumps((BINS, SAME))
    file = tmp_path / "lfw.bin"
    for end in range(0, len(data), 97):
        file.write_bytes(data[:end])
        with pytest.raises(DatasetError):
            open_sets(file)
    file.write_bytes(data + b"x")
    with pytest.raises(DatasetError, match="1 bytes follow its end"):
        open_sets(file)


@given(data=st.binary(max_size=100), suffix=st.sampled_from([".bin", ".csv", ".txt", ""]))
@settings(max_examples=150)
def test_random_files_only_ever_raise_dataset_errors(
    tmp_path_factory: pytest.TempPathFactory, data: bytes, suffix: str
) -> None:
    file = tmp_path_factory.getbasetemp() / f"random{suffix}"
    file.write_bytes(data)
    with pytest.raises(DatasetError):
        open_sets(file)
