"""
# Hot and dead pixels, crosstalk

A real array differs from pixel to pixel. A table `[defects]` describes how; without it every pixel is the same.
"""

# %%
# A sensor file with a spread of dark rates, hot pixels, dead pixels and crosstalk. Every key is optional.

from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

import qsim

Path("noisy.toml").write_text("""
[sensor]
model = "BinarySPAD"
pde = 0.4
dark_count_rate = 40.0
bits = 3

[defects]
device_seed = 7
prnu = 0.03
dark.hot_share = 0.02
dark.hot_to = 4000.0
dead = 0.002
crosstalk = 0.002
""")
Path("clean.toml").write_text(Path("noisy.toml").read_text().partition("[defects]")[0])

# %%
# The same clip through both. The fixed pattern belongs to the device: the same pixels are hot in every frame and
# every clip.

side = 128  # tests: 16
clip = qsim.render("text", frames=3, height=side, width=side, speed=4, psnr=30)
streams = {name: clip.sense(f"{name}.toml", ppp=2.0) for name in ("clean", "noisy")}
for name, stream in streams.items():
    codes = stream.codes[:].mean(axis=0)
    brightest = np.sort(codes, axis=None)[-codes.size // 100 :]
    print(f"{name}: mean code {codes.mean():.3f}, that of the brightest 1 % of the pixels {brightest.mean():.3f}")

# %%
# At this light photons outnumber dark counts: the mean codes are nearly equal, and the hottest pixels are bright dots
# in the noisy frame.

figure, axes = plt.subplots(1, 2, figsize=(8, 4.2), layout="constrained")
for axis, (name, stream) in zip(axes, streams.items(), strict=True):
    axis.imshow(stream.codes[1], cmap="gray", vmax=7)
    axis.set_title(name)
    axis.axis("off")

# %%
# The json of a stream stores the table, so the stream can be drawn again.

print(streams["noisy"].info.defects)
