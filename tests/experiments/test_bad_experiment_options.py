"""Bad options of experiments are refused before anything runs."""

import pytest

from ms_slam_env.benchmark import experiment_class
from ms_slam_env.errors import InputError

REFUSED = {
    "adaptation": [
        ({"image_size": "1x1"}, "unknown image size"),
        ({"scenes": ("mars",)}, "unknown scene"),
        ({"thresholds": (0.1,)}, "thresholds"),
        ({"configurations": ("a.yaml", "b.yaml")}, "cannot read configuration a.yaml"),
    ],
    "arm_masks": [
        ({"scenes": ("garage",)}, "unknown scene 'garage'; valid choices: living_room"),
        ({"options": ("targets.M_I=0.1",)}, "only those of the arm"),
        ({"options": ("arm.colour=red",)}, "unknown option of ArmConfig 'arm.colour'"),
        ({"states": 0}, "states = 0 is outside"),
        ({"episodes": 101}, "outside"),
    ],
    "compare": [
        ({"sequences": ("table",)}, "neither a folder nor scene:seed"),
        ({"sequences": ("table:x",)}, "neither a folder nor scene:seed"),
        ({"sequences": ("table:1:fog",)}, "'fog'; valid choices: kinect"),
        ({"sequences": ("table:1:none+fog",)}, "'fog'; valid choices: .*rolling-shutter"),
        ({"sequences": ("no-such-scene:1",)}, "valid choices: living_room"),
        ({"sequences": ()}, "Compare.sequences is empty"),
        ({"backends": ("lidar",)}, "valid choices: surfel"),
        ({"backends": ("surfel,icp",)}, "'icp' is not option=value"),
        ({"image_sizes": ("3x3",)}, "valid choices"),
        ({"frames": 1}, "outside"),
        ({"trajectories": ("orb",)}, "'orb' are not NAME=FILE"),
        ({"trajectories": ("orb=one.txt",)}, "with several sequences the file needs {sequence}"),
        ({"trajectories": ("surfel={sequence}.txt",)}, "must differ"),
        ({"reference": "orb"}, "unknown reference 'orb'; valid choices: surfel"),
        ({"threads": 0}, "outside"),
    ],
    "env_speed": [
        ({"embodiments": ("tripod",)}, "unknown embodiment 'tripod'"),
        ({"observations": ("smell",)}, "unknown observation 'smell'"),
        ({"seconds": 0}, "EnvSpeed.seconds = 0 is outside"),
    ],
    "explore_divergence": [
        ({"sequences": ("nowhere:1",)}, "nowhere"),
        ({"keep_every": (0,)}, "keep_every"),
    ],
    "explore_rates": [
        ({"samplers": ("grid",)}, "valid choices: random, nsga2, tpe, gp, forest"),
        ({"keep_every": ()}, "no sampler or no rate"),
        ({"keep_every": (0,)}, "keep_every"),
        ({"parameters": ("speed",)}, "unknown parameter 'speed'"),
    ],
    "explore_samplers": [
        ({"samplers": ("grid",)}, "valid choices: random, nsga2, tpe, gp"),
        ({"samplers": ()}, "no sampler"),
        ({"parameters": ("image_size",)}, "'image_size' has no order"),
    ],
    "frame_selection": [
        ({"sequences": ("room",)}, "neither a folder nor scene:seed"),
        ({"sequences": ("cellar:2000",)}, "unknown scene 'cellar'"),
        ({"managements": ("some",)}, "valid choices: none, regular"),
        ({"managements": ("budget,budget_per_s=1,measured=true",)}, "measures time"),
        ({"backend": "orb"}, "unknown SLAM backend 'orb'"),
        ({"image_size": "3x2"}, "unknown image size '3x2'"),
        ({"frames": 3}, "frames = 3 is outside"),
    ],
    "frame_skipping": [
        ({"intervals": (0,)}, "interval 0 is outside"),
        ({"intervals": (81,)}, "interval 81 is outside"),
        ({"desired_ate_m": 0}, "desired_ate_m"),
        ({"histograms": "of-paper"}, "of-paper"),
    ],
    "lookahead_ranking": [
        ({"scenes": ("no-such-scene",)}, "living_room"),
        ({"states": 0}, "states"),
    ],
    "planners": [
        ({"planners": ("nonsense",)}, "unknown planner 'nonsense'; valid choices: .*greedy"),
        ({"planners": ()}, "no planner"),
        ({"planners": ("random", "random")}, "twice"),
        ({"planners": ("greedy,foo=1",)}, "unknown option of planner greedy 'foo'.*rho_I"),
        ({"planners": ("greedy,rho_I",)}, "not option=value"),
        ({"planners": ("os:path",)}, "not a subclass"),
        ({"planners": ("nowhere:Planner",)}, "cannot be loaded"),
        ({"task": "rom"}, "unknown task 'rom'; valid choices: room, home, arm, disturbed"),
        ({"scenes": ("mars",)}, "unknown scene 'mars'; valid choices: living_room"),
        ({"scenes": ("missing.glb",)}, "mesh file 'missing.glb' does not exist"),
        ({"scenes": ("pyproject.toml",)}, "unknown scene"),
        ({"seeds": "exam"}, "unknown split of seeds 'exam'; valid choices: train"),
        ({"episodes": 0}, "episodes = 0"),
        ({"episodes": 101}, "outside \\[1, 100\\]"),
        ({"env_id": "CartPole-v1"}, "valid choices: MSActiveSLAM"),
        ({"options": ("lookahead",)}, "not name=value"),
        ({"options": ("lookahed.reference=live",)}, "lookahed'; valid choices: .*lookahead"),
        ({"options": ("lookahead.reference=dead",)}, "valid choices: live, predicted"),
        ({"options": ("scene=table",)}, "the benchmark sets it"),
        ({"options": ("step_m=1",)}, "the benchmark sets it"),
        ({"steps": 0}, "steps"),
        ({"step_m": float("nan")}, "step_m"),
    ],
    "pose_covariance": [({"frames": 3}, "frames")],
    "pose_sources": [
        ({"sources": ("odometry",)}, "valid choices: slam, slam-kinematics, kinematics"),
        ({"sources": ()}, "at least one"),
        ({"sources": ("slam", "slam")}, "must be different"),
        ({"options": ("pose=slam",)}, "option 'pose' cannot be set"),
        ({"seeds": "exam"}, "unknown split of seeds 'exam'"),
    ],
    "relocalization": [
        ({"variants": ("sift",)}, "ferns, features, local"),
        ({"settings": ("upside-down",)}, "near, far, black, foreign"),
        ({"scenes": ()}, "at least one"),
        ({"scenes": ("table", "table")}, "different"),
        ({"sizes": ("1x1",)}, "image size"),
        ({"maps": 0}, "maps"),
        ({"after": 300}, "after"),
    ],
    "robustness": [
        ({"sequences": ("no-such-scene:1",)}, "unknown scene 'no-such-scene'; valid choices: "),
        ({"sequences": ("usme:no-such-sequence:1",)}, "unknown USME sequence .*city-traffic"),
        ({"sequences": ("usme:city-traffic",)}, "is not usme:NAME:SEED"),
        ({"backends": ("no-such-backend",)}, "unknown SLAM backend .*valid choices: surfel"),
        ({"variations": ("upside-down",)}, "unknown variation .*valid choices: none"),
        ({"image_sizes": ()}, "image_sizes and backends need one value"),
    ],
    "slam_speed": [
        ({"frames": 1}, "SlamSpeed.frames = 1 is outside"),
        ({"warm_up": 80}, "SlamSpeed.warm_up = 80 is outside"),
        ({"stored": (0,)}, "must hold integers"),
    ],
    "soak": [
        ({"env_ids": ("moon",)}, "unknown environment 'moon'"),
        ({"steps": 0}, r"Soak\.steps = 0 is outside"),
    ],
    "submaps": [({"settings": ("sideways",)}, "return, dark, foreign")],
}
"""Options and what the error says of them, by experiment."""


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [(name, *case) for name, cases in REFUSED.items() for case in cases],
)
def test_bad_options_are_refused_before_anything_runs(name, options, message):
    def start():
        experiment = experiment_class(name)(**options)
        experiment.specs()
        experiment.prepare()

    with pytest.raises(InputError, match=message):
        start()
