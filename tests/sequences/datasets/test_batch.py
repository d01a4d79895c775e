from __future__ import annotations

import os
import time

import pytest
from joblib import parallel_config

from stario.sequences.datasets.batch import Skipped, each
from stario.sequences.errors import InputError


@pytest.mark.parametrize("jobs", [None, 1, 2])
def test_what_fails_is_skipped_with_its_reason(jobs: int | None) -> None:
    """Errors have arguments of their own, which a process could not hand over by pickling."""

    def halve(number: int) -> int:
        if number % 2:
            raise InputError("number", str(number), "an even one")
        return number // 2

    odd = Skipped("3", "number: found 3, expected an even one")
    assert list(each(halve, [2, 3, 8], jobs)) == [1, odd, 4]


def test_results_come_one_by_one() -> None:
    seen: list[int] = []

    def note(number: int) -> int:
        seen.append(number)
        return number

    results = each(note, range(10))
    assert next(results) == 0
    assert len(seen) < 10
    assert list(results) == list(range(1, 10))


def double(number: int) -> int:
    return 2 * number


def test_a_backend_that_hands_out_nothing_before_the_end_works_too() -> None:
    """As Ray's; joblib's own of the kind runs processes without loky."""
    with parallel_config("multiprocessing"):
        assert list(each(double, [1, 2, 3], 2)) == [2, 4, 6]


def test_a_bug_ends_the_batch() -> None:
    with pytest.raises(ZeroDivisionError):
        list(each(lambda number: 1 // number, [1, 0]))


def test_jobs_are_processes() -> None:
    def process(delay: float) -> int:
        time.sleep(delay)
        return os.getpid()

    found = set(each(process, [0.2] * 4, 2))
    assert os.getpid() not in found
    assert set(each(process, [0.0], 1)) == {os.getpid()}
