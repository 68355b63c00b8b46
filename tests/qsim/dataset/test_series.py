"""Clips counted from their series: names, folders and jobs of any index, without a list of the others."""

import itertools

import pytest

from qsim.dataset import recipe
from qsim.dataset.series import BLOCK, Listing, Series, block_folder, seed_numbers, short_seeds

DIGEST = "0" * 64
SERIES = (
    Series(stem="fan", seeds="3..5", speeds=(1.0, 2.5), split="train", digest=DIGEST),
    Series(stem="fan", seeds=(9, 7), split="val", digest=DIGEST),
    Series(stem="fan_0", seeds=12, speeds=(0.5,), split="test", digest=DIGEST),
)
NAMES = ["fan_0003", "fan_0003_x2.5", "fan_0004", "fan_0004_x2.5", "fan_0005", "fan_0005_x2.5", "fan_0009", "fan_0007"]
NAMES += ["fan_0_0012_x0.5"]

MILLION = """[recipe]
name = "m"
frames = 2
height = 8
width = 8
[[scenes]]
family = "fan"
seeds = "0..999999"
[[scenes]]
family = "tumble"
seeds = "5..14"
speed = [1.0, 2.0]
split = "test"
"""


def test_a_listing_counts_the_clips_of_its_series():
    listing = Listing(SERIES)
    assert len(listing) == sum(map(len, SERIES)) == len(NAMES)
    assert [listing.name(index) for index in range(len(listing))] == NAMES
    for start, stop in itertools.combinations(range(len(NAMES) + 1), 2):
        assert list(listing.names(start, stop)) == NAMES[start:stop]
    assert [listing.find(name) for name in NAMES] == list(range(len(NAMES)))


@pytest.mark.parametrize("name", ["fan_0006", "fan_3", "fan_0003_x2", "fan_00003", "fan_0009_x2.5", "x", "fan_0_0012"])
def test_no_other_name_is_found(name: str):
    assert Listing(SERIES).find(name) is None


@pytest.mark.parametrize("seeds", [(4,), (4, 5, 6), (6, 5), (0, 2)])
def test_equal_seeds_are_written_alike_and_read_back(seeds: tuple[int, ...]):
    written = short_seeds(seeds)
    assert tuple(seed_numbers(written)) == seeds
    assert written == short_seeds(seed_numbers(written))
    assert isinstance(written, str) == (seeds == (4, 5, 6))


@pytest.mark.parametrize("total", [1, 999, 1000, 1001, 999_999, 1_000_000, 1_000_001, 2 * 10**9])
def test_no_folder_has_more_than_a_thousand_entries(total: int):
    """Folders of blocks near each place where one begins: each level counts to a thousand, and blocks differ."""
    levels = {1: 0, 999: 0, 1000: 0, 1001: 1, 999_999: 1, 1_000_000: 1, 1_000_001: 2, 2 * 10**9: 3}[total]
    indices = [i for i in (0, 1, 999, 1000, 999_999, 1_000_000, total - 1) if i < total]
    folders = {index: block_folder(index, total) for index in indices}
    for index, folder in folders.items():
        parts = folder.split("/") if folder else []
        assert len(parts) == levels
        assert all(len(part) == 3 and 0 <= int(part) < 1000 for part in parts)
        number = 0
        for part in parts:
            number = number * 1000 + int(part)
        assert number * BLOCK <= index < (number + 1) * BLOCK


def test_jobs_of_a_million_are_made_when_they_are_asked_for():
    jobs = recipe.parse(MILLION).jobs
    assert len(jobs) == 1_000_020
    assert (jobs[765_432].name, jobs[765_432].key) == ("fan_765432", "000/765/fan_765432")
    assert [job.name for job in jobs[-3:]] == ["tumble_0013_x2", "tumble_0014", "tumble_0014_x2"]
    assert jobs.frames() == 2 * len(jobs)
    part = jobs[6::100_000]
    assert [job.scene_seed for job in part] == [6 + i * 100_000 for i in range(10)] + [8]
    assert [(each[0].stem, len(each)) for each in part.by_section()] == [("fan", 10), ("tumble", 1)]
    assert part.frames() == 22
    joined = part.by_section()[1].together(part.by_section()[0])
    assert [job.name for job in joined[-1:]] == ["fan_900006"]
    assert len(joined[2:7]) == 5
    assert jobs.find("tumble_0005_x2") == jobs[1_000_001]
    assert jobs[3].digest == jobs.listing.digest(3)
    with pytest.raises(IndexError):
        jobs[1_000_020]


def test_shards_of_every_number_hold_every_job_once():
    jobs = recipe.parse(MILLION.replace("0..999999", "0..6")).jobs
    names = jobs.names()
    for count in (1, 2, 5, 30, 40):
        parts = [jobs[i::count].names() for i in range(count)]
        assert sorted(itertools.chain(*parts)) == sorted(names)
        sections = [[job.name for each in jobs[i::count].by_section() for job in each] for i in range(count)]
        assert sections == parts
