"""Axes that can be read: labels of logarithmic axes are few, plain and apart."""

import itertools

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg

from ms_slam_env.report import figures


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
