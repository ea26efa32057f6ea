from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pytest
from matplotlib.colors import to_rgb

from torch_pbd import CholeskyCovRegressor, Demonstrations, DMPController, GMMBaseline, ProMPBaseline
from torch_pbd.control import AdmittancePlant
from torch_pbd.data import (
    handwriting_covariance,
    handwriting_mean,
    make_handwriting_demonstrations,
    make_paper_simulation,
)
from torch_pbd.plotting import (
    DATA,
    EMPIRICAL,
    FORCE,
    MODEL,
    OTHER,
    SERIES,
    TRUTH,
    MovementDisplay,
    plot_covariance_ellipses,
    plot_demonstrations,
    plot_model_bands,
    plot_std_band,
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


@pytest.fixture(scope="module")
def strokes():
    return make_handwriting_demonstrations(timing=0.0, rate=25.0, random_state=0)


@pytest.fixture(scope="module")
def run(strokes):
    controller = DMPController(GMMBaseline()).fit(strokes)
    schedule = controller.schedule(100.0)
    force = np.zeros_like(schedule.position)
    force[50:80, 1] = 2.0
    return schedule, controller.simulate(force=force, rate=100.0), controller.simulate(rate=100.0)


@pytest.fixture(autouse=True)
def no_figure_is_left():
    yield
    plt.close("all")


def labelled(figure):
    """Colours and dashes of the legend of a figure."""
    return {(to_rgb(line.get_color()), line.get_linestyle()) for line in figure.legends[0].get_lines()}


def drawn(figure):
    lines = [line for ax in figure.axes for line in ax.lines if line.get_zorder() > 0]
    return {(to_rgb(line.get_color()), line.get_linestyle()) for line in lines}


def test_pushes_and_stiffness_are_drawn_in_readable_units(run):
    schedule, pushed, unpushed = run
    axes = pushed.plot(unpushed=unpushed, names=schedule.names)
    expected = [1e3 * pushed.deviation, pushed.force, np.diagonal(pushed.stiffness, axis1=1, axis2=2)]
    for ax, columns, label in zip(
        axes, expected, ["deviation [mm]", "external force [N]", "stiffness [N/m]"], strict=True
    ):
        np.testing.assert_allclose(np.stack([line.get_ydata() for line in ax.lines[:2]], axis=1), columns)
        assert ax.get_ylabel() == label
    np.testing.assert_allclose(axes[0].lines[3].get_ydata(), 1e3 * unpushed.deviation[:, 1])
    *_, spread, stiffness = schedule.plot()
    np.testing.assert_allclose(spread.lines[1].get_ydata() ** 2, 1e6 * schedule.covariance[:, 1, 1], rtol=1e-9)
    np.testing.assert_allclose(stiffness.lines[1].get_ydata(), schedule.stiffness[:, 1, 1])


def test_pushes_on_a_pose_are_drawn_in_the_units_of_each_block():
    time = 0.01 * np.arange(50)
    turned = np.stack([np.cos(time), 0.0 * time, np.sin(time), 0.0 * time], axis=1)
    gain = np.tile(np.diag([100.0, 200.0, 300.0, 4.0, 5.0, 6.0]), (50, 1, 1))
    still, force = np.zeros((50, 3)), np.tile(np.arange(1.0, 7.0), (50, 1))
    twist = np.tile([0.0, 0.0, 0.0, 0.0, 2.0, 0.0], (50, 1))
    run = AdmittancePlant().simulate(still, twist, gain, 0.2 * gain, force, dt=0.01, orientation_desired=turned)
    axes = run.plot(names=list("xyzabc"))
    assert [ax.get_ylabel() for ax in axes] == [
        "deviation [mm]",
        "external force [N]",
        "stiffness [N/m]",
        "deviation [deg]",
        "external torque [Nm]",
        "stiffness [Nm/rad]",
    ]
    arrays = run.numpy()
    rows = [1e3 * arrays.deviation, arrays.force, np.diagonal(arrays.stiffness, axis1=1, axis2=2)]
    for ax, columns in zip(axes, [*rows, np.degrees(arrays.deviation), *rows[1:]], strict=True):
        block = slice(0, 3) if ax in axes[:3] else slice(3, 6)
        np.testing.assert_allclose(np.stack([line.get_ydata() for line in ax.lines[:3]], axis=1), columns[:, block])
    assert {text.get_text() for text in run.plot()[0].figure.legends[0].get_texts()} >= {"force x", "torque z"}


def test_names_of_a_run_are_as_many_as_its_outputs(run):
    with pytest.raises(ValueError, match=r"names is \['a'\], must be 2, one for each output"):
        run[1].plot(names=["a"])


def test_a_batch_of_runs_is_refused(run):
    _, pushed, _ = run
    batch = replace(pushed, position=np.stack([pushed.position] * 3))
    with pytest.raises(ValueError, match=r"must be of one run, .*take one of the batch"):
        batch.plot()


@pytest.mark.parametrize(("n_outputs", "n_axes", "kind"), [(1, 1, "rectilinear"), (3, 1, "3d"), (7, 7, "rectilinear")])
def test_demonstrations_of_any_number_of_outputs_are_drawn(n_outputs, n_axes, kind, rng):
    recorded = Demonstrations(np.arange(5.0), rng.normal(size=(3, 5, n_outputs)), units="mm")
    axes = np.ravel(recorded.plot())
    assert [ax.name for ax in axes] == [kind] * n_axes
    assert axes[-1].get_ylabel() == ("y1 [mm]" if kind == "3d" else f"y{n_outputs - 1} [mm]")


def test_outputs_are_given_by_name_or_number_and_others_refused(strokes):
    assert strokes.plot(["y"]).get_ylabel() == strokes.plot([1]).get_ylabel() == "y [m]"
    for wrong in (["z"], [2], [], [True, 0.5]):
        with pytest.raises(ValueError, match=r"outputs is .*must be one to 9 of 'x', 'y', or their numbers"):
            strokes.plot(wrong)


def test_what_cannot_be_drawn_together_is_refused_by_name(strokes, ax, rng):
    deep = Demonstrations(np.arange(5.0), rng.normal(size=(3, 5, 3)))
    with pytest.raises(ValueError, match=r"ax is .*must be Axes of projection='3d' for three outputs"):
        deep.plot(ax=ax)
    model = GMMBaseline(n_components=1).fit(*strokes.stack())
    with pytest.raises(ValueError, match=r"demonstrations is .*must be a Demonstrations"):
        MovementDisplay.from_estimator(model, strokes.stack()[0])
    with pytest.raises(ValueError, match=r"demonstrations is .*must be with the 2 outputs that GMM"):
        MovementDisplay.from_estimator(model, deep)
    with pytest.raises(ValueError, match=r"names is \['a', 'b'\], must be 1, one for each model"):
        MovementDisplay.from_estimator(model, strokes, names=["a", "b"])
    with pytest.raises(ValueError, match=r"names is \['GMMBaseline', 'GMMBaseline'\], must be 2, .*no two alike"):
        MovementDisplay.from_estimator(model, strokes, other=model)


@pytest.mark.parametrize("input", ["time", "phase"])
def test_a_display_has_the_law_of_the_model(strokes, input):
    model = GMMBaseline().fit(*strokes.stack(input))
    display = MovementDisplay.from_estimator(model, strokes, input=input, n_std=1.5)
    at = np.linspace(0.0, 2.0 if input == "time" else 1.0, 21)
    mean, covariance = model.predict(at[:, np.newaxis], return_cov=True)
    for path, centre, matrix in zip(display.ax_.collections[0].get_paths(), mean, covariance, strict=True):
        away = path.vertices - centre
        distance = np.einsum("ni,ij,nj->n", away, np.linalg.inv(matrix), away)
        np.testing.assert_allclose(distance, 1.5**2, rtol=1e-6)
    band = display.axes_[2].collections[0].get_paths()[0].vertices
    top = mean[:, 1] + 1.5 * np.sqrt(covariance[:, 1, 1])
    np.testing.assert_allclose([band[np.isclose(band[:, 0], x), 1].max() for x in at], top, rtol=1e-9)


def test_a_display_draws_whole_movements_over_what_they_learned(strokes):
    model = ProMPBaseline(n_basis=5).fit(make_handwriting_demonstrations(rate=25.0, random_state=0))
    assert MovementDisplay.from_estimator(model, strokes).axes_[1].get_xlabel() == "phase"
    with pytest.raises(ValueError, match=r"estimator is .*of a controller take its covariance_"):
        MovementDisplay.from_estimator(DMPController(), strokes)


def test_every_line_of_a_figure_is_in_its_legend(strokes, run):
    schedule, pushed, unpushed = run
    model = GMMBaseline().fit(*strokes.stack())
    truth = handwriting_mean(np.linspace(0, 1, 201)), handwriting_covariance(np.linspace(0, 1, 201))
    display = MovementDisplay.from_estimator(model, strokes, other=model, names=["a", "b"], truth=lambda _: truth)
    figures = [
        strokes.plot().figure,
        display.figure_,
        schedule.plot()[0].figure,
        pushed.plot(unpushed=unpushed)[0].figure,
    ]
    for figure in figures:
        assert drawn(figure) - labelled(figure) == set()


def test_one_colour_means_one_thing():
    colours = [DATA, MODEL, EMPIRICAL, FORCE, TRUTH, OTHER]
    assert len({*colours, *SERIES}) == 6 + len(SERIES)
