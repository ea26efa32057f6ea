"""Low-pass filter at true times, and resampling that keeps holes."""

import numpy as np
import pytest

from torch_pbd.data import Demonstrations


def swinging(frequency, time, **labels):
    wave = np.sin(2.0 * np.pi * frequency * time)[:, np.newaxis]
    return Demonstrations([time], [wave], **labels)


@pytest.mark.parametrize("ratio", [0.2, 0.5, 1.0, 2.0, 4.0])
def test_low_pass_has_the_gain_of_butterworths_filter_run_both_ways(ratio):
    # Of second order forward and backward: |H|^2 = 1 / (1 + (f / f_c)^4).
    time = np.arange(0.0, 20.0, 0.01)
    passed = swinging(2.0 * ratio, time).low_pass(2.0)
    inner = slice(500, 1500)  # away from the ends
    wave = np.sin(2.0 * np.pi * 2.0 * ratio * time[inner])
    gain = passed.positions[0][inner, 0] @ wave / (wave @ wave)
    assert gain == pytest.approx(1.0 / (1.0 + ratio**4), rel=2e-3)
    np.testing.assert_array_equal(passed.times[0], time)


def test_low_pass_takes_uneven_times_as_they_are_and_their_unit(rng):
    time = np.cumsum(rng.uniform(0.002, 0.02, size=1500))
    slow, noise = np.sin(2.0 * np.pi * 0.5 * time), 0.1 * rng.normal(size=time.shape)
    found = Demonstrations([time], [slow + noise]).low_pass(4.0).positions[0][:, 0]
    assert np.std(found - slow) < 0.4 * np.std(noise)
    in_ms = Demonstrations([1e3 * time], [slow + noise], time_unit="ms").low_pass(4.0)
    np.testing.assert_allclose(in_ms.positions[0][:, 0], found, atol=1e-9)


def test_low_pass_leaves_lines_alone_and_refuses_few_samples():
    line = Demonstrations([np.arange(9.0)], [np.outer(np.arange(9.0), [1.0, -2.0])])
    np.testing.assert_allclose(line.low_pass(0.01).positions[0], line.positions[0], atol=1e-9)
    with pytest.raises(ValueError, match="demonstration 0 has 4 samples, must have 5"):
        Demonstrations([np.arange(4.0)], [np.arange(4.0)]).low_pass(1.0)
    with pytest.raises(ValueError, match="cutoff is -1"):
        line.low_pass(-1.0)


def test_resampling_keeps_holes_where_it_is_told_how_long_a_gap_may_be():
    time = np.r_[np.arange(0.0, 1.01, 0.1), np.arange(3.0, 4.01, 0.1)]
    recorded = Demonstrations([time, np.linspace(0.0, 4.0, 41)], [2.0 * time, np.linspace(0.0, 8.0, 41)])
    bridged, holed = recorded.resample(81), recorded.resample(81, max_gap=0.5)
    assert bridged.n_steps == (81, 81)
    assert holed.n_steps == (81 - 39, 81)  # 1.05 to 2.95, at 0.05
    kept = holed.times[0]
    assert not ((kept > 1.0 + 1e-9) & (kept < 3.0 - 1e-9)).any()
    np.testing.assert_allclose(holed.positions[0][:, 0], 2.0 * kept, atol=1e-12)
    with pytest.raises(ValueError, match="max_gap is 0"):
        recorded.resample(81, max_gap=0.0)
