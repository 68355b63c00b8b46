"""`qsim check --redraw`: correct streams of every kind pass; wrong codes are found even if all checksums fit."""

import dataclasses
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from clips import describe_video, write_clip, write_dataset
from scipy.special import gammaln

from qsim import files
from qsim.cli import program
from qsim.dataset import checking
from qsim.dataset.generation import Options, generate
from qsim.dataset.job import Job
from qsim.dataset.recipe import Recipe
from qsim.rendering.render_settings import RenderSettings
from qsim.sensor.qis import QIS
from qsim.streams.clip import Clip
from qsim.streams.preparation import prepare
from qsim.streams.sensing import Sensing
from qsim.streams.storing import sense, write_stream
from qsim.streams.stream import Stream, write_packed
from qsim.streams.stream_info import StreamInfo

BINARY = '[sensor]\nmodel = "BinarySPAD"\npde = 0.5\ndark_count_rate = 200.0\nbits = {bits}\n'
COUNTING = '[sensor]\nmodel = "CountingSPAD"\npde = 0.5\ndark_count_rate = 10.0\ndead_time = 3e-4\nbits = {bits}\n'
QUANTA = '[sensor]\nmodel = "QIS"\nquantum_efficiency = 0.8\ndark_current = 1.6\nread_noise = 0.2\nbits = {bits}\n'
MAPS = "[defects]\ndevice_seed = 4\nprnu = 0.2\ndead = 0.1\n"
DISTURBED = "[defects]\nafterpulse = 0.1\ncrosstalk = 0.05\n"

SPIKES = """[sensor]
model = "SpikeCamera"
quantum_efficiency = 0.6
dark_current = 10.0
threshold = 12
subtracts = {subtracts}
"""

# Name -> (sensor file, other settings, its `drawn_by`)
KINDS = {
    "QIS": (QUANTA.format(bits=3), {"ppp": 3.25}, "table"),
    "QIS of a long table": (QUANTA.format(bits=8) + "gain = 0.0085\n", {"ppp": 9000.0}, "table"),
    "QIS of ten bits": (QUANTA.format(bits=10), {"ppp": 400.0, "seed": 5}, "process"),
    "QIS with maps": (QUANTA.format(bits=3) + MAPS, {"ppp": 3.0, "diffraction": True}, "table"),
    "QIS with read-out maps": (QUANTA.format(bits=3) + "[defects]\noffset = 0.3\n", {"ppp": 3.0}, "process"),
    "planes": (BINARY.format(bits=1) + MAPS, {"ppp": 0.7}, "planes"),
    "planes with a memory": (BINARY.format(bits=2) + DISTURBED, {"ppp": 2.0}, "planes"),
    "summed planes of the clip": (BINARY.format(bits=2), {"ppp": 2.0, "bits": 2, "group": True}, "planes"),
    "many planes": (BINARY.format(bits=10), {"ppp": 300.0}, "process"),
    "counting": (COUNTING.format(bits=3), {"ppp": 3.0}, "closed form"),
    "counting, followed": (COUNTING.format(bits=3) + "[defects]\ncarry_dead_time = true\n", {"ppp": 3.0}, "events"),
    "QIS, slices": (QUANTA.format(bits=3), {"ppp": 3.0, "slices": 3}, "table"),
    "QIS of ten bits, slices": (QUANTA.format(bits=10), {"ppp": 400.0, "slices": 2}, "process"),
    "spikes": (SPIKES.format(subtracts="true"), {"ppp": 9.0}, "spikes"),
    "spikes, reset to zero": (SPIKES.format(subtracts="false"), {"ppp": 9.0, "seed": 3}, "spikes"),
    "counting, slices": (COUNTING.format(bits=3), {"ppp": 3.0, "slices": 3}, "events"),
    "counting, rows": (
        COUNTING.format(bits=3),
        {"ppp": 3.0, "slices": 2, "row_delay": 9e-5, "row_order": "up"},
        "events",
    ),
    "planes, columns": (
        BINARY.format(bits=1) + DISTURBED,
        {"ppp": 0.7, "row_delay": 3e-5, "row_order": "left"},
        "planes",
    ),
}


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> Clip:
    return write_clip(tmp_path_factory.mktemp("clips") / "moving", frames=6, height=10, width=13)


def drawn(clip: Clip, folder: Path, kind: str) -> Stream:
    text, settings, _ = KINDS[kind]
    (folder / "mine.toml").write_text(text)
    return sense(clip, Sensing(str(folder / "mine.toml"), name="test", **settings), force=True)[0]


def stored_again(clip: Clip, stream: Stream, values: np.ndarray, **changes: object) -> Stream:
    """Store a stream with other codes and the right checksums."""
    return write_stream(clip, stream.name, [values], dataclasses.replace(stream.info, **changes))


@pytest.mark.parametrize("kind", KINDS)
def test_right_streams_pass_and_wrong_codes_are_counted(clip, tmp_path, kind):
    """With flipped codes in frames 1 and 2, all files still match their checksums."""
    stream = drawn(clip, tmp_path, kind)
    assert stream.info.drawn_by == KINDS[kind][2]
    (found,) = checking.redraw(stream.path)
    assert (found.differ, found.why, found.wrong) == (0, None, False)
    wrong = stream.codes()
    wrong[1, 2, 3:5] ^= 1
    wrong[min(2, len(wrong) - 1), 9, 12] ^= 1
    stored_again(clip, stream, wrong)
    assert clip.verify() == []
    (found,) = checking.redraw(clip.path)
    assert (found.codes, found.differ, found.first) == (wrong.size, 3, 1)
    assert found.wrong


def test_an_unknown_law_is_refused(clip, tmp_path):
    stream = drawn(clip, tmp_path, "QIS")
    old = stored_again(clip, stream, stream.codes(), drawn_by="magic")
    (found,) = checking.redraw(old.path)
    assert found.why == (
        "drawn by 'magic', which is none of table, process, planes, closed form, events, spikes; sense it again"
    )


def as_the_shifted_sums_drew(sensor: QIS, photons: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Return codes of float32 sums with one factor exp(-shift) in every weight, which underflows."""
    f = np.float32
    steps = sensor.short_sums()
    n = len(steps.full)
    shift = n + 7 * np.sqrt(n) + 30 - 85
    mean = (photons * sensor.efficiency).astype(f)
    weight = np.full(mean.shape, np.exp(-shift), f)
    terms = []
    for _ in range(n):
        terms.append(np.where(weight < 2.0**-126, f(0), weight))
        weight = (terms[-1] * (mean / f(steps.scale))).astype(f)
    numbers = np.arange(n)
    full = np.exp(numbers * np.log(steps.scale) - gammaln(numbers + 1)).astype(f)
    codes_drawn = np.zeros(mean.shape, np.uint8)
    for prefix, band in zip(steps.prefix, steps.band, strict=True):
        total = sum(terms[m] * full[m] for m in range(prefix))
        total = total + sum(terms[prefix + m] * f(band[m]) for m in range(len(band)))
        codes_drawn += u * np.exp(mean - f(shift)) >= total
    return codes_drawn


def test_codes_of_the_shifted_sums_are_named(tmp_path, capsys):
    """3 bits at 36 PPP: dark pixels got the top code; exit code 1, and what to do."""
    from qsim.keys import uniform, words

    radiance = np.repeat([0.02, 0.1, 0.3, 1.0], 16).reshape(1, 1, 64) * np.ones((2, 32, 1))
    clip = write_clip(tmp_path / "dark", radiance=radiance)
    stream, _ = sense(clip, Sensing("quiver-physical", bits=3, ppp=36.0, name="r"))
    draw = prepare(clip, Sensing("quiver-physical", bits=3, ppp=36.0))
    u = uniform(words(draw.key, stream.shape))
    old = as_the_shifted_sums_drew(stream.sensor, draw.light(clip, 0, 2), u)
    share = (old != stream.codes()).mean()
    assert 0.01 < share < 0.5
    assert program.main(["check", str(clip.path), "--redraw"]) == 0
    assert "drawn again: 1 of 1 streams, 4096 codes; all hold the reference's codes" in capsys.readouterr().out
    stored_again(clip, stream, old)
    assert program.main(["check", str(clip.path)]) == 0, "checksums alone are content"
    capsys.readouterr()
    assert program.main(["check", str(clip.path), "--redraw"]) == 1
    out = capsys.readouterr().out
    assert f"r.npy: {round(share * 4096)} of 4096 codes differ from the reference's, first in frame 0" in out
    assert "sense it again and replace it" in out
    assert "4096 codes; 1 hold wrong codes" in out
    assert program.main(["check", str(clip.path), "--redraw", "--json"]) == 1
    facts = json.loads(capsys.readouterr().out)
    assert [(one["differ"], one["wrong"]) for one in facts["redrawn"]] == [(round(share * 4096), True)]
    assert program.main(["sense", str(clip.path), "--bits", "3", "--ppp", "36", "-o", "r", "--force"]) == 0
    assert program.main(["check", str(clip.path), "--redraw"]) == 0


def test_streams_of_other_origin_and_damaged_ones_are_said_not_passed(clip, tmp_path, capsys):
    own = write_clip(tmp_path / "own", frames=3, height=8, width=9)
    info = StreamInfo.of(QIS(0.8, 1.6, 0.2, 3), shape=(3, 8, 9), exposure=5e-4, frame_rate=2000.0)
    write_stream(own, "imported", [np.ones((3, 8, 9), np.uint8)], info)
    assert program.main(["check", str(own.path), "--redraw"]) == 0
    out = capsys.readouterr().out
    assert "imported.npy: not drawn again: was not drawn from a clip by qsim" in out
    assert "drawn again: 0 of 1 streams, 0 codes; so nothing is known of them" in out
    stream, _ = sense(own, Sensing("quiver-physical", ppp=3.0, name="cut"))
    stream.path.write_bytes(stream.path.read_bytes()[:-20])
    assert program.main(["check", str(own.path), "--redraw"]) == 1
    assert "cut.npy: not drawn again" in capsys.readouterr().out
    empty = write_clip(tmp_path / "empty", frames=3, height=8, width=9)
    assert program.main(["check", str(empty.path), "--redraw"]) == 2
    assert "empty: holds no stream to draw again" in capsys.readouterr().err


def test_streams_beside_no_clip_and_restored_video_do_not_end_the_check(clip, tmp_path, capsys):
    """What was redrawn before them was lost."""
    stream = drawn(clip, tmp_path, "QIS")
    capture, moved, video = (tmp_path / "out" / f"{name}.npy" for name in ("capture", "moved", "video"))
    capture.parent.mkdir()
    info = StreamInfo.of(stream.sensor, shape=stream.shape, exposure=5e-4, frame_rate=2000.0)
    write_packed(capture, [stream.packed], info)
    for end in (".npy", ".json"):
        shutil.copy(stream.path.with_suffix(end), moved.with_suffix(end))
    np.save(video, np.ones(stream.shape, np.float32))
    describe_video(video.with_suffix(".json"), sha256=files.sha256(video))
    assert program.main(["check", *map(str, (stream.path, capture, moved, video)), "--redraw"]) == 0
    out = capsys.readouterr().out
    assert f"{capture}: not drawn again: was not drawn from a clip by qsim" in out
    assert f"{moved}: not drawn again: {tmp_path}: not a clip folder" in out
    assert "drawn again: 1 of 3 streams" in out


def test_a_few_codes_in_a_million_are_the_compiled_engines_own():
    few = checking.Redrawn(Path("s.npy"), 1_000_000, 5, 3)
    assert not few.wrong
    assert few.line() == "s.npy: 5 of 1000000 codes differ from the reference's, as many as the compiled engine may"
    assert replace(few, differ=6).wrong


def test_a_data_set_is_drawn_again_clip_by_clip(tmp_path, capsys):
    """Streams added by `qsim sense`: each is named with its clip, and passes after --force."""
    path = write_dataset(tmp_path / "set", {"train": 2, "test": 1})
    assert program.main(["sense", str(path), "--bits", "3", "--ppp", "3.25", "-o", "s"]) == 0
    found = checking.redraw(path)
    assert len(found) == 3
    assert not any(one.differ for one in found)
    clip = Clip.open(path / "clips" / "train_0001")
    stored_again(clip, clip.stream("s"), clip.stream("s").codes() ^ 1)
    capsys.readouterr()
    assert program.main(["check", str(path), "--redraw"]) == 1
    out = capsys.readouterr().out
    assert f"{clip.path / 'streams' / 's.npy'}: {14 * 36 * 44} of {14 * 36 * 44} codes differ" in out
    assert "3 of 3 streams" in out


def test_a_damaged_clip_is_named_and_the_others_are_drawn_again(tmp_path, capsys):
    """The damage of one clip ended the command, and what `check` had found in others was lost."""
    path = write_dataset(tmp_path / "set", {"train": 3})
    assert program.main(["sense", str(path), "--bits", "3", "--ppp", "3.25", "-o", "s"]) == 0
    about = path / "clips" / "train_0001" / "clip.json"
    about.write_text(about.read_text() + "x")
    (path / "clips" / "train_0002" / "streams" / "s.npy").unlink()
    capsys.readouterr()
    assert program.main(["check", str(path), "--redraw"]) == 1
    out = capsys.readouterr().out
    assert f"{about}: not readable as JSON" in out
    assert f"{path / 'clips' / 'train_0002' / 'streams' / 's.npy'}: missing" in out
    assert "train_0001/streams/s.npy: not drawn again" in out
    assert "drawn again: 1 of 3 streams" in out
    assert program.main(["check", str(about.parent), "--redraw"]) == 1
    assert "drawn again: 0 of 1 streams, 0 codes; so nothing is known of them" in capsys.readouterr().out


def test_what_is_said_of_a_recipes_streams_mends_them(tmp_path, capsys):
    """Every checksum fits the wrong codes; when the file is deleted, `generate --repair` draws them again."""
    settings = RenderSettings(frames=14, height=36, width=44, frame_rate=2000.0)
    sensing = Sensing("quiver-physical", bits=3, ppp=3.25, name="s")
    recipe = Recipe("tiny", (Job("family", 0, 1.0, "train", settings, 0, (sensing,)),))

    def make(job: Job, target: Path, wrong: bool) -> Clip:
        clip = write_clip(target, job=job.digest)
        stream, _ = sense(clip, sensing)
        return Clip.open(stored_again(clip, stream, stream.codes() ^ 1).path.parent.parent) if wrong else clip

    path = tmp_path / "set"
    generate(recipe, path, Options(workers=0), make=lambda job, target: make(job, target, True))
    stream = path / "clips" / "family_0000" / "streams" / "s.npy"
    assert program.main(["check", str(path)]) == 0
    capsys.readouterr()
    assert program.main(["check", str(path), "--redraw"]) == 1
    assert "makes it again with --repair" in capsys.readouterr().out
    stream.unlink()
    generate(recipe, path, Options(workers=0, repair=True), make=lambda job, target: make(job, target, False))
    assert stream.is_file()
    assert program.main(["check", str(path), "--redraw"]) == 0
