"""The kinds of results that a report knows; the first that fits is taken."""

from __future__ import annotations

from typing import Any

from ms_slam_env.benchmark.report.kinds.adaptation import Adaptation
from ms_slam_env.benchmark.report.kinds.base import Kind
from ms_slam_env.benchmark.report.kinds.compare import Comparison
from ms_slam_env.benchmark.report.kinds.divergence import Divergence
from ms_slam_env.benchmark.report.kinds.exploration import Exploration
from ms_slam_env.benchmark.report.kinds.frame_management import FrameManagement
from ms_slam_env.benchmark.report.kinds.generic import Generic
from ms_slam_env.benchmark.report.kinds.planners import Planners
from ms_slam_env.benchmark.report.kinds.stages import Stages
from ms_slam_env.benchmark.report.kinds.studies import Difficulty, Rates, Samplers
from ms_slam_env.benchmark.report.kinds.sweeps import FrameSkipping, StepSize, Training
from ms_slam_env.benchmark.report.kinds.teams import Teams
from ms_slam_env.benchmark.report.kinds.trajectory import Evaluation, Run
from ms_slam_env.benchmark.report.kinds.usme import Usme

KINDS: tuple[Kind, ...] = (
    Planners(),
    Comparison(),
    Divergence(),
    Exploration(),
    Samplers(),
    Rates(),
    Difficulty(),
    Usme(),
    FrameManagement(),
    Adaptation(),
    Teams(),
    Run(),
    Evaluation(),
    StepSize(),
    FrameSkipping(),
    Training(),
    Stages(),
    Generic(),
)


def kind_of(content: dict[str, Any]) -> Kind:
    """The kind of JSON ``content``."""
    return next(kind for kind in KINDS if kind.fits(content))
