"""Tests the export of windows: codes, truth and flow of every split, as another program reads them."""

import json
from pathlib import Path

import numpy as np
import pytest
from clips import colour_clip, square_clip, write_clip, write_dataset

from qsim.cli.program import main
from qsim.dataset.dataset import Dataset
from qsim.formats.pairs import streams_of, windows
from qsim.sensor.qis import QIS
from qsim.sensor.spad import BinarySPAD
from qsim.streams.clip import Clip

h5py = pytest.importorskip("h5py")


def test_a_data_set_becomes_windows_by_split(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    data = write_dataset(tmp_path / "d", {"train": 2, "test": 1})
    splits = {split: [clip.name for clip in Dataset.open(data).clips(split)] for split in ("train", "test")}
    for clip in Dataset.open(data).clips():
        clip.sense(ppp=3.25, bits=3)
        clip.sense(QIS(0.8, 1.6, 0.2, 10), ppp=200.0)
    assert main(["convert", str(data), str(tmp_path / "p.h5"), "--to", "pairs", "--window", "5"]) == 0
    said = capsys.readouterr().out
    assert "12 windows (8 train, 4 test) of 5 codes of 36 x 44 pixels, from 6 streams" in said
    assert "not written: depth, body indices, and 24 codes that fill no window" in said
    seen = set()
    with h5py.File(tmp_path / "p.h5", "r") as file:
        for split, group in file.items():
            assert group["codes"].shape == group["truth"].shape == (len(group["first"]), 5, 36, 44)
            assert (group["codes"].dtype, group["truth"].dtype) == (np.uint16, np.float32)
            for n, first in enumerate(group["first"]):
                clip = Clip.open(data / "clips" / group["clip"].asstr()[n])
                stream = clip.stream(group["stream"].asstr()[n])
                assert clip.name in splits[split]
                np.testing.assert_array_equal(group["codes"][n], stream[first : first + 5])
                np.testing.assert_allclose(group["truth"][n], stream.truth(first, first + 5), rtol=1e-6)
                assert (group["bits"][n], group["ppp"][n]) == (stream.bits, pytest.approx(stream.info.light.ppp))
                assert json.loads(group["sensor"].asstr()[n]) == stream.info.sensor
                rates = (group["exposure"][n], group["frame_rate"][n], group["code_model"].asstr()[n])
                assert rates == (stream.exposure, 2000.0, stream.sensor.code_model)
                seen.add((clip.name, stream.name, int(first)))
    assert len(seen) == 12


def test_windows_of_colour_clips_have_mosaics_and_three_bands(tmp_path: Path):
    """Truth is that of the bands, and the filters are stated from the first pixel on; bands do not mix in a file."""
    clip = colour_clip(tmp_path / "c", frames=6, origin=[1, 0])
    stream = clip.sense(QIS(0.8, 1.6, 0.2, 3), ppp=6.0, colour="rggb", name="s")
    assert main(["convert", str(clip.path), str(tmp_path / "p.h5"), "--to", "pairs", "--window", "3", "-q"]) == 0
    with h5py.File(tmp_path / "p.h5", "r") as file:
        group = file["all"]
        assert group["codes"].shape == (2, 3, 7, 9)
        assert group["truth"].shape == (2, 3, 3, 7, 9)
        np.testing.assert_array_equal(group["codes"][1], stream[3:6])
        np.testing.assert_allclose(group["truth"][1], stream.truth(3, 6), rtol=1e-6)
        assert [json.loads(text)["mask"] for text in group["colour"].asstr()] == [["GB", "RG"]] * 2
    grey = write_clip(tmp_path / "g", frames=6, height=7, width=9)
    grey.sense(QIS(0.8, 1.6, 0.2, 3), ppp=6.0, name="s")
    with pytest.raises(ValueError, match="clip c has three bands and g one; convert them one by one"):
        windows({"all": streams_of([clip, grey])}, 3)


def test_flow_is_that_of_the_clip_and_unknown_where_points_hide(tmp_path: Path):
    clip = square_clip(tmp_path / "c")
    clip.sense("quiver-paper", ppp=2.0)
    assert main(["convert", str(clip.path), str(tmp_path / "p.h5"), "--window", "5", "-q"]) == 0
    with h5py.File(tmp_path / "p.h5", "r") as file:
        flow = file["all/flow"][0]
        assert file["all/codes"].dtype == np.uint8
    for t in range(4):
        np.testing.assert_array_equal(flow[t], np.where(clip.valid(t), clip.flow(t), np.nan))
    assert np.isnan(flow[4]).all(), "the last frame has no next one"


def test_flow_of_sums_leads_from_code_to_code_and_clips_without_truth_have_none(tmp_path: Path):
    clip = square_clip(tmp_path / "c", frames=6)
    clip.sense(BinarySPAD(0.4, 1.0, 2), ppp=3.0, group=True)
    write_clip(tmp_path / "e", frames=3).sense("quiver-paper", ppp=2.0)
    found = {}
    for name in ("c", "e"):
        assert main(["convert", str(tmp_path / name), str(tmp_path / f"{name}.h5"), "--window", "2", "-q"]) == 0
        with h5py.File(tmp_path / f"{name}.h5", "r") as file:
            found[name] = file["all/flow"][...]
            assert file["all/codes"].shape[:2] == (1, 2)
    assert np.isnan(found["e"]).all()
    expected = np.zeros((2, 24, 33), np.float32)
    expected[0, 6:12, 5:11] = 3.0  # the square of the middle plane, three planes later
    expected[0, 6:12, 11:13] = [2.0, 1.0]  # what it runs over, and this clip calls valid, goes along from there
    np.testing.assert_array_equal(found["c"][0, 0], expected)
    assert np.isnan(found["c"][0, 1]).all(), "the last code has no next one"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("clip p.h5", "no window of 11 codes in 0 streams; make some with `qsim sense`"),
        ("lit p.h5", "no window of 11 codes in 1 streams"),
        ("lit p.zarr --to pairs --window 2", "p.zarr: pairs are written to one HDF5 file; name it .h5"),
        ("lit foreign.h5 --window 2 --force", "foreign.h5: was not written by `qsim convert`"),
        ("lit foreign.h5 --window 2", "foreign.h5: exists; name another"),
        ("lit p.h5 --window 1 --every 3", "--every: windows of pairs are made of all codes of a stream; leave it out"),
        ("lit p.h5 --window 1 --planes 3", "--planes: sums planes of one bit, and lit/streams/s.npy holds codes of 3"),
        ("lit p.h5 --window 0", "expected a whole number from 1"),
    ],
)
def test_what_cannot_be_written_is_one_line(tmp_path: Path, monkeypatch, capsys, words: str, message: str):
    monkeypatch.chdir(tmp_path)
    write_clip(tmp_path / "clip", frames=3)
    write_clip(tmp_path / "lit", frames=3).sense("quiver-paper", ppp=2.0, name="s")
    with h5py.File("foreign.h5", "w") as file:
        file["mine"] = 1
    before = sorted(tmp_path.rglob("*"))
    assert main(["convert", *words.split()]) == 2
    found = capsys.readouterr().err
    assert message in found
    assert len(found.splitlines()) == 1
    assert sorted(tmp_path.rglob("*")) == before


def test_clips_of_unequal_sizes_are_refused(tmp_path: Path):
    from qsim.formats import pairs

    clips = [write_clip(tmp_path / f"c{width}", frames=3, width=width) for width in (20, 22)]
    for clip in clips:
        clip.sense("quiver-paper", ppp=2.0)
    with pytest.raises(ValueError, match="clips c20 and c22 are 36 x 20 and 36 x 22 px; convert them one by one"):
        pairs.write({"all": pairs.streams_of(clips)}, tmp_path / "p.h5", 3)


def test_only_our_own_file_is_replaced_and_a_failure_leaves_the_old_one(tmp_path: Path, monkeypatch):
    from qsim.formats import pairs

    clip = write_clip(tmp_path / "c", frames=4)
    clip.sense("quiver-paper", ppp=2.0)
    pairs.write({"all": pairs.streams_of([clip])}, tmp_path / "p.h5", 2)
    old = (tmp_path / "p.h5").read_bytes()

    def stop(done: int, total: int) -> None:
        raise OSError("the disk was taken away")

    with pytest.raises(OSError, match="taken away"):
        pairs.write({"all": pairs.streams_of([clip])}, tmp_path / "p.h5", 4, force=True, progress=stop)
    assert (tmp_path / "p.h5").read_bytes() == old
    assert len(list(tmp_path.iterdir())) == 2
    pairs.write({"all": pairs.streams_of([clip])}, tmp_path / "p.h5", 4, force=True)
    with h5py.File(tmp_path / "p.h5", "r") as file:
        assert file["all/codes"].shape[:2] == (1, 4)


def test_pairs_of_stored_planes_are_those_of_their_sums(tmp_path: Path, monkeypatch, capsys):
    """A clip's planes, or one stream of them, summed now: as the pairs of the sums that were sensed."""
    monkeypatch.chdir(tmp_path)
    for name, options in (("c", {"bits": 1, "ppp": 1.0}), ("d", {"planes": 3, "ppp": 3.0})):
        square_clip(tmp_path / name / "clip", frames=9).sense("spad-320x240", name="s", **options)
    for n, words in enumerate(
        ("c/clip --planes 3", "c/clip/streams/s.npy --planes 3", "d/clip", "d/clip/streams/s.json")
    ):
        source, *more = words.split()
        assert main(["convert", source, f"p{n}.h5", "--to", "pairs", "--window", "2", *more, "-q"]) == 0
    for n in range(3):
        with h5py.File(f"p{n}.h5") as one, h5py.File("p3.h5") as other:
            for name in other["all"]:
                if name not in ("clip", "sensor"):
                    np.testing.assert_array_equal(one["all"][name][...], other["all"][name][...], err_msg=name)
    assert main(["convert", "c/clip/streams/s.npy", "x.dat", "--planes", "3"]) == 2
    assert "c/clip/streams/s.npy: a spike file holds one bit per pixel" in capsys.readouterr().err
