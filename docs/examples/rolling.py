"""
# Rows at their own time

Many sensors read their rows one after the other. What moves meanwhile is bent; the truth is known at the time of every
row and at one time for all of them.
"""

# %%
# A pole moves to the right. The clip has eight frames for each exposure of the sensor, so that every row finds the
# light of its interval.

import matplotlib.pyplot as plt
import numpy as np

import qsim
from qsim import CountingSPAD
from qsim.scene import Body, Camera, Constant, Diffuse, Scene, Translation
from qsim.scene.shapes import sheet

side, rate, per_code = 64, 16_000, 8  # tests: 16, 16_000, 4
wall = Body("wall", sheet(4, 4), Diffuse(0.2))
speed = 200.0  # m/s
pole = Body("pole", sheet(0.1, 1.0), Diffuse(0.8), Translation((speed, 0, 0), (-0.1, 0, 0.02)))
pitch = 1e-4 * 64 / side
camera = Camera(focal_length=8e-3, f_number=2.8, pixel_pitch=pitch, height=side, width=side, origin=(0, 0, 1))
scene = Scene("pole", 0, camera, (Constant(1.0),), (wall, pole))
clip = qsim.render(scene, frames=2 * per_code, frame_rate=rate, psnr=32)

# %%
# A counting SPAD reads its rows from top to bottom within the frame of 0.5 ms, or all at once.

sensor = CountingSPAD(pde=0.6, dark_count_rate=50.0, dead_time=0.0, bits=8)
delay = per_code / rate / side
rolling = clip.sense(sensor, ppp=60, slices=per_code, row_delay=delay, name="rolling")
at_once = clip.sense(sensor, ppp=60, slices=per_code, name="at_once")
figure, axes = plt.subplots(1, 4, figsize=(10, 2.8), layout="constrained")
truths = rolling.truth(0, 1)[0], rolling.truth(0, 1, at="frame")[0]
titles = "read at once", "row after row", "truth at the rows' times", "truth at mid-frame"
for axis, image, title in zip(axes, (at_once[0], rolling[0], *truths), titles, strict=True):
    axis.imshow(image, cmap="gray")
    axis.set_title(title, fontsize=10)
    axis.axis("off")

# %%
# The pole leans by speed times delay: the centre of its light in each row, against the law.

background = np.median(rolling[0], axis=1, keepdims=True)
excess = np.maximum(rolling[0] - background - 3 * np.sqrt(background + 1), 0)
centre = (excess * np.arange(side)).sum(axis=1) / np.maximum(excess.sum(axis=1), 1)
rows = np.flatnonzero(excess.sum(axis=1) > 0)
found = np.polyfit(rows, centre[rows], 1)[0]
pixels = camera.focal_length / camera.pixel_pitch / (1 - 0.02)  # per metre at the pole
print(f"lean {found:.4f} px per row, speed times delay {speed * pixels * delay:.4f}")
