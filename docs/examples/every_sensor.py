"""
# Every sensor on one scene

The same light, seen by a quanta image sensor, by a clocked SPAD and by a counting SPAD.
"""

# %%
# A clip holds radiance, so one rendering serves any number of sensors. `speed` multiplies every motion of a family.

import matplotlib.pyplot as plt
import numpy as np

import qsim
from qsim import QIS, BinarySPAD, CountingSPAD

side = 128  # tests: 16
clip = qsim.render("gears", frames=3, height=side, width=side, speed=4, psnr=32)

# %%
# `ppp` is the mean number of photons per pixel and code. Every sensor gets the same light here; what it writes
# depends on its law.

sensors = {
    "QIS, 3 bits, 0.2 e- read noise": QIS(quantum_efficiency=0.8, dark_current=1.6, read_noise=0.2, bits=3),
    "QIS, 3 bits, 2 e- read noise": QIS(quantum_efficiency=0.8, dark_current=1.6, read_noise=2.0, bits=3),
    "clocked SPAD, 1 bit": BinarySPAD(pde=0.4, dark_count_rate=20.0, bits=1),
    "clocked SPAD, sum of 7 planes": BinarySPAD(pde=0.4, dark_count_rate=20.0, bits=3),
    "counting SPAD, 6 bits": CountingSPAD(pde=0.4, dark_count_rate=20.0, dead_time=30e-9, bits=6),
}
streams = {name: clip.sense(sensor, ppp=3.25, name=f"s{n}") for n, (name, sensor) in enumerate(sensors.items())}
for name, stream in streams.items():
    codes = stream.codes[:]
    expected = stream.sensor.mean(stream.truth(), stream.exposure).mean()
    print(f"{name:32} mean code {codes.mean():.3f}, expected {expected:.3f}, largest {codes.max()}")

# %%
# Codes 0 to 7 are shown from black to white. A binary pixel saturates at 1/PDE photons.

figure, axes = plt.subplots(2, 3, figsize=(9, 6.4), layout="constrained")
truth = next(iter(streams.values())).truth(1, 2)[0]
axes[0, 0].imshow(truth, cmap="gray", vmin=0, vmax=8)
axes[0, 0].set_title("light: 3.25 photons/pixel")
for axis, (name, stream) in zip(axes.flat[1:], streams.items(), strict=True):
    axis.imshow(stream.codes[1], cmap="gray", vmin=0, vmax=min(2**stream.bits - 1, 7))
    axis.set_title(name, fontsize=10)
for axis in axes.flat:
    axis.axis("off")

# %%
# The exact distribution of a code is known at every light, so the histogram of a flat patch can be predicted without
# drawing.

figure, axis = plt.subplots(figsize=(7, 3), layout="constrained")
for name, sensor in sensors.items():
    probability = sensor.pmf(3.25, clip.exposure)[:8]
    axis.plot(np.arange(len(probability)), probability, "o-", label=name)
axis.set(xlabel="code", ylabel="probability at 3.25 photons")
axis.legend(fontsize=8)
