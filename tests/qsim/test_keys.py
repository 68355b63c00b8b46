"""Tests keyed random words: equal to Dr.Jit's, independent of crops and order, uniform, all different."""

from __future__ import annotations

import math

import numpy as np
import pytest
from compiled_cases import loaded_drjit
from stats import assert_histogram, assert_mean

from qsim.keys import Key, hash_name, normal, philox4x32, uniform, uniform_pair, words


def test_words_are_those_of_dr_jit():
    """Rounds, order of the key's halves and of the counters; Dr.Jit's last counter counts calls, ours redraws."""
    loaded_drjit()
    from drjit import scalar

    key = Key(12, hash_name("fan_03"), stage=2).philox_key
    assert key >= 2**32
    counters = np.array([[0, 5, 2**32 - 1], [1, 0, 77], [3, 2**31, 9]], np.uint64)
    for redraw in range(3):
        ours = philox4x32(np.vstack([counters, np.full(3, redraw)]), key)
        for i, (x, y, frame) in enumerate(counters.T.tolist()):
            generator = scalar.Philox4x32(seed=key, counter_0=x, counter_1=y, counter_2=frame)
            for _ in range(redraw):
                generator.next_uint32x4()
            np.testing.assert_array_equal(ours[:, i], [int(w) for w in generator.next_uint32x4()])


def test_four_neighbours_share_a_block():
    key = Key(1, 2, frame=9)
    row = words(key, (1, 8), origin=(5, 0), redraw=1)[0]
    for block in (0, 1):
        expected = philox4x32(np.array([block, 5, 9, 1]), key.philox_key)
        np.testing.assert_array_equal(row[4 * block : 4 * block + 4], expected)


@pytest.mark.parametrize("origin", [(0, 0), (0, 1), (3, 2), (5, 3), (7, 4), (2, 9)])
def test_a_crop_has_the_words_of_the_whole(origin):
    whole = words(Key(3, 4, 5), (17, 23), redraw=2)
    y, x = origin
    crop = words(Key(3, 4, 5), (8, 11), origin, redraw=2)
    np.testing.assert_array_equal(crop, whole[y : y + 8, x : x + 11])


def test_words_do_not_depend_on_batches():
    """A frame of many more blocks than are computed at a time, against its rows alone."""
    whole = words(Key(1, 1), (70, 1003))
    for y in (0, 33, 69):
        np.testing.assert_array_equal(words(Key(1, 1), (1, 1003), (y, 0))[0], whole[y])


def test_a_stack_is_its_frames():
    stack = words(Key(1, 2, 7), (3, 5, 6), (1, 1))
    for t in range(3):
        np.testing.assert_array_equal(stack[t], words(Key(1, 2, 7 + t), (5, 6), (1, 1)))


def test_every_part_of_the_key_matters():
    """Seed, clip, frame, stage and redraw: no two give a common row of words, swapped seed and clip included."""
    keys = [Key(1, 2), Key(2, 1), Key(1, 3), Key(1, 2, frame=1), Key(1, 2, stage=1), Key(-1, 2), Key(12, 0), Key(1, 20)]
    drawn = [words(k, (8, 10)) for k in keys] + [words(keys[0], (8, 10), redraw=1)]
    rows = np.concatenate(drawn)
    assert len(np.unique(rows, axis=0)) == len(rows)


def test_words_are_uniform():
    """64 bins of the high and of the low bits of 600 000 words, and their mean."""
    drawn = words(Key(0, 0), (600, 1000))
    assert_histogram(drawn >> 26, np.full(64, 1 / 64), checks=3)
    assert_histogram(drawn & 63, np.full(64, 1 / 64), checks=3)
    assert_mean(uniform(drawn), 0.5, 1 / 12, checks=3)


def test_neighbours_frames_and_redraws_are_uncorrelated():
    """Correlation of 600 000 pairs has sigma 1 / sqrt(n)."""
    u = uniform(words(Key(4, 4), (600, 1000))) - 0.5
    others = [np.roll(u, 1, 1), np.roll(u, 4, 1), np.roll(u, 1, 0)]
    others += [uniform(words(k, (600, 1000), redraw=r)) - 0.5 for k, r in ((Key(4, 4, 1), 0), (Key(4, 4), 1))]
    for other in others:
        assert_mean(u * other, 0.0, 1 / 144, checks=5)


def test_uniform_numbers_keep_their_digits_at_both_ends():
    lowest = np.array([0], np.uint32)
    highest = np.array([2**32 - 1], np.uint32)
    assert uniform(lowest)[0] == 2.0**-33
    assert 0 < uniform(highest)[0] < 1
    below, above = uniform_pair(lowest, lowest)
    assert (below[0], above[0]) == (2.0**-65, 1.0)
    below, above = uniform_pair(highest, highest)
    assert (below[0], above[0]) == (1.0, 2.0**-65)


def test_normal_numbers_are_exact_in_both_tails():
    """1 - 2^-65 is 1 as a float64; its number is the mirror of that of 2^-65."""
    below = np.array([2.0**-65, 0.5, 1.0])
    above = np.array([1.0, 0.5, 2.0**-65])
    z = normal(below, above)
    assert z[1] == 0
    assert z[2] == -z[0]
    assert math.erfc(z[2] / math.sqrt(2)) / 2 == pytest.approx(2.0**-65, rel=1e-12)


def test_names_are_hashed_the_same_for_ever():
    """A golden value: files of earlier versions must replay."""
    assert hash_name("fan_03") == 7687061250864729447
    assert Key(7, hash_name("fan_03"), stage=1).philox_key == 11614136099242458991


def test_parts_that_are_no_integers_are_named():
    with pytest.raises(ValueError, match=r"^Key.seed is an integer, got 1.5$"):
        Key(1.5, 0)
    with pytest.raises(ValueError, match=r"^Key.frame counts frames from 0 to 2\^32 - 1, got -1$"):
        Key(0, 0, -1)
    with pytest.raises(ValueError, match=r"^rows -1 to 0: random numbers have counters from 0 to 2\^32 - 1"):
        words(Key(0, 0), (2, 2), (-1, 0))
    assert Key(np.int64(3), np.uint8(4)) == Key(3, 4)


def test_at_moves_in_time_only():
    assert Key(1, 2, 3, 4).at(9) == Key(1, 2, 9, 4)
