"""Restores blur-free video from few-bit quanta streams; trains, evaluates and compares methods.

    video = quiver.restore(stream)
    quiver.score(video, stream).psnr
    data = quiver.windows("out/starter", split="train")
    loader = DataLoader(data, batch_sampler=Batches(8, first=0, last=1000))  # Batches: quiver.data.windows

Torch is imported with the first network or window, not with the package.
"""

from qsim.lazy_imports import attach

__getattr__, __dir__, __all__ = attach(__name__, __file__)
