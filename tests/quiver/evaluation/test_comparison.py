"""One table: equal codes for all, resumed rows, failures with reasons, the truth's own worth, real static photons."""

from __future__ import annotations

import contextlib
import json
import math
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from clips import ClipMaker
from numpy import ndarray as Array

from qsim import files
from qsim.clip.manifest import RELATIVE
from qsim.clip.sensing import Sensing, sense
from qsim.clip.writer import ClipWriter
from quiver.data.clips import open_clips, truth
from quiver.data.codes import Codes, array_codes, sensed
from quiver.data.illumination import Illumination, ideal_counter
from quiver.data.photon_counts import Counts, read_counts
from quiver.evaluation import summary
from quiver.evaluation.comparison import (
    Comparison,
    ComparisonRow,
    append,
    begin,
    evaluate,
    finished,
    scored_frames,
    truth_psnr,
)
from quiver.evaluation.static_object import evaluate_static, markdown, mean_square, reference
from quiver.restoration.interface import Restorer
from quiver.restoration.restorers import restorer

HAZELNUT = Path(__file__).parents[2] / "data" / "hazelnut_gates6.npz"


def method(name: str, restore: object, learned: bool = False) -> Restorer:
    """A restorer from a function of (codes) -> photons [T, H, W]."""

    def fill(codes: Codes, out: Array, first: int, progress: object) -> None:
        out += restore(codes)[first : first + len(out)]

    return Restorer(name, 1, 0, learned, f"test {name}", fill)


def oracle(source: Path, factor: float = 1.0) -> Restorer:
    """Knows the truth of every clip at 3.25 PPP; `factor` is its error of brightness."""
    known = {clip.name: clip for clip in open_clips(source)}

    def restore(codes: Codes) -> Array:
        clip = known[codes.name.split(",")[0]]
        return factor * truth(clip, sensed(clip, Illumination())[1], 0, len(clip))

    return method(f"oracle {factor:g}", restore)


def broken(codes: Codes) -> Array:
    raise RuntimeError("no road\nleads there")


def test_a_known_truth_scores_what_it_should(tiny_dataset):
    """Perfect: infinite. One tenth too dark: 20 log10 of a tenth of the truth's rms; matched: infinite."""
    comparison = Comparison(str(tiny_dataset))
    rows = evaluate(comparison, [oracle(tiny_dataset), oracle(tiny_dataset, 0.9)])
    assert [row.method for row in rows] == ["oracle 1", "oracle 0.9"] * 2
    perfect, dark = rows[0].score, rows[1].score
    assert perfect.psnr > 120
    assert dark.psnr_matched > 120
    clip = open_clips(tiny_dataset, "test")[0]
    x = truth(clip, sensed(clip, Illumination())[1], 0, 14) / 8.125
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

    comparison, out = Comparison(str(tiny_dataset)), tmp_path / "table"
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
    with pytest.raises(FileExistsError, match="is no evaluation"):
        begin(comparison, tmp_path, open_clips(str(tiny_dataset), "test"))


@pytest.mark.parametrize("changed", ["codes", "light"])
def test_an_evaluation_of_other_codes_or_another_truth_is_not_continued(make_clip, tmp_path, changed):
    """Rows of a stream that was sensed again, or of a clip that was made again, are not mixed with new ones."""
    clip = make_clip(frames=4, height=12, width=16)
    sense(clip, Sensing("quiver-physical", bits=3, ppp=3.25, name="s"))
    comparison, methods = Comparison(str(clip.path), stream="s"), [method("ones", lambda codes: np.ones(codes.shape))]
    evaluate(comparison, methods, tmp_path / "t")
    before = (tmp_path / "t" / "rows.jsonl").read_bytes()
    evaluate(comparison, methods, tmp_path / "t")
    if changed == "codes":
        sense(clip, Sensing("quiver-physical", bits=3, ppp=3.25, seed=5, name="s"), force=True)
    else:
        description = clip.path / "clip.json"
        meta = json.loads(description.read_text()) | {"scene": {"family": "sliding", "seed": 9}}
        files.write_description(description, meta)
    with pytest.raises((FileExistsError, ValueError), match="changed since"):
        evaluate(comparison, methods, tmp_path / "t")
    assert (tmp_path / "t" / "rows.jsonl").read_bytes() == before


def test_a_failure_keeps_its_row_and_reason(tiny_dataset, tmp_path):
    comparison, methods = Comparison(str(tiny_dataset)), [method("broken", broken), restorer("moment:1")]
    rows = evaluate(comparison, methods, tmp_path / "t")
    assert [row.failure for row in rows[:2]] == ["RuntimeError: no road leads there", None]
    summary.write(tmp_path / "t", comparison, methods, rows)
    text = (tmp_path / "t/evaluation.md").read_text()
    assert "failed: test_0: RuntimeError: no road leads there" in text
    assert "- broken, 3.25 PPP, 3 bit, test_1: RuntimeError" in text
    assert [row.method for row in finished((tmp_path / "t/rows.jsonl").read_text().splitlines())] == ["moment:1"] * 2


def test_the_table_holds_what_was_promised(tiny_dataset, tmp_path):
    comparison = Comparison(str(tiny_dataset), lights=(Illumination(), Illumination(ppp=26.0)))
    methods = [restorer("naive"), restorer("moment:3")]
    rows = evaluate(comparison, methods, tmp_path / "t")
    summary.write(tmp_path / "t", comparison, methods, rows)
    found = json.loads((tmp_path / "t/evaluation.json").read_text())
    assert len(found["rows"]) == 2 * 2 * 2
    assert "RVRT" in found["not_built_yet"]
    line = found["table"][1]
    assert (line["method"], line["light"], line["scores"]["psnr"]["scenes"]) == ("moment:3", "3.25 PPP, 3 bit", 2)
    assert line["scores"]["psnr"]["half_width"] > 0
    assert line["truth_psnr"] == pytest.approx(rows[0].truth_psnr, abs=3)
    text = (tmp_path / "t/evaluation.md").read_text()
    assert "| moment:3 | 3 (1) | 26 PPP, 3 bit |" in text
    assert "| sliding:400 | 3.25 PPP, 3 bit |" in text
    assert f"The paper also compares with {', '.join(summary.PAPER_METHODS)}: not built yet." in text
    assert "By motion" not in text  # these clips have no flow
    assert all(row.peak_bytes is not None and 0 <= row.peak_bytes < 2e9 for row in rows)
    for picture in ("evaluation.png", "crops_3.25PPP_3bit.png", "crops_26PPP_3bit.png"):
        assert (tmp_path / "t" / picture).read_bytes().startswith(b"\x89PNG")


def test_truth_psnr_is_the_radiance_error_in_units_of_white(make_clip: ClipMaker):
    """Relative clip, mean 1 by construction of the factor: rms 0.01 of radiance is 0.01 * 3.25 / mean of 8.125."""
    clip = make_clip(relative=True, error=0.01)
    _, factor = sensed(clip, Illumination())
    expected = -20 * math.log10(0.01 * (3.25 / clip.mean_radiance) / 8.125)
    assert truth_psnr(clip, factor, 8.125, range(4)) == pytest.approx(expected)
    assert truth_psnr(make_clip("unknown", error=None), 1.0, 8.125, range(4)) is None
    # Measured clamped at white, it counts up to 2.5 x the mean light; a higher peak takes the unclamped one.
    halved = replace(clip, meta=clip.meta | {"error_at_white_per_frame": [0.005] * len(clip)})
    assert truth_psnr(halved, factor, 8.125, range(4)) == pytest.approx(expected + 20 * math.log10(2))
    assert truth_psnr(halved, factor, 16.25, range(4)) == truth_psnr(clip, factor, 16.25, range(4))


def bright_clip(make_clip: ClipMaker, share: float, **options: object):
    """A clip in which so many pixels are about nine times as bright as the others."""
    rng = np.random.default_rng(9)
    radiance = rng.uniform(0.8, 1.2, (12, 24, 30)) * np.where(rng.random((24, 30)) < share, 9.0, 1.0)
    return make_clip(f"bright_{share:g}", radiance=radiance, **options)


def test_every_sensor_is_scored_at_one_peak(make_clip: ClipMaker):
    """2.5 times the light, whatever the sensor: no score is infinite, and the same pixels lie above the peak."""
    clip = bright_clip(make_clip, 0.1)
    rng = np.random.default_rng(10)
    sensors = [("spad-320x240", 1), ("quiver-physical", 3), ("quiver-paper", 5), ("megax-b", 4), ("qis-ma2017", 1)]
    methods = [restorer("naive"), restorer("moment:3")]
    for sensor, bits in sensors:
        ppp = float(np.exp(rng.uniform(np.log(0.3), np.log(100))))
        rows = evaluate(Comparison(str(clip.path), None, (Illumination(sensor, ppp, bits),)), methods)
        assert [row.failure for row in rows] == [None, None]
        assert [row.peak for row in rows] == pytest.approx([2.5 * ppp] * 2)
        light = clip.mean_radiance  # of light in units of the peak: radiance / (2.5 mean)
        above = np.mean([clip.sharp(t) > 2.5 * light for t in range(len(clip))])
        assert rows[0].score.above_peak == pytest.approx(above)
        assert all(math.isfinite(row.score.psnr) and row.score.psnr_matched >= row.score.psnr for row in rows)


def test_a_one_bit_sensor_in_much_light_is_not_perfect(make_clip: ClipMaker):
    """At 10 PPP every pixel of a 1-bit code lies above its own white: there all guesses were perfect, `moment` inf."""
    comparison = Comparison(
        str(make_clip().path), None, (Illumination("spad-320x240", 1.0, 1), Illumination("spad-320x240", 10.0, 1))
    )
    dim, bright = evaluate(comparison, [restorer("moment")])
    assert bright.score.psnr < dim.score.psnr < 40
    hidden = evaluate(replace(comparison, peak=1.0), [restorer("moment")])[1]
    assert hidden.score.above_peak > 0.9
    assert not math.isinf(hidden.score.psnr)
    text = summary.markdown(replace(comparison, peak=1.0), [restorer("moment")], [dim, hidden])
    assert "peak = 1 photons per pixel" in text
    assert "Warning: 100.0 % of the pixels of sliding_0 at 10 PPP, 1 bit lie above the peak" in text
    assert " inf " not in text


@pytest.mark.parametrize("peak", [1e-6, 1e9])
def test_an_extreme_peak_has_a_table_and_no_foreign_warning(peak, tiny_dataset, tmp_path):
    comparison = Comparison(str(tiny_dataset), peak=peak)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        methods = [restorer("naive")]
        rows = evaluate(comparison, methods, tmp_path / "out")
        summary.write(tmp_path / "out", comparison, methods, rows)
    assert all(row.failure is None for row in rows)
    crops = list((tmp_path / "out/crops").glob("*.npy"))
    assert crops
    assert all(np.isfinite(np.load(crop)).all() for crop in crops)


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
    """Peak = white of the sensor as published; with the default gain that is 2.5 times the light."""
    clip = make_clip()
    paper = Comparison(str(clip.path), None, (Illumination("quiver-paper"),), published=True)
    assert evaluate(paper, [restorer("moment")])[0].peak == pytest.approx(7 / 0.8)
    assert evaluate(replace(paper, lights=(Illumination(),)), [restorer("moment")])[0].peak == pytest.approx(2.5 * 3.25)
    assert evaluate(replace(paper, peak=3.0), [restorer("moment")])[0].peak == 3.0
    assert "the sensor's white, as published" in summary.peak_name(paper)


def test_saturated_pixels_count_nowhere(tmp_path):
    """Half of a recording is saturated: a method that errs there alone is as good as one that errs nowhere."""
    mask = np.zeros((24, 30), bool)
    mask[:, 15:] = True
    meta = {"shape": [12, 24, 30], "frame_rate": 2000.0, "exposure": 5e-4, "radiance_unit": RELATIVE, "camera": None}
    rng = np.random.default_rng(14)
    with ClipWriter(tmp_path / "recorded", meta) as writer:
        for t in range(12):
            writer.add(t, rng.uniform(0.5, 1.5, (24, 30)), saturated=mask)
    clip = open_clips(tmp_path / "recorded")[0]
    exact = truth(clip, sensed(clip, Illumination())[1], 0, 12)
    noise = rng.normal(0, 1, exact.shape)
    spoilt = method("spoilt", lambda codes: exact + 0.1 * noise + np.where(mask, 5.0, 0.0))
    rows = evaluate(Comparison(str(clip.path), None), [spoilt, method("whole", lambda codes: exact + 0.1 * noise)])
    assert rows[0].score == rows[1].score
    assert rows[0].score.psnr > 35


def test_scores_near_the_truth_are_marked(make_clip: ClipMaker):
    """A truth with an error of 3 % of its mean is worth 38.4 dB; an answer of 36 dB is marked, one of 20 dB is not."""
    clip = make_clip("rough", error=0.03 * make_clip().mean_radiance)
    rng = np.random.default_rng(11)

    def wrong(psnr: float) -> Restorer:
        sigma = 2.5 * 3.25 * 10 ** (-psnr / 20)
        exact = truth(clip, sensed(clip, Illumination())[1], 0, len(clip))
        return method(f"at {psnr:g}", lambda codes: exact + rng.normal(0, sigma, exact.shape))

    comparison, methods = Comparison(str(clip.path), None), [wrong(36.0), wrong(20.0)]
    rows = evaluate(comparison, methods)
    assert rows[0].truth_psnr == pytest.approx(20 * math.log10(2.5 / 0.03), abs=0.01)
    near, far = summary.summarise(rows)
    assert near.near_truth == ("psnr", "psnr_matched")
    assert far.near_truth == ()
    text = summary.markdown(comparison, methods, rows)
    assert f"{near.scores['psnr'].mean:.2f} † |" in text
    assert f"{far.scores['psnr'].mean:.2f} |" in text
    assert "† In one clip or more within 3 dB of the truth's own PSNR" in text


def test_published_windows_are_counted_as_published():
    """All but the first and last five frames: 345 of 15 clips of 33; 6017 of 31 clips with 6327 frames."""
    assert sum(len(scored_frames(33, True)) for _ in range(15)) == 345
    lengths = [204] * 30 + [6327 - 30 * 204]
    assert sum(len(scored_frames(n, True)) for n in lengths) == 6017
    assert list(scored_frames(12, True)) == [5, 6]
    assert len(scored_frames(9, True)) == 0
    assert len(scored_frames(9, False)) == 9


def test_published_protocol_forces_every_window(tiny_dataset):
    """Every restored frame comes from a window of eleven with a mean of 3.25 PPP; each has its own factor."""
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
    with pytest.raises(ValueError, match="give --ppp"):
        evaluate(
            Comparison(str(tiny_dataset), lights=(Illumination("quiver-paper", None),), published=True),
            [method("x", look)],
        )


def test_stored_streams_are_scored(tiny_dataset, make_clip: ClipMaker):
    from qsim.clip.sensing import Sensing, sense

    clip = make_clip()
    sense(clip, Sensing("quiver-physical", bits=3, ppp=3.25, name="mine"))
    stored = evaluate(Comparison(str(clip.path), None, stream="mine"), [restorer("moment")])
    drawn = evaluate(Comparison(str(clip.path), None), [restorer("moment")])
    assert stored[0].score == drawn[0].score
    assert stored[0].light == "mine"
    with pytest.raises(FileNotFoundError, match="no stream 'none'; there are: mine"):
        evaluate(Comparison(str(clip.path), None, stream="none"), [restorer("moment")])


def test_nothing_to_score_is_an_error(tmp_path, tiny_dataset):
    with pytest.raises(FileNotFoundError, match="no such data set"):
        evaluate(Comparison(str(tmp_path / "none")), [restorer("moment")])
    with pytest.raises(ValueError, match="unknown split 'tset'"):
        evaluate(Comparison(str(tiny_dataset), "tset"), [restorer("moment")])


def test_rows_survive_json(tmp_path):
    row = ComparisonRow("m", "d", "l", "c", "s", failure="why")
    append(tmp_path / "rows", row)
    assert math.isnan(ComparisonRow.from_dict(json.loads((tmp_path / "rows").read_text())).seconds_per_frame)


# Static real photons


def static_counts(light: float, shares: Array, seed: int = 0) -> tuple[Counts, Array]:
    rng = np.random.default_rng(seed)
    true = light * rng.uniform(0.2, 1.6, (60, 70))
    return Counts(rng.poisson(shares[:, None, None] * true), shares, "synthetic"), true


def test_the_reference_takes_off_its_own_noise():
    """An oracle's error against 19 noisy frames is all reference noise: what is left is zero within its own spread."""
    shares = np.tile([1.2, 0.9, 0.9], 10)
    left, measured = [], []
    for seed in range(40):
        counts, true = static_counts(5.0, shares, seed)
        estimate, variance = reference(counts, np.arange(11, 30))
        left.append(mean_square(true / 7, estimate / 7, variance / 49))
        measured.append(mean_square(true / 7, estimate / 7, np.zeros_like(variance)))
    sigma = np.std(left, ddof=1) / math.sqrt(40)
    assert abs(np.mean(left)) < 5 * sigma  # includes the clamp: a fifth of the pixels is above white
    assert np.mean(measured) > 100 * sigma


def test_flicker_is_divided_out():
    """Frames of unequal light: the mean of eleven, divided by their shares, is unbiased."""
    shares = np.tile([1.5, 0.5], 15)
    counts, _ = static_counts(2.0, shares)
    found = evaluate_static(counts, [restorer("moment")], splits=4)[0]
    assert found.scale == pytest.approx(1.0, abs=0.05)
    flat = evaluate_static(replace(counts, shares=np.ones(30)), [restorer("moment")], splits=4)[0]
    assert flat.psnr < found.psnr


def test_real_photons():
    """The hazelnut: 30 frames of 3.08 photons; eleven averaged beat three, and shares are the gates' means."""
    counts = read_counts(HAZELNUT)
    assert counts.frames.shape[0] == 30
    assert counts.shares[:6] == pytest.approx(
        np.array([3.5431, 3.1394, 2.7712, 2.6510, 2.9083, 3.4963]) / 3.0849, rel=0.05
    )
    eleven, three, bad = evaluate_static(counts, [restorer("moment"), restorer("moment:3"), method("bad", broken)])
    assert eleven.psnr_matched > three.psnr_matched + 3
    assert eleven.psnr_matched > eleven.psnr_as_measured > 20
    assert bad.failure == "RuntimeError: no road leads there"
    text = markdown(counts, [eleven, three, bad], 11, 3)
    assert "| bad | failed: RuntimeError" in text


def test_bad_counts_are_named(tmp_path):
    np.save(tmp_path / "float.npy", np.ones((3, 4, 5)))
    with pytest.raises(ValueError, match=r"expected whole counts \[N, H, W\] or \[T, K, H, W\], got float64"):
        read_counts(tmp_path / "float.npy")
    dark = np.ones((3, 4, 5), np.uint8)
    dark[1] = 0
    np.save(tmp_path / "dark.npy", dark)
    with pytest.raises(ValueError, match="frame or gate 1 holds no photon"):
        read_counts(tmp_path / "dark.npy")
    (tmp_path / "text.npy").write_text("hello")
    with pytest.raises(ValueError, match="not readable as an array"):
        read_counts(tmp_path / "text.npy")
    np.savez(tmp_path / "two.npz", a=dark, b=dark)
    with pytest.raises(ValueError, match=r"two.npz: not readable .*holds 2 arrays \(a, b\); one is read"):
        read_counts(tmp_path / "two.npz")
    with pytest.raises(ValueError, match="codes of 1 to 8 bits, got 9"):
        evaluate_static(Counts(dark, np.ones(3), "x"), [restorer("moment")], frames=1, bits=9)
    with pytest.raises(ValueError, match="leave none of 3 for the reference"):
        evaluate_static(Counts(dark, np.ones(3), "x"), [restorer("moment")], frames=3)


@pytest.mark.parametrize("name", ["counts.npz", "counts.npy"])
def test_a_damaged_file_of_counts_is_one_line(tmp_path, name):
    """Cut anywhere, any byte changed, or foreign bytes: read as whole counts, or one `ValueError` with the name."""
    counts = np.random.default_rng(12).poisson(3.0, (6, 5, 4)).astype(np.uint16)
    path = tmp_path / name
    np.savez_compressed(path, counts) if name.endswith("npz") else np.save(path, counts)
    good, rng, refused = path.read_bytes(), np.random.default_rng(13), 0
    cases = [b"", b"PK\3\4", b"PK\5\6" + bytes(18), b"\x93NUMPY", good[:1]]
    for _ in range(250):
        content = bytearray(good[: rng.integers(1, len(good) + 1)] if rng.random() < 0.4 else good)
        for _ in range(int(rng.integers(1, 4))):
            content[rng.integers(len(content))] = rng.integers(256)
        cases.append(bytes(content))
    for content in cases:
        path.write_bytes(content)
        with contextlib.suppress(ValueError):
            read_counts(path)
            continue
        with pytest.raises(ValueError, match=f"^{path}: [^\n]*$"):
            read_counts(path)
        refused += 1
    assert refused > 100
    with pytest.raises(FileNotFoundError, match="no such file"):
        read_counts(tmp_path / f"none{name}")
    with pytest.raises(ValueError, match=r"photon counts are a .npy, or a .npz"):
        read_counts(tmp_path / "counts.txt")


def test_an_ideal_counter_counts():
    """White is the top code; codes up to it are the counts themselves."""
    sensor = ideal_counter(3)
    assert sensor.white(1.0) == 7
    codes = array_codes(np.full((1, 4, 4), 3, np.uint8), sensor, 1.0)
    np.testing.assert_allclose(restorer("naive:1").restore(codes), 3.0)
