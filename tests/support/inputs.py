"""Makes a small file of every format that a command reads, and lists the command lines that read them."""

from __future__ import annotations

import contextlib
import gzip
from pathlib import Path

import numpy as np
import raw_planes
from clips import write_clip, write_dataset
from sdt_files import sdt_bytes

import qsim.cli.program
import quiver.cli.program
from qsim.sensor.counting import CountingSPAD
from qsim.streams.sensing import Sensing
from qsim.streams.storing import sense

READS = {  # what reads -> what it is given
    "qsim check clip": ("clip",),
    "qsim check data": ("data",),
    "qsim check r.json": ("r.json", "r.npy"),
    "qsim check clip/streams/s.json": ("clip",),
    "qsim sense clip --ppp 3 --bits 3 --name n": ("clip",),
    "qsim sense clip --sensor my.toml --ppp 3 --name n": ("clip", "my.toml"),
    "qsim sense clip --defects map.toml --ppp 3 --bits 3 --name n": ("clip", "map.toml", "gain.npy"),
    "qsim sense clip --name s --replay clip:1": ("clip",),
    "qsim compare clip": ("clip",),
    "qsim preview clip": ("clip",),
    "qsim preview r.npy": ("r.json", "r.npy"),
    "qsim preview codes.npy --bits 3": ("codes.npy",),
    "qsim report r.json": ("r.json", "r.npy"),
    "qsim report clip": ("clip",),
    "qsim report table": ("table",),
    "qsim report run": ("run",),
    "qsim explore clip": ("clip",),
    "qsim plan t.toml -q": ("t.toml",),
    "qsim convert codes.npy c --layout codes --bits 3 --frame-rate 9": ("codes.npy",),
    "qsim convert codes.npy.gz c --layout codes --bits 3 --frame-rate 9": ("codes.npy.gz",),
    "qsim convert light.npy c --transfer linear --frame-rate 9": ("light.npy",),
    "qsim convert png c --transfer linear --frame-rate 9": ("png",),
    "qsim convert stack.tif c --transfer linear --frame-rate 9": ("stack.tif",),
    "qsim convert film.mp4 c --transfer srgb --frame-rate 9": ("film.mp4",),
    "qsim convert film.gif c --transfer srgb --layout video --frame-rate 9": ("film.gif",),
    "qsim convert a.mat c --bits 5 --frame-rate 9": ("a.mat",),
    "qsim convert v73.mat c --bits 5 --frame-rate 9": ("v73.mat",),
    "qsim convert a.h5 c --transfer linear --frame-rate 9": ("a.h5",),
    "qsim convert a.sdt c --bits 8 --frame-rate 9 --axes TYX": ("a.sdt",),
    "qsim convert a.ptu c --bits 8": ("a.ptu",),
    "qsim convert zarr c --frame-rate 9": ("zarr",),
    "qsim convert dump.dat c --layout spike --height 16 --width 24 --frame-rate 9": ("dump.dat",),
    "qsim convert spikes/a.dat c --frame-rate 9": ("spikes",),
    "qsim convert raw.bin c --layout raw --height 16 --width 24 --bits 8 --frame-rate 9": ("raw.bin",),
    "qsim convert clip/streams/b.json e --to cube": ("clip",),
    "qsim convert clip/streams/s.json e --to png": ("clip",),
    "qsim convert clip e --to nerfstudio": ("clip",),
    "qsim convert clip e.h5 --window 2": ("clip",),
    "qsim calibrate --model spad --bits 1 --dark planes.npy 1e-5 -o s.toml": ("planes.npy",),
    "qsim calibrate --bits 12 --static photons.npz 5e-5 -o s.toml": ("photons.npz",),
    "qsim tradeoff clip --ppp 3 --bits 1,2": ("clip",),
    "quiver restore clip --stream s -o n.npy --method moment": ("clip",),
    "quiver restore clip/streams/b.npy -o n.npy --method moment": ("clip",),
    "quiver restore codes.npy --sensor my.toml -o n.npy --method moment": ("codes.npy", "my.toml"),
    "quiver restore clip --stream s -o n.npy --method run/best.safetensors": ("clip", "run"),
    "quiver evaluate data -o e --methods naive --ppp 3": ("data",),
    "quiver evaluate --static static.npy --methods naive --splits 1": ("static.npy",),
    "quiver evaluate --static counts.npz --methods naive --splits 1": ("counts.npz",),
    "quiver domain run/best.safetensors": ("run",),
    "quiver convert-weights their.pth -o o.safetensors": ("their.pth",),
    "quiver train data -o run --preset unet --protocol control --steps 2 --crop 16 --batch 1": ("data", "run"),
}
REFUSED = ("qsim plan", "qsim calibrate --bits 12 --static photons.npz", "quiver domain")  # also with good files


def write_inputs(folder: Path) -> None:
    """Write everything that the lines name."""
    rng = np.random.default_rng(0)
    clip = write_clip(folder / "clip", frames=12, height=16, width=24, frame_rate=20000.0, exposure=5e-5)
    sense(clip, Sensing("quiver-physical", bits=3, ppp=3.25, name="s"))
    sense(clip, Sensing("spad-320x240", name="b"))
    sense(clip, Sensing(CountingSPAD(0.5, 100.0, 2e-5, 3), ppp=3, follow=True, name="f"))
    write_dataset(folder / "data", {"train": 1, "val": 1, "test": 1}, frames=12, height=16, width=24)
    codes = rng.integers(0, 4, (3, 16, 24)).astype(np.uint8)
    np.save(folder / "codes.npy", codes)
    (folder / "codes.npy.gz").write_bytes(gzip.compress((folder / "codes.npy").read_bytes()))
    np.save(folder / "light.npy", rng.integers(0, 60000, (3, 16, 24)).astype(np.uint16))
    np.save(folder / "planes.npy", (rng.random((200, 6, 8)) < 0.01).astype(np.uint8))
    static = rng.poisson(5.0, (60, 16, 16)).astype(np.uint8)
    np.save(folder / "static.npy", static)
    np.savez(folder / "counts.npz", static)
    np.save(folder / "gain.npy", np.ones((16, 24), np.float32))
    (folder / "map.toml").write_text('[defects]\ngain_map = "gain.npy"\n')
    (folder / "my.toml").write_text(
        '[sensor]\nmodel = "CountingSPAD"\nbits = 3\npde = 0.5\ndark_count_rate = 100.0\ndead_time = 2e-5\n'
    )
    head = "[recipe]\nname='t'\nframes=2\nheight=16\nwidth=16\npsnr=20.0\n"
    (folder / "t.toml").write_text(f"{head}[[scenes]]\nfamily='no_such_family'\ncount=2\n")
    _foreign(folder, codes, static)
    photons = ["convert", str(folder / "clip/streams/f.json"), str(folder / "photons.npz"), "--to", "photons", "-q"]
    assert qsim.cli.program.main(photons) == 0
    for line in (
        "restore clip --stream s -o r.npy --method moment",
        "evaluate clip -o table --methods naive --ppp 3",
        "train data -o run --preset unet --protocol control --steps 2 --crop 16 --batch 1",
    ):
        with contextlib.chdir(folder):  # a run states its data as they were named
            assert quiver.cli.program.main([*line.split(), "-q"]) == 0


def _foreign(folder: Path, codes: np.ndarray, static: np.ndarray) -> None:
    """Files of the formats of others."""
    import h5py
    import ptufile
    import tifffile
    import torch
    from golden import published_state
    from PIL import Image
    from scipy.io import savemat

    from qsim.formats import array_files, video

    (folder / "png").mkdir()
    for t, frame in enumerate(codes):
        Image.fromarray(frame * 60).save(folder / f"png/{t}.png")
    pictures = [Image.fromarray(frame * 60) for frame in codes]
    pictures[0].save(folder / "film.gif", save_all=True, append_images=pictures[1:], duration=40)
    tifffile.imwrite(folder / "stack.tif", codes * 60, compression="zlib", photometric="minisblack")
    video.write_video(folder / "film.mp4", iter(codes * 60), 30, lossless=True)
    savemat(folder / "a.mat", {"OUTPUT": codes.transpose(1, 2, 0)}, do_compression=True)
    with h5py.File(folder / "v73.mat", "w", userblock_size=512) as file:
        file["OUTPUT"] = codes.transpose(0, 2, 1)
    with h5py.File(folder / "a.h5", "w") as file:
        file.create_dataset("a", data=codes * 60, compression="gzip", chunks=(1, 16, 24))
    images = static[:6].reshape(3, 16, 16, 1, 2).astype(np.uint16)
    ptufile.imwrite(folder / "a.ptu", images, 1e-7, 1e-8, pixel_time=1e-5)
    (folder / "a.sdt").write_bytes(sdt_bytes(static[:8].reshape(2, 4, 16, 16).transpose(0, 2, 3, 1)))
    array_files.write_zarr(folder / "zarr", iter([codes[:, :, :] > 1]), codes.shape, {"fps": 1000})
    spikes = raw_planes.spike((codes > 1).astype(np.uint8))
    (folder / "dump.dat").write_bytes(spikes)
    (folder / "spikes").mkdir()
    (folder / "spikes/a.dat").write_bytes(spikes)
    (folder / "spikes/config.yaml").write_text("spike_h: 16\nspike_w: 24\n")
    (folder / "raw.bin").write_bytes(codes.tobytes())
    torch.save(published_state(), folder / "their.pth")
