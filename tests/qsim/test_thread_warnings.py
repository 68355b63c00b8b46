"""Warnings of one thread are treated in their own way, whatever other threads do meanwhile."""

import threading
import warnings

import pytest

from qsim.thread_warnings import warnings_here


def test_only_the_innermost_block_of_this_thread_acts():
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        warnings.warn("before", stacklevel=1)
        with warnings_here("error"):
            with pytest.raises(UserWarning, match="inside"):
                warnings.warn("inside", stacklevel=1)
            with warnings_here("ignore"):
                warnings.warn("ignored", DeprecationWarning, stacklevel=1)
            with pytest.raises(RuntimeWarning, match="again"):
                warnings.warn("again", RuntimeWarning, stacklevel=1)
        warnings.warn("after", stacklevel=1)
    assert [str(one.message) for one in told] == ["before", "after"]


def test_threads_that_cross_leave_each_other_alone():
    """Two blocks that end in the order in which they began, and a thread without a block beside them."""
    entered = threading.Barrier(3)
    left = threading.Barrier(3)
    found = {}

    def crossing(name, first):
        try:
            with warnings_here("error"):
                entered.wait()
                if not first:
                    left.wait()
            if first:
                left.wait()
            warnings.warn(name, stacklevel=1)
        except Warning as error:  # for the assertion: an error in a thread is seen by nobody
            found[name] = error

    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        threads = [threading.Thread(target=crossing, args=case) for case in (("first", True), ("second", False))]
        for thread in threads:
            thread.start()
        entered.wait()
        warnings.warn("beside", stacklevel=1)
        left.wait()
        for thread in threads:
            thread.join()
    assert not found
    assert sorted(str(one.message) for one in told) == ["beside", "first", "second"]
