"""
# How dead time bends the response

A SPAD detects nothing for some nanoseconds after each detection. Bright pixels therefore lose counts, and count with
less noise than Poisson.
"""

# %%
# The exact laws of three kinds of pixels, without and with a dead time of 100 ns, at an exposure of 10 µs.

import matplotlib.pyplot as plt
import numpy as np

from qsim import CountingSPAD, Key

exposure = 10e-6  # s
light = np.linspace(1, 400, 60)  # photons per pixel and exposure
pixels = {
    "no dead time": CountingSPAD(pde=0.5, dark_count_rate=0.0, dead_time=0.0, bits=8),
    "100 ns": CountingSPAD(pde=0.5, dark_count_rate=0.0, dead_time=100e-9, bits=8),
    "100 ns, paralyzable": CountingSPAD(pde=0.5, dark_count_rate=0.0, dead_time=100e-9, bits=8, paralyzable=True),
}
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
for name, pixel in pixels.items():
    mean, variance = pixel.mean(light, exposure), pixel.variance(light, exposure)
    left.plot(light, mean, label=name)
    right.plot(light, variance / mean, label=name)
    print(f"{name:20} at 200 photons: mean count {np.interp(200, light, mean):.2f}")
left.set(xlabel="photons per exposure", ylabel="mean count")
right.set(xlabel="photons per exposure", ylabel="variance / mean")
left.legend()

# %%
# A drawn histogram beside the exact one. The counts of the non-paralyzable pixel cannot exceed exposure / dead time =
# 100.

count = 20_000  # tests: 500
pixel = pixels["100 ns"]
codes = pixel.sample(np.full((1, 1, count), 200.0), exposure, key=Key(seed=0, clip=0))
figure, axis = plt.subplots(figsize=(7, 3), layout="constrained")
axis.hist(codes.ravel(), bins=np.arange(30, 70) - 0.5, density=True, label="drawn")
axis.plot(np.arange(30, 70), pixel.pmf(200.0, exposure)[30:70], "k.", label="exact")
axis.set(xlabel="count", ylabel="probability")
axis.legend()

# %%
# Light is found again from a mean count by the exact response. Without it, 200 photons would be taken for fewer.

mean = codes.mean()
found = float(pixel.response(exposure).invert(mean, samples=count))
print(f"mean count {mean:.2f}: naive {mean / 0.5:.1f} photons, by the response {found:.1f}")
