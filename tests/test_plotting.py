import matplotlib.pyplot as plt
import numpy as np
import pytest

from torch_pbd import CholeskyCovRegressor, Demonstrations, DMPController
from torch_pbd.data import make_paper_simulation
from torch_pbd.plotting import (
    plot_covariance_ellipses,
    plot_demonstrations,
    plot_model_bands,
    plot_pushes,
    plot_std_band,
    plot_stiffness,
)


@pytest.fixture
def ax():
    figure, axes = plt.subplots()
    yield axes
    plt.close(figure)


def test_every_point_of_an_ellipse_is_n_std_from_its_centre(ax, rng):
    roots = rng.normal(size=(4, 2, 2))
    covariance, centres = roots @ roots.transpose(0, 2, 1), rng.normal(size=(4, 2))
    ellipses = plot_covariance_ellipses(centres, covariance, ax, n_std=2.5)
    for path, centre, matrix in zip(ellipses.get_paths(), centres, covariance, strict=True):
        away = path.vertices - centre
        distance = np.sqrt(np.einsum("ni,ij,nj->n", away, np.linalg.inv(matrix), away))
        np.testing.assert_allclose(distance, 2.5, rtol=1e-7)  # the inverse loses digits


def test_an_ellipse_of_a_singular_covariance_is_a_line(ax):
    ellipses = plot_covariance_ellipses(np.zeros((1, 2)), [[[4.0, 0.0], [0.0, 0.0]]], ax, n_std=1.0)
    vertices = ellipses.get_paths()[0].vertices
    np.testing.assert_allclose([vertices[:, 0].max(), np.abs(vertices[:, 1]).max()], [2.0, 0.0], atol=1e-12)


def test_a_band_has_n_std_on_either_side(ax):
    line, band = plot_std_band([0.0, 1.0], [1.0, 2.0], [0.5, 0.25], ax, n_std=2.0)
    np.testing.assert_array_equal(line.get_ydata(), [1.0, 2.0])
    vertices = band.get_paths()[0].vertices
    assert {(0.0, 0.0), (0.0, 2.0), (1.0, 1.5), (1.0, 2.5)} <= set(map(tuple, vertices))


def test_demonstrations_are_one_line_each_with_names_and_units(ax, rng):
    demonstrations = Demonstrations(np.arange(5.0), rng.normal(size=(3, 5, 2)), names=["x", "y"], units="m")
    assert len(plot_demonstrations(demonstrations, [1], ax)) == 3
    assert (ax.get_xlabel(), ax.get_ylabel()) == ("time [s]", "y [m]")
    assert len(ax.get_legend_handles_labels()[1]) == 1
    lines = plot_demonstrations(demonstrations, [0, 1], ax)
    np.testing.assert_array_equal(lines[2].get_xydata(), demonstrations[2].position)


def test_a_model_is_drawn_beyond_the_data_beside_the_empirical_deviations():
    X, y, _ = make_paper_simulation(6, 20, random_state=0)
    model = CholeskyCovRegressor().fit(X, y)
    figure, axes = plt.subplots(1, 2)
    plot_model_bands(model, X, y, axes, beyond=0.5)
    for output, ax in enumerate(axes):
        mean = next(line for line in ax.lines if line.get_label() == "model: mean, 2 sd")
        assert (mean.get_xdata().min(), mean.get_xdata().max()) == (-200.0, 200.0)
        np.testing.assert_allclose(mean.get_ydata(), model.predict(mean.get_xdata()[:, None])[:, output])
        bars = ax.containers[0].lines[2][0].get_segments()
        at_end = y[X[:, 0] == 100.0, output]
        centre, half = at_end.mean(), 2.0 * at_end.std(ddof=1)
        np.testing.assert_allclose(bars[-1][:, 1], [centre - half, centre + half], rtol=1e-9)
    plt.close(figure)


@pytest.mark.filterwarnings("ignore:The movement starts at")  # as a random walk does
def test_pushes_and_stiffness_are_drawn_in_readable_units(rng):
    recorded = Demonstrations(np.linspace(0.0, 2.0, 50), 0.01 * rng.normal(size=(4, 50, 2)).cumsum(axis=1), units="m")
    controller = DMPController(CholeskyCovRegressor()).fit(recorded)
    schedule, run = controller.schedule(100.0), controller.simulate(rate=100.0)
    figure, axes = plt.subplots(4, 1)
    plot_pushes(run, schedule, 1, axes[:3], unpushed=run)
    drawn, dashed = axes[0].get_lines()[:2]
    np.testing.assert_allclose(drawn.get_ydata(), 1e3 * run.deviation[:, 1])
    np.testing.assert_allclose(dashed.get_ydata(), drawn.get_ydata())
    assert axes[0].get_ylabel() == "y1 - desired [mm]"
    lines = plot_stiffness(schedule, axes[3])
    np.testing.assert_allclose(lines[1].get_ydata(), schedule.stiffness[:, 1, 1])
    assert axes[3].get_ylabel() == "stiffness [N/m]"
    plt.close(figure)
