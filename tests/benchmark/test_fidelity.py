"""The fidelity benchmark on a tiny path, and its table."""

import numpy as np
import pytest

from ms_slam_env.benchmark import fidelity
from ms_slam_env.benchmark.fidelity_report import as_table, save_figure, summarise
from ms_slam_env.errors import InputError

CHOSEN = ("default", "default, live reference")


@pytest.fixture(scope="module")
def result(box_scene):
    spec = fidelity.FidelitySpec("box", 0, 2, 0.06, 6.0, "80x60")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(fidelity, "get_scene", lambda name, seed: box_scene)
        patch.setattr(fidelity, "SETTINGS", {name: fidelity.SETTINGS[name] for name in CHOSEN})
        return fidelity.run_path(spec)


def test_a_path_gives_every_setting_at_every_state(result):
    assert result["states"] + result["lost"] == 2
    assert list(result["settings"]) == list(CHOSEN)
    for states in result["settings"].values():
        assert len(states) == result["states"]
        for state in states:
            assert (np.abs(state["correlation"]) <= 1).all()
            assert (np.array(state["floor"]) < state["median"]).all()


def test_prediction_ranks_the_motions_in_the_test_room(result):
    correlations = [state["correlation"] for state in result["settings"]["default"]]
    assert (np.median(correlations, axis=0) > 0.5).all()


def test_met_divergence_does_not_depend_on_the_reference(result):
    predicted, live = (result["settings"][name] for name in CHOSEN)
    assert [state["median"] for state in predicted] == [state["median"] for state in live]


def test_rank_correlation_of_a_constant_is_zero():
    met = np.arange(10.0).reshape(5, 2)
    predicted = np.stack([np.ones(5), -met[:, 1]], axis=1)
    assert fidelity._rank_correlations(predicted, met) == [0.0, pytest.approx(-1.0)]


def test_table_and_figure(tmp_path):
    state = {"correlation": [0.5, 0.9], "floor": [0.001, 0.002], "median": [0.01, 0.02]}
    lines = summarise(["a", "absent"], [{"settings": {"a": [state, state], "absent": []}}])
    assert [line.setting for line in lines] == ["a"]
    table = as_table(lines)
    assert table.startswith("2 states")
    assert "| a | 0.50 [0.50, 0.50] | 0.0010 | 0.010 | 0.90 [0.90, 0.90] |" in table
    save_figure(lines, tmp_path / "figure.png")
    assert (tmp_path / "figure.png").stat().st_size > 1000


def test_bad_arguments_are_refused(tmp_path):
    with pytest.raises(InputError, match="living_room"):
        fidelity.main(["--scenes", "kitchen", "--out", str(tmp_path)])
    with pytest.raises(InputError, match="states"):
        fidelity.main(["--states", "0", "--out", str(tmp_path)])
