"""One table: equal codes for all methods, resumed rows, failures with reasons, the PSNR of the truth."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from clips import ClipMaker, colour_clip, sliding_pattern
from methods import broken, method
from numpy import ndarray as Array
from sensor_files import QIS, sensor_file

from qsim import descriptions, files
from qsim.clip.clip_info import RELATIVE, RenderInfo
from qsim.clip.writer import ClipWriter
from qsim.optics.radiometry import RGB
from qsim.streams.clip import Clip
from qsim.streams.code_truth import CodeTruth
from qsim.streams.exposures import Timing
from qsim.streams.sensing import Sensing
from qsim.streams.storing import sense
from quiver.cli.program import main
from quiver.data.clips import open_clips
from quiver.data.codes import Codes, sensed, stream_codes
from quiver.data.illumination import Illumination
from quiver.evaluation import breakdown, metrics, summary
from quiver.evaluation import comparison as comparison_module
from quiver.evaluation.comparison import (
    Comparison,
    ComparisonRow,
    begin,
    evaluate,
    score_video,
    scored_frames,
    truth_psnr,
)
from quiver.evaluation.comparison_rows import append, finished
from quiver.restoration.interface import Restorer
from quiver.restoration.restorers import restorer


def oracle(source: Path, factor: float = 1.0) -> Restorer:
    """A restorer with the truth of every clip at 3.25 PPP; `factor` is its error of brightness."""
    known = {clip.name: clip for clip in open_clips(source)}

    def restore(codes: Codes) -> Array:
        clip = known[codes.name.split(",")[0]]
        return factor * sensed(clip, Illumination())[1].video()

    return method(f"oracle {factor:g}", restore)


def test_a_known_truth_scores_what_it_should(tiny_dataset):
    """Perfect: infinite. One tenth too dark: 20 log10 of a tenth of the truth's rms; matched: infinite."""
    comparison = Comparison(str(tiny_dataset))
    rows = evaluate(comparison, [oracle(tiny_dataset), oracle(tiny_dataset, 0.9)])
    assert [row.method for row in rows] == ["oracle 1", "oracle 0.9"] * 2
    perfect = rows[0].score
    dark = rows[1].score
    assert perfect.psnr > 120
    assert dark.psnr_matched > 120
    clip = open_clips(tiny_dataset, "test")[0]
    x = sensed(clip, Illumination())[1].video() / 8.125
    assert x.max() < 1
    expected = np.mean([-20 * math.log10(0.1 * math.sqrt(np.mean(frame**2))) for frame in x])
    assert dark.psnr == pytest.approx(expected, abs=1e-3)
    assert dark.scale == pytest.approx(1 / 0.9, rel=1e-6)


def test_all_methods_see_the_same_codes(tiny_dataset):
    seen: list[Array] = []

    def look(codes: Codes) -> Array:
        seen.append(codes.read(0, codes.shape[0]))
        return np.ones(codes.shape)

    evaluate(Comparison(str(tiny_dataset)), [method("a", look), method("b", look)])
    evaluate(Comparison(str(tiny_dataset)), [method("c", look)])
    np.testing.assert_array_equal(seen[0], seen[1])
    np.testing.assert_array_equal(seen[0], seen[4])
    assert not np.array_equal(seen[0], seen[2])


def test_an_interrupted_evaluation_goes_on(tiny_dataset, tmp_path):
    calls: list[str] = []

    def count(codes: Codes) -> Array:
        calls.append(codes.name)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return np.ones(codes.shape)

    comparison = Comparison(str(tiny_dataset))
    out = tmp_path / "table"
    with pytest.raises(KeyboardInterrupt):
        evaluate(comparison, [method("slow", count)], out)
    with open(out / "rows.jsonl", "a") as file:
        file.write('{"method": "slow", "torn')
    rows = evaluate(comparison, [method("slow", count)], out)
    assert len(rows) == 2
    assert len(calls) == 3
    assert evaluate(comparison, [method("slow", count)], out) == rows
    assert len(calls) == 3
    evaluate(comparison, [replace(method("slow", count), description="other weights")], out)
    assert len(calls) == 5
    with pytest.raises(FileExistsError, match="holds another evaluation"):
        evaluate(replace(comparison, seed=1), [method("slow", count)], out)
    with pytest.raises(FileExistsError, match="is not an evaluation"):
        begin(comparison, tmp_path, open_clips(str(tiny_dataset), "test"))


def test_rows_of_another_precision_or_cut_are_not_taken(make_clip: ClipMaker, tmp_path):
    comparison = Comparison(str(make_clip(frames=4, height=12, width=16).path), None)
    out = tmp_path / "t"
    calls: list[str] = []

    def network(precision: str = "float32", cut: str = "") -> Restorer:
        def restore(codes: Codes) -> Array:
            calls.append(f"{precision} {cut}")
            return np.ones(codes.shape)

        found = method("net", restore, learned=True)
        return replace(found, identity={"precision": precision}, cut=lambda height, width: cut)

    evaluate(comparison, [network()], out)
    lines = (out / "rows.jsonl").read_text().splitlines()
    assert (json.loads(lines[0])["precision"], json.loads(lines[0])["cut"]) == ("float32", "")
    runs = [{}, {"precision": "bfloat16"}, {"cut": "4 tiles of at most 9 x 12"}, {"precision": "bfloat16"}, {}]
    rows = [evaluate(comparison, [network(**run)], out)[0] for run in runs]
    assert calls == ["float32 ", "bfloat16 ", "float32 4 tiles of at most 9 x 12"]
    assert [row.precision for row in rows] == ["float32", "bfloat16", "float32", "bfloat16", "float32"]


def test_a_run_without_memory_for_a_tile_is_a_failure(make_clip: ClipMaker):
    def no_tile(height: int, width: int) -> str:
        raise ValueError("raise --memory")

    def restore(codes: Codes) -> Array:
        raise ValueError("raise --memory")

    row = evaluate(Comparison(str(make_clip(frames=4).path), None), [replace(method("net", restore), cut=no_tile)])[0]
    assert row.failure == "ValueError: raise --memory"


def test_rows_of_an_edited_sensor_file_are_not_mixed(make_clip: ClipMaker, tmp_path):
    """Its numbers and maps count, not its comments."""
    np.save(tmp_path / "gain.npy", np.full((36, 44), 1.1))
    file = sensor_file(tmp_path, QIS + 'gain_map = "gain.npy"\n', 3)
    comparison = Comparison(str(make_clip(frames=4).path), None, (Illumination.of(file, 3.25, None),))
    methods = [restorer("moment:1")]
    out = tmp_path / "t"
    rows = evaluate(comparison, methods, out)
    assert list(json.loads((out / "plan.json").read_text())["sensors_sha256"]) == [file]
    sensor_file(tmp_path, QIS + '# measured on a Monday\ngain_map = "gain.npy"\n', 3)
    assert evaluate(comparison, methods, out) == rows
    before = (out / "rows.jsonl").read_bytes()
    for edited in ("number", "map"):
        if edited == "number":
            sensor_file(tmp_path, QIS.replace("0.8", "0.7") + 'gain_map = "gain.npy"\n', 3)
        else:
            sensor_file(tmp_path, QIS + 'gain_map = "gain.npy"\n', 3)
            np.save(tmp_path / "gain.npy", np.full((36, 44), 1.2))
        with pytest.raises(FileExistsError, match="rows of clips, streams or sensors that were changed since"):
            evaluate(comparison, [*methods, restorer("naive")], out)
    assert (out / "rows.jsonl").read_bytes() == before


def test_two_sensors_at_one_light_level_are_both_scored(make_clip: ClipMaker, tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    noisy = QIS.replace("read_noise = 0.2", "read_noise = 0.9")
    one = sensor_file(tmp_path / "a", QIS, 3)
    two = sensor_file(tmp_path / "b", noisy, 3)
    clip = make_clip(frames=4)
    for sensors, named in ((("quiver-physical", "spad-320x240"),) * 2, ((one, two), ("a/mine.toml", "b/mine.toml"))):
        lights = tuple(Illumination.of(sensor, 3.25, 3) for sensor in sensors)
        comparison = Comparison(str(clip.path), None, lights)
        out = tmp_path / Path(sensors[1]).stem
        rows = evaluate(comparison, [restorer("moment")], out)
        assert [row.light for row in rows] == [f"3.25 PPP, 3 bit, {name}" for name in named]
        assert rows[0].score != rows[1].score
        assert [line.light for line in summary.summarise(rows)] == [row.light for row in rows]
        summary.write(out, comparison, [restorer("moment")], rows)
        assert len(list(out.glob("crops_*.png"))) == 2
    with pytest.raises(ValueError, match=r"two different lights are both called '3\.25 PPP, 3 bit, quiver-physical'"):
        Comparison(str(clip.path), None, (Illumination(), Illumination.of(ppp=3.25000001)))


@pytest.mark.parametrize("changed", ["codes", "light"])
def test_an_evaluation_of_other_codes_or_another_truth_is_not_continued(make_clip, tmp_path, changed):
    """Rows of a stream that was sensed again, or of a clip that was made again, are not mixed with new ones."""
    clip = make_clip(frames=4, height=12, width=16)
    sense(clip, Sensing("quiver-physical", bits=3, ppp=3.25, name="s"))
    comparison = Comparison(str(clip.path), stream="s")
    methods = [method("ones", lambda codes: np.ones(codes.shape))]
    evaluate(comparison, methods, tmp_path / "t")
    before = (tmp_path / "t" / "rows.jsonl").read_bytes()
    evaluate(comparison, methods, tmp_path / "t")
    if changed == "codes":
        sense(clip, Sensing("quiver-physical", bits=3, ppp=3.25, seed=5, name="s"), force=True)
    else:
        description = clip.path / "clip.json"
        meta = json.loads(description.read_text()) | {"scene": {"family": "sliding", "seed": 9}}
        descriptions.write_values(description, meta)
    with pytest.raises((FileExistsError, ValueError), match="changed since"):
        evaluate(comparison, methods, tmp_path / "t")
    assert (tmp_path / "t" / "rows.jsonl").read_bytes() == before


def test_a_failure_keeps_its_row_and_reason(tiny_dataset, tmp_path):
    comparison = Comparison(str(tiny_dataset))
    methods = [method("broken", broken), restorer("moment:1")]
    rows = evaluate(comparison, methods, tmp_path / "t")
    assert [row.failure for row in rows[:2]] == ["RuntimeError: no road leads there", None]
    summary.write(tmp_path / "t", comparison, methods, rows)
    text = (tmp_path / "t/evaluation.md").read_text()
    assert "failed: test_0000: RuntimeError: no road leads there" in text
    assert "- broken, 3.25 PPP, 3 bit, test_0001: RuntimeError" in text
    assert [row.method for row in finished((tmp_path / "t/rows.jsonl").read_text().splitlines())] == ["moment:1"] * 2


def test_truth_psnr_is_the_radiance_error_in_units_of_white(make_clip: ClipMaker):
    """Relative clip, mean 1 by construction of the factor: rms 0.01 of radiance is 0.01 * 3.25 / mean of 8.125."""
    clip = make_clip(relative=True, error=0.01)
    _, truth = sensed(clip, Illumination())
    light = sliding_pattern(len(clip), *clip.shape[1:], 0)
    rounded = [np.sqrt(np.mean((light[t] - clip.radiance(t)) ** 2)) for t in range(4)]  # to half floats, 2e-4
    error = math.sqrt(0.01**2 + np.mean(np.square(rounded)))
    expected = -20 * math.log10(error * (3.25 / clip.mean_radiance) / 8.125)
    assert truth_psnr(truth, 8.125, range(4)) == pytest.approx(expected)
    assert truth_psnr(replace(truth, clip=make_clip("unknown", error=None)), 8.125, range(4)) is None
    # Measured clamped at white, it counts up to 2.5 x the mean light; a higher peak takes the unclamped one.
    info = replace(clip.info, error_at_white_per_frame=[0.005] * len(clip))
    halved = replace(truth, clip=replace(clip, info=info))
    half = -20 * math.log10(0.005 * (3.25 / clip.mean_radiance) / 8.125)
    assert truth_psnr(halved, 8.125, range(4)) == pytest.approx(half)
    assert truth_psnr(halved, 16.25, range(4)) == truth_psnr(truth, 16.25, range(4))


def test_truth_psnr_of_sums_is_that_of_their_sharp_middles(make_clip: ClipMaker):
    """Frames of planes have ten times the noise of the sharp frame in the middle of a code."""
    made = make_clip(relative=True, error=0.01)
    clip = replace(made, info=replace(made.info, error_at_white_per_frame=()))
    _, truth = sensed(clip, Illumination.of("spad-320x240", 3.25, None).over(3))
    alone = truth_psnr(truth, 8.125, range(2))
    codes = tuple(0.1 * error for error in clip.info.error_per_frame[1::3])
    info = replace(clip.info, error_per_code=codes, render=RenderInfo(planes=3, codes=(3,)))
    assert truth_psnr(replace(truth, clip=replace(clip, info=info)), 8.125, range(2)) == pytest.approx(alone + 20)
    shifted = replace(info, render=RenderInfo(planes=5, codes=(5,)))  # codes that begin elsewhere have other middles
    assert truth_psnr(replace(truth, clip=replace(clip, info=shifted)), 8.125, range(1)) < alone + 1


def bright_clip(make_clip: ClipMaker, share: float, **options: object):
    """A clip in which this many pixels are about nine times as bright as the others."""
    rng = np.random.default_rng(9)
    radiance = rng.uniform(0.8, 1.2, (12, 24, 30)) * np.where(rng.random((24, 30)) < share, 9.0, 1.0)
    return make_clip(f"bright_{share:g}", radiance=radiance, **options)


def test_every_sensor_is_scored_at_one_peak(make_clip: ClipMaker):
    """2.5 times the light, for any sensor: no score is infinite, and the same pixels lie above the peak."""
    clip = bright_clip(make_clip, 0.1)
    rng = np.random.default_rng(10)
    sensors = [("spad-320x240", 1), ("quiver-physical", 3), ("quiver-paper", 5), ("megax-b", 4), ("qis-ma2017", 1)]
    methods = [restorer("naive"), restorer("moment:3")]
    for sensor, bits in sensors:
        ppp = float(np.exp(rng.uniform(np.log(0.3), np.log(100))))
        rows = evaluate(Comparison(str(clip.path), None, (Illumination.of(sensor, ppp, bits),)), methods)
        assert [row.failure for row in rows] == [None, None]
        assert [row.peak for row in rows] == pytest.approx([2.5 * ppp] * 2)
        light = clip.mean_radiance  # of light in units of the peak: radiance / (2.5 mean)
        above = np.mean([clip.sharp(t) > 2.5 * light for t in range(len(clip))])
        assert rows[0].score.above_peak == pytest.approx(above)
        assert all(math.isfinite(row.score.psnr) and row.score.psnr_matched >= row.score.psnr for row in rows)


def test_another_peak_moves_scores_by_its_ratio(make_clip: ClipMaker):
    """With nothing above either peak, twice the peak is 6.02 dB more, and the matching factor stays."""
    comparison = Comparison(str(make_clip().path), None)
    one, two = (evaluate(replace(comparison, peak=peak), [restorer("moment")])[0] for peak in (40.0, 80.0))
    assert two.score.psnr - one.score.psnr == pytest.approx(20 * math.log10(2), abs=1e-6)
    assert two.score.scale == pytest.approx(one.score.scale)
    assert two.truth_psnr - one.truth_psnr == pytest.approx(20 * math.log10(2))
    assert two.peak == 80.0
    with pytest.raises(ValueError, match="number of photons above 0"):
        evaluate(replace(comparison, peak=-1.0), [restorer("moment")])


def test_the_published_protocol_keeps_its_white(make_clip: ClipMaker):
    """Peak = white of the sensor as published; the gain that its program derives from the light gives 2.5 times it."""
    clip = make_clip()
    paper = Comparison(str(clip.path), None, (Illumination.of("quiver-paper"),), published=True)
    assert evaluate(paper, [restorer("moment")])[0].peak == pytest.approx(7 / 0.8)
    published = replace(paper, lights=(Illumination.of("quiver-published"),))
    assert evaluate(published, [restorer("moment")])[0].peak == pytest.approx(2.5 * 3.25)
    assert evaluate(replace(paper, peak=3.0), [restorer("moment")])[0].peak == 3.0
    assert "the sensor's white, as published" in summary.peak_name(paper)


def test_saturated_pixels_count_nowhere(tmp_path):
    """Half of a recording is saturated: a method with errors there alone scores as one without errors."""
    mask = np.zeros((24, 30), bool)
    mask[:, 15:] = True
    meta = {"shape": [12, 24, 30], "frame_rate": 2000.0, "exposure": 5e-4, "radiance_unit": RELATIVE, "camera": None}
    rng = np.random.default_rng(14)
    with ClipWriter(tmp_path / "recorded", meta) as writer:
        for t in range(12):
            writer.add(t, rng.uniform(0.5, 1.5, (24, 30)), saturated=mask)
    clip = open_clips(tmp_path / "recorded")[0]
    exact = sensed(clip, Illumination())[1].video()
    noise = rng.normal(0, 1, exact.shape)
    spoilt = method("spoilt", lambda codes: exact + 0.1 * noise + np.where(mask, 5.0, 0.0))
    rows = evaluate(Comparison(str(clip.path), None), [spoilt, method("whole", lambda codes: exact + 0.1 * noise)])
    assert rows[0].score == rows[1].score
    assert rows[0].score.psnr > 35


def test_published_windows_are_counted_as_published():
    """All but the first and last five frames: 345 of 15 clips of 33; 6017 of 31 clips with 6327 frames."""
    assert sum(len(scored_frames(33, True)) for _ in range(15)) == 345
    lengths = [204] * 30 + [6327 - 30 * 204]
    assert sum(len(scored_frames(n, True)) for n in lengths) == 6017
    assert list(scored_frames(12, True)) == [5, 6]
    assert len(scored_frames(9, True)) == 0
    assert len(scored_frames(9, False)) == 9


def test_published_protocol_forces_every_window(tiny_dataset):
    """Every restored frame comes from a window of eleven with a mean of 3.25 PPP and a separate factor."""
    levels: list[float] = []

    def look(codes: Codes) -> Array:
        stack = codes.read(0, codes.shape[0])
        levels.append(float(stack.mean()))
        return stack.astype(np.float32)

    rows = evaluate(Comparison(str(tiny_dataset), published=True), [method("look", look)])
    assert rows[0].score.frames == 14 - 10
    assert len(levels) == 2 * 4
    assert max(levels) - min(levels) < 0.1
    assert rows[0].score.scale_spread > 0
    with pytest.raises(ValueError, match="give ppp="):
        evaluate(
            Comparison(str(tiny_dataset), lights=(Illumination.of("quiver-paper", None),), published=True),
            [method("x", look)],
        )


def test_published_crops_show_the_codes_that_methods_saw(make_clip: ClipMaker, tmp_path):
    """Of the middle window, not of the clip at one exposure."""
    seen: list[Array] = []

    def look(codes: Codes) -> Array:
        seen.append(codes.read(5, 6)[0])
        return codes.read(0, codes.shape[0]).astype(np.float32)

    clip = make_clip()
    out = tmp_path / "table"
    row = evaluate(Comparison(str(clip.path), None, published=True), [method("look", look)], out)[0]
    assert row.failure is None
    frames = scored_frames(len(clip), True)
    wanted = seen[len(frames) // 2][breakdown.place(CodeTruth(clip, Timing()), frames[len(frames) // 2])] / 7
    stored = files.load_array(breakdown.crop_file(out, row.light, clip.name, "codes"))
    np.testing.assert_array_equal(stored, wanted.astype(np.float16))


def test_published_windows_of_a_sensor_with_defects_are_refused(tiny_dataset, tmp_path):
    """They are drawn without defects; nothing is written."""
    text = '[sensor]\nmodel = "QIS"\nquantum_efficiency = 0.8\ndark_current = 1.6\nread_noise = 0.2\nbits = 3\n'
    (tmp_path / "clean.toml").write_text(text)
    (tmp_path / "worn.toml").write_text(text + "[defects]\ndead = 0.1\n")
    clean, worn = (
        Comparison(str(tiny_dataset), lights=(Illumination.of(str(tmp_path / name), 3.25, None),), published=True)
        for name in ("clean.toml", "worn.toml")
    )
    assert evaluate(clean, [restorer("naive")])[0].failure is None
    with pytest.raises(ValueError, match=r"worn\.toml has a table \[defects\]"):
        evaluate(worn, [restorer("naive")], tmp_path / "table")
    assert not (tmp_path / "table").exists()
    assert evaluate(replace(worn, published=False), [restorer("naive")])[0].failure is None


def test_published_windows_of_a_spike_camera_are_refused(tiny_dataset, tmp_path, capsys):
    """They were drawn as planes without a memory."""
    text = '[sensor]\nmodel = "SpikeCamera"\nquantum_efficiency = 0.6\ndark_current = 0.0\nthreshold = 9\n'
    (tmp_path / "spike.toml").write_text(text)
    words = ["--methods", "naive", "--published", "--sensor", str(tmp_path / "spike.toml")]
    assert main(["evaluate", str(tiny_dataset), "-o", str(tmp_path / "table"), *words]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert "the charge of a spike camera" in said
    assert not (tmp_path / "table").exists()


def test_stored_streams_are_scored(tiny_dataset, make_clip: ClipMaker):
    from qsim.streams.sensing import Sensing
    from qsim.streams.storing import sense

    clip = make_clip()
    sense(clip, Sensing("quiver-physical", bits=3, ppp=3.25, name="mine"))
    stored = evaluate(Comparison(str(clip.path), None, stream="mine"), [restorer("moment")])
    drawn = evaluate(Comparison(str(clip.path), None), [restorer("moment")])
    assert stored[0].score == drawn[0].score
    assert stored[0].light == "mine"
    with pytest.raises(FileNotFoundError, match="no stream 'none'; there are: mine"):
        evaluate(Comparison(str(clip.path), None, stream="none"), [restorer("moment")])


@pytest.mark.parametrize("peak", [None, 5.0])
def test_a_video_has_the_score_that_an_evaluation_of_its_stream_has(make_clip: ClipMaker, peak: float | None):
    clip = make_clip(sharp=True)
    stream = clip.sense(ppp=3.25, bits=3, name="mine")
    row = evaluate(Comparison(str(clip.path), None, stream="mine", peak=peak), [restorer("moment")])[0]
    found = score_video(restorer("moment").restore(stream_codes(stream)), stream, peak=peak)
    assert found.psnr == pytest.approx(row.score.psnr, rel=1e-9)
    assert found.to_dict() == pytest.approx(row.score.to_dict(), rel=1e-6)


def test_a_video_of_another_shape_or_without_truth_is_refused(make_clip: ClipMaker):
    stream = make_clip(frames=4).sense(ppp=3.25, bits=3)
    with pytest.raises(ValueError, match=r"video has shape \[3, .* stream \[4, "):
        score_video(stream.truth(0, 3), stream)
    assert score_video(stream.truth(), stream).psnr == math.inf


def test_unknown_pixels_of_a_stream_have_no_score(tmp_path):
    mask = np.zeros((2, 9, 9), bool)
    mask[:, 4:6] = True
    meta = {"shape": [2, 9, 9], "frame_rate": 2000.0, "exposure": 5e-4, "radiance_unit": RELATIVE}
    with ClipWriter(tmp_path / "s", meta) as writer:
        for t in range(2):
            writer.add(t, np.full((9, 9), 2.0), saturated=mask[t])
    stream = Clip.open(tmp_path / "s").sense("quiver-paper", ppp=2.0)
    video = stream.truth()
    video[mask] = 0
    assert score_video(video, stream).psnr == math.inf


def test_nothing_to_score_is_an_error(tmp_path, tiny_dataset):
    with pytest.raises(FileNotFoundError, match="no such data set"):
        evaluate(Comparison(str(tmp_path / "none")), [restorer("moment")])
    with pytest.raises(ValueError, match="unknown split 'tset'"):
        evaluate(Comparison(str(tiny_dataset), "tset"), [restorer("moment")])


def test_a_colour_clip_is_refused_as_published_before_anything_is_written(tmp_path):
    clip = colour_clip(tmp_path / "colour", frames=12)
    with pytest.raises(ValueError, match="holds three bands"):
        evaluate(Comparison(str(clip.path), None, published=True), [restorer("naive")], tmp_path / "table")
    assert not (tmp_path / "table").exists()


def test_rows_survive_json(tmp_path):
    row = ComparisonRow("m", "d", "l", "c", "s", failure="why")
    append(tmp_path / "rows", row)
    assert math.isnan(ComparisonRow.from_dict(json.loads((tmp_path / "rows").read_text())).seconds_per_frame)


def test_infinite_scores_survive_json(tmp_path):
    """An exact answer has an infinite PSNR. It was stored as null, and a resumed table had another mean."""
    score = metrics.Score(math.inf, math.inf, 1.0, 1.0, 1.0, 0.0, frames=3, above_peak=0.0)
    row = ComparisonRow("m", "d", "l", "c", "s", score, 0.1, 5, 8.0, truth_psnr=math.inf, motion_squares=(0.0, 1.0))
    append(tmp_path / "rows", row)
    append(tmp_path / "rows", replace(row, clip="low", score=replace(score, psnr=-math.inf)))
    text = (tmp_path / "rows").read_text()
    assert list(finished(text.splitlines())) == [row, replace(row, clip="low", score=replace(score, psnr=-math.inf))]
    assert {"psnr": "inf", "psnr_matched": "inf"}.items() <= json.loads(text.splitlines()[0])["score"].items()


def test_memory_is_that_of_the_device_of_the_method(make_clip: ClipMaker, monkeypatch):
    kinds: list[str] = []

    class Peak:
        def __init__(self, kind: str) -> None:
            kinds.append(kind)

        def bytes(self) -> int:
            return 1000 * len(kinds)

    monkeypatch.setattr(comparison_module, "PeakMemory", Peak)
    ones = method("ones", lambda codes: np.ones(codes.shape))
    comparison = Comparison(str(make_clip(frames=3).path), None)
    methods = [ones, replace(ones, name="on a GPU", learned=True, device="cuda")]
    rows = evaluate(comparison, methods)
    assert kinds == ["cpu", "cuda"]
    assert [row.peak_bytes for row in rows] == [1000, 2000]
    assert [row.device for row in rows] == ["cpu", "cuda"]
    assert [line["devices"] for line in summary.as_dict(comparison, methods, rows)["table"]] == [["cpu"], ["cuda"]]


def test_the_spread_of_factors_is_over_clips(tiny_dataset):
    """It was 0.000 where the mean of a clip's equal factors is rounded."""
    known = {clip.name: clip for clip in open_clips(tiny_dataset)}

    def restore(codes: Codes) -> Array:
        clip = known[codes.name.split(",")[0]]
        at = sorted(known).index(clip.name)
        return sensed(clip, Illumination())[1].video() / (0.7 + 0.1 * at)

    rows = evaluate(Comparison(str(tiny_dataset)), [method("off", restore)])
    factors = [row.score.scale for row in rows]
    (line,) = summary.summarise(rows)
    assert line.scale_spread == pytest.approx(np.std(factors))


def test_two_clips_of_one_name_are_refused(make_clip: ClipMaker, tmp_path):
    """A renamed folder keeps the name of its clip: the second one got the row of the first."""
    for seed in (0, 1):
        make_clip("same", seed=seed).path.rename(tmp_path / f"folder_{seed}")
    with pytest.raises(ValueError, match="two clips are called same, by which rows are kept"):
        evaluate(Comparison(str(tmp_path), split=None), [method("any", lambda codes: codes.read(0, codes.shape[0]))])


def test_the_table_of_a_stored_stream_states_no_seed_of_its_own(make_clip: ClipMaker, tmp_path):
    sense(make_clip("c"), Sensing("quiver-physical", 3, ppp=3.25, seed=5, name="s"))
    comparison = Comparison(str(tmp_path), split=None, stream="s")
    assert "noise seed" not in summary.markdown(comparison, [], [])
    assert "noise seed 0" in summary.markdown(replace(comparison, stream=None), [], [])


def test_a_colour_clip_with_saturated_pixels_is_scored(tmp_path):
    """They are counted and not stored: the mask of one band failed against three."""
    meta = {"frame_rate": 2000.0, "exposure": 5e-4, "radiance_unit": RELATIVE, "camera": None, "bands": list(RGB)}
    mask = np.zeros((3, 16, 18), bool)
    mask[:, 4, 5] = True
    with ClipWriter(tmp_path / "c", meta | {"shape": [3, 16, 18]}) as writer:
        for t in range(3):
            writer.add(t, np.full((3, 16, 18), 0.5), saturated=mask)
    clip = Clip.open(tmp_path / "c")
    assert clip.info.saturated_pixels > 0
    stream = clip.sense("quiver-physical", ppp=3.25, bits=3, colour="rggb", name="s")
    assert stream.known() is None
