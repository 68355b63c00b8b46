"""Events of clips: drawn, stored, checked, kept, compared and written for other programs; what is refused."""

from __future__ import annotations

import json

import h5py
import numpy as np
import pytest
from clips import colour_clip, write_clip

from qsim.cli.program import main
from qsim.sensor.event_camera import EventCamera
from qsim.streams.clip import Clip
from qsim.streams.event_stream import EVENT, EventStream
from qsim.streams.photons import clip_photons
from qsim.studies import readouts

NOISY = EventCamera(mismatch=0.05, cutoff=500.0, leak_rate=50.0, shot_noise=200.0, refractory=1e-5)


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> Clip:
    made = write_clip(tmp_path_factory.mktemp("events") / "clip", frames=9, height=17, width=23)
    made.sense_events(NOISY, ppp=100, name="noisy")
    made.sense_events("dvs-ideal", ppp=100, name="ideal")
    return made


def test_stored_events_are_ordered_and_inside_the_clip(clip):
    stream = clip.event_stream("noisy")
    array = stream.array
    assert array.dtype == EVENT
    assert len(array) == len(stream) > 500
    assert (np.diff(array["t"]) >= 0).all()
    assert 0 <= array["t"][0] <= array["t"][-1] <= 8 * 500
    assert array["x"].max() == 22
    assert array["y"].max() == 16
    assert stream.info.brighter == int(array["p"].sum())
    assert np.array_equal(np.load(stream.path), array)
    assert np.array_equal(stream.between(1e-3, 2e-3), array[(array["t"] >= 1000) & (array["t"] < 2000)])


def test_events_are_kept_by_their_settings_and_replaced_only_when_forced(tmp_path):
    clip = write_clip(tmp_path / "clip", frames=3, height=5, width=7)
    first = clip.sense_events(NOISY, ppp=100, name="a")
    before = first.array.copy()
    told: list[int] = []
    clip.sense_events(NOISY, ppp=100, name="a", progress=lambda done, total: told.append(done))
    assert told == []
    with pytest.raises(FileExistsError, match=r"exists with other settings; give a name=, or replace it with force"):
        clip.sense_events(NOISY, ppp=100, name="a", seed=1)
    other = clip.sense_events(NOISY, ppp=100, name="a", seed=1, force=True)
    assert not np.array_equal(before, other.array)
    assert np.array_equal(before, clip.sense_events(NOISY, ppp=100, name="a", force=True).array)
    assert clip.event_streams == ("a",)


def test_damage_is_named(tmp_path):
    clip = write_clip(tmp_path / "clip", frames=3, height=5, width=7)
    path = clip.sense_events(NOISY, ppp=100, name="a").path
    assert clip.verify() == []
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    assert clip.verify() == [f"{path}: contents changed (checksum differs)"]
    path.write_bytes(content[:-5])
    with pytest.raises(ValueError, match=r"has \d+ bytes, and \d+ events take \d+"):
        _ = clip.event_stream("a").array
    json_path = path.with_suffix(".json")
    json_path.write_text(json_path.read_text().replace('"following"', '"followed"'))
    with pytest.raises(ValueError, match="followed"):
        clip.event_stream("a")
    assert main(["check", str(path)]) == 1


def test_a_clip_without_changes_has_no_events(tmp_path):
    """Constant light, also of black pixels and of light near the largest half: an empty file that all readers take."""
    light = np.array([0.0, 1.0, 60000.0])[None, None].repeat(4, axis=0)
    clip = write_clip(tmp_path / "clip", radiance=light)
    stream = clip.sense_events("dvs-ideal")
    assert len(stream) == 0
    assert stream.array.shape == (0,)
    for name in ("e.h5", "e.npz"):
        assert main(["convert", str(stream.path), str(tmp_path / name), "-q"]) == 0
    assert h5py.File(tmp_path / "e.h5")["ms_to_idx"][:].tolist() == [0, 0]


def test_black_pixels_have_the_contrast_over_the_dark_current(tmp_path):
    """A pixel from black to n photons: floor(ln(1 + n QE / (exposure dark)) / threshold) events."""
    light = np.zeros((2, 1, 3))
    light[1, 0] = [0, 1, 300]
    clip = write_clip(tmp_path / "clip", radiance=light)
    stream = clip.sense_events(EventCamera(dark_current=7.0, threshold_on=0.11))
    current = clip_photons(clip, 1)[0] * 0.8 / clip.exposure
    expected = np.floor(np.log1p(current / 7) / 0.11)
    np.testing.assert_array_equal(np.bincount(stream.array["x"], minlength=3), expected)


def test_what_has_no_events_is_refused(tmp_path):
    with pytest.raises(ValueError, match="holds three bands, and an event camera takes one"):
        colour_clip(tmp_path / "colour").sense_events("dvs")
    one = write_clip(tmp_path / "one", frames=1, height=5, width=7)
    with pytest.raises(ValueError, match="has one frame, and events are changes between frames"):
        one.sense_events("dvs")
    with pytest.raises(ValueError, match="ppp or as lux, not both"):
        one.sense_events("dvs", ppp=1, lux=1)
    with pytest.raises(FileNotFoundError, match="no events 'a'; there are: none yet; make some with `qsim events`"):
        one.event_stream("a")
    lost = write_clip(tmp_path / "lost", frames=3, height=5, width=7, relative=True, source={"missing_frames": [1]})
    with pytest.raises(ValueError, match="frame 1 was lost and is stored dark, which would be events"):
        lost.sense_events("dvs", ppp=1)
    relative = write_clip(tmp_path / "relative", frames=2, height=5, width=7, relative=True)
    with pytest.raises(ValueError, match="give a target in photons per pixel"):
        relative.sense_events("dvs")


def test_files_have_the_layouts_of_event_tools(clip, tmp_path, monkeypatch):
    monkeypatch.setattr("qsim.formats.event_files.BLOCK", 97)
    stream = clip.event_stream("noisy")
    assert main(["convert", str(stream.path), str(tmp_path / "e.h5"), "-q"]) == 0
    assert main(["convert", str(stream.path.with_suffix(".json")), str(tmp_path / "e.npz"), "-q"]) == 0
    with h5py.File(tmp_path / "e.h5") as file:
        columns = {name: file[f"events/{name}"][:] for name in "txyp"}
        first = file["ms_to_idx"][:]
        assert file["t_offset"][()] == 0
        assert (file.attrs["height"], file.attrs["width"]) == (17, 23)
    assert {name: one.dtype for name, one in columns.items()} == {"t": "u4", "x": "u2", "y": "u2", "p": "u1"}
    for name, one in columns.items():
        np.testing.assert_array_equal(one, stream.array[name])
    for millisecond, number in enumerate(first):
        assert (columns["t"][:number] < 1000 * millisecond).all()
        assert (columns["t"][number:] >= 1000 * millisecond).all()
    with np.load(tmp_path / "e.npz") as file:
        np.testing.assert_array_equal(file["events"], stream.array)
        assert (file["height"], file["width"]) == (17, 23)
    assert json.loads((tmp_path / "e.npz.json").read_text())["events"] == len(stream)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["{events}", "e.mp4"], "events are written to .h5 or .npz"),
        (["{events}", "e.h5", "--to", "pairs"], "holds events, and pairs are codes with their truth"),
        (["{events}", "e.h5", "--to", "zarr"], "holds events, which are written with --to events"),
        (["{clip}", "e.h5", "--to", "events"], "holds no events; draw some with `qsim events`"),
        (["{events}", "e.h5", "--lossy"], "which holds events"),
        (["{events}", "e", "--from", "3"], "holds events, and planes are summed and chosen in streams"),
    ],
)
def test_what_no_file_of_events_can_be_is_refused(clip, tmp_path, monkeypatch, capsys, words, message):
    monkeypatch.chdir(tmp_path)
    places = {"events": clip.event_stream("noisy").path, "clip": clip.path}
    assert main(["convert", *(word.format(**places) for word in words)]) == 2
    assert message in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_the_light_of_ideal_events_is_known_within_a_threshold(clip):
    """Contrast that is added up lags the true logarithm by less than one threshold, at every frame."""
    stream = clip.event_stream("ideal")
    frames = range(1, len(clip))
    dark = stream.camera.dark_current * clip.exposure / 0.8 / stream.info.light.factor
    for t, found in zip(frames, readouts._from_events(clip, stream, frames), strict=True):
        apart = np.log((found + dark) / (clip_photons(clip, t) + dark))
        assert np.abs(apart).max() < 0.2 * (1 + 1e-6)
    assert np.abs(apart).max() > 0.15


def test_events_stand_beside_codes_in_a_comparison(clip, capsys):
    clip.sense("spad-320x240", ppp=0.5, name="spad", force=True)
    found = readouts.compare(clip, span=1e-3)
    rows = {row.stream: row for row in found.rows}
    assert set(rows) == {"", "ideal", "noisy", "spad"}
    ideal = rows["ideal"]
    assert (ideal.model, ideal.bits, ideal.ppp) == ("EventCamera", None, pytest.approx(200))
    assert ideal.codes == round(len(clip.event_stream("ideal")) / 4)
    assert ideal.psnr_db > rows["noisy"].psnr_db
    assert main(["compare", str(clip.path), "--streams", "ideal"]) == 0
    assert "is given the light of the first frame" in capsys.readouterr().out


def test_the_command_draws_what_is_missing(tmp_path, capsys):
    write_clip(tmp_path / "clip", frames=3, height=5, width=7)
    line = ["events", str(tmp_path / "clip"), "--ppp", "3,100", "--camera", "dvs-ideal"]
    assert main(line) == 0
    assert capsys.readouterr().out.count("wrote ") == 2
    assert main([*line, "--json"]) == 0
    (dim, bright) = json.loads(capsys.readouterr().out)["events"]
    assert not dim["made"]
    assert bright["events"] == len(EventStream.open(tmp_path / "clip/events/dvs-ideal_100ppp.json"))
    assert main([*line, "-o", "x"]) == 2
    assert "--name: is of one light level, not of 2" in capsys.readouterr().err
