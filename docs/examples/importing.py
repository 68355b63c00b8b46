"""
# Importing real data

Two real measurements come with the program: a ball filmed at 30 000 frames per second, and photon counts of a
hazelnut, a single-photon detector's scan. Their licences lie beside them.
"""

# %%
# High-speed video becomes a clip: its light is relative, so a light level must be given when it is sensed.

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import qsim
import quiver
from qsim.formats import read, to_clip, to_stream
from qsim.formats.importing import Import
from qsim.formats.recording import Hints

folder = Path(qsim.__file__).parent / "measurements"
np.save("ball.npy", np.load(folder / "ball_12bit.npz")["frames"])
recording = read(Path("ball.npy"), Hints(layout="light", transfer="linear", white=4095))
clip = to_clip(recording, Path("ball"), Import(frame_rate=30_000))
print(clip)

# %%
# A sensor sees the real motion as it sees a rendered one.

stream = clip.sense("quiver-physical", bits=3, ppp=3.25)
figure, axes = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
for axis, picture, title in zip(
    axes, (stream.truth(10, 11)[0], stream.codes[10]), ("video", "3-bit codes"), strict=True
):
    axis.imshow(picture, cmap="gray")
    axis.set_title(title)
    axis.axis("off")

# %%
# Frames of a photon-counting camera become a stream: codes without light. Here the counts are cut to one bit and
# packed along rows, eight pixels a byte, which is the usual photon cube.

length = 30  # tests: 12
counts = np.load(folder / "hazelnut_gates6.npz")["gates"].reshape(30, 256, 256)[:length]
np.save("cube.npy", np.packbits(counts > 0, axis=-1))
cube = read(Path("cube.npy"), Hints(layout="cube", width=256))
print(f"{cube.source}: {cube.shape}, {cube.bits} bit")
planes = to_stream(cube, Path("hazelnut"), Import(frame_rate=1000.0))
print(planes)

# %%
# A pixel that fired in a share p of the planes saw −log(1 − p) photons per plane: the moment method inverts the exact
# mean code. Where every plane fired, one bit cannot state how bright it was.

restored = quiver.restore(planes, "moment")
figure, axes = plt.subplots(1, 2, figsize=(9, 4.4), layout="constrained")
for axis, picture, title in zip(
    axes, (planes.codes[length // 2], restored[length // 2]), ("one plane", "mean of 11 planes, inverted"), strict=True
):
    axis.imshow(picture, cmap="gray")
    axis.set_title(title)
    axis.axis("off")
