"""
# Bit depth against motion

A sensor takes 10 000 binary planes per second. Summing 2ᵇ − 1 of them gives a code of b bits: less noise, more blur.
Which sum is best?
"""

# %%
# A fast clip at the rate of the planes. A SPAD sums 1, 3, 7, 15 or 31 planes to one code; every plane keeps its own
# instant of the motion.

import matplotlib.pyplot as plt
import numpy as np

import qsim

side = 96  # tests: 16
depths = (1, 2, 3, 4, 5)  # tests: (1, 2, 3)
frames = 2 ** depths[-1] - 1
clip = qsim.render("text", frames=frames, height=side, width=side, frame_rate=10_000, speed=16, psnr=28)
streams = {bits: clip.sense("spad-320x240", bits=bits, ppp=2.0 * (2**bits - 1), group=True) for bits in depths}

# %%
# The frame in the middle of the clip, as light per plane, is compared with the sharp instant in its middle.

errors = {}
figure, axes = plt.subplots(1, len(depths), figsize=(2.4 * len(depths), 2.8), layout="constrained")
for axis, (bits, stream) in zip(axes, streams.items(), strict=True):
    planes, middle = 2**bits - 1, len(stream) // 2
    found = stream.sensor.response(stream.exposure).invert(stream.codes[middle].astype(float), samples=1) / planes
    truth = stream.truth(middle, middle + 1)[0] / planes
    errors[bits] = float(np.mean((found - truth) ** 2))
    axis.imshow(found, cmap="gray", vmin=0, vmax=6)
    axis.set_title(f"{bits} bits, {planes} planes", fontsize=10)
    axis.axis("off")
print({bits: f"{error:.3f}" for bits, error in errors.items()})

# %%
# The error falls with noise and rises with blur: three bits are best at this speed and light. `qsim tradeoff` does this
# study at any speed and light, with the exact expectations beside the simulated numbers.

figure, axis = plt.subplots(figsize=(5, 3), layout="constrained")
axis.semilogy(list(errors), list(errors.values()), "o-")
axis.set(xlabel="bits", ylabel="mean square error [photons²]", xticks=list(errors))
