import numpy as np
import pytest
import torch
from sklearn.neighbors import NearestNeighbors

from torch_pbd.gp.observations import Observations, merge_observations, neighbourhoods, spacing


def tensor(array):
    return torch.tensor(array, dtype=torch.float64)


@pytest.mark.parametrize("e", [1, 2])
def test_spacing_is_a_quantile_of_the_distances_to_the_nearest_neighbour(e, rng):
    x = rng.uniform(size=(300, e))
    nearest = NearestNeighbors(n_neighbors=1).fit(x).kneighbors()[0]
    assert spacing(tensor(x)) == pytest.approx(np.quantile(nearest, 0.9), rel=1e-9)


def test_spacing_of_a_grid_is_its_step_far_from_the_origin_too():
    # Inputs near 1e6 are themselves known to 1e-10 only, a tenth of the tolerance times the step.
    assert spacing(1e6 + 0.1 * torch.arange(50, dtype=torch.float64)[:, None]) == pytest.approx(0.1, rel=1e-8)


@pytest.mark.parametrize("n", [5, 8])
def test_inputs_that_fit_are_each_for_themselves(n):
    index = neighbourhoods(torch.rand(n, 2, dtype=torch.float64), 8)
    assert index.tolist() == list(range(n))


@pytest.mark.parametrize("e", [1, 2])
@pytest.mark.parametrize(("n", "max_inputs"), [(9, 8), (100, 16), (1000, 24), (257, 256), (7, 1)])
def test_neighbourhoods_share_the_inputs_about_equally(n, max_inputs, e, generator):
    index = neighbourhoods(torch.rand(n, e, dtype=torch.float64, generator=generator), max_inputs)
    sizes = torch.bincount(index)
    assert len(sizes) == max_inputs
    assert sizes.min() >= 1
    assert sizes.max() <= 2 * sizes.min() + 1


def test_neighbourhoods_on_a_line_are_runs_of_sorted_inputs(generator):
    x = torch.rand(100, 1, dtype=torch.float64, generator=generator)
    index = neighbourhoods(x, 10)[x[:, 0].argsort()]
    assert (index.diff() >= 0).all()


def test_neighbourhoods_divide_the_dimension_that_is_widest(generator):
    x = torch.rand(64, 2, dtype=torch.float64, generator=generator) * tensor([0.01, 1.0])
    index = neighbourhoods(x, 8)[x[:, 1].argsort()]
    assert (index.diff() >= 0).all()


def test_many_equal_inputs_are_divided_all_the_same():
    index = neighbourhoods(torch.zeros(50, 1, dtype=torch.float64), 8)
    assert torch.bincount(index).tolist() == pytest.approx([6.25] * 8, abs=1)


def observations(n, generator):
    return Observations(
        torch.rand(n, 2, dtype=torch.float64, generator=generator),
        torch.randn(3, n, dtype=torch.float64, generator=generator),
        torch.randint(1, 9, (n,), generator=generator).double(),
    )


def test_merging_is_the_weighted_average_of_each_neighbourhood(generator):
    given = observations(100, generator)
    merged = merge_observations(given, 16)
    index = neighbourhoods(given.inputs, 16).numpy()
    assert len(merged.counts) == 16
    for number in range(16):
        member = index == number
        weights = given.counts.numpy()[member]
        assert merged.counts[number] == weights.sum()
        np.testing.assert_allclose(
            merged.inputs[number], np.average(given.inputs.numpy()[member], axis=0, weights=weights), rtol=1e-9
        )
        np.testing.assert_allclose(
            merged.targets[:, number], np.average(given.targets.numpy()[:, member], axis=1, weights=weights), rtol=1e-9
        )


def test_merging_is_exact_for_what_is_straight(generator):
    given = observations(100, generator)
    slope = tensor([[2.0, -3.0], [0.5, 4.0]])
    straight = Observations(given.inputs, slope @ given.inputs.mT + 1.0, given.counts)
    merged = merge_observations(straight, 16)
    torch.testing.assert_close(merged.targets, slope @ merged.inputs.mT + 1.0, rtol=1e-9, atol=1e-12)


def test_observations_that_fit_are_left_as_they_are(generator):
    given = observations(16, generator)
    assert merge_observations(given, 16) is given
