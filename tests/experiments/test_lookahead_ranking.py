"""The ranking of motions by prediction on a tiny path, and its table."""

import numpy as np
import pytest
from ms_slam_experiments import lookahead_ranking as ranking
from ms_slam_experiments.lookahead_ranking import JUDGED, KINDS, LookaheadRanking


def test_rank_correlation_of_a_constant_is_zero():
    met = np.arange(10.0).reshape(5, 2)
    predicted = np.stack([np.ones(5), -met[:, 1]], axis=1)
    assert ranking.rank_correlations(predicted, met) == [0.0, pytest.approx(-1.0)]


def test_one_line_a_setting_that_has_states():
    state = {f"{name}_{kind}": 0.5 for name in JUDGED for kind in KINDS}
    found = {"predictions": [{"variant": "default", **state}] * 2}
    rows = [{"spec": {}, "error": None, "result": found}]
    (table,) = LookaheadRanking().tables(rows)
    (line,) = table.rows
    assert (line["variant"], line["states"]) == ("default", 2)
    assert line["rank_correlation_depth"].value == line["divergence_met_intensity"] == 0.5
    (chart,) = LookaheadRanking().charts(rows)
    assert chart.panels[1].series[0].x == [0.5]
