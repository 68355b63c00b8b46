"""What `quiver restore` and `quiver evaluate` take for input: sums of planes, and options that act or are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from clips import ClipMaker

import quiver
from qsim.clip.sensing import Sensing, sense
from quiver.cli.program import main
from quiver.data.illumination import Illumination
from quiver.data.photon_cubes import cube_codes, plane_bits
from quiver.restoration.interface import RestoreOptions
from quiver.restoration.restorers import restorer

VALID = [2**b - 1 for b in range(1, 17)]
SPAD = Illumination("spad-320x240", None, None)


def packed(planes: np.ndarray, path: Path) -> Path:
    np.save(path, np.packbits(planes, axis=2))
    return path


@pytest.mark.parametrize("planes", VALID)
def test_sums_of_planes_are_plain_sums(tmp_path, planes):
    """Every depth from 1 to 16 bits, a width that fills no byte, planes left over; full and random planes."""
    rng = np.random.default_rng(planes)
    height, width, frames = (2, 5, 3) if planes < 5000 else (1, 3, 1)
    drawn = rng.integers(0, 2, (planes * frames + min(planes - 1, 2), height, width), dtype=np.uint8)
    drawn[:planes] = 1  # the first code is the top one: where a narrow type wraps
    codes = cube_codes(packed(drawn, tmp_path / "c.npy"), SPAD, 1000.0, planes=planes, width=width)
    expected = drawn[: planes * frames].reshape(frames, planes, height, width).astype(np.int64).sum(axis=1)
    assert codes.shape == expected.shape
    assert codes.sensor.bits == planes.bit_length()
    assert codes.sensor.levels == planes + 1
    np.testing.assert_array_equal(codes.read(0, frames).astype(np.int64), expected)
    assert codes.read(0, 1).max() == planes
    for t in range(frames):
        np.testing.assert_array_equal(codes.read(t, t + 1)[0], expected[t])


def test_planes_unpacked_in_pieces_are_the_same(tmp_path, monkeypatch):
    drawn = np.random.default_rng(1).integers(0, 2, (511 * 2, 3, 11), dtype=np.uint8)
    path = packed(drawn, tmp_path / "c.npy")
    whole = cube_codes(path, SPAD, 1000.0, planes=511, width=11).read(0, 2)
    monkeypatch.setattr("quiver.data.photon_cubes.PLANE_PIXELS", 3 * 11 * 7)
    np.testing.assert_array_equal(cube_codes(path, SPAD, 1000.0, planes=511, width=11).read(0, 2), whole)


def test_plane_counts_that_no_code_sums_are_refused(tmp_path, capsys):
    """1 to 1000 and beyond the deepest code: 2^b - 1 is taken, everything else is refused with its neighbours."""
    for planes in [*range(1, 1001), 65534, 65535, 65536, 10**9]:
        if planes in VALID:
            assert 2 ** plane_bits(planes) - 1 == planes
            continue
        with pytest.raises(ValueError, match=rf"got {planes}; use ") as caught:
            plane_bits(planes)
        near = [int(word) for word in str(caught.value).rsplit("use ", 1)[1].split(" or ")]
        below, above = max(v for v in VALID if v < planes), min((v for v in VALID if v > planes), default=None)
        assert near == [v for v in (below, above) if v is not None]
    path = packed(np.ones((10, 4, 8), np.uint8), tmp_path / "c.npy")
    words = ["restore", path, "--width", 8, "--planes", 5, "--sensor", "spad-320x240", "--method", "naive"]
    assert main([str(word) for word in [*words, "-o", tmp_path / "r.npy"]]) == 2
    assert capsys.readouterr().err.endswith("sums 2^b - 1 binary planes, got 5; use 3 or 7\n")
    assert not (tmp_path / "r.npy").exists()


def test_binary_planes_are_codes_of_one_bit(tmp_path):
    path = packed(np.random.default_rng(0).integers(0, 2, (4, 3, 9), dtype=np.uint8), tmp_path / "c.npy")
    assert cube_codes(path, SPAD, 1000.0, width=9).sensor.bits == 1


@pytest.mark.parametrize(
    ("light", "planes", "message"),
    [
        (Illumination("spad-320x240", None, 3), 15, "sums of 15 planes are 4-bit codes, got bits = 3"),
        (Illumination("quiver-paper", None, None), 7, "quiver-paper: only a clocked SPAD sums planes, this is a QIS"),
    ],
)
def test_a_sensor_that_cannot_have_made_the_sums_is_refused(tmp_path, light, planes, message):
    path = packed(np.ones((30, 3, 9), np.uint8), tmp_path / "c.npy")
    with pytest.raises(ValueError, match=message):
        cube_codes(path, light, 1000.0, planes=planes, width=9)


def test_an_archive_under_the_name_of_an_array_is_named(tmp_path):
    with open(tmp_path / "z.npy", "wb") as file:
        np.savez(file, a=np.zeros((2, 3, 4), np.uint8))
    with pytest.raises(ValueError, match=r"z\.npy: is an archive"):
        cube_codes(tmp_path / "z.npy", Illumination(), 1000.0)


# Options


@pytest.fixture
def inputs(make_clip: ClipMaker, tmp_path: Path) -> dict[str, Path]:
    """A clip with one stream, its stream's file, a clip without, an array of codes, packed planes, and counts."""
    clip = make_clip(frames=4)
    sense(clip, Sensing("quiver-physical", bits=3, ppp=3.25, name="mine"))
    rng = np.random.default_rng(0)
    np.save(tmp_path / "codes.npy", rng.integers(0, 8, (4, 6, 7), dtype=np.uint8))
    np.save(tmp_path / "counts.npy", rng.poisson(3.0, (30, 8, 8)).astype(np.uint8))
    packed(rng.integers(0, 2, (14, 6, 7), dtype=np.uint8), tmp_path / "planes.npy")
    return {
        "clip": clip.path,
        "stream": clip.path / "streams/mine.npy",
        "array": tmp_path / "codes.npy",
        "planes": tmp_path / "planes.npy",
        "counts": tmp_path / "counts.npy",
    }


VALUES = {
    "stream": "mine",
    "sensor": "quiver-paper",
    "ppp": 9,
    "bits": 2,
    "seed": 5,
    "width": 7,
    "planes": 7,
    "frame-rate": 500,
    "mode": "exact",
    "device": "cpu",
    "precision": "float32",
}
REFUSED = {  # by kind of input, with a classical method
    "stream": ["stream", "sensor", "ppp", "bits", "seed", "width", "planes", "frame-rate"],
    "clip": ["sensor", "bits", "seed", "width", "planes", "frame-rate"],
    "clip --stream mine": ["sensor", "ppp", "bits", "seed", "width", "planes", "frame-rate"],
    "clip --ppp 3": ["stream", "width", "planes", "frame-rate"],
    "array --sensor quiver-paper": ["stream", "ppp", "seed", "planes"],
    "planes --sensor spad-320x240 --width 7": ["stream", "ppp", "seed", "bits"],
    "planes --sensor spad-320x240 --width 7 --planes 7": ["stream", "ppp", "seed", "bits"],
}


@pytest.mark.parametrize("kind", REFUSED)
def test_an_option_that_cannot_act_is_refused(kind, inputs, tmp_path, capsys):
    """Each option of `quiver restore` that this input would ignore: one line that names it, and nothing is made."""
    name, *own = kind.split()
    words = ["restore", str(inputs[name]), *own, "--method", "naive", "-o", str(tmp_path / "r.npy"), "-q"]
    assert main(words) == 0
    for option in [*REFUSED[kind], "mode", "device", "precision"]:
        other = [*words, f"--{option}", str(VALUES[option])]
        other[other.index(str(tmp_path / "r.npy"))] = str(tmp_path / "other.npy")
        assert main(other) == 2, option
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert option in said
        assert not list(tmp_path.glob("other*"))


def test_the_other_options_change_the_answer(inputs, tmp_path):
    """What is taken for a clip that is sensed now, for an array and for planes makes another video."""

    def video(kind: str, *words: object) -> np.ndarray:
        path = tmp_path / "r.npy"
        asked = ["restore", inputs[kind], "-o", path, "-q", "--force", "--method", "naive", *words]
        assert main([str(word) for word in asked]) == 0
        return np.load(path)

    for kind, words, options in (
        ("clip", ["--ppp", 3], ["ppp", "sensor", "bits", "seed"]),
        ("array", ["--ppp", 3], ["ppp"]),
        ("planes", ["--width", 7, "--sensor", "spad-320x240"], ["planes"]),
    ):
        base = video(kind, *words)
        for option in options:
            other = video(kind, *words, f"--{option}", VALUES[option])
            assert other.shape != base.shape or not np.array_equal(other, base), (kind, option)
    base = video("array", "--ppp", 3, "--method", "moment")
    for words in (
        ["--ppp", 3, "--bits", 4],
        ["--sensor", "quiver-paper"],
        ["--ppp", 3, "--sensor", "quiver-published"],
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
        (["--device", "cpu"], "--device"),
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


def test_one_line_says_what_was_assumed(inputs, tmp_path, capsys):
    assert main(["restore", str(inputs["clip"]), "-o", str(tmp_path / "r.npy")]) == 0
    lines = [line for line in capsys.readouterr().err.splitlines() if "warning:" not in line]  # of the weights' domain
    assert len(lines) == 1
    said = lines[0]
    for part in (
        "quiver-physical, 3 bit, 3.25 photons",
        "white = 8.125",
        "4 frames",
        "method nano",
        "weights ",
        "exact",
    ):
        assert part in said
    assert main(["restore", str(inputs["clip"]), "-o", str(tmp_path / "q.npy"), "-q", "--method", "naive"]) == 0
    assert capsys.readouterr().err == ""


@pytest.mark.filterwarnings("ignore:nano was")  # measured or not for such streams
def test_the_command_and_the_call_have_one_default_method(inputs, tmp_path):
    assert main(["restore", str(inputs["clip"]), "-o", str(tmp_path / "r.npy"), "-q"]) == 0
    np.testing.assert_allclose(quiver.restore(inputs["clip"]), np.load(tmp_path / "r.npy"), atol=1e-5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"mode": "streaming"}, "--mode: acts on networks, and moment is classical"),
        ({"device": "cpu"}, "--device: acts on networks"),
    ],
)
def test_the_call_refuses_what_it_would_ignore(inputs, changes, message):
    with pytest.raises(ValueError, match=message):
        quiver.restore(inputs["clip"], "moment", **changes)
    with pytest.raises(ValueError, match="a stream knows its light"):
        quiver.restore(inputs["stream"], "moment", ppp=3.0)


def test_a_mode_of_a_network_that_has_one_is_refused(inputs, tmp_path, capsys):
    from quiver.model.unet import UNet, UNetConfig
    from quiver.model.weights import save

    network = UNet(UNetConfig(2))
    save(network, network.config, tmp_path / "u.safetensors")
    words = ["restore", str(inputs["clip"]), "-o", str(tmp_path / "r.npy"), "--method", str(tmp_path / "u.safetensors")]
    assert main([*words, "--mode", "streaming"]) == 2
    assert "--mode streaming: u shares no work between frames" in capsys.readouterr().err
    assert restorer(words[-1], RestoreOptions(mode="streaming")).seamless
