"""Opens the clips of a data set, and gives the peak of a score."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from qsim.clip.manifest import check_outside
from qsim.dataset.clip_list import ClipList
from qsim.dataset.dataset import Dataset
from qsim.files import sha256, to_json
from qsim.optics.radiometry import WHITE_PER_MEAN
from qsim.publishing.published_set import PublishedSet, is_published
from qsim.streams.clip import Clip

__all__ = [
    "Clip",
    "check_outside",
    "clips_digest",
    "has_sharp",
    "open_clips",
    "peak_of",
    "split_clips",
    "unfinished",
]


def open_clips(path: Path | str | Iterable[Path | str], split: str | None = None) -> ClipList:
    """Return the finished clips of a data set, all or of one split; the one clip of a clip folder; those of a folder
    of clips, each of which states its split; those of a published set, in a folder or at an address; or those of
    several such, one after another.
    """
    if not isinstance(path, Path | str):
        return ClipList([part for folder in path for part in open_clips(folder, split).parts])
    if is_published(path):
        return PublishedSet.open(path).clips(split)
    path = Path(path)
    if (path / "clip.json").exists():
        return ClipList.of([Clip.open(path)])
    made = sorted(found.parent for found in path.glob("*/clip.json"))
    if path.exists() and not made and not any((path / name).exists() for name in ("dataset.json", "jobs")):
        raise FileNotFoundError(f"{path}: neither a clip nor a data set (it has no clip.json and no dataset.json)")
    if not made or (path / "dataset.json").exists():
        return Dataset.open(path).clips(split)
    return ClipList.of(clip for clip in map(Clip.open, made) if split in (None, clip.info.split))


def split_clips(path: Path | str | Iterable[Path | str], validation: str) -> tuple[ClipList, ClipList]:
    """Return the clips to train on, and those of the validation split that are not among them.

    A clip folder is in every split, so it trains. The split `train` validates on the training clips.
    """
    training = open_clips(path, "train")
    validating = open_clips(path, validation)
    return training, validating if validation == "train" else validating.without(training)


def clips_digest(*groups: Sequence[Clip]) -> str:
    """Return the SHA-256 of what tells clips from others; their folders do not count.

    For clips of a data set these are its series and which of them are finished, for others their names and checksums.
    """
    return sha256(to_json([ClipList.of(group).digest() for group in groups]))


def unfinished(folders: Iterable[str]) -> list[str]:
    """Return a line for each data set of which clips are missing."""
    missing = {path: len(Dataset.open(path).missing) for path in folders if (Path(path) / "dataset.json").exists()}
    return [
        f"{path}: the data set lacks {count} of its clips; a run resumes only with the clips that it began with, so "
        "finish `qsim generate` first"
        for path, count in missing.items()
        if count
    ]


def has_sharp(clip: Clip) -> bool:
    """Return whether the clip stores sharp frames beside the exposed ones."""
    return clip.info.has_sharp


def peak_of(light: float, peak: float | None = None) -> float:
    """Return the peak of a score [photons]: `peak` if given, else 2.5 times the mean light of the stream.

    `ValueError` for a stream without light.
    """
    found = WHITE_PER_MEAN * light if peak is None else peak
    if not 0 < found < float("inf"):
        raise ValueError(
            f"the peak of a score is a number of photons above 0, got {found!r}; check that the stream holds light"
        )
    return found
