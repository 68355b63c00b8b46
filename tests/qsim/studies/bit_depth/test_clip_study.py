"""Bit depths of one clip: simulated errors against their expectations, and the laws behind them."""

import numpy as np
import pytest

from qsim.cli.program import main
from qsim.clip.clip import RELATIVE, Clip, ClipWriter
from qsim.clip.motion_statistics import moving_mean
from qsim.report import clip_section
from qsim.studies.bit_depth import answer, clip_study
from qsim.studies.bit_depth.clip_study import Question, study
from qsim.studies.bit_depth.laws import Structure

SIZE = (48, 64)


def write_clip(path, frames: int, speed: int, frame_rate: float = 10_000.0, *, still: int = 0) -> Clip:
    """A periodic texture that moves to the right by whole pixels: its statistics are the same at all times.

    `still` rows are said to stand still.
    """
    y, x = np.mgrid[0 : SIZE[0], 0 : SIZE[1]]
    turn = 2 * np.pi / SIZE[1]
    texture = 1.0 + 0.5 * np.sin(3 * turn * x) + 0.3 * np.cos(7 * turn * x + y / 5) + 0.15 * np.sin(16 * turn * x)
    meta = {"shape": [frames, *SIZE], "frame_rate": frame_rate, "exposure": 1 / frame_rate, "radiance_unit": RELATIVE}
    flow = np.zeros((2, *SIZE), np.float32)
    flow[0, still:] = speed
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
    from qsim.sensor.spad import BinarySPAD
    from qsim.studies.bit_depth.clip_study import Reading

    reading = Reading("planes", 3, BinarySPAD(0.8, 0.0, 1), 1e-4)
    whole = BinarySPAD(0.8, 0.0, 3)
    assert np.allclose(reading.pmf(np.array([0.5, 4.0])), whole.pmf(np.array([0.5, 4.0]), 7e-4))
    theta = 4.0
    assert reading.snr_db(theta) == pytest.approx(
        20 * np.log10(theta * np.sqrt(whole.fisher_information(np.array(theta), 7e-4)))
    )
    assert np.allclose(reading.estimates, whole.maximum_likelihood(np.eye(8), 7e-4).photons, rtol=1e-6)


def test_noise_falls_and_blur_grows_with_depth(found):
    for model in clip_study.MODELS:
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
    plane = clip_study.plane_sensor(question, 0.65, clip.exposure)
    frames = list(clip_study.expose(clip, 20, question, 0.65, plane, np.zeros(7)))
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

    from qsim.clip.stream import replay

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


# Motion that is asked for, edges, and the sentence


def test_one_definition_of_motion(tmp_path):
    """Half of the field stands still: studies, figures and the clip page all say what the moving half does."""
    clip = write_clip(tmp_path / "half", 32, 2, still=24)
    rows = study(clip, Question(bits=(1, 3), ppp=0.65, instants=2)).rows
    assert [row.motion_px_per_frame for row in rows] == pytest.approx([2, 14, 2, 14])
    assert [answer.code_motion(row) for row in rows] == pytest.approx([14] * 4)
    assert 7 * clip_study.clip_motion(clip, 3) == pytest.approx(14)
    line = clip_section.motion_line(clip, range(4))
    assert "moves 2 px/frame on average (14 px per 3-bit frame of 7 planes)" in line


def test_what_moves_is_told_per_frame():
    """0.02 px per plane is nothing in one plane and 0.14 px in seven."""
    length = np.array([0.0, 0.02, 0.01, np.nan])
    assert moving_mean(length) is None
    assert moving_mean(length, 7) == pytest.approx(0.14)
    assert moving_mean(length, 11) == pytest.approx((0.22 + 0.11) / 2)


@pytest.mark.parametrize("seed", range(40))
def test_the_speed_is_found_for_any_scene(seed):
    """Random fields of flow: the motion reached is within 5 % of what was asked, or the refusal names the nearest."""
    rng = np.random.default_rng(seed)
    length = rng.exponential(10 ** rng.uniform(-5, 2), 500) * (rng.random(500) < rng.uniform(0.01, 1))
    px = 10 ** rng.uniform(-0.5, 1.5)
    shown = []

    def motion(speed: float) -> float:
        shown.append(moving_mean(speed * length, 7) or 0.0)
        return shown[-1]

    reachable = [moving_mean(v * length, 7) or 0.0 for v in np.geomspace(1e-3, 1e3, 400)]
    nearest = min(reachable, key=lambda found: abs(found - px))
    if abs(nearest / px - 1) > 0.05:
        with pytest.raises(ValueError, match="cannot be reached"):
            answer.speed_for(px, motion, "scene")
        return
    speed, reached = answer.speed_for(px, motion, "scene")
    assert reached == pytest.approx(px, rel=0.05)
    assert moving_mean(speed * length, 7) == pytest.approx(reached, rel=1e-3)
    assert len(shown) <= 10


def test_still_scenes_and_motions_out_of_reach_are_refused():
    with pytest.raises(ValueError, match=r"wall: nothing in it moves, so --px 3 cannot be reached; leave --px out"):
        answer.speed_for(3.0, lambda speed: 0.0, "wall")
    with pytest.raises(ValueError, match=r"snail: --px 3 cannot be reached; speed factor 1000 gives 0.5 px"):
        answer.speed_for(3.0, lambda speed: 5e-4 * speed, "snail")


def test_a_clip_is_made_faster_by_whole_factors(clip, tmp_path, capsys):
    assert answer.step_for(14.0, clip) == (2, pytest.approx(14))
    with pytest.raises(ValueError, match="moves 7 px per 3-bit frame, and a clip can only be made faster"):
        answer.step_for(3.0, clip)
    still = write_clip(tmp_path / "still", 8, 0)
    with pytest.raises(ValueError, match="nothing in it moves"):
        answer.step_for(3.0, still)
    assert main(["tradeoff", str(clip.path), "--px", "14", "--ppp", "0.65", "--bits", "1,2"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "--px 14: speed factor 2 gives 14 px per 3-bit frame (7 planes), mean of what moves"
    assert lines[-1].startswith("at 14 px per 3-bit frame and 0.65 photons per plane: planes ")


def test_an_optimum_at_the_edge_is_marked(clip):
    """Dim and slow wants many bits; the sentence says how much the neighbours lose."""
    found = study(clip, Question(bits=(1, 2), ppp=0.1, instants=4))
    assert answer.at_edge(found, "multibit") == ">="
    assert answer.marked(found, "multibit") == ">= 2"
    said = answer.answer(found)
    lost = found.best("multibit").psnr_db - rows_of(found, "multibit")[0].psnr_db
    assert f"multibit >= 2 bits, 1 bit is {lost:.1f} dB worse (the deepest tried: try --bits 1,...,4)" in said
    deep = study(clip, Question(bits=(4, 5), ppp=30.0, instants=2))
    assert answer.at_edge(deep, "multibit") == "<="


def test_the_range_is_widened_until_the_best_is_inside(clip):
    told = []
    found = answer.widened(clip, Question(bits=(1, 2), ppp=0.65, instants=2), told.append)
    assert len(told) == len(found.bits) - 2
    edges = [answer.at_edge(found, model) for model in clip_study.MODELS]
    assert ">=" not in edges or 2 ** (found.bits[-1] + 1) - 1 > len(clip) or found.bits[-1] == answer.WIDEST
    assert found.bits == tuple(range(1, found.bits[-1] + 1))
    assert len(found.bits) > 2


def test_bits_that_were_given_are_kept_and_others_widened(clip, capsys):
    import json

    words = ["tradeoff", str(clip.path), "--ppp", "0.1", "--instants", "2", "--json"]
    assert main([*words, "--bits", "1,2"]) == 0
    given = json.loads(capsys.readouterr().out)
    assert given["best"]["multibit"]["edge"] == ">="
    assert {row["bits"] for row in given["rows"]} == {1, 2}
    assert main(words) == 0
    found = json.loads(capsys.readouterr().out)
    assert {row["bits"] for row in found["rows"]} >= {1, 2, 3, 4, 5}
    assert found["answer"].startswith("at 7 px per 3-bit frame and 0.1 photons per plane: ")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("--table CLIP", "--table is made from numbers alone; leave the clip or scene out"),
        ("--table --ppp 1", "tradeoff --table: --ppp changes nothing here"),
        ("--table --px 1", "tradeoff --table: --px changes nothing here"),
        ("--table --speed 2", "tradeoff --table: --speed changes nothing here"),
        ("--table --sensor spad-320x240", "tradeoff --table: --sensor changes nothing here"),
        ("--table --plane-sensor quiver-paper", "tradeoff --table: --plane-sensor changes nothing here"),
        ("--table --instants 2", "tradeoff --table: --instants changes nothing here"),
        ("--table --frames 2", "tradeoff --table: --frames changes nothing here"),
        ("--table --seed 0", "tradeoff --table: --seed changes nothing here"),
        ("--table --streams", "tradeoff --table: --streams changes nothing here"),
        ("--table -o x", "tradeoff --table: --output changes nothing here"),
        ("--table --force", "tradeoff --table: --force changes nothing here"),
        ("--table --paper-figure 1", "tradeoff --table: --paper-figure changes nothing here"),
        ("CLIP --ppp 1 --read-noise 0", "tradeoff of a clip or scene: --read-noise changes nothing here"),
        ("CLIP --ppp 1 --motion 10", "tradeoff of a clip or scene: --motion changes nothing here"),
        ("CLIP --ppp 1 --size 8x8", "tradeoff of a clip: --size changes nothing here"),
        ("CLIP --ppp 1 --base-fps 20000", "tradeoff of a clip: --base-fps changes nothing here"),
        ("CLIP --ppp 1 --frames 9", "tradeoff of a clip: --frames changes nothing here"),
        ("CLIP --ppp 1 --force", "tradeoff without --output: --force changes nothing here"),
        ("CLIP --ppp 1 --px 3 --speed 2", "not allowed with argument"),
        ("CLIP --ppp 1 --px 13.9,14", "need one and the same speed; give fewer"),
        ("CLIP --ppp 1,2 --streams -o x", "--streams: writes one speed and one light level"),
        ("CLIP --ppp 1 --speed 2 --bits 1,2 --streams -o x", "--streams: writes a clip at its own speed"),
        ("--paper-figure 1 --ppp 1 -o x", "tradeoff --paper-figure: --ppp changes nothing here"),
        ("--paper-figure 1 --px 1 -o x", "tradeoff --paper-figure: --px changes nothing here"),
        ("--paper-figure 1 --bits 1 -o x", "tradeoff --paper-figure: --bits changes nothing here"),
        ("--paper-figure 1 --base-fps 1 -o x", "tradeoff --paper-figure: --base-fps changes nothing here"),
        ("--paper-figure 1 --sensor a -o x", "tradeoff --paper-figure: --sensor changes nothing here"),
        ("--paper-figure 1 --instants 1 -o x", "tradeoff --paper-figure: --instants changes nothing here"),
        ("--paper-figure 1 --frames 1 -o x", "tradeoff --paper-figure: --frames changes nothing here"),
        ("--paper-figure 1 --streams -o x", "tradeoff --paper-figure: --streams changes nothing here"),
        ("--paper-figure 1 --motion 1 -o x", "tradeoff --paper-figure: --motion changes nothing here"),
        ("--paper-figure 1 --speed 1,2 -o x", "--paper-figure draws one speed; give one"),
        ("--paper-figure 1 CLIP --speed 2 -o x", "tradeoff --paper-figure of a clip: --speed changes nothing here"),
        ("--paper-figure 1 CLIP --size 8x8 -o x", "tradeoff of a clip: --size changes nothing here"),
    ],
)
def test_options_that_cannot_act_are_refused(clip, capsys, tmp_path, monkeypatch, words, message):
    monkeypatch.chdir(tmp_path)
    assert main(["tradeoff", *words.replace("CLIP", str(clip.path)).split()]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_the_motion_of_a_scene_is_that_of_its_clip(tmp_path, capsys):
    """Measured without rendering; the rendered clip then moves so."""
    import json

    words = ["tradeoff", "fan", "--px", "3", "--ppp", "2", "--bits", "1,2", "--size", "24x32", "--frames", "16"]
    assert main([*words, "-o", str(tmp_path / "out"), "--json", "-q"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["px_asked"] == [3.0]
    assert found["motion_px_per_code_frame"] == pytest.approx(3.0, rel=0.1)
