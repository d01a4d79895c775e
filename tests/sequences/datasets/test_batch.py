from __future__ import annotations

import os
import time

import pytest
from joblib import parallel_config

from stario.sequences.datasets.batch import Skipped, each, without_skipped
from stario.sequences.errors import InputError


@pytest.mark.parametrize("jobs", [None, 1, 2])
def test_a_failing_item_is_skipped_with_its_reason(jobs: int | None) -> None:
    """The errors take arguments of their own, with which plain pickling between processes fails."""

    def halve(number: int) -> int:
        if number % 2:
            raise InputError("number", str(number), "an even one")
        return number // 2

    odd = Skipped("3", "number: found 3, expected an even one")
    outcomes = list(each(halve, [2, 3, 8], jobs))
    assert outcomes == [1, odd, 4]
    skipped: list[Skipped] = []
    assert list(without_skipped(outcomes, skipped)) == [1, 4]
    assert skipped == [odd]


def test_results_are_yielded_one_by_one() -> None:
    processed: list[int] = []

    def record(number: int) -> int:
        processed.append(number)
        return number

    results = each(record, range(10))
    assert next(results) == 0
    assert len(processed) < 10
    assert list(results) == list(range(1, 10))


def double(number: int) -> int:
    return 2 * number


def test_a_backend_that_returns_nothing_before_the_end_works_too() -> None:
    """Like Ray's; joblib's own backend of this kind runs processes without loky."""
    with parallel_config("multiprocessing"):
        assert list(each(double, [1, 2, 3], 2)) == [2, 4, 6]


def test_an_unexpected_exception_costs_one_item_and_its_traceback_is_logged(caplog) -> None:
    outcomes = list(each(lambda number: 1 // number, [1, 0, -1]))
    assert outcomes[::2] == [1, -1]
    assert outcomes[1].reason.startswith("ZeroDivisionError")
    assert "Traceback" in caplog.text


def test_several_jobs_run_in_separate_processes() -> None:
    def process(delay: float) -> int:
        time.sleep(delay)
        return os.getpid()

    found = set(each(process, [0.2] * 4, 2))
    assert os.getpid() not in found
    assert set(each(process, [0.0], 1)) == {os.getpid()}
