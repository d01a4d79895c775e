from dataclasses import replace

import numpy as np
import pytest

from stario.fusion.evaluation.checks.faults import (
    DummyPredictor,
    Fault,
    fault_table,
    faults,
    matched_walk,
    run_faults,
    with_true_displacements,
)
from stario.fusion.navigator import Navigator

SECONDS = 10.0
SAMPLES = ("time", "gyro", "accel")


@pytest.fixture(scope="module")
def scores():
    sequence, config = matched_walk(SECONDS, seed=1)
    return run_faults(sequence, config, graph=False)


@pytest.fixture(scope="module")
def results(scores):
    return {row.group: row for row in scores.itertuples()}


def test_every_fault_ends_in_finite_states(results):
    assert list(results) == [fault.name for fault in faults(SECONDS)]
    assert all(result.finite and np.isfinite(result.error_with) for result in results.values())
    assert results["none"].error_with == results["none"].error_without


def test_every_fault_but_none_modifies_samples_or_predictions_as_drawn_from_the_seed():
    sequence, _ = matched_walk(5.0, seed=1)
    for fault in faults(5.0)[1:]:
        if fault.modify_samples is not None:
            drawn = (np.random.default_rng(3) for _ in range(2))
            first, again = (fault.modify_samples(sequence, rng) for rng in drawn)
            pairs = [[getattr(each, name) for each in (sequence, first, again)] for name in SAMPLES]
            assert not all(np.array_equal(old, new) for old, new, _ in pairs), fault.name
            for _, new, same in pairs:
                np.testing.assert_array_equal(new, same)
        if fault.modify_predictions is not None:
            mean, covariance = np.ones((200, 3)), np.tile(np.eye(3), (200, 1, 1))
            fault.modify_predictions(mean, covariance, np.random.default_rng(0))
            assert not ((mean == 1.0).all() and (covariance == np.eye(3)).all()), fault.name


def test_a_refused_recording_is_a_row_of_the_table():
    in_degrees = Fault("rates in degrees", lambda s, _: replace(s, gyro=np.degrees(s.gyro)))
    sequence, config = matched_walk(SECONDS, seed=1)
    found = run_faults(sequence, config, graph=False, only=[in_degrees, Fault("none")])
    refused, unchanged = found.itertuples()
    assert np.isnan(refused.error_with)
    assert unchanged.error_with == refused.error_without
    row = next(row for row in fault_table(found).splitlines() if "degrees" in row)
    assert all(words in row for words in (" - ", "refused: ", "deg/s"))


def test_every_fault_is_reported(results, scores):
    lines = fault_table(scores).splitlines()
    for fault, words in (
        ("gap of 3 s", "gap 3.0 s"),
        ("one NaN in time", "not_finite 1"),
        ("one NaN in gyro", "not_finite 1"),
        ("one NaN in accel", "not_finite 1"),
        ("one NaN from the network", "refused value that is not finite 1"),
        ("one NaN in the covariance", "refused value that is not finite 1"),
        ("1 % duplicated, 1 % swapped", "duplicate"),
        ("three wild timestamps", "future 3"),
        ("ten spikes", "spike 10"),
        ("accelerometer clipped", "saturated"),
    ):
        assert words in results[fault].reported
        [line] = (line for line in lines if line.startswith(fault))
        assert words in line


def test_small_faults_add_little_error(results):
    for fault in ("one NaN in gyro", "20% of samples dropped", "190 Hz", "500 Hz"):
        assert results[fault].error_with < results[fault].error_without + 0.3


def test_a_block_of_false_displacements_lasts_five_seconds():
    [block] = [fault for fault in faults(60.0) if fault.name == "network off by 1 m for 5 s"]
    mean = np.zeros((600, 3))  # ten a second
    assert block.modify_predictions is not None
    block.modify_predictions(mean, np.tile(np.eye(3), (600, 1, 1)), np.random.default_rng(0))
    assert mean.sum(axis=0).tolist() == [50.0, 0.0, 0.0]
    assert np.flatnonzero(mean[:, 0])[0] == pytest.approx(300, abs=1)


def test_true_displacements_have_the_noise_that_the_filter_takes_them_to_have():
    """The filter multiplies their covariance by its scale."""
    sequence, config = matched_walk(SECONDS)
    config = replace(config, filter=replace(config.filter, covariance_scale=4.0))
    preprocessed = Navigator(DummyPredictor(), config).observe(sequence)
    measured = with_true_displacements(preprocessed, sequence.truth, config, 0, noise=0.05)
    errors = []
    for interval, measurement in zip(measured.intervals, measured.measurements, strict=True):
        if measurement is not None:
            np.testing.assert_allclose(4.0 * measurement.covariance_N, 0.05**2 * np.eye(3))
            ends = sequence.truth.at(np.array([interval.stop - 1.0, interval.stop])).position_W
            length = np.linalg.norm((ends[1] - ends[0])[:2])
            errors.append(np.linalg.norm(measurement.d_N[:2]) - length)
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(0.05, rel=0.35)
