"""
# The public benchmark's layout

The Single Photon Challenge gives cubes of binary planes in three colours and asks for the picture of the last plane. A
scene of ours becomes such a cube, and its restored picture is scored.
"""

# %%
# Binary planes of one clip behind a red, a green and a blue filter, each with its own noise. At 0.4 photons per pixel,
# plane and band, the light is 0.2 detections.

import json
import zipfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from PIL import Image

import qsim
from qsim.cli import main
from quiver.cli import main as quiver

side, planes, speed = 96, 64, 0.2  # tests: 16, 9, 0.2
clip = qsim.render(
    "text", "text", frames=planes, height=side, width=side, frame_rate=16_000, speed=speed, bands="rgb", psnr=28
)
for seed, colour in enumerate(("red", "green", "blue"), 1):
    clip.sense("spad512s", bits=1, ppp=0.4, colour=colour, name=colour, seed=seed)

# %%
# `qsim convert --to challenge` writes the cube, with the truth of its last plane. NumPy reads it as the benchmark does.

main(["convert", "text", "cubes/text", "--to", "challenge", "--window", str(planes)])
packed = np.load("cubes/text/000000.npy", mmap_mode="r")
cube = np.unpackbits(packed, axis=2)
print(packed.shape, packed.dtype, f"{cube.mean():.3f} detections per plane")

# %%
# `quiver restore` writes the zip that a submission is, and scores it where the truth lies beside the cube. Sums of
# three planes are codes of two bits.

words = ["restore", "cubes", "-o", "submission.zip", "--planes", "3", "--method", "qbp-bm3d"]
quiver(words)
print(f"{json.loads(Path('submission.json').read_text())['psnr']:.1f} dB below 255")
with zipfile.ZipFile("submission.zip") as archive, archive.open(archive.namelist()[0]) as file:
    restored = np.asarray(Image.open(file))
truth = np.asarray(Image.open("cubes/text/000000.png"))
light = -np.log1p(-np.minimum(cube.mean(axis=0), 0.98)) / 0.5  # a plane of light x fires with 1 - exp(-x / 2)
figure, axes = plt.subplots(1, 4, figsize=(11, 3), layout="constrained")
mean = np.clip(light, 0, 1)[:, :side] ** (1 / 2.2)
shown = {"last plane": 255 * cube[-1][:, :side], "all planes, light": mean, "restored": restored, "truth": truth}
for axis, (name, picture) in zip(axes, shown.items(), strict=True):
    axis.imshow(picture)
    axis.set_title(name, fontsize=10)
    axis.axis("off")
