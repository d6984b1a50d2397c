"""What tests of reports share."""

import pytest


@pytest.fixture(autouse=True)
def committed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Results of tests say the same whether or not the checkout has changes."""
    monkeypatch.setattr("ms_slam_env.report.provenance.git_commit", lambda: "0" * 40)
