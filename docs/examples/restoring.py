"""
# Restoring video

Few-bit frames go in, photons per pixel come out. Classical methods need no training; the network `mergenet` is
shipped with its weights.
"""

# %%
# A moving scene, and three bits of it at 3.25 photons per pixel.

import matplotlib.pyplot as plt

import qsim
import quiver

side = 128  # tests: 16
clip = qsim.render("gears", frames=11, height=side, width=side, speed=3, psnr=32)
stream = clip.sense("quiver-physical", bits=3, ppp=3.25)

# %%
# `naive` is the mean of eleven frames, `moment` inverts the exact mean code, `qbp` aligns patches before it averages,
# and `mergenet` is a small network on frames merged along motion. A score compares with the truth of the stream; its
# peak is 2.5 times the mean light.

methods = ("naive:11", "moment:3", "qbp", "mergenet")  # tests: ("naive:11", "moment:3", "mergenet")
videos = {method: quiver.restore(stream, method) for method in methods}
scores = {method: quiver.score(video, stream) for method, video in videos.items()}
for method, score in scores.items():
    print(f"{method:10} PSNR {score.psnr:.2f} dB, after the best factor {score.psnr_matched:.2f} dB")

# %%
middle = 5
pictures = {
    "truth": stream.truth(middle, middle + 1)[0],
    "codes": stream.codes[middle] * stream.sensor.white(stream.exposure) / 7,
}
pictures |= {f"{method}, {scores[method].psnr:.1f} dB": video[middle] for method, video in videos.items()}
figure, axes = plt.subplots(2, 3, figsize=(9, 6.4), layout="constrained")
for axis, (title, picture) in zip(axes.flat, pictures.items(), strict=False):
    axis.imshow(picture, cmap="gray", vmin=0, vmax=8)
    axis.set_title(title)
for axis in axes.flat:
    axis.axis("off")
