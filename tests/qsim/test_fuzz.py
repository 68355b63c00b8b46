"""Readers against damage: a mutated file is read, or refused in one line that names it; never a crash, never a flood.

Each format's files are made once and then mutated: bits flipped, bytes overwritten by extremes, cut, doubled, inserted.
The reading happens in a fork, so that a crash of a C library or a swollen memory is seen.
"""

import gzip
import json
import os
import random
import resource
import shutil
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import raw_planes
from fakes import RECIPE
from forks import forked

from qsim import exr, formats, recipe, video
from qsim.clip import RELATIVE, Clip, ClipWriter
from qsim.footage import Hints
from qsim.stream import Stream

MEMORY = 400 << 20  # bytes that a reader of these tiny files may take at most
T, H, W = 4, 6, 16


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
    video.write_png(folder, iter(some_planes() * 200))


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
    video.write_zarr(folder, iter([some_planes()]), (T, H, W), {"fps": 1000})


def make_raw(encode: Callable[[np.ndarray], bytes], height: int) -> Callable[[Path], None]:
    def write(folder: Path) -> None:
        (folder / "a.bin").write_bytes(encode(np.resize(some_planes(), (2, height, 512))))

    return write


def make_stream(folder: Path) -> None:
    np.save(folder / "codes.npy", some_planes() * 5)
    footage = formats.read(folder / "codes.npy", Hints("codes", bits=3))
    formats.to_stream(footage, folder / "s", formats.Capture(1000.0))
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
        footage = formats.read(folder / file if file else folder, hints)
        found = footage.read(0, min(footage.shape[0], 64))
        assert found.shape == (min(footage.shape[0], 64), *footage.shape[1:])
        if footage.bits is not None:
            assert found.max() < 2**footage.bits

    return read


LIGHT = Hints(transfer="srgb")
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
    "recipe": (make_recipe, lambda folder: recipe.load(folder / "r.toml")),
}


def mutate(content: bytes, chance: random.Random) -> bytes:
    """One to four mutations of a file's bytes, most of them near its head, where the promises are."""
    changed = bytearray(content)
    for _ in range(chance.randint(1, 4)):
        reach = len(changed) if chance.random() < 0.4 else min(len(changed), 256)
        place = chance.randrange(reach) if reach else 0
        kind = chance.randrange(6)
        if kind == 0 and changed:
            changed[place] ^= 1 << chance.randrange(8)
        elif kind == 1:
            changed[place : place + 4] = chance.choice([b"\xff\xff\xff\x7f", b"\0\0\0\0", b"\xff\xff\xff\xff", b"9999"])
        elif kind == 2:
            del changed[place:]
        elif kind == 3:
            changed[place:place] = changed[: chance.randrange(64)]
        elif kind == 4:
            changed[place : place + 8] = chance.randbytes(8)
        else:
            digits = [i for i, byte in enumerate(changed[:512]) if 48 <= byte < 58]
            if digits:  # numbers in text headers
                i = chance.choice(digits)
                changed[i : i + 1] = chance.choice([b"0", b"-1", b"99999999999", b"1e9", b"7"])
    return bytes(changed)


def attack(name: str, folder: Path, rounds: int) -> str:
    """Mutate and read so many times; "" or what went wrong."""
    make, read = FORMATS[name]
    chance = random.Random(name)
    original = folder / "original"
    original.mkdir()
    make(original)
    targets = sorted(path.relative_to(original) for path in original.rglob("*") if path.is_file())
    read(original)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
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
            if str(victim) not in str(error) or "\n" in str(error):
                return f"round {n}, {target.name}: the message does not name the file in one line: {error!r}"
        except BaseException as error:
            shutil.copytree(victim, folder / "culprit")
            return f"round {n}, {target.name}: {error!r}"
        grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - before
        if grown > MEMORY:
            shutil.copytree(victim, folder / "culprit")
            return f"round {n}, {target.name}: {grown >> 20} MiB for a file of {target.stat().st_size} bytes"
    return "" if refused > rounds // 10 else f"only {refused} of {rounds} were refused: the attack is too weak"


def fuzz(name: str, folder: Path, rounds: int) -> None:
    report = folder / "report"

    def work() -> None:
        os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # decoders complain to stderr
        report.write_text(attack(name, folder, rounds))

    _, status = os.waitpid(forked(work), 0)
    assert os.waitstatus_to_exitcode(status) == 0, f"the reader of {name} took the process down"
    assert report.read_text() == ""


@pytest.mark.parametrize("name", FORMATS)
def test_mutated_files_are_refused_in_one_line(name: str, tmp_path: Path):
    fuzz(name, tmp_path, 60)


@pytest.mark.slow
@pytest.mark.parametrize("name", FORMATS)
def test_ten_thousand_mutated_files(name: str, tmp_path: Path):
    fuzz(name, tmp_path, -(-10_000 // len(FORMATS)))


def test_a_header_that_promises_a_terabyte(tmp_path: Path):
    """Sizes are compared with the file before anything is allocated."""
    shape = (1 << 20, 1 << 10, 1 << 10)
    with open(tmp_path / "a.npy", "wb") as file:
        np.lib.format.write_array_header_1_0(file, {"descr": "|u1", "fortran_order": False, "shape": shape})
    for name, content in [("a.npy", None), ("a.npy.gz", gzip.compress((tmp_path / "a.npy").read_bytes()))]:
        if content is not None:
            (tmp_path / name).write_bytes(content)
        with pytest.raises(ValueError, match=name):
            formats.read(tmp_path / name, Hints("cube"))


def test_a_picture_of_a_terapixel(tmp_path: Path):
    (tmp_path / "p").mkdir()
    video.write_png(tmp_path / "p", iter([np.zeros((5, 7), np.uint8)]))
    content = bytearray((tmp_path / "p" / "000000.png").read_bytes())
    content[16:24] = struct.pack(">II", 1 << 20, 1 << 20)
    content[29:33] = struct.pack(">I", zlib.crc32(bytes(content[12:29])))
    (tmp_path / "p" / "000000.png").write_bytes(content)
    with pytest.raises(ValueError, match=r"000000\.png"):
        formats.read(tmp_path / "p", Hints(transfer="linear"))


def test_the_exr_reader_survives_every_truncation(tmp_path: Path):
    content = exr.encode({"Y": np.ones((5, 7), np.float16)})
    path = tmp_path / "a.exr"
    for length in range(len(content)):
        path.write_bytes(content[:length])
        with pytest.raises(ValueError, match="truncated or damaged"):
            exr.read_half(path, 5, 7)
