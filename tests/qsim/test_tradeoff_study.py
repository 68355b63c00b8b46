"""Bit depths of one clip: simulated errors against their expectations, and the laws behind them."""

import numpy as np
import pytest

from qsim import tradeoff_study
from qsim.cli import main
from qsim.clip import RELATIVE, Clip, ClipWriter
from qsim.tradeoff import Structure
from qsim.tradeoff_study import Question, study

SIZE = (48, 64)


def write_clip(path, frames: int, speed: int, frame_rate: float = 10_000.0) -> Clip:
    """A periodic texture that moves to the right by whole pixels: its statistics are the same at all times."""
    y, x = np.mgrid[0 : SIZE[0], 0 : SIZE[1]]
    turn = 2 * np.pi / SIZE[1]
    texture = 1.0 + 0.5 * np.sin(3 * turn * x) + 0.3 * np.cos(7 * turn * x + y / 5) + 0.15 * np.sin(16 * turn * x)
    meta = {"shape": [frames, *SIZE], "frame_rate": frame_rate, "exposure": 1 / frame_rate, "radiance_unit": RELATIVE}
    flow = np.zeros((2, *SIZE), np.float32)
    flow[0] = speed
    truth = {"flow": flow, "flow_back": -flow, "valid": np.ones(SIZE, bool)}
    with ClipWriter(path, meta) as writer:
        for t in range(frames):
            writer.add(t, np.roll(texture, speed * t, axis=1).astype(np.float32), truth=truth)
    return Clip.open(path)


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    return write_clip(tmp_path_factory.mktemp("tradeoff") / "wave", 64, 1)


@pytest.fixture(scope="module")
def found(clip):
    return study(clip, Question(bits=(1, 3, 4), ppp=0.65, instants=4))


def rows_of(found, model):
    return [row for row in found.rows if row.model == model]


@pytest.mark.parametrize("ppp", [0.1, 0.65, 8.0])
@pytest.mark.parametrize("plane", [None, "quiver-paper"])
def test_simulation_agrees_with_its_expectation(clip, ppp, plane):
    """Twelve rows, none further off than its stated error allows (p = 1e-6 in all)."""
    from stats import critical_z

    rows = study(clip, Question(bits=(1, 3, 4), ppp=ppp, plane=plane, instants=4)).rows
    limit = critical_z(1e-6 / len(rows))
    # 3e-3: second order in the differences of light between the planes of a frame
    for row in rows:
        relative = row.psnr_error_db * np.log(10) / 10
        assert abs(row.sigmas) * relative < limit * relative + 3e-3, row


def test_blur_follows_from_the_structure_function(found):
    for row in found.rows:
        assert row.blur_predicted == pytest.approx(row.blur_error, rel=2e-3, abs=1e-6)


def test_motion_and_rate_follow_the_planes(found):
    for row in found.rows:
        assert row.motion_px_per_frame == pytest.approx(2**row.bits - 1)
        assert row.fps * (2**row.bits - 1) == pytest.approx(10_000)
        assert row.data_rate_megabytes_per_second == pytest.approx(48 * 64 * row.bits * row.fps / 8e6)


def test_binary_read_without_noise_is_a_plane(clip):
    """One bit, one clip frame: a SPAD plane has the information that 1 - exp(-n) allows, the QIS less (read noise)."""
    from qsim.spad import BinarySPAD
    from qsim.tradeoff_study import Reading

    reading = Reading("planes", 3, BinarySPAD(0.8, 0.0, 1), 1e-4)
    whole = BinarySPAD(0.8, 0.0, 3)
    assert np.allclose(reading.pmf(np.array([0.5, 4.0])), whole.pmf(np.array([0.5, 4.0]), 7e-4))
    theta = 4.0
    assert reading.snr_db(theta) == pytest.approx(
        20 * np.log10(theta * np.sqrt(whole.fisher_information(np.array(theta), 7e-4)))
    )
    assert np.allclose(reading.estimates, whole.maximum_likelihood(np.eye(8), 7e-4).photons, rtol=1e-6)


def test_noise_falls_and_blur_grows_with_depth(found):
    for model in tradeoff_study.MODELS:
        rows = rows_of(found, model)
        assert [row.shot_error for row in rows] == sorted((row.shot_error for row in rows), reverse=True)
        assert [row.blur_error for row in rows] == sorted(row.blur_error for row in rows)
        assert rows[0].blur_error == 0


def test_shot_noise_of_a_sum_is_that_of_its_light(found):
    """Mean light 0.65, efficiency 0.8: variance per plane 0.65/0.8 over M, plus 1.6 dark electrons per second."""
    for row in found.rows:
        m = 2**row.bits - 1
        assert row.shot_error**2 == pytest.approx((0.8 * 0.65 + 1.6e-4) / 0.64 / m, rel=1e-3)


def test_deeper_frames_hold_the_planes_of_shallower_ones(clip):
    question = Question(bits=(1, 2, 3), ppp=0.65)
    plane = tradeoff_study.plane_sensor(question, 0.65, clip.exposure)
    frames = list(tradeoff_study.expose(clip, 20, question, 0.65, plane, np.zeros(7)))
    assert [frame.planes for frame in frames] == [1, 3, 7]
    assert (frames[0].fired <= frames[1].fired).all()
    assert (frames[1].fired <= frames[2].fired).all()
    assert (frames[2].fired - frames[1].fired).max() <= 4


def test_faster_is_every_other_frame(clip, tmp_path):
    """Speed 2 of a clip is the clip that moves twice as fast."""
    twice = write_clip(tmp_path / "wave2", 32, 2)
    stepped = study(clip, Question(bits=(1, 3), ppp=0.65, speed=2, instants=1))
    fast = study(twice, Question(bits=(1, 3), ppp=0.65, instants=1))
    for a, b in zip(stepped.rows, fast.rows, strict=True):
        assert a.blur_error == pytest.approx(b.blur_error, rel=1e-6)
        assert a.motion_px_per_frame == pytest.approx(b.motion_px_per_frame)


def test_structure_function_scales_with_speed():
    """A ramp (D = k^2) has no blur; a sine loses amplitude by the mean of the cosine over the frame."""
    ramp = Structure(np.arange(9.0) ** 2)
    assert ramp.blur(9) == pytest.approx(0, abs=1e-12)
    wave = Structure(1 - np.cos(2 * np.pi * np.arange(41) / 40))  # of sin, variance 1/2
    mean = np.cos(2 * np.pi * np.arange(-3, 4) / 40).mean()
    assert wave.blur(7) == pytest.approx((1 - mean) ** 2 / 2, rel=1e-9)
    mean = np.cos(4 * np.pi * np.arange(-3, 4) / 40).mean()
    assert wave.blur(7, 2.0) == pytest.approx((1 - mean) ** 2 / 2, rel=1e-9)


def test_clips_that_cannot_answer_are_refused(clip, tmp_path, capsys):
    slow = write_clip(tmp_path / "slow", 3, 1, frame_rate=2000.0)
    with pytest.raises(ValueError, match="at least 10000 fps"):
        study(slow, Question(ppp=1.0))
    with pytest.raises(ValueError, match="7 bits at speed 1 need 127"):
        study(clip, Question(bits=(7,), ppp=1.0))
    assert main(["tradeoff", str(clip.path)]) == 2
    assert "--ppp" in capsys.readouterr().err


def test_command_writes_numbers_figure_and_streams(clip, tmp_path, capsys):
    import json

    from qsim.stream import replay

    out = tmp_path / "out"
    words = ["tradeoff", str(clip.path), "--ppp", "0.65", "--bits", "1,3", "-o", str(out), "--json", "--streams"]
    assert main(words) == 0
    found = json.loads(capsys.readouterr().out)
    assert found == json.loads((out / "tradeoff.json").read_text())
    assert [(row["model"], row["bits"]) for row in found["rows"]] == [
        ("planes", 1), ("planes", 3), ("multibit", 1), ("multibit", 3),
    ]  # fmt: skip
    assert (out / "tradeoff.png").read_bytes().startswith(b"\x89PNG")
    deep, shallow = (Clip.open(out / "streams" / f"wave_{bits}bit") for bits in (3, 1))
    assert deep.streams == ("multibit", "planes")
    assert deep.shape == (9, *SIZE)
    assert deep.verify() == []
    planes = shallow.stream("planes").codes()[:63].reshape(9, 7, *SIZE).sum(axis=1)
    assert np.array_equal(planes, deep.stream("planes").codes())
    assert np.array_equal(*replay(deep, deep.stream("multibit"), 4))
    assert np.array_equal(deep.sharp(2), clip.radiance(2 * 7 + 3))
    mean = deep.stream("multibit").photons_factor * np.mean([deep.radiance(t) for t in range(9)])
    assert mean == pytest.approx(7 * 0.65, rel=2e-2)
    assert main(words) == 2
    assert "--force" in capsys.readouterr().err


def test_sweep_over_speed_and_light(clip, tmp_path, capsys):
    """The law from the slowest clip picks depths that cost less than 0.3 dB.

    Not where binary planes saturate: there motion helps them, and the law takes light as constant within a frame.
    """
    import json

    out = tmp_path / "sweep"
    words = ["tradeoff", str(clip.path), "--bits", "1,2,3", "--speed", "1,4", "--ppp", "0.3:30:2", "-o", str(out)]
    assert main([*words, "--instants", "2", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    cells, agreement = found["cells"], found["agreement"]
    assert len(cells) == agreement["cells"] == 2 * 2 * 2
    sigmas = [row["sigmas"] for study in found["studies"] for row in study["rows"]]
    assert len(sigmas) == agreement["simulated"] == 2 * 2 * 6
    assert agreement["largest_sigmas"] == max(map(abs, sigmas))
    assert agreement["largest_loss_db"] == max(cell["loss_of_prediction_db"] for cell in cells)
    others = [cell for cell in cells if cell["best_bits"] != cell["best_bits_predicted"]]
    assert agreement["cells_with_another_depth"] == len(others)
    assert (out / "best.png").exists()
    lawful = [cell for cell in cells if cell["model"] == "multibit" or cell["ppp"] < 1]
    assert max(cell["loss_of_prediction_db"] for cell in lawful) < 0.3
    best = {(cell["speed"], cell["ppp"]): cell["best_bits"] for cell in cells if cell["model"] == "multibit"}
    assert best[4.0, 30.0] < best[1.0, 0.3]  # fast and bright wants short frames


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--speed", "0.5", "--ppp", "1"], "whole factors only"),
        (["--ppp", "0.1:x"], "numbers above 0"),
        (["--ppp", "1", "--bits", "9"], "render a longer clip"),
        (["--ppp", "1", "--streams"], "-o"),
    ],
)
def test_mistakes_are_one_line(clip, capsys, words, message):
    assert main(["tradeoff", str(clip.path), *words]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_no_source_is_said(capsys, tmp_path):
    assert main(["tradeoff"]) == 2
    assert "give a clip or a scene" in capsys.readouterr().err
    assert main(["tradeoff", "fann", "-o", str(tmp_path)]) == 2
    assert "neither a clip folder nor a scene" in capsys.readouterr().err
