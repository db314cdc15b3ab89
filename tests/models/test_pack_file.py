import pytest

from models.errors import PackError
from models.pack_file import LivenessStatement, PackFile, read_pack_file


def read(folder, text):
    (folder / "pack.toml").write_text(text)
    return read_pack_file(folder)


def test_no_file_states_nothing(tmp_path):
    assert read_pack_file(tmp_path) == PackFile()


def test_all_keys(tmp_path):
    stated = read(
        tmp_path,
        """
        [embedder]
        mean = [1, 2.5, 3]
        scale = 128
        channel_order = "bgr"
        input_size = 128
        [detector]
        input_size = 320
        """,
    )
    assert stated == PackFile(
        mean=(1.0, 2.5, 3.0),
        scale=(128.0, 128.0, 128.0),
        channel_order="bgr",
        input_size=128,
        detector_size=320,
    )


def test_liveness_graphs_by_their_file(tmp_path):
    stated = read(
        tmp_path,
        """
        [[liveness]]
        file = "first.onnx"
        [[liveness]]
        file = "second.onnx"
        crop_scale = 1.5
        crop = "square"
        input_size = 128
        channel_order = "rgb"
        input_range = [0, 1]
        live_class = 0
        score = "difference"
        """,
    )
    assert stated == PackFile(
        liveness={
            "first.onnx": LivenessStatement(),
            "second.onnx": LivenessStatement(
                crop_scale=1.5,
                crop="square",
                input_size=128,
                channel_order="rgb",
                input_range=(0.0, 1.0),
                live_class=0,
                score="difference",
            ),
        }
    )


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[embedder", "not valid TOML"),
        ("mean = 1", "unknown table or key 'mean'"),
        ("embedder = 3", r"must be a table, written \[embedder\]"),
        ("[embedder]\nmeen = 1", "unknown key 'meen'.*mean"),
        ("[detector]\nmean = 1", "unknown key 'mean' in .detector."),
        ("[embedder]\nmean = 'x'", "number or a list of three"),
        ("[embedder]\nmean = [1, 2]", "number or a list of three"),
        ("[embedder]\nmean = [1, 2, true]", "number or a list of three"),
        ("[embedder]\nmean = nan", "number or a list of three"),
        ("[embedder]\nscale = inf", "number or a list of three"),
        ("[embedder]\nscale = [1, 0, 1]", "must not be 0"),
        ("[embedder]\nchannel_order = 'rbg'", 'must be "rgb" or "bgr"'),
        ("[embedder]\ninput_size = 120", "multiple of 16"),
        ("[embedder]\ninput_size = 96", "from 112"),
        ("[embedder]\ninput_size = 112.0", "multiple of 16"),
        ("[detector]\ninput_size = 100", "multiple of 32"),
        ("[detector]\ninput_size = 65536", "to 2048"),
        ("[liveness]\nfile = 'a'", r"must be a table, written \[\[liveness\]\]"),
        ("liveness = 3", r"must be a table, written \[\[liveness\]\]"),
        ("[[liveness]]\nfile = 'a'\nscale = 2", "unknown key 'scale'.*crop_scale"),
        ("[[liveness]]\ncrop_scale = 2", "needs 'file'"),
        ("[[liveness]]\nfile = 'a'\n[[liveness]]\nfile = 'a'", "states a twice"),
        ("[[liveness]]\nfile = 'a'\ncrop_scale = 0.1", "number from 0.5 to 8"),
        ("[[liveness]]\nfile = 'a'\ncrop_scale = nan", "number from 0.5 to 8"),
        ("[[liveness]]\nfile = 'a'\ncrop = 'round'", '"box" or "square"'),
        ("[[liveness]]\nfile = 'a'\ninput_range = [1, 0]", "two numbers that ascend"),
        ("[[liveness]]\nfile = 'a'\ninput_range = 1", "two numbers that ascend"),
        ("[[liveness]]\nfile = 'a'\nlive_class = -1", "whole number from 0"),
        ("[[liveness]]\nfile = 'a'\nlive_class = true", "whole number from 0"),
        ("[[liveness]]\nfile = 'a'\nscore = 'argmax'", '"softmax" or "difference"'),
        ("[[liveness]]\nfile = 'a'\ninput_size = 8", "from 16"),
        ("# " + "x" * 70_000, "not a pack.toml"),
    ],
)
def test_mistakes_are_named(tmp_path, text, said):
    with pytest.raises(PackError, match=said) as caught:
        read(tmp_path, text)
    assert "pack.toml" in str(caught.value)
