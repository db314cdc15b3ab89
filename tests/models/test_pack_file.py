import pytest

from models.errors import PackError
from models.pack_file import PackFile, read_pack_file


def read(folder, text):
    (folder / "pack.toml").write_text(text)
    return read_pack_file(folder)


def test_what_is_stated_and_what_is_not(tmp_path):
    assert read_pack_file(tmp_path) == PackFile()
    stated = read(
        tmp_path,
        """
        [embedder]
        mean = [1, 2.5, 3]
        scale = 128
        [detector]
        input_size = 320
        [[liveness]]
        file = "first.onnx"
        [[liveness]]
        file = "second.onnx"
        crop_scale = 1.5
        input_range = [0, 1]
        live_class = 0
        """,
    )
    assert stated.embedder.mean == (1.0, 2.5, 3.0)
    assert stated.embedder.scale == (128.0, 128.0, 128.0)
    assert stated.embedder.channel_order is None
    assert stated.detector.input_size == 320
    second = stated.liveness_of("second.onnx")
    assert (second.crop_scale, second.input_range, second.live_class) == (1.5, (0.0, 1.0), 0)
    assert stated.liveness_of("first.onnx").crop_scale is None
    assert stated.liveness_of("third.onnx") is None


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[embedder", "not valid TOML"),
        ("mean = 1", "mean: unknown key"),
        ("embedder = 3", "embedder: "),
        ("[embedder]\nmeen = 1", "embedder.meen: unknown key"),
        ("[detector]\nmean = 1", "detector.mean: unknown key"),
        ("[embedder]\nmean = 'x'", "embedder.mean.0: .*valid number"),
        ("[embedder]\nmean = [1, 2]", "embedder.mean"),
        ("[embedder]\nmean = [1, 2, true]", "embedder.mean.2: .*valid number"),
        ("[embedder]\nmean = nan", "embedder.mean.0"),
        ("[embedder]\nscale = inf", "embedder.scale.0"),
        ("[embedder]\nscale = [1, 0, 1]", "greater than 0"),
        ("[embedder]\nchannel_order = 'rbg'", "'rgb' or 'bgr'"),
        ("[detector]\ninput_size = 320.0", "valid integer"),
        ("[detector]\ninput_size = 100", "multiple of 32"),
        ("[detector]\ninput_size = 65536", "equal to 2048"),
        ("[liveness]\nfile = 'a'", "liveness: .*list"),
        ("[[liveness]]\nfile = 'a'\nscale = 2", "liveness.0.scale: unknown key"),
        ("[[liveness]]\ncrop_scale = 2", "liveness.0.file: .*required"),
        ("[[liveness]]\nfile = 'a'\n[[liveness]]\nfile = 'a'", "states a twice"),
        ("[[liveness]]\nfile = 'a'\ncrop_scale = 0.1", "equal to 0.5"),
        ("[[liveness]]\nfile = 'a'\ncrop_scale = nan", "finite number"),
        ("[[liveness]]\nfile = 'a'\ncrop = 'round'", "'box' or 'square'"),
        ("[[liveness]]\nfile = 'a'\ninput_range = [1, 0]", "must ascend"),
        ("[[liveness]]\nfile = 'a'\ninput_range = 1", "liveness.0.input_range"),
        ("[[liveness]]\nfile = 'a'\nlive_class = -1", "equal to 0"),
        ("[[liveness]]\nfile = 'a'\nlive_class = true", "valid integer"),
        ("# " + "x" * 70_000, "not a pack.toml"),
    ],
)
def test_mistakes_are_named(tmp_path, text, said):
    with pytest.raises(PackError, match=said) as caught:
        read(tmp_path, text)
    assert "pack.toml" in str(caught.value)
