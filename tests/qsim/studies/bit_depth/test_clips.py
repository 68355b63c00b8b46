"""Tests the clips of a study: one clip at several speeds, grouped frames, and another clip in the way."""

from dataclasses import replace

import numpy as np
import pytest
from clips import write_clip
from waves import SIZE, wave_clip

from qsim import records
from qsim.cli.program import main
from qsim.clip.clip_info import SceneName
from qsim.dataset.checking import redraw
from qsim.rendering import clip_rendering, fidelity
from qsim.streams.clip import Clip
from qsim.streams.photons import clip_photons, light_level
from qsim.studies.bit_depth import clips
from qsim.studies.bit_depth.clips import ClipShape, clips_for, group, render, write_streams
from qsim.studies.bit_depth.readout import StudySettings
from qsim.studies.readouts import compare


def test_a_clip_at_several_speeds_is_one_clip_read_in_steps(clip):
    found = list(clips_for(str(clip.path), [1.0, 4.0], ClipShape(64), None))
    assert [(one.speed, one.step) for one in found] == [(1.0, 1), (4.0, 4)]
    assert {one.clip.path for one in found} == {clip.path}
    with pytest.raises(ValueError, match="whole factors only"):
        list(clips_for(str(clip.path), [0.5], ClipShape(64), None))


def test_a_grouped_frame_is_the_mean_and_its_sharp_frame_the_middle_one(clip, tmp_path):
    grouped = group(clip, tmp_path / "wave_7", 7)
    assert grouped.shape == (64 // 7, *SIZE)
    assert grouped.exposure == pytest.approx(7 * clip.exposure)
    assert grouped.frame_rate == pytest.approx(clip.frame_rate / 7)
    mean = np.mean([clip.radiance(t) for t in range(7, 14)], axis=0, dtype=np.float64)
    np.testing.assert_allclose(grouped.radiance(1), mean, rtol=1e-3)  # stored as halves
    assert np.array_equal(grouped.sharp(1), clip.radiance(10))


def test_a_grouped_frame_is_saturated_where_one_of_its_frames_is(tmp_path):
    light = np.ones((6, *SIZE), np.float32)
    light[1, 0, 0] = 1e6
    grouped = group(write_clip(tmp_path / "sun", radiance=light), tmp_path / "sun_3", 3)
    assert np.argwhere(grouped.saturated(0)).tolist() == [[0, 0]]
    assert not grouped.saturated(1).any()


@pytest.mark.parametrize("relative", [True, False])
def test_codes_of_summed_planes_belong_to_the_frames_of_their_own_clip(clip, tmp_path, relative):
    """A code of either stream is one frame of the grouped clip: the same truth, and a like score."""
    if not relative:
        light = np.stack([clip.radiance(t) for t in range(len(clip))])
        clip = write_clip(tmp_path / "lit", radiance=light, frame_rate=clip.frame_rate, exposure=clip.exposure)
    factor = light_level(clip, ppp=0.65).factor
    (path,) = write_streams(clip, tmp_path, StudySettings(bits=(3,), ppp=0.65))
    grouped = Clip.open(path)
    planes = grouped.stream("planes")
    multibit = grouped.stream("multibit")
    assert planes.info.light.ppp == pytest.approx(7 * 0.65)
    for t in (0, len(grouped) - 1):
        middle = clip_photons(clip, 7 * t + 3, 7 * factor, sharp=True)
        np.testing.assert_allclose(planes.truth(t, t + 1)[0], middle, rtol=1e-6)
        np.testing.assert_allclose(planes.truth(t, t + 1), multibit.truth(t, t + 1), rtol=0.02)
    found = compare(grouped)
    assert len(found.instants) == len(grouped)
    scores = {row.stream: row.psnr_db for row in found.rows}
    assert scores["planes"] == pytest.approx(scores["multibit"], abs=2.0)
    (again, other) = sorted(redraw(path), key=lambda one: one.path.name, reverse=True)
    assert "was not drawn from a clip" in again.why
    assert (other.why, other.differ) == (None, 0)
    assert planes.info.sensor_name == ""  # no device is called so; the record has all


def test_another_clip_in_the_place_of_a_rendered_one_is_refused(tmp_path):
    wave_clip(tmp_path / "plain_x1", 4, 1)
    with pytest.raises(FileExistsError, match="exists and is another clip; name another folder"):
        render("plain", tmp_path / "plain_x1", ClipShape(8, 24, 32))


def test_a_clip_of_an_edited_scene_file_is_refused(tmp_path, monkeypatch):
    """The digests of the files that a scene reads are stored with its clip, and compared before it is taken."""

    def rendered(scene, path, *, frames, frame_rate, made_of, **_):
        about = {"family": scene.name, "seed": scene.seed, "speed": scene.speed}
        return write_clip(
            path,
            frames=frames,
            height=6,
            width=8,
            frame_rate=frame_rate,
            **vars(replace(made_of, scene=SceneName(**about))),
        )

    monkeypatch.setattr(clip_rendering, "render_clip", rendered)
    monkeypatch.setattr(fidelity, "choose_budget", lambda *_, **__: None)
    file = tmp_path / "own.py"
    shape = ClipShape(2, 6, 8, frame_rate=10_000.0)
    file.write_text("from qsim.scenes.plain import scene\n")
    made = render(str(file), tmp_path / "own_x1", shape)
    assert list(made.info.reads) == ["own.py"]
    assert records.plain(render(str(file), tmp_path / "own_x1", shape).info) == records.plain(made.info)
    assert not render("plain", tmp_path / "plain_x1", shape).info.reads
    assert render("plain", tmp_path / "plain_x1", shape)
    file.write_text("from qsim.scenes.plain import scene\n\n")
    with pytest.raises(FileExistsError, match=r"own\.py and its files as they are now; name another folder"):
        render(str(file), tmp_path / "own_x1", shape)


def test_streams_of_a_sensor_file_have_every_depth(clip, tmp_path):
    """Its bits are those of the depth. With defects it is refused before a clip is written."""
    file = tmp_path / "spad.toml"
    text = '[sensor]\nmodel = "BinarySPAD"\npde = 0.4\ndark_count_rate = 10.0\nbits = 2\n'
    file.write_text(text)
    made = write_streams(clip, tmp_path, StudySettings(bits=(1, 3), sensor=str(file), ppp=0.65))
    streams = [Clip.open(path).stream("multibit") for path in made]
    assert [stream.bits for stream in streams] == [1, 3]
    assert all(stream.sensor.efficiency == 0.4 and not stream.info.defects for stream in streams)
    file.write_text(f"{text}[defects]\nprnu = 0.02\n")
    with pytest.raises(ValueError, match=r"spad\.toml: .* without the table"):
        write_streams(clip, tmp_path / "other", StudySettings(bits=(3,), sensor=str(file), ppp=0.65))
    assert not (tmp_path / "other").exists()


def test_planes_that_cannot_be_summed_are_refused_before_the_study(clip, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("qsim.studies.bit_depth.clip_study.study", lambda *_, **__: pytest.fail("was studied first"))
    words = ["tradeoff", str(clip.path), "--ppp", "0.65", "--bits", "1,2", "--plane-sensor", "quiver-paper"]
    assert main([*words, "--streams", "-o", str(tmp_path / "out")]) == 2
    assert "need a clocked SPAD; leave out the plane sensor" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_one_plane_of_an_open_shutter_keeps_its_sharp_instant(tmp_path):
    """A frame of one bit was scored against blurred light, deeper ones against the sharp instant."""
    open_clip = write_clip(tmp_path / "c", frames=6, height=5, width=8, sharp=True)
    for m in (1, 3):
        grouped = group(open_clip, tmp_path / f"by{m}", m)
        assert np.array_equal(grouped.sharp(1), open_clip.sharp(m + m // 2))


def test_streams_of_a_crop_have_the_noise_of_its_place(tmp_path):
    clip = write_clip(tmp_path / "c", frames=14, height=12, width=16, frame_rate=10_000.0, origin=[8, 12])
    (path,) = write_streams(clip, tmp_path, StudySettings(bits=(3,), ppp=0.65))
    found = Clip.open(path)
    assert found.stream("planes").origin == found.stream("multibit").origin == (8, 12)


def test_progress_counts_the_frames_of_all_clips_that_are_rendered(tmp_path, monkeypatch):
    """Three speeds, one of them rendered before: the other two make up the whole."""
    (tmp_path / "clips" / "fan_x2").mkdir(parents=True)
    (tmp_path / "clips" / "fan_x2" / "clip.json").touch()

    def rendered(name, path, shape, *, speed, progress):
        for t in range(shape.frames if progress is not None else 0):
            progress(t + 1, shape.frames)

    monkeypatch.setattr(clips, "render", rendered)
    told = []
    wanted = [1.0, 2.0, 3.0]
    list(clips_for("fan", wanted, ClipShape(4), tmp_path, lambda done, total: told.append((done, total))))
    assert told == [(done, 8) for done in range(1, 9)]
    assert clips.to_render("fan", wanted, tmp_path) == 2
