"""
# Three cameras in the same light

A spike camera, a conventional camera and a quanta image sensor see one clip. Each is averaged over the same time, so
that like is compared with like.
"""

# %%
# A plane of the spike camera is one frame of the clip. The conventional camera exposes for twelve of them, which blurs
# motion; `ppp` counts photons per code, so it has twelve times those of a plane.

import matplotlib.pyplot as plt
import numpy as np

import qsim
from qsim import QIS, SpikeCamera
from qsim.studies.readouts import compare

side, speed = 96, 4  # tests: 16, 4
clip = qsim.render("fan", frames=36, height=side, width=side, frame_rate=20_000, speed=speed, psnr=34)
spike = SpikeCamera(quantum_efficiency=0.6, dark_current=100.0, threshold=1000)
camera = QIS(0.6, 100.0, 5.0, 12, gain=4095 / 10_000, full_well=10_000.0)  # at ISO 100 the full well fills the code

streams = {
    "spike camera": clip.sense(spike, ppp=500, name="spike"),
    "conventional camera": clip.sense(camera, ppp=6000, slices=12, name="conventional"),
    "quanta sensor": clip.sense("quiver-physical", bits=3, ppp=500, name="quanta"),
}
for name, stream in streams.items():
    print(f"{name:20} {len(stream)} codes of {stream.bits} bits, {stream.exposure * 1e6:.0f} us each")

# %%
# `compare` averages the codes within a span of time, by default that of the longest code, and inverts the exact
# response. The first row is the light itself: what the blur of the span leaves.

for row in compare(clip).rows:
    print(f"{row.stream or 'light':14} {row.codes:3} codes in {row.seconds * 1e3:.2f} ms: {row.psnr_db:.1f} dB")

# %%
# In a shorter span there is less blur and fewer photons. The conventional camera has no such codes.

for row in compare(clip, ["spike", "quanta"], span=4 / clip.frame_rate).rows:
    print(f"{row.stream or 'light':14} {row.codes:3} codes in {row.seconds * 1e3:.2f} ms: {row.psnr_db:.1f} dB")
figure, axes = plt.subplots(1, 4, figsize=(11, 3), layout="constrained")
shown = {"one spike plane": streams["spike camera"][18], "twelve spike planes": streams["spike camera"][12:24].mean(0)}
shown |= {"conventional": streams["conventional camera"][1], "one quanta code": streams["quanta sensor"][18]}
for axis, (name, picture) in zip(axes, shown.items(), strict=True):
    axis.imshow(picture, cmap="gray", vmin=0, vmax=np.percentile(picture, 99) or 1)
    axis.set_title(name, fontsize=10)
    axis.axis("off")
