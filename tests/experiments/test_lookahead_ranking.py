"""The ranking of motions by prediction on a tiny path, and its table."""

import numpy as np
import pytest
from ms_slam_experiments import lookahead_ranking as ranking
from ms_slam_experiments.lookahead_ranking import JUDGED, KINDS, LookaheadRanking, RankingSpec

CHOSEN = ("default", "default, live reference")


@pytest.fixture(scope="module")
def result(box_scene):
    spec = RankingSpec("box", 0, 2, 0.06, 6.0, "80x60")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ranking, "get_scene", lambda name, seed: box_scene)
        patch.setattr(ranking, "SETTINGS", {name: ranking.SETTINGS[name] for name in CHOSEN})
        return LookaheadRanking.run(spec)


def of(result, variant, key):
    return [state[key] for state in result["predictions"] if state["variant"] == variant]


def test_a_path_gives_every_setting_at_every_state(result):
    assert result["states"] + result["lost_states"] == 2
    for variant in CHOSEN:
        assert len(of(result, variant, "rank_correlation_intensity")) == result["states"]
    for state in result["predictions"]:
        for kind in KINDS:
            assert abs(state[f"rank_correlation_{kind}"]) <= 1
            assert state[f"divergence_floor_{kind}"] < state[f"divergence_met_{kind}"]


def test_prediction_ranks_the_motions_in_the_test_room(result):
    for kind in KINDS:
        assert np.median(of(result, "default", f"rank_correlation_{kind}")) > 0.5


def test_met_divergence_does_not_depend_on_the_reference(result):
    predicted, live = (of(result, name, "divergence_met_intensity") for name in CHOSEN)
    assert predicted == live


def test_rank_correlation_of_a_constant_is_zero():
    met = np.arange(10.0).reshape(5, 2)
    predicted = np.stack([np.ones(5), -met[:, 1]], axis=1)
    assert ranking.rank_correlations(predicted, met) == [0.0, pytest.approx(-1.0)]


def test_one_line_a_setting_that_has_states():
    state = {f"{name}_{kind}": 0.5 for name in JUDGED for kind in KINDS}
    rows = [{"error": None, "result": {"predictions": [{"variant": "default", **state}] * 2}}]
    (table,) = LookaheadRanking().tables(rows)
    (line,) = table.rows
    assert (line["variant"], line["states"]) == ("default", 2)
    assert line["rank_correlation_depth"].value == line["divergence_met_intensity"] == 0.5
    (chart,) = LookaheadRanking().charts(rows)
    assert chart.panels[1].series[0].x == [0.5]
