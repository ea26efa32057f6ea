import math
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.signal
import torch

from torch_pbd.control.simulation.sensor import ForceSensor

DT = 1e-3
EVERYTHING = ForceSensor(0.3, 0.05, 0.02, 5.0, cutoff=125.0, delay_steps=3, deadband=0.1)


def measure(sensor, force, dt=DT, generator=None):
    """Readings of a force (..., T, d), tick by tick."""
    reader = sensor.start(force[..., 0, :], dt, generator)
    readings, saturated = zip(*(reader(tick) for tick in force.unbind(-2)), strict=True)
    return SimpleNamespace(force=torch.stack(readings, dim=-2), saturated=torch.stack(saturated, dim=-1))


def forces(rng, *shape, scale=3.0):
    return torch.tensor(scale * rng.normal(size=shape))


@pytest.mark.parametrize("d", [1, 2, 9])
def test_an_ideal_sensor_reads_the_force(d, rng):
    force = forces(rng, 4, 20, d)
    reading = measure(ForceSensor(), force, DT)
    assert torch.equal(reading.force, force)
    assert not reading.saturated.any()
    assert reading.saturated.shape == (4, 20)


@pytest.mark.parametrize("cutoff", [0.4883, 125.0, 3000.0])
def test_the_step_response_is_the_exponential(cutoff):
    force = torch.full((200, 2), 10.0).double()
    reading = measure(ForceSensor(cutoff=cutoff), force, DT).force
    time = torch.arange(200).double() * DT
    expected = -10.0 * torch.expm1(-2 * math.pi * cutoff * time)
    torch.testing.assert_close(reading, expected[:, None].expand(200, 2), rtol=1e-12, atol=0)


def test_the_filter_is_that_of_scipy(rng):
    force = forces(rng, 3, 300, 2)
    system = ([1.0], [1 / (2 * np.pi * 31.25), 1.0])
    numerator, denominator, _ = scipy.signal.cont2discrete(system, DT, method="zoh")
    expected = scipy.signal.lfilter(numerator.ravel(), denominator, force.numpy(), axis=-2)
    reading = measure(ForceSensor(cutoff=31.25), force, DT).force
    np.testing.assert_allclose(reading, expected, rtol=1e-9, atol=1e-12)


def test_the_stages_come_in_their_order(rng):
    # each changes what the others do: bias before clip, noise behind the filter, deadband last
    force = forces(rng, 300, 2, scale=6.0)
    seeds = [torch.Generator().manual_seed(5) for _ in range(2)]
    reading = measure(EVERYTHING, force, DT, seeds[0])
    decay, level, expected, clipped = np.exp(-2 * np.pi * 125.0 * DT), np.full(2, 0.3), [], []
    for tick in force.numpy():
        noisy = level + 0.05 * torch.randn(2, generator=seeds[1], dtype=torch.float64).numpy()
        level = decay * level + (1 - decay) * (tick + 0.3)
        rounded = 0.02 * np.round(np.clip(noisy, -5.0, 5.0) / 0.02)
        expected.append(np.sign(rounded) * np.maximum(np.abs(rounded) - 0.1, 0.0))
        clipped.append((np.abs(noisy) >= 5.0).any())
    np.testing.assert_allclose(reading.force[3:], expected[:-3], rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(reading.saturated[3:], clipped[:-3])
    assert 5 < sum(clipped) < 200  # else the test above shows nothing
    torch.testing.assert_close(reading.force[:3], torch.full((3, 2), 0.2, dtype=torch.float64), rtol=0, atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_noise_keeps_the_type_and_the_global_state(dtype, rng):
    force = forces(rng, 3, 50, 6).to(dtype)
    before = torch.get_rng_state()
    one, two = (measure(EVERYTHING, force, DT, torch.Generator().manual_seed(1)) for _ in range(2))
    assert torch.equal(one.force, two.force)
    assert one.force.dtype == dtype
    assert torch.equal(before, torch.get_rng_state())


def test_a_sensor_starts_at_rest():
    sensor = ForceSensor(bias=[0.5, -2.0], cutoff=10.0, delay_steps=2, range=2.0)
    reader = sensor.start(torch.zeros(2), DT)
    for _ in range(9):
        force, saturated = reader(torch.zeros(2))
        assert force.tolist() == [0.5, -2.0]
        assert saturated
        force.zero_()  # a caller may: the readings to come are not touched by it


@pytest.mark.parametrize("delay", [0, 1, 7])
def test_a_delay_shifts_readings_and_flags(delay, rng):
    force = forces(rng, 2, 40, 3)
    prompt = measure(ForceSensor(0.4, range=3.0), force, DT)
    late = measure(ForceSensor(0.4, range=3.0, delay_steps=delay), force, DT)
    assert torch.equal(late.force[:, delay:], prompt.force[:, : 40 - delay])
    assert torch.equal(late.saturated[:, delay:], prompt.saturated[:, : 40 - delay])
    assert (late.force[:, :delay] == 0.4).all()
    assert prompt.saturated.any()


def test_quantization_errs_by_half_a_step_at_most(rng):
    force = forces(rng, 50, 100)
    error = measure(ForceSensor(resolution=0.025), force, DT).force - force
    assert 0.0124 < error.abs().max() <= 0.0125 * (1 + 1e-9)
    steps = (force + error) / 0.025
    torch.testing.assert_close(steps, steps.round(), rtol=0, atol=1e-9)


def test_saturation_clips_and_flags_the_tick():
    force = torch.tensor([[9.9, -9.9], [0.0, 10.0], [-1e30, 3.0], [1.0, 2.0]])
    reading = measure(ForceSensor(range=10.0), force, DT)
    assert reading.saturated.tolist() == [False, True, True, False]
    assert torch.equal(reading.force, force.clamp(-10.0, 10.0))
    boundless = measure(ForceSensor(range=math.inf), force, DT)
    assert torch.equal(boundless.force, force)
    assert not boundless.saturated.any()


def test_noise_is_white_of_its_scale(generator):
    sensor = ForceSensor(noise_scale=0.1, cutoff=1.0)  # behind the filter, so not lowered by it
    noise = measure(sensor, torch.zeros(400, 50).double(), DT, generator).force
    n = noise.numel()
    assert abs(noise.mean()) < 5 * 0.1 / math.sqrt(n)
    assert abs(noise.std() / 0.1 - 1) < 5 / math.sqrt(2 * n)
    for other in (noise.roll(1, dims=0), noise.roll(1, dims=1)):
        assert abs((noise * other).mean()) < 5 * 0.1**2 / math.sqrt(n)


def test_a_deadband_is_continuous_and_zero_within():
    force = torch.linspace(-2.0, 2.0, 4001, dtype=torch.float64)[None, :]
    reading = measure(ForceSensor(deadband=0.5), force, DT).force
    expected = force.sign() * (force.abs() - 0.5).clamp_min(0.0)
    torch.testing.assert_close(reading, expected, rtol=0, atol=1e-15)
    assert reading.diff(dim=1).max() < 0.001 + 1e-12


@pytest.mark.parametrize("sensor", [replace(EVERYTHING, noise_scale=0.0, resolution=0.0), ForceSensor()])
def test_gradients_flow_to_the_force(sensor, rng):
    force = forces(rng, 12, 2, scale=1.0).requires_grad_()
    assert torch.autograd.gradcheck(lambda f: measure(sensor, f, DT).force, force)


def test_the_gradient_is_the_impulse_response(rng):
    force = forces(rng, 30, 1).requires_grad_()
    reading = measure(ForceSensor(cutoff=80.0, delay_steps=2, noise_scale=1.0), force, DT, torch.Generator())
    (gradient,) = torch.autograd.grad(reading.force[-1].sum(), force)
    decay = math.exp(-2 * math.pi * 80.0 * DT)
    age = 26 - torch.arange(30).double()  # two ticks of delay, and one of the filter
    expected = torch.where(age >= 0, (1 - decay) * decay ** age.clamp_min(0), 0.0)
    torch.testing.assert_close(gradient[:, 0], expected, rtol=1e-9, atol=0)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_lost_sample_is_nan_once_and_the_filter_holds(value, rng):
    sensor = ForceSensor(0.2, cutoff=50.0, delay_steps=2)
    force = forces(rng, 30, 2)
    kept = force[[*range(10), *range(11, 30)]]
    force[10, 1] = value
    reading = measure(sensor, force, DT).force
    assert reading.isnan().nonzero().tolist() == [[12, 1]]
    assert torch.equal(reading[13:, 1], measure(sensor, kept, DT).force[12:, 1])


@pytest.mark.parametrize("cutoff", [500.0, 125.0, 31.25, 7.813])
def test_a_jr3_is_late_by_one_over_its_cutoff(cutoff):
    sensor = replace(ForceSensor.jr3(cutoff), bias=0.0, noise_scale=0.0, resolution=0.0)
    ramp = torch.arange(500).double()[:, None] * DT
    lag = (ramp - measure(sensor, ramp, DT).force)[-1].item()
    assert abs(lag - 1 / cutoff) < 0.5001 * DT
    assert ForceSensor.jr3() == ForceSensor.jr3(500.0, rate=1000.0)
    assert sensor.range == 200.0


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ({"bias": math.nan}, "bias is nan N, must be a finite number"),
        ({"bias": [0.0, math.inf]}, "bias is inf N, must be"),
        ({"noise_scale": -0.1}, "noise_scale is -0.1 N, must be a finite number of at least 0"),
        ({"resolution": -1.0}, "resolution is -1.0 N, must be"),
        ({"resolution": 300.0}, "resolution is 300.0 N, must be a finite number of at least 0 and at most 200"),
        ({"range": 0.0}, "range is 0.0 N, must be a finite number above 0"),
        ({"range": math.nan}, "range is nan N, must be"),
        ({"cutoff": 0.0}, "cutoff is 0.0 Hz, must be a finite number above 0 or None"),
        ({"cutoff": math.inf}, "cutoff is inf Hz"),
        ({"delay_steps": -1}, "delay_steps is -1, must be an integer"),
        ({"delay_steps": True}, "delay_steps is True"),
        ({"deadband": math.nan}, "deadband is nan N, must be"),
    ],
)
def test_parameters_are_checked(parameters, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        ForceSensor(**parameters)


def test_what_cannot_be_read_is_refused(rng):
    force = forces(rng, 5, 2)
    with pytest.raises(ValueError, match="bias has 3 values, but the force has 2 axes"):
        ForceSensor(bias=[0.0, 1.0, 2.0]).start(force[0], DT)
    with pytest.raises(ValueError, match=r"generator is None, must be a Generator: noise_scale is 0\.05 N"):
        ForceSensor.jr3().start(force[0], DT)
    with pytest.raises(ValueError, match=r"cutoff is 0\.0 Hz"):
        ForceSensor.jr3(0.0)
