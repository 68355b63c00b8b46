"""
# Photons in time

A counting SPAD that is followed photon by photon: when each came, how long the pixel was dead, and the codes that a
clocked SPAD would have made of the same photons.
"""

# %%
# `follow=True` draws every photon. The times are drawn again from the key of the stream and written to one file.

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import qsim
from qsim import CountingSPAD
from qsim.formats import photon_times

side, frames = 96, 4  # tests: 12, 2
clip = qsim.render("fan", frames=frames, height=side, width=side, speed=4, psnr=30)
sensor = CountingSPAD(pde=0.5, dark_count_rate=200.0, dead_time=2e-5, bits=5)
stream = clip.sense(sensor, ppp=12, follow=True, name="photons")
events = photon_times.write(stream, Path("photons.npz"))
times = photon_times.read(Path("photons.npz"))
print(f"{events} events, {times.counts().sum()} counted: the others came while their pixel was dead")
print("codes are the counts:", np.array_equal(np.minimum(times.counts(), 31), stream.codes()))

# %%
# Between two counts lies the dead time, to the last digit: times are not rounded to a clock.

pixels = list(np.ndindex(side, side))
intervals = np.concatenate([times.intervals(y, x) for y, x in pixels])
first = times.first_photons()
figure, axes = plt.subplots(1, 2, figsize=(9, 3), layout="constrained")
axes[0].hist(intervals * 1e6, bins=np.arange(0, 200, 4))
axes[0].axvline(sensor.dead_time * 1e6, color="black", linewidth=1)
axes[0].set(xlabel="time between counts [us]", ylabel="number")
axes[1].hist(first[~np.isnan(first)] * 1e6, bins=np.arange(0, 500, 10))
axes[1].set(xlabel="time to the first count of an exposure [us]")
print(f"shortest interval {intervals.min() * 1e6:.4f} us, dead time {sensor.dead_time * 1e6:.4f} us")

# %%
# The same photons read in three ways: their number, the first of each exposure, and the planes of a clocked SPAD, which
# is not blind after a detection.

clocked = times.clocked(7).reshape(frames, 7, side, side).sum(axis=1)
pictures = {
    "truth": stream.truth(0, 1)[0],
    "counts": times.counts()[0],
    "first count: soon is bright, log": -np.log(np.nan_to_num(first[0], nan=clip.exposure)),
    "sum of 7 clocked planes": clocked[0],
}
figure, axes = plt.subplots(1, 4, figsize=(11, 3), layout="constrained")
for axis, (name, picture) in zip(axes, pictures.items(), strict=True):
    axis.imshow(picture, cmap="gray", vmin=np.percentile(picture, 2), vmax=np.percentile(picture, 98))
    axis.set_title(name, fontsize=10)
    axis.axis("off")
