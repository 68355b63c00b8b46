"""Makes the animated picture of the README: one clip, seen and restored in six ways, with the PSNR of each.

python benchmarks/animation.py docs/pictures/demo.webp     # about three minutes of processor time

A scene of the family `text` is rendered and sensed at 3.25 photons per pixel with 1 bit and with 3 bits. `mergenet` was
trained on photographs and on rendered scenes of other families. All panels show photons on one tone curve. PSNR is that
of `quiver.score` over the complete clip: peak 2.5 times the mean light.
"""

from __future__ import annotations

import io
import sys
from dataclasses import dataclass
from pathlib import Path

from numpy import ndarray as Array
from PIL import Image, ImageDraw, ImageFont

import qsim
import quiver
from qsim import colour, files

HEIGHT = 192
WIDTH = 288
FRAMES = 30
SHOWN = range(6, 24)  # frames of the film, whose windows of 11 frames lie in the clip
PPP = 3.25
CAPTION = 22  # pixels above every panel
GAP = 4  # pixels between panels
PAUSE = 80  # milliseconds of a frame: 1/160 of the real speed
MOST_BYTES = 3_000_000


@dataclass(frozen=True)
class Panel:
    """One film with its caption."""

    caption: str
    photons: Array  # [T, H, W]


def panels(clip: qsim.Clip) -> list[Panel]:
    """Return the six films of a clip: truth, single frames of two depths, and three restorations of 3 bits."""
    one, three = (clip.sense(ppp=PPP, bits=bits) for bits in (1, 3))
    wanted = [
        ("one 1-bit frame", one, "moment:1"),
        ("one 3-bit frame", three, "moment:1"),
        ("average of 11 frames", three, "naive"),
        ("QBP + BM3D", three, "qbp-bm3d"),
        ("ours: mergenet", three, "mergenet"),
    ]
    found = [Panel("truth", three.truth())]
    for name, stream, method in wanted:
        video = quiver.restore(stream, method)
        found.append(Panel(f"{name}   {quiver.score(video, stream).psnr:.1f} dB", video))
        print(found[-1].caption, flush=True)
    return found


def film(shown: list[Panel], columns: int = 3) -> bytes:
    """Return an animated WebP of panels in rows, with their captions drawn above them."""
    white = colour.peak(shown[0].photons)
    height, width = shown[0].photons.shape[1:]
    rows = -(-len(shown) // columns)
    size = columns * (width + GAP) - GAP, rows * (height + CAPTION)
    font = ImageFont.load_default(size=15)
    frames = []
    for t in SHOWN:
        sheet = Image.new("L", size, 24)
        draw = ImageDraw.Draw(sheet)
        for i, panel in enumerate(shown):
            x = i % columns * (width + GAP)
            y = i // columns * (height + CAPTION)
            sheet.paste(Image.fromarray(colour.tone(panel.photons[t], white)), (x, y + CAPTION))
            draw.text((x + 4, y + 2), panel.caption, fill=255, font=font)
        frames.append(sheet.convert("RGB"))
    out = io.BytesIO()
    frames[0].save(out, "WEBP", save_all=True, append_images=frames[1:], duration=PAUSE, loop=0, quality=60, method=4)
    return out.getvalue()


def main(target: Path) -> None:
    clip = qsim.render("text", frames=FRAMES, height=HEIGHT, width=WIDTH, speed=2.5, psnr=38)
    content = film(panels(clip))
    if len(content) > MOST_BYTES:
        raise SystemExit(f"{target}: {len(content)} bytes, more than {MOST_BYTES}")
    files.write_bytes(target, content)
    print(f"{target}: {len(content) / 1e6:.2f} MB")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
