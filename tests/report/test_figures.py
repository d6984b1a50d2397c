"""Axes that can be read: labels of logarithmic axes are few, plain and apart."""

import itertools

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from ms_slam_env.report import figures
from ms_slam_env.report.charts import Chart, Panel, Series
from ms_slam_env.report.plotly_charts import plots_of


@pytest.mark.parametrize(
    "ends", [(0.05, 900), (0.3, 400), (1.2, 48), (2.1, 9), (3.1, 4.4), (0.002, 0.0031), (5, 5)]
)
@pytest.mark.parametrize("width", [2.4, 6.4])
def test_labels_of_a_logarithmic_axis_are_plain_and_apart(ends, width):
    figure = figures.new_figure(width=width)
    ax = figure.subplots()
    ax.plot(ends, [0, 1], "o")
    ax.set_xscale("log")
    figures.plain_log_ticks(ax.xaxis)
    FigureCanvasAgg(figure).draw()
    low, high = ax.get_xlim()
    labels = [tick.label1 for tick in ax.xaxis.get_major_ticks() if low <= tick.get_loc() <= high]
    assert 2 <= len(labels) <= 8
    for label in labels:
        assert float(label.get_text().replace("−", "-")) > 0
    boxes = sorted((label.get_window_extent() for label in labels), key=lambda box: box.x0)
    gaps = np.array([b.x0 - a.x1 for a, b in itertools.pairwise(boxes)])
    assert (gaps > 2).all()


def test_many_panels_stand_in_rows_of_four_and_a_truth_is_dashed():
    lines = [Series("estimate", [0, 1], [0, 1], mode="lines"),
             Series("truth", [0, 1], [0, 2], mode="dashes")]  # fmt: skip
    panels = [Panel("position_x_m", "position_y_m", lines, title=str(k)) for k in range(6)]
    chart = Chart("paths", "Paths", "", panels)
    axes = figures.draw(chart).axes
    assert [ax.get_title() for ax in axes] == [str(k) for k in range(6)]
    tops = [round(ax.get_subplotspec().rowspan.start) for ax in axes]
    assert tops == [0, 0, 0, 0, 1, 1]
    assert [line.get_linestyle() for line in axes[5].lines] == ["-", "--"]
    estimate, truth = plots_of(chart)[0].data
    assert (estimate["line"]["dash"], truth["line"]["dash"]) == ("solid", "dash")
    assert truth["mode"] == "lines"


def test_lines_of_more_series_than_colours_are_told_apart():
    lines = [Series(f"planner {n}", [0, 1], [n, n], mode="lines") for n in range(12)]
    figure = figures.draw(Chart("many", "Many", "", [Panel("steps", "ate_m", lines)]))
    drawn = figure.axes[0].get_lines()
    looks = {(line.get_color(), line.get_linestyle()) for line in drawn}
    assert len(drawn) == len(looks) == 12
