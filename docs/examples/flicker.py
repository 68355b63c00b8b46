"""
# Light that flickers

Lamps on the mains vary a hundred times per second, and dimmed LEDs are switched on and off. A fast camera sees it in
every frame. The strength of each light is known exactly, so that it can be divided out.
"""

# %%
# The strength of three lamps, averaged over the exposures of a camera at 2000 frames per second. The means are closed
# forms, not samples.

import matplotlib.pyplot as plt
import numpy as np

import qsim
from qsim.scene import AreaLamp, Body, Camera, Diffuse, Mains, PulseWidth, RectifiedSine, Scene, Texture
from qsim.scene.shapes import sheet

rate = 2000
start = np.arange(40) / rate
lamps = {
    "filament, 100 Hz": Mains(100, depth=0.2),
    "tube without smoothing, 120 Hz": RectifiedSine(120),
    "LED, 400 Hz, 30 % on": PulseWidth(400, duty=0.3),
}
figure, axis = plt.subplots(figsize=(7, 3), layout="constrained")
for name, lamp in lamps.items():
    axis.step(start * 1e3, lamp.mean(start, start + 1 / rate), where="mid", label=name)
axis.set(xlabel="time [ms]", ylabel="strength")
axis.legend()

# %%
# A wall under the tube. The clip holds its strength in every frame, and the mean of the codes follows it.

side, frames = 48, 40  # tests: 12, 8
wall = Body("wall", sheet(4, 4), Diffuse(Texture(0.3 + 0.4 * np.random.default_rng(0).random((9, 9)))))
tube = AreaLamp((1, 2, 3), (0, 0, 0), 1.2, 0.2, 20.0, flicker=RectifiedSine(120))
camera = Camera(focal_length=8e-3, f_number=2.8, pixel_pitch=2e-4, height=side, width=side, origin=(0, 0, 4))
clip = qsim.render(Scene("tube", 0, camera, (tube,), (wall,)), frames=frames, frame_rate=rate, psnr=30)
stream = clip.sense("quiver-physical", ppp=3.25, bits=3)
strength = clip.strengths["light0"]
brightness = stream.codes().mean(axis=(1, 2))
print(f"strength of the lamp {strength.min():.2f} to {strength.max():.2f}")
print(f"mean code {brightness.min():.2f} to {brightness.max():.2f}")

# %%
# The codes as photons, and the same over the strength of the lamp. What is left is noise, and the response of pixels
# that do not all have the mean light.

response = stream.sensor.response(stream.exposure)
light = np.array([float(response.invert(code, samples=side**2)) for code in brightness])
steady = light / strength
figure, axis = plt.subplots(figsize=(7, 3), layout="constrained")
axis.plot(light, label="mean photons per pixel")
axis.plot(steady, label="over the strength of the lamp")
axis.set(xlabel="frame", ylim=(0, None))
axis.legend()
print(f"spread over frames: {light.std() / light.mean():.3f}, over the strength {steady.std() / steady.mean():.3f}")
