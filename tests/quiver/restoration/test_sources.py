"""The inputs of `quiver restore` and `quiver evaluate`: options have an effect or are refused."""

from __future__ import annotations

import numpy as np
import pytest
from sensor_files import SPAD, sensor_file

import quiver
from qsim.streams.sensing import Sensing
from qsim.streams.storing import sense
from quiver.cli.program import main
from quiver.data.codes import array_codes, repaired, sensed, stream_codes
from quiver.data.illumination import Illumination, read_sensor
from quiver.restoration.interface import RestoreOptions
from quiver.restoration.restored_file import restore_to_file
from quiver.restoration.restorers import restorer
from quiver.restoration.sources import assumed

# Options


VALUES = {
    "stream": "mine",
    "sensor": "quiver-paper",
    "ppp": 9,
    "bits": 2,
    "seed": 5,
    "width": 7,
    "planes": 7,
    "summed": 7,
    "frame-rate": 500,
    "mode": "exact",
    "precision": "float32",
}
REFUSED = {  # by kind of input, with a classical method
    "stream": ["stream", "sensor", "ppp", "bits", "seed", "width", "planes", "summed", "frame-rate"],
    "clip": ["sensor", "bits", "seed", "width", "planes", "frame-rate"],
    "clip --stream mine": ["sensor", "ppp", "bits", "seed", "width", "planes", "frame-rate"],
    "clip --ppp 3": ["stream", "width", "summed", "frame-rate"],
    "array --sensor quiver-paper": ["stream", "ppp", "seed", "planes"],
    "planes --sensor spad-320x240 --width 7": ["stream", "ppp", "seed", "bits", "summed"],
    "planes --sensor spad-320x240 --width 7 --planes 7": ["stream", "ppp", "seed", "bits"],
}


@pytest.mark.parametrize("kind", REFUSED)
def test_an_option_that_cannot_act_is_refused(kind, inputs, tmp_path, capsys):
    """Each option of `quiver restore` without effect on this input: one line names it, and nothing is written."""
    name, *own = kind.split()
    words = ["restore", str(inputs[name]), *own, "--method", "naive", "-o", str(tmp_path / "r.npy"), "-q"]
    assert main(words) == 0
    for option in [*REFUSED[kind], "mode", "precision"]:
        other = [*words, f"--{option}", str(VALUES[option])]
        other[other.index(str(tmp_path / "r.npy"))] = str(tmp_path / "other.npy")
        assert main(other) == 2, option
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert option in said
        assert not list(tmp_path.glob("other*"))


def test_the_other_options_change_the_answer(inputs, tmp_path):
    """Each option for a clip that is sensed now, for an array and for planes makes another video."""

    def video(kind: str, *words: object) -> np.ndarray:
        path = tmp_path / "r.npy"
        asked = ["restore", inputs[kind], "-o", path, "-q", "--force", "--method", "naive", *words]
        assert main([str(word) for word in asked]) == 0
        return np.load(path)

    for kind, words, options in (
        ("clip", ["--ppp", 6], ["ppp", "sensor", "bits", "seed"]),
        ("array", ["--ppp", 6], ["ppp"]),
        ("planes", ["--width", 7, "--sensor", "spad-320x240"], ["planes"]),
    ):
        base = video(kind, *words)
        for option in options:
            other = video(kind, *words, f"--{option}", VALUES[option])
            assert other.shape != base.shape or not np.array_equal(other, base), (kind, option)
    base = video("array", "--ppp", 6, "--method", "moment")
    for words in (
        ["--ppp", 6, "--bits", 4],
        ["--sensor", "quiver-paper"],
        ["--ppp", 6, "--sensor", "quiver-published"],
    ):
        assert not np.array_equal(video("array", *words, "--method", "moment"), base), words


@pytest.mark.parametrize(
    ("words", "option"),
    [
        (["--frames", "5"], "--frames"),
        (["--splits", "2"], "--splits"),
        (["--split", "val"], "--split"),
        (["--stream", "mine", "--sensor", "quiver-paper"], "--sensor"),
        (["--stream", "mine", "--ppp", "3"], "--ppp"),
        (["--stream", "mine", "--bits", "3"], "--bits"),
        (["--stream", "mine", "--seed", "3"], "--seed"),
        (["--stream", "mine", "--published"], "--published"),
        (["--mode", "streaming"], "--mode"),
        (["--precision", "bfloat16"], "--precision"),
    ],
)
def test_an_evaluation_refuses_what_it_would_ignore(inputs, tmp_path, capsys, words, option):
    asked = ["evaluate", str(inputs["clip"]), "-o", str(tmp_path / "t"), "--methods", "naive", *words]
    assert main(asked) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert option in said
    assert not (tmp_path / "t").exists()


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["clip"], "measured counts"),
        (["-o", "t"], "--output"),
        (["--split", "val"], "--split"),
        (["--stream", "mine"], "--stream"),
        (["--sensor", "quiver-paper"], "--sensor"),
        (["--ppp", "3"], "--ppp"),
        (["--published"], "--published"),
        (["--force"], "--force"),
        (["--bits", "1,3"], "--bits"),
    ],
)
def test_measured_counts_refuse_what_is_of_clips(inputs, capsys, words, named):
    assert main(["evaluate", "--static", str(inputs["counts"]), "--methods", "naive", *words]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert named in said


def test_two_lines_say_what_was_chosen_and_assumed(inputs, tmp_path, capsys):
    assert main(["restore", str(inputs["clip"]), "-o", str(tmp_path / "r.npy")]) == 0
    lines = [line for line in capsys.readouterr().err.splitlines() if "warning:" not in line]  # of the weights' domain
    chosen, said = lines
    method = chosen.removeprefix("auto: ").partition(";")[0]
    assert method in ("mergenet", "qbp-bm3d:5")  # the better one in this cell of the weights file
    assert chosen.startswith(f"auto: {method}; measured at quiver-physical, 3 bit, 3.25 PPP")
    for part in (
        "quiver-physical, 3 bit, 3.25 photons",
        "white of the sensor = 8.75 photons",
        "4 frames",
        f"method {method}",
    ):
        assert part in said
    assert main(["restore", str(inputs["clip"]), "-o", str(tmp_path / "q.npy"), "-q", "--method", "naive"]) == 0
    assert capsys.readouterr().err == ""


def test_the_dark_rate_of_an_array_is_that_of_the_measured_map(inputs, tmp_path):
    """A uniform map, in which no pixel is hot: the video of a sensor that states this rate, not that of the file."""
    np.save(tmp_path / "rates.npy", np.full((6, 7), 80.0))  # 1/s
    videos = []
    dark_map = 'dark_map = "rates.npy"\n'
    for name, rate, table in (("mapped", "0.0", dark_map), ("stated", "80.0", ""), ("dark", "0.0", "")):
        sensor = sensor_file(tmp_path, SPAD.replace("200.0", rate) + table, bits=3, name=f"{name}.toml")
        words = ["restore", inputs["array"], "-o", tmp_path / "r.npy", "--sensor", sensor, "--method", "moment"]
        assert main([str(word) for word in [*words, "--force", "-q"]]) == 0
        videos.append(np.load(tmp_path / "r.npy"))
    mapped, stated, dark = videos
    np.testing.assert_array_equal(mapped, stated)
    assert mapped.mean() < dark.mean()


def test_a_mode_of_a_network_that_has_one_is_refused(inputs, tmp_path, capsys):
    from quiver.model.unet import UNet, UNetConfig
    from quiver.model.weights import save

    network = UNet(UNetConfig(2))
    save(network, network.config, tmp_path / "u.safetensors")
    words = ["restore", str(inputs["clip"]), "-o", str(tmp_path / "r.npy"), "--method", str(tmp_path / "u.safetensors")]
    for mode in ("exact", "streaming", "windows"):
        assert main([*words, "--mode", mode]) == 2
        assert f"--mode: u shares no work between frames, it has one mode, not {mode}" in capsys.readouterr().err
    assert main(words) == 0
    assert "exact" not in capsys.readouterr().err
    assert restorer(words[-1], RestoreOptions(mode="streaming")).seamless


def test_defects_that_are_not_inverted_are_told(make_clip, tmp_path):
    """Of a stored stream, a clip that is sensed now and a bare array: in the line, the json and the call in Python."""
    clip = make_clip(frames=2, height=8, width=8)
    path = sensor_file(tmp_path, SPAD + "crosstalk = 0.05\nafterpulse = 0.1\n")
    stream = sense(clip, Sensing(path, ppp=1.0))[0]
    bare = array_codes(stream.codes(0, 2), stream.sensor, stream.exposure)
    now = sensed(clip, Illumination.of(path, 1.0, None))[0]
    naive = restorer("naive")
    for codes in (stream_codes(stream), now, repaired(bare, read_sensor(path)[1])):
        assert ", crosstalk and afterpulse not inverted (restored light is too bright)," in assumed(codes, naive)
    assert "inverted" not in assumed(bare, naive)
    assert restore_to_file(now, naive, tmp_path / "r.npy").not_inverted == "crosstalk and afterpulse"
    with pytest.warns(UserWarning, match="crosstalk and afterpulse not inverted, restored light is too bright"):
        quiver.restore(stream, "naive")
