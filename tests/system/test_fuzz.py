"""Readers against damage: a mutated file is read, or refused in one line that names it; no crash, no flood.

Each format's files are made once and then mutated: bits flipped, bytes overwritten by extremes, cut, doubled, inserted.
The reading happens in a fork, so that a crash of a C library or a swollen memory is seen.
"""

import gzip
import io
import json
import os
import pickle
import random
import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import raw_planes
from clips import describe_video
from damaged_bytes import mutate
from fakes import RECIPE
from forks import forked
from gltf_files import arm

from qsim import files
from qsim.calibration import sensor_file
from qsim.cli.program import main
from qsim.clip import exr
from qsim.clip.clip_info import RELATIVE
from qsim.clip.writer import ClipWriter
from qsim.dataset import recipe
from qsim.formats import array_files, detection, images, importing, video
from qsim.formats.recording import Hints
from qsim.process import peak_memory
from qsim.restored_video import Restored
from qsim.scene import animated_file
from qsim.sensor import devices
from qsim.sensor.defects import defect_table
from qsim.sensor.defects.pixel_array import PixelArray
from qsim.streams.clip import Clip
from qsim.streams.stream import Stream
from quiver.data.illumination import Illumination
from quiver.data.photon_cubes import cube_codes

MEMORY = 400 << 20  # bytes that a reader of these tiny files may take at most
T = 4
H = 6
W = 16


def some_planes() -> np.ndarray:
    return (np.random.default_rng(0).random((T, H, W)) < 0.3).astype(np.uint8)


def make_npy(folder: Path) -> None:
    np.save(folder / "a.npy", np.packbits(some_planes(), axis=-1))


def make_gz(folder: Path) -> None:
    make_npy(folder)
    (folder / "a.npy.gz").write_bytes(gzip.compress((folder / "a.npy").read_bytes()))
    (folder / "a.npy").unlink()


def make_float(folder: Path) -> None:
    np.save(folder / "a.npy", np.random.default_rng(0).random((T, H, W)))


def make_spike(folder: Path) -> None:
    (folder / "a.dat").write_bytes(raw_planes.spike(some_planes()))
    (folder / "config.yaml").write_text("spike_h: 6\nspike_w: 16\n")


def make_png(folder: Path) -> None:
    images.write_png(folder, iter(some_planes() * 200))


def make_tiff(folder: Path) -> None:
    import tifffile

    tifffile.imwrite(folder / "a.tif", some_planes() * 200, compression="zlib", photometric="miniswhite")
    tifffile.imwrite(folder / "b.tif", some_planes()[0] * 200, photometric="minisblack")


def make_mp4(folder: Path) -> None:
    video.write_video(folder / "a.mp4", iter(some_planes() * 200), 30, lossless=True)


def make_mat(folder: Path) -> None:
    from scipy.io import savemat

    savemat(folder / "part_1.mat", {"OUTPUT": some_planes().transpose(1, 2, 0)}, do_compression=True)
    (folder / "info.json").write_text('{"no_parts": 1}')


def make_mat73(folder: Path) -> None:
    import h5py

    with h5py.File(folder / "part_1.mat", "w", userblock_size=512) as file:
        file["OUTPUT"] = some_planes().transpose(0, 2, 1)


def make_visionsim(folder: Path) -> None:
    np.save(folder / "frames.npy", np.packbits(some_planes(), axis=-1)[..., None])
    info = {"w": W, "h": H, "c": 1, "bitpack": True, "bitpack_dim": 2}
    (folder / "transforms.json").write_text(json.dumps(info))


def make_zarr(folder: Path) -> None:
    array_files.write_zarr(folder, iter([some_planes()]), (T, H, W), {"fps": 1000})


def make_raw(encode: Callable[[np.ndarray], bytes], height: int) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        (folder / "a.bin").write_bytes(encode(np.resize(some_planes(), (2, height, 512))))

    return write


def make_stream(folder: Path) -> None:
    np.save(folder / "codes.npy", some_planes() * 5)
    recording = importing.read(folder / "codes.npy", Hints("codes", bits=3))
    importing.to_stream(recording, folder / "s", importing.Import(1000.0))
    (folder / "codes.npy").unlink()


def read_stream(folder: Path) -> None:
    stream = Stream.open(folder / "s.json")
    assert stream.codes(0, min(len(stream), 9)).max() < 2**stream.bits
    assert stream.sensor.levels == 2**stream.bits


def make_recipe(folder: Path) -> None:
    (folder / "r.toml").write_text(RECIPE)


def make_clip(folder: Path) -> None:
    meta = {"shape": [T, H, W], "frame_rate": 9.0, "exposure": 0.1, "radiance_unit": RELATIVE, "camera": None}
    with ClipWriter(folder / "clip", meta) as writer:
        for t in range(T):
            flow = np.random.default_rng(t).normal(size=(2, H, W))
            writer.add(t, np.random.default_rng(t).random((H, W)), truth={"flow": flow})


def read_clip(folder: Path) -> None:
    clip = Clip.open(folder / "clip")
    for t in range(min(len(clip), 9)):
        clip.radiance(t)
        clip.flow(t)


def reader(hints: Hints, file: str | None = None) -> Callable[[Path], None]:
    def read(folder: Path) -> None:
        recording = importing.read(folder / file if file else folder, hints)
        found = recording.read(0, min(recording.shape[0], 64))
        assert found.shape == (min(recording.shape[0], 64), *recording.shape[1:])
        if recording.bits is not None:
            assert found.max() < 2**recording.bits

    return read


LIGHT = Hints(transfer="srgb")


def make_counts(folder: Path) -> None:
    np.save(folder / "a.npy", some_planes())


def make_map(folder: Path) -> None:
    np.save(folder / "gain.npy", np.ones((H, W), np.float32))
    (folder / "d.toml").write_text('[defects]\ngain_map = "gain.npy"\n')


def read_map(folder: Path) -> None:
    found = defect_table.from_toml(folder / "d.toml")
    if found is not None:
        PixelArray.of(found, devices.load("quiver-physical", ppp=3.25), H, W)


def make_video(folder: Path) -> None:
    np.save(folder / "v.npy", np.ones((T, H, W), np.float32))
    describe_video(folder / "v.json", shape=(T, H, W), sha256=files.sha256(folder / "v.npy"))


def read_video(folder: Path) -> None:
    restored = Restored.open(folder / "v.json")
    restored.verify()
    assert restored.frames().shape == (T, H, W)


def read_bare(folder: Path) -> None:
    codes = cube_codes(folder / "a.npy", Illumination(), 2000.0)
    codes.read(0, min(codes.shape[0], 9))


def read_detected(folder: Path) -> None:
    assert detection.detect(folder / "a.npy") in detection.LAYOUTS


def make_glb(folder: Path) -> None:
    arm().write(folder / "a.glb")


def make_gltf(folder: Path) -> None:
    arm().write(folder / "a.gltf", "beside")


def read_body(folder: Path) -> None:
    mesh, motion = animated_file(next(folder.glob("a.gl*")), 0.1)
    assert np.isfinite(motion.deform(0.3)).all()
    assert motion.deform(0.7).shape == mesh.vertices.shape


def read_calibration(folder: Path) -> None:
    sensor_file.read_stack(folder / "a.npy", bits=3, exposure=1e-3, photons=None)


FORMATS: dict[str, tuple[Callable[[Path], None], Callable[[Path], None]]] = {
    "cube": (make_npy, reader(Hints("cube"), "a.npy")),
    "cube.gz": (make_gz, reader(Hints("cube"), "a.npy.gz")),
    "codes": (make_npy, reader(Hints("codes", bits=8), "a.npy")),
    "light": (make_float, reader(Hints("light"), "a.npy")),
    "spike": (make_spike, reader(Hints(), "a.dat")),
    "png": (make_png, reader(LIGHT)),
    "png codes": (make_png, reader(Hints(bits=8))),
    "tiff": (make_tiff, reader(LIGHT)),
    "video": (make_mp4, reader(LIGHT, "a.mp4")),
    "mat": (make_mat, reader(Hints())),
    "mat 7.3": (make_mat73, reader(Hints())),
    "visionsim": (make_visionsim, reader(Hints())),
    "zarr": (make_zarr, reader(Hints())),
    "swissspad2 half": (make_raw(raw_planes.half, 256), reader(Hints("swissspad2-half"), "a.bin")),
    "swissspad2 full": (make_raw(raw_planes.full, 512), reader(Hints("swissspad2-full"), "a.bin")),
    "spad512s": (make_raw(raw_planes.spad512s, 512), reader(Hints("spad512s"), "a.bin")),
    "clip": (make_clip, read_clip),
    "stream": (make_stream, read_stream),
    "detected": (make_float, read_detected),
    "map of defects": (make_map, read_map),
    "restored": (make_video, read_video),
    "bare codes": (make_counts, read_bare),
    "calibration": (make_counts, read_calibration),
    "glb": (make_glb, read_body),
    "gltf": (make_gltf, read_body),
    "recipe": (make_recipe, lambda folder: recipe.load(folder / "r.toml")),
}


def attack(name: str, folder: Path, rounds: int) -> str:
    """Mutate and read so many times; "" or what went wrong."""
    make, read = FORMATS[name]
    chance = random.Random(name)
    original = folder / "original"
    original.mkdir()
    make(original)
    targets = sorted(path.relative_to(original) for path in original.rglob("*") if path.is_file())
    read(original)
    before = peak_memory()
    refused = 0
    for n in range(rounds):
        victim = folder / "victim"
        shutil.rmtree(victim, ignore_errors=True)
        shutil.copytree(original, victim)
        target = victim / chance.choice(targets)
        target.write_bytes(mutate(target.read_bytes(), chance))
        try:
            read(victim)
        except (ValueError, OSError) as error:
            refused += 1
            if (target.name not in str(error) and str(victim) not in str(error)) or "\n" in str(error):
                return f"round {n}, {target.name}: the message does not name the file in one line: {error!r}"
        except BaseException as error:
            shutil.copytree(victim, folder / "culprit")
            return f"round {n}, {target.name}: {error!r}"
        grown = peak_memory() - before
        if grown > MEMORY:
            shutil.copytree(victim, folder / "culprit")
            return f"round {n}, {target.name}: {grown >> 20} MiB for a file of {target.stat().st_size} bytes"
    return "" if refused > rounds // 10 else f"only {refused} of {rounds} were refused: the attack is too weak"


def npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def other_kinds() -> dict[str, bytes]:
    """Contents that do not belong under a name: files of other kinds, arrays that are none, headers that lie."""
    archive = io.BytesIO()
    header = io.BytesIO()
    np.savez(archive, a=np.zeros(3))
    np.lib.format.write_array_header_1_0(header, {"descr": "|u1", "fortran_order": False, "shape": (1 << 40, 6, 2)})
    flat = npy(np.zeros((4, 6, 2), np.uint8))
    return {
        "empty": b"",
        "npz": archive.getvalue(),
        "zip": b"PK\3\4",
        "no axes": npy(np.uint8(3)),
        "no axes, gzipped": gzip.compress(npy(np.uint8(3))),
        "objects": npy(np.array([{1: 2}, None], dtype=object)),
        "texts": npy(np.array(["a", "b"])),
        "complex": npy(np.zeros((4, 6, 2), complex)),
        "structured": npy(np.zeros((4, 6), "u1,f4")),
        "no frames": npy(np.zeros((0, 6, 2), np.uint8)),
        "five axes": npy(np.zeros((1, 1, 4, 6, 2), np.uint8)),
        "a petabyte": header.getvalue(),
        "version 9": flat[:6] + b"\x09\x09" + flat[8:],
        "deep header": flat.replace(b"(4, 6, 2)", b"(" * 9),
        "text": b"hello\n" * 9,
        "null": b"null",
        "deep": b"[" * 9999,
        "digits": b'{"no_parts": ' + b"9" * 5000 + b', "w": 1e999, "shape": [NaN]}',
        "list of files": b"ffconcat version 1.0\nfile 'a.mp4'\n",
        "playlist": b"#EXTM3U\n#EXT-X-TARGETDURATION:10\n#EXTINF:10,\n/etc/passwd\n#EXT-X-ENDLIST\n",
        "png": b"\x89PNG\r\n\x1a\n" + bytes(40),
        "hdf5": b"\x89HDF\r\n\x1a\n" + bytes(90),
        "tiff": b"II*\0\x08\0\0\0\xff\xff" + bytes(40),
        "exr": exr.MAGIC + b"channels\0chlist\0\xff\xff\xff\x7f",
    }


def swap(name: str, folder: Path, rounds: int) -> str:
    """Each file of a format replaced by each other kind; "" or what went wrong."""
    make, read = FORMATS[name]
    original = folder / "original"
    original.mkdir()
    make(original)
    read(original)
    before = peak_memory()
    for target in [path for path in sorted(original.rglob("*")) if path.is_file()][:rounds]:
        for kind, content in other_kinds().items():
            victim = folder / "victim"
            shutil.rmtree(victim, ignore_errors=True)
            shutil.copytree(original, victim)
            (victim / target.relative_to(original)).write_bytes(content)
            try:
                read(victim)
            except (ValueError, OSError) as error:
                named = str(victim) in str(error) or target.name in str(error)
                if not named or "\n" in str(error) or "pickle" in str(error):
                    return f"{target.name} as {kind}: {error!r}"
            except BaseException as error:
                return f"{target.name} as {kind}: {error!r}"
            grown = peak_memory() - before
            if grown > MEMORY:
                return f"{target.name} as {kind}: {grown >> 20} MiB"
    return ""


def fuzz(name: str, folder: Path, rounds: int, how: Callable[[str, Path, int], str]) -> None:
    report = folder / "report"

    def work() -> None:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # decoders complain to stderr
        report.write_text(how(name, folder, rounds))

    _, status = os.waitpid(forked(work), 0)
    assert os.waitstatus_to_exitcode(status) == 0, f"the reader of {name} took the process down"
    assert report.read_text() == ""


@pytest.mark.parametrize("name", FORMATS)
def test_mutated_files_are_refused_in_one_line(name: str, tmp_path: Path):
    fuzz(name, tmp_path, 60, attack)


@pytest.mark.parametrize("name", FORMATS)
def test_files_of_another_kind_are_refused_in_one_line(name: str, tmp_path: Path):
    fuzz(name, tmp_path, 3, swap)


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
def test_ten_thousand_mutated_files(name: str, tmp_path: Path):
    fuzz(name, tmp_path, -(-10_000 // len(FORMATS)), attack)


def test_a_header_that_promises_a_terabyte(tmp_path: Path):
    """Sizes are compared with the file before anything is allocated."""
    shape = (1 << 20, 1 << 10, 1 << 10)
    with open(tmp_path / "a.npy", "wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "|u1", "fortran_order": False, "shape": shape})
    for name, content in [("a.npy", None), ("a.npy.gz", gzip.compress((tmp_path / "a.npy").read_bytes()))]:
        if content is not None:
            (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=name):
            importing.read(tmp_path / name, Hints("cube"))


def test_a_picture_of_a_terapixel(tmp_path: Path):
    (tmp_path / "p").mkdir()
    images.write_png(tmp_path / "p", iter([np.zeros((5, 7), np.uint8)]))
    content = bytearray((tmp_path / "p" / "000000.png").read_bytes())
    content[16:24] = struct.pack(">II", 1 << 20, 1 << 20)
    content[29:33] = struct.pack(">I", zlib.crc32(bytes(content[12:29])))
    (tmp_path / "p" / "000000.png").write_bytes(content)
    with pytest.raises(ValueError, match=r"000000\.png"):
        importing.read(tmp_path / "p", Hints(transfer="linear"))


def test_the_exr_reader_survives_every_truncation(tmp_path: Path):
    content = exr.encode({"Y": np.ones((5, 7), np.float16)})
    path = tmp_path / "a.exr"
    for length in range(len(content)):
        path.write_bytes(content[:length])
        with pytest.raises(ValueError, match="truncated or damaged"):
            exr.read_half(path, 5, 7)


def described_zarr(folder: Path, **changes: object) -> Path:
    """A zarr of the planes whose array says something else."""
    folder.mkdir()
    make_zarr(folder)
    about = folder / "frames" / "zarr.json"
    about.write_text(json.dumps(json.loads(about.read_text()) | changes))
    return folder


def test_zarrs_that_promise_more_than_there_is(tmp_path: Path):
    """Chunks are counted in the folder before the library lists all that there should be: 10^15 of them took 22 GB."""
    grid = {"name": "regular", "configuration": {"chunk_shape": [1, 1, 1]}}
    huge = described_zarr(tmp_path / "huge", shape=[10**9, 1000, 1000], chunk_grid=grid)
    grid = {"name": "regular", "configuration": {"chunk_shape": [1 << 20, 1 << 10, 1]}}
    thick = described_zarr(tmp_path / "thick", chunk_grid=grid)
    large = described_zarr(tmp_path / "large", attributes={"a": "x" * (1 << 22)})
    before = peak_memory()
    for folder, words in [
        (huge, r"1 of 1000000000000000 chunks"),
        (thick, "at a time"),
        (large, r"has \d+ bytes; at most"),
    ]:
        with pytest.raises(ValueError, match=words):
            importing.read(folder, Hints("zarr"))
    assert peak_memory() - before < MEMORY


def test_attributes_of_a_zarr_that_no_description_holds(tmp_path: Path):
    """They became a stream that nothing opens."""
    folder = described_zarr(tmp_path / "large", attributes={"fps": 10**30})
    with pytest.raises(ValueError, match=r"zarr\.json: not readable as JSON \(a whole number of more than 64 bits"):
        importing.read(folder, Hints("zarr"))


@pytest.mark.parametrize("codec", ["pickle", "numcodecs.pickle", "bz2", "lzma", "json2"])
def test_zarr_codecs_that_execute_or_expand_are_refused(tmp_path: Path, codec: str):
    codecs = [{"name": "bytes"}, {"name": "sharding_indexed", "configuration": {"codecs": [{"name": codec}]}}]
    with pytest.raises(ValueError, match=f"stored by the codec '{codec.removeprefix('numcodecs.')}'"):
        importing.read(described_zarr(tmp_path / "v3", codecs=codecs), Hints("zarr"))
    (tmp_path / "v2").mkdir()
    about = {"zarr_format": 2, "shape": [4, 6, 16], "chunks": [4, 6, 16], "dtype": "|u1", "order": "C", "fill_value": 0}
    about |= {"compressor": None, "filters": [{"id": codec}]}
    (tmp_path / "v2" / ".zarray").write_text(json.dumps(about))
    (tmp_path / "v2" / "0.0.0").write_bytes(pickle.dumps(some_planes().tobytes()))
    with pytest.raises(ValueError, match="stored by the codec"):
        importing.read(tmp_path / "v2", Hints("zarr"))


def test_planes_that_lie_in_another_file_are_refused(tmp_path: Path):
    """HDF5 can name any file of the machine as the place of its data: external storage, links, virtual data sets."""
    import h5py

    (tmp_path / "secret").write_bytes(bytes(T * W * H))
    with h5py.File(tmp_path / "other.mat", "w") as file:
        file["OUTPUT"] = np.zeros((T, W, H), np.uint8)
    with h5py.File(tmp_path / "external.mat", "w") as file:
        place = [(str(tmp_path / "secret"), 0, h5py.h5f.UNLIMITED)]
        file.create_dataset("OUTPUT", (T, W, H), "u1", external=place)
    with h5py.File(tmp_path / "link.mat", "w") as file:
        file["OUTPUT"] = h5py.ExternalLink("other.mat", "OUTPUT")
    with h5py.File(tmp_path / "soft.mat", "w") as file:
        file["there"] = h5py.ExternalLink("other.mat", "/")
        file["OUTPUT"] = h5py.SoftLink("/there/OUTPUT")
    with h5py.File(tmp_path / "virtual.mat", "w") as file:
        layout = h5py.VirtualLayout((T, W, H), "u1")
        layout[:] = h5py.VirtualSource(str(tmp_path / "other.mat"), "OUTPUT", (T, W, H))
        file.create_virtual_dataset("OUTPUT", layout)
    importing.read(tmp_path / "other.mat")
    for name in ("external", "link", "soft", "virtual"):
        with pytest.raises(ValueError, match=rf"{name}\.mat: OUTPUT (lies in other files|is a link)"):
            importing.read(tmp_path / f"{name}.mat")


def test_a_video_that_names_other_videos_is_refused(tmp_path: Path):
    make_mp4(tmp_path)
    assert importing.read(tmp_path / "a.mp4", LIGHT).shape == (T, H, W)
    (tmp_path / "list.mp4").write_text("ffconcat version 1.0\nfile 'a.mp4'\n")
    with pytest.raises(ValueError, match=r"list\.mp4: not readable as video"):
        importing.read(tmp_path / "list.mp4", LIGHT)


def test_truth_of_another_size_or_type_is_refused(tmp_path: Path):
    """clip.json says the size; the file may not be larger or of other numbers, and its bytes have to be there."""
    make_clip(tmp_path)
    clip = Clip.open(tmp_path / "clip")
    place = clip.path / "truth" / "000000.exr"
    for channels in (
        {name: np.zeros((H + 1, W), "<f4") for name in "uv"},
        {name: np.zeros((H, W), "<f2") for name in "uv"},
        {"u": np.zeros((H, W), "<u4"), "v": np.zeros((H, W), "<f4")},
        {"w": np.zeros((H, W), "<f4")},
    ):
        place.write_bytes(exr.encode(channels, compress=True))
        with pytest.raises(ValueError, match=r"truth/000000\.exr"):
            clip.flow(0)
    window = struct.pack("<iiii", 0, 0, W - 1, H - 1)
    bomb = exr.encode({name: np.zeros((H, W), "<f4") for name in "uv"}, compress=True)
    place.write_bytes(bomb.replace(window, struct.pack("<iiii", 0, 0, 32767, 32767)))
    with pytest.raises(ValueError, match="expected scan lines"):
        clip.flow(0)
    with pytest.raises(ValueError, match="bytes cannot hold"):
        exr.read(place)


def test_a_missing_frame_says_that_the_clip_is_damaged(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    make_clip(tmp_path)
    place = tmp_path / "clip"
    for folder in ("truth", "radiance"):
        for file in (place / folder).iterdir():
            file.unlink()
        assert main(["preview", str(place), "--frame", "0", "-o", str(tmp_path / f"{folder}.png")]) == 2
        said = capsys.readouterr().err
        assert f"{place / folder}/" in said
        assert "the clip is damaged, run `qsim check" in said
