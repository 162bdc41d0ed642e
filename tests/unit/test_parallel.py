"""Work in threads: the same results in the same order, and the first error."""

from __future__ import annotations

import threading
import time

import pytest
from real2sim.parallel import in_threads


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_results_come_in_the_order_of_the_items(threads):
    def work(item):
        time.sleep(0.02 if item % 2 else 0.0)
        return 10 * item

    assert in_threads(threads, work, range(7)) == [0, 10, 20, 30, 40, 50, 60]
    assert in_threads(threads, work, []) == []


def test_two_threads_work_beside_each_other_and_one_does_not_leave_its_own():
    both = threading.Barrier(2, timeout=10)
    assert in_threads(2, lambda item: both.wait() >= 0, range(2)) == [True, True]
    own = threading.get_ident()
    assert in_threads(1, lambda item: threading.get_ident() == own, range(3)) == [True] * 3


@pytest.mark.parametrize("threads", [1, 2])
def test_an_error_ends_it_and_what_was_not_begun_is_left(threads):
    begun = []

    def work(item):
        begun.append(item)
        time.sleep(0.01)
        if item == 1:
            raise ValueError("item 1")

    with pytest.raises(ValueError, match="item 1"):
        in_threads(threads, work, range(100))
    assert len(begun) < 20
