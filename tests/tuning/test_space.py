"""Design spaces from texts, and configurations from values."""

import dataclasses

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ms_slam_env.errors import InputError
from ms_slam_env.slam.configuration import SlamConfiguration
from ms_slam_env.slam.surfel import SurfelConfig, SurfelSlam
from ms_slam_env.slam.surfel.surfel_config import PAPER
from ms_slam_env.tuning import Choice, Float, Integer, make_space
from ms_slam_env.tuning.space import GROUPS, KNOWN, absences, why_absent


def test_the_paper_has_three_parameters():
    space = make_space(["paper"])
    assert space.defaults() == {
        "depth_cutoff_m": 8.0,
        "icp_rgb_weight": 0.1,
        "confidence_threshold": 10.0,
    }


def test_the_papers_ranges_and_defaults_are_those_it_prints():
    """ICRA 2017, section IV-A: [0 - 10] m, 3 m; [0 - 1], 0.1; [0 - 12], 10."""
    config = SurfelConfig.paper()
    published = (config.depth_cutoff_m, config.icp_rgb_weight, config.confidence_threshold)
    assert published == (3.0, 0.1, 10.0)
    changed = {
        field.name
        for field in dataclasses.fields(SurfelConfig)
        if getattr(config, field.name) != getattr(SurfelConfig(), field.name)
    }
    # The others are our default already, and what ElasticFusion has not is off.
    added = {"check_slips", "motion_mask", "submaps"}
    assert changed == {"depth_cutoff_m", "loop_closure", *added}
    for name, high in (("depth_cutoff_m", 10), ("icp_rgb_weight", 1), ("confidence_threshold", 12)):
        assert PAPER[name][1:] == (0, high)
        assert KNOWN[name].ends()[1] == high
        for value in PAPER[name]:
            SurfelConfig(**{name: value})


def test_every_known_parameter_holds_its_default():
    base = SlamConfiguration()
    others = {name for name in GROUPS["kinectfusion"] if not name.startswith("iterations")}
    own = [name for name in KNOWN if name not in others]
    space = make_space([name for name in own if not why_absent(name, base)])
    for name, value in space.defaults().items():
        assert space.parameters[name].contains(value), name
        assert (
            space.parameters[name]
            .distribution()
            ._contains(space.parameters[name].distribution().to_internal_repr(value))
        )
    assert space.configuration(space.defaults()).slam_config["iterations"] == [4, 5, 10]


def test_pyramid_levels_leave_out_the_coarsest():
    space = make_space(["pyramid_levels", "iterations.0", "iterations.2"])
    assert space.defaults() == {"pyramid_levels": 3, "iterations.0": 4, "iterations.2": 10}
    values = {"iterations.0": 7, "iterations.2": 1}
    for levels, left in ((1, [7]), (2, [7, 5]), (3, [7, 5, 1])):
        made = space.configuration({**values, "pyramid_levels": levels})
        assert made.slam_config["iterations"] == left


def test_the_compiler_is_a_level_of_its_own():
    space = make_space(["compiler", "points_per_level"])
    made = space.configuration({"compiler.fast_math": True, "points_per_level": 700})
    assert made.compiler == {"fast_math": True}
    assert made.slam_config == {"points_per_level": 700}
    assert space.defaults()["compiler.optimization_level"] is None
    assert "compiler.block_dim" not in space.parameters  # of a GPU


def test_levels_that_a_backend_lacks_say_so():
    surfel = SlamConfiguration()
    lines = absences(["machine", "compiler", "points_per_level"], surfel)
    assert "threads is absent: Warp runs a kernel on one thread of the CPU, or on a GPU" in lines
    assert "compiler.block_dim is absent: a CPU runs one thread of a block" in lines
    assert any(line.startswith("precision is absent") for line in lines)
    odometry = SlamConfiguration(slam="odometry")  # OpenCV's, which has threads
    assert list(make_space(["threads"], odometry).parameters) == ["threads"]
    with pytest.raises(
        InputError, match="parameter 'threads' is absent: Warp runs a kernel on one"
    ):
        make_space(["threads=1,2"], surfel)
    with pytest.raises(InputError, match=r"fuse_fp, compiler.block_dim are absent: backend"):
        make_space(["compiler"], odometry)


def test_values_go_where_they_belong():
    base = SlamConfiguration(slam_config={"max_confidence": 20.0}, image_size="80x60")
    space = make_space(["iterations.0", "iterations.2", "loops.window=1:500", "keep_every"], base)
    values = {"iterations.0": 1, "iterations.2": 7, "loops.window": 33, "keep_every": 2}
    made = space.configuration(values)
    assert made.slam_config == {
        "max_confidence": 20.0,
        "iterations": [1, 5, 7],
        "loops": {"window": 33},
    }
    assert (made.keep_every, made.image_size, base.keep_every) == (2, "80x60", 1)


def test_ranges_as_text():
    space = make_space(
        [
            "depth_cutoff_m=1:9",
            "points_per_level=100:9000:log",
            "loop_closure=none,deformation",
            "icp_angle_deg=10:80",
            "image_size=80x60,160x120",
        ]
    )
    assert space.parameters == {
        "depth_cutoff_m": Float(1, 9),
        "points_per_level": Integer(100, 9000, log=True),
        "loop_closure": Choice(("none", "deformation")),
        "icp_angle_deg": Float(10, 80),
        "image_size": Choice(("80x60", "160x120")),
    }


@settings(deadline=None)  # a busy machine is no failure
@given(low=st.integers(-50, 50), size=st.integers(1, 50), value=st.integers(-120, 120))
def test_a_range_holds_what_lies_in_it(low, size, value):
    for kind in (Integer, Float):
        assert kind(low, low + size).contains(value) == (low <= value <= low + size)
    assert not Integer(low, low + size).contains(low + 0.5)


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        ([], "no parameter to explore"),
        (["speed"], "unknown parameter 'speed'; valid choices: depth_cutoff_m"),
        (["iterations.7"], "unknown parameter 'iterations.7'"),
        (["loops.speed=1:2"], "unknown parameter 'loops.speed'"),
        (
            ["bilateral_sigma_m"],
            "parameter 'bilateral_sigma_m' needs a range, as in bilateral_sigma_",
        ),
        (["depth_cutoff_m=5:7"], "'depth_cutoff_m' starts at 8.0, which is not one of 5 to 7"),
        (["depth_cutoff_m=5:1"], "range 5.0:1.0 holds no values"),
        (["depth_cutoff_m=0:5:log"], "holds no values"),
        (["depth_cutoff_m=1:5:exp"], "'1:5:exp' is not low:high or low:high:log"),
        (["depth_cutoff_m=near:far"], "'near:far' is not low:high"),
        (["depth_cutoff_m=1:50"], "SurfelConfig.depth_cutoff_m = 50.0 is outside [0, 12]"),
        (["loop_closure=none,some"], "unknown SurfelConfig.loop_closure 'some'"),
        (["image_size=160x120,3x2"], "unknown image size '3x2'"),
        (["loop_closure=none"], "values none must be two or more"),
        (["loop_closure=[,none"], "is not one value"),
    ],
)
def test_bad_parameters_are_one_line(texts, message):
    with pytest.raises(InputError) as caught:
        make_space(texts)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


class _Own(SurfelSlam):
    def __init__(self, intrinsics, depth_max_m: float = 5.0, window: int = 3) -> None: ...


def test_a_users_backend_has_the_parameters_of_its_constructor():
    base = SlamConfiguration(slam=f"{__name__}:_Own", slam_config={"window": 4})
    space = make_space(["depth_max_m=1:8", "window=2:9", "image_size=80x60,160x120"], base)
    assert space.defaults() == {"depth_max_m": 5.0, "window": 4, "image_size": "160x120"}
    assert space.parameters["window"] == Integer(2, 9)
    assert space.configuration({"depth_max_m": 2.0}).slam_config == {"window": 4, "depth_max_m": 2}
    with pytest.raises(InputError, match=r"parameter 'depth'; .* depth_max_m, window, image"):
        make_space(["depth=1:8"], base)
    with pytest.raises(InputError, match=r"group 'algorithm' of parameters does not fit backend '"):
        make_space(["algorithm"], base)
