import numpy as np
import pytest
from scipy.signal import butter, filtfilt

from torch_pbd.control.primitive import smoothing
from torch_pbd.control.primitive.smoothing import smoothed_noise, variance_share
from torch_pbd.data import Demonstrations, make_tunnel_demonstrations


def smooth(demonstrations, cutoff, n_steps):
    """Stretched to their own median duration."""
    duration = float(np.median([time[-1] - time[0] for time in demonstrations.times]))
    return smoothing.smooth(demonstrations.times, demonstrations.positions, cutoff, n_steps, duration)


def two(time, position, **labels):
    return Demonstrations(time, np.stack([position, position])[:, :, None], **labels)


def jittered(rng, n=301, step=0.01):
    time = step * np.arange(n)
    time[1:-1] += rng.uniform(-0.2 * step, 0.2 * step, size=n - 2)
    return time


@pytest.mark.parametrize("frequency", [0.5, 2.0, 4.0, 8.0])
def test_the_response_is_that_of_a_butterworth_filter_run_both_ways(frequency):
    time = np.arange(0.0, 20.0, 0.01)
    movements = smooth(two(time, np.sin(2.0 * np.pi * frequency * time)), 4.0, 4001)
    inner = np.abs(movements.position[0, 1000:3000, 0]).max()  # away from the ends
    assert inner == pytest.approx(1.0 / (1.0 + (frequency / 4.0) ** 4), abs=5e-4)


def test_smoothing_agrees_with_scipys_filter_in_the_middle(rng):
    time = np.arange(0.0, 20.0, 0.001)
    noise = rng.normal(size=len(time))
    movements = smooth(two(time, noise), 4.0, len(time))
    filtered = filtfilt(*butter(2, 4.0, fs=1000.0), noise)
    middle = slice(2000, -2000)
    np.testing.assert_allclose(movements.position[0, middle, 0], filtered[middle], atol=1e-3 * filtered.std())


def test_without_a_cutoff_a_polynomial_at_jittered_times_has_its_own_acceleration(rng):
    time = jittered(rng)
    position = time**5 - 2.0 * time**3
    movements = smooth(two(time, position), None, 101)
    u = movements.time
    np.testing.assert_allclose(movements.velocity[0, :, 0], 5.0 * u**4 - 6.0 * u**2, atol=1e-8)
    np.testing.assert_allclose(movements.acceleration[0, :, 0], 20.0 * u**3 - 12.0 * u, atol=1e-6)


def test_true_times_are_used_where_they_jitter(rng):
    time = jittered(rng, 1001)
    movements = smooth(two(time, np.sin(2.0 * time)), 4.0, 201)
    middle, u = slice(20, -20), movements.time
    bias = 4.0 * (2.0 / (2.0 * np.pi * 4.0)) ** 4  # acceleration times what the filter takes away
    np.testing.assert_allclose(movements.acceleration[0, middle, 0], -4.0 * np.sin(2.0 * u[middle]), atol=1.1 * bias)


def test_demonstrations_of_other_durations_are_stretched_with_their_derivatives():
    times = [np.linspace(0.0, lasting, 401) for lasting in (8.0, 10.0, 12.5)]
    recorded = Demonstrations(
        times, [np.sin(time / lasting)[:, None] for time, lasting in zip(times, (8.0, 10.0, 12.5), strict=True)]
    )
    movements = smooth(recorded, None, 51)
    assert movements.time[-1] == 10.0
    for name, expected in [("position", np.sin), ("velocity", np.cos)]:
        values = getattr(movements, name)[:, :, 0]
        scale = {"position": 1.0, "velocity": 0.1}[name]
        np.testing.assert_allclose(values, np.tile(scale * expected(movements.time / 10.0), (3, 1)), atol=1e-8)


@pytest.mark.parametrize("factor", [1e-6, 1e6])
def test_units_and_origins_do_not_matter(rng, factor):
    time, position = jittered(rng), rng.normal(size=301).cumsum()
    plain = smooth(two(time, position), 4.0, 50)
    scaled = smooth(two(time + 100.0, factor * (position + 1e3)), 4.0, 50)
    for name in ("velocity", "acceleration"):
        expected = getattr(plain, name)
        np.testing.assert_allclose(getattr(scaled, name) / factor, expected, atol=1e-6 * np.abs(expected).max())


def test_a_constant_output_stays_constant(rng):
    time = np.arange(0.0, 5.0, 0.01)
    movements = smooth(two(time, np.full(len(time), 0.5)), 4.0, 50)
    np.testing.assert_allclose(movements.position, 0.5, rtol=1e-12)
    np.testing.assert_allclose(movements.acceleration, 0.0, atol=1e-9)


@pytest.mark.parametrize(("n_samples", "cutoff", "least"), [(4, 4.0, 5), (2, None, 3)])
def test_too_few_samples_are_an_error_that_names_the_demonstration(n_samples, cutoff, least):
    times = [np.arange(9.0), np.arange(float(n_samples))]
    recorded = Demonstrations(times, [np.zeros((len(time), 1)) for time in times])
    with pytest.raises(ValueError, match=rf"demonstration 1 has {n_samples} samples, needs at least {least}"):
        smooth(recorded, cutoff, 10)


@pytest.mark.parametrize("n_samples", [3, 4, 5, 6])
def test_the_shortest_demonstrations_have_an_acceleration(n_samples):
    time = np.linspace(0.0, 1.0, n_samples)
    movements = smooth(two(time, time**2), None, 5)
    np.testing.assert_allclose(movements.acceleration[:, :, 0], 2.0, atol=1e-9)


def test_a_duration_slows_movement_and_cutoff_together(rng):
    time = np.arange(0.0, 1.0, 0.002)
    recorded = two(time, rng.normal(size=len(time)).cumsum())
    fast, slow = (
        smoothing.smooth(recorded.times, recorded.positions, cutoff, 50, lasting)
        for cutoff, lasting in [(8.0, 1.0), (2.0, 4.0)]
    )
    np.testing.assert_allclose(slow.time, 4.0 * fast.time / fast.time[-1])
    ratio = fast.time[-1] / 4.0
    np.testing.assert_allclose(slow.velocity, ratio * fast.velocity, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(slow.acceleration, ratio**2 * fast.acceleration, rtol=1e-6, atol=1e-6)


def test_the_share_of_half_the_deviations_is_a_quarter_of_the_variance(rng):
    whole = rng.normal(size=(6, 40, 2))
    np.testing.assert_allclose(variance_share(0.5 * whole + rng.normal(size=(40, 2)), whole), 0.25, rtol=1e-12)


def test_noise_is_told_from_movement():
    recorded = make_tunnel_demonstrations(20, random_state=0)
    movements = smooth(recorded, 4.0, 100)
    # The tremor of 0.1 mm is above the cutoff; quantization and noise of y are micrometres.
    np.testing.assert_allclose(movements.noise_scale, [1e-4, 2.3e-6], rtol=0.2)
    share = variance_share(smoothed_noise(movements, recorded.times, 4.0).position, movements.position)
    assert share[0] < 1e-4  # x moves by centimetres
    assert share[1] > 0.5  # y is the same for all, but for its noise
