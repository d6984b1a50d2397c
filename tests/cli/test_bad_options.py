"""What no command takes: one line that names the choices, code 2, and nothing on the disk."""

from __future__ import annotations

import shlex
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from ms_slam_env.cli import main
from ms_slam_env.geometry import se3_exp
from ms_slam_env.sequences import write_trajectory

DEFAULTS = {
    "generate": "--scene table",
    "record": "--scenes table --scene-seeds 1 --options image_size=80x60",
    "view": "--save x.rrd",
}
TRAINERS = ("imitation", "ppo", "sb3")
PROBLEMS = (
    ("--scenes mars", "unknown scene 'mars'; valid choices: living_room"),
    ("--env-id Mars-v0", "unknown environment 'Mars-v0'; valid choices: MSActiveSLAM-v0, "),
    ("--step-m 7", "step_m = 7.0 is outside"),
    ("--scene-seeds 1000", "EnvConfig.num_scene_seeds = 1000 is outside"),  # validation's
    ("--observation rgbd", "observation 'rgbd' has several parts"),
)
NEEDS = {"record": "minari", "view": "rerun", "explore": "optuna", "train": "sb3_contrib"}


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[str]]:
    """A sequence of three frames, and two trajectories."""
    folder = tmp_path_factory.mktemp("inputs")
    (folder / "sequence" / "depth").mkdir(parents=True)
    for index in range(3):
        pixels = np.full((60, 80), 5000, np.uint16)
        Image.fromarray(pixels).save(folder / f"sequence/depth/{index}.png")
    (folder / "sequence" / "intrinsics.txt").write_text("71 71 39.5 29.5 80 60 5000")
    poses = np.stack([se3_exp([0.1 * k, np.sin(k), 0, 0, 0, 0.1 * k]) for k in range(120)])
    pair = [str(folder / "estimate.txt"), str(folder / "truth.txt")]
    for path in pair:
        write_trajectory(path, 0.05 * np.arange(120), poses)
    return {"SEQUENCE": [str(folder / "sequence")], "ESTIMATE": pair[:1], "PAIR": pair}


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("fly", "unknown command 'fly'; valid choices: benchmark, "),
        ("benchmark --planners nonsense", "unknown planner 'nonsense'; valid choices:"),
        ("benchmark --scenes mars", "unknown scene 'mars'; valid choices: living_room"),
        ("benchmark --scenes missing.glb", "mesh file 'missing.glb' does not exist"),
        ("benchmark --options slam=orb", "unknown SLAM backend 'orb'; valid choices:"),
        ("benchmark --options foo=1", "unknown option of the environment 'foo'"),
        ("benchmark --options slam_config.foo=1", "SurfelConfig 'slam_config.foo'; valid"),
        ("benchmark --planners policy,path=none.zip", "no policy file 'none.zip'"),
        ("benchmark --planners greedy,rho_I=x", "rho_I = 'x' is outside"),
        ("benchmark --planners greedy,foo=1", "'foo'; valid choices: preset, rho_I"),
        ("benchmark --planners :Greedy", "planner ':Greedy' cannot be loaded"),
        ("benchmark --planners 'greedy,rho_I=['", "'[' is not a YAML value"),
        ("benchmark --options 'steps=['", "'[' is not a YAML value"),
        ("benchmark --stps 3", "Unrecognized options: --stps"),
        ("benchmark --planner greedy", "perhaps you meant --planners"),
        ("benchmark --steps 0", "error: steps = 0 is outside"),
        ("benchmark --step-m -1", "error: step_m = -1.0 is outside"),
        ("benchmark --steps three", "--steps"),
        ("benchmark --seeds exam", "valid choices: train, validation, test"),
        ("benchmark --env-id CartPole-v1", "unknown env_id 'CartPole-v1'; valid"),
        (
            "benchmark --env-id MSActiveSLAM-Adaptive-v0",
            "chooses motions only, MSActiveSLAM-Adaptive-v0 also needs a SLAM configuration",
        ),
        ("benchmark --workers 0 --planners random", "workers = 0"),
        ("evaluate", "Missing"),
        ("evaluate missing.txt missing.txt", "cannot read trajectory missing.txt"),
        ("train nonsense", "unknown trainer 'nonsense'; valid choices: imitation, ppo"),
        *((f"train {name} {words}", said) for name in TRAINERS for words, said in PROBLEMS),
        (
            "train ppo --env-id MSActiveSLAM-FreeCamera-Continuous-v0",
            "the actions of 'MSActiveSLAM-FreeCamera-Continuous-v0' are continuous, which no tr",
        ),
        ("train qrdqn --observation rgbd", "observation 'rgbd' has several parts"),
        ("train sb3 --num-envs -1", "Args.num_envs = -1"),
        ("train sb3 --n-steps -1", "Args.n_steps = -1"),
        ("train sb3 --gamma -1", "Args.gamma = -1"),
        ("train sb3 --minutes -1", "Args.minutes = -1"),
        ("train ppo --seed -1", "seed = -1"),
        ("train ppo --memory -1", "memory"),
        ("train ppo --pull 1", "--pull needs --init"),
        ("train ppo --memory 4 --n-steps 40 --chunk 16", "not a multiple of chunk = 16"),
        ("train ppo --init nothing", "no policy file 'nothing'"),
        ("train ppo --resume", "no policy file"),
        ("train ppo --observation x:Y", "unknown observation 'x:Y'"),
        ("generate --scene mars", "unknown scene 'mars'"),
        ("generate --image-size 1x1", "unknown image size '1x1'"),
        ("generate --noise loud", "unknown noise model 'loud'"),
        ("generate --perturbations rain", "unknown perturbation 'rain'; valid choices: rolling"),
        ("generate --perturbations motion-blur,time=1", "unknown option of MotionBlur"),
        ("generate --perturbations motion-blur,samples", "'samples' is not option=value"),
        ("generate --perturbations motion-blur,samples=x", "MotionBlur.samples = 'x' is outside"),
        ("generate --path.frames 1", "HandheldPath.frames = 1 is outside"),
        ("generate --trajectory none.txt", "cannot read trajectory none.txt"),
        ("generate --planner dreamer", "unknown planner 'dreamer'; valid choices: "),
        ("generate --planner greedy,depth=3", "unknown option of planner greedy 'depth'"),
        ("generate --planner greedy --trajectory t.txt", "exclude each other"),
        ("generate --steps 5", "the options of an episode need --planner"),
        ("generate --scale 0.5", "--scale needs --trajectory"),
        ("generate --planner greedy --steps 0", "steps = 0 is outside"),
        ("generate --planner greedy --options speed=3", "speed"),
        ("generate --planner greedy --env-id Mars-v0", "Mars-v0"),
        ("generate --seed -1", "scene seed -1 must be an integer"),
        ("run nowhere", "sequence 'nowhere' is neither a folder nor scene:seed"),
        ("run SEQUENCE --backend orb", "unknown SLAM backend 'orb'; valid choices: su"),
        ("run SEQUENCE --params speed", "option 'speed' is not name=value"),
        ("run SEQUENCE --params speed=1", "'slam_config.speed'; valid choices"),
        ("run SEQUENCE --intrinsics '1 2 3'", "--intrinsics: expected 'fx fy cx cy width"),
        ("run SEQUENCE --intrinsics '1 2 3 4 5 x'", "--intrinsics: 'x' is not a number"),
        ("run SEQUENCE --intrinsics '9 9 4 3 9 7 5000'", "is 80x60 but the intrinsics say 9x7"),
        ("run SEQUENCE --image-size 3x2", "unknown image size '3x2'"),
        ("run SEQUENCE --frame-management some", "'some'; valid choices: none, regular"),
        ("run SEQUENCE --frame-management divergence,x=1", "frame_management.x"),
        ("run SEQUENCE --config no.yaml", "cannot read configuration no.yaml: No such file"),
        ("record --planner nobody", "unknown planner 'nobody'"),
        ("record --env-id Nothing-v0", "Nothing-v0'; valid choices"),
        ("record --scenes kitchn", "unknown scene 'kitchn'"),
        ("record --observation smell", "unknown observation 'smell'"),
        ("record --options colour", "not name=value"),
        ("record --options scene=wall", "option 'scene' cannot be set"),
        ("record --episodes 0", "episodes"),
        ("record --name ../x-v0", "not of the form NAME-v0"),
        ("evaluate PAIR --align affine", "valid choices: se3, sim3, yaw, origin, none"),
        ("evaluate PAIR --delta 0", "delta must be an integer >= 1, got 0"),
        ("evaluate PAIR --max-difference-s -1", "max_difference_s = -1.0 is outside"),
        ("evaluate PAIR --delta-unit km", "valid choices: frames, m, s"),
        ("evaluate PAIR --delta 1.5", "delta must be an integer"),
        ("evaluate PAIR --delta 1000 --delta-unit m", "no two poses are 1000 m apart"),
        ("evaluate PAIR --pairs some", "valid choices: all, consecutive"),
        ("evaluate PAIR --segments 0", "segments = 0 is outside"),
        ("evaluate PAIR --segments 5000", "cannot be cut into 5000 segments"),
        ("evaluate PAIR --segment-lengths-m -1", "> 0 m"),
        ("evaluate PAIR --tolerance nan", "tolerance = nan is outside"),
        ("evaluate PAIR --gap-s -1", "gap_s = -1.0 is outside"),
        (
            "evaluate PAIR --align origin --align-first 3",
            "se3, sim3, yaw can align by the first poses",
        ),
        ("evaluate PAIR --align-first 0", "align_first = 0 is outside"),
        ("evaluate PAIR --map map.ply", "maps are given as --map ESTIMATE --true-map GROUNDTRUTH"),
        ("evaluate PAIR --deltas 1 2", "--deltas needs --runs"),
        ("evaluate PAIR --cutoff-m 0.1", "--cutoff-m needs --map"),
        ("evaluate ESTIMATE", "Missing GROUNDTRUTH"),
        ("explore --sampler grid", "valid choices: random, nsga2, tpe, gp"),
        ("explore --objectives ate ext_ms", "unknown objective 'ate'"),
        ("explore --constraints ate_m=1", "is not metric<limit"),
        (
            "explore --constraints 'ext_ms>1'",
            "is not metric<limit, as in ate_m<0.01, nor M_I>limit",
        ),
        (
            "explore --parameters threads",
            "parameter 'threads' is absent: Warp runs a kernel on one",
        ),
        ("explore --parameters compiler.speed", "unknown parameter"),
        ("explore --tolerance 0.5", "tolerance = 0.5 is outside"),
        ("explore --parameters speed", "unknown parameter 'speed'"),
        ("explore --sequences nowhere", "sequence 'nowhere' is neither a folder nor"),
        ("explore --sequences nowhere:1000", "unknown scene 'nowhere'"),
        ("explore --held-out nowhere:1000", "unknown scene 'nowhere'"),
        ("explore --held-out .", "is no RGB-D sequence"),
        ("explore --held-out table:1002", "sequence table:1002 is explored and held out"),
        ("explore --trials 0", "trials = 0 must be at least 1"),
        ("explore --config no.yaml", "cannot read configuration no.yaml"),
        ("explore --clock sundial", "valid choices: processor, wall"),
        ("explore --frames 3", "frames = 3 is outside"),
        ("explore --image-size 3x3", "unknown image size '3x3'"),
        ("view --planner nobody", "unknown planner"),
        ("view --scene kitchn", "unknown scene"),
        ("view --save .", "is a folder"),
        ("view --steps 0", "steps"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(
    line: str,
    message: str,
    inputs: dict[str, list[str]],
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    command, *words = shlex.split(line)
    pytest.importorskip(NEEDS.get(command, "numpy"))
    words = [part for word in words for part in inputs.get(word, [word])]
    words = [*DEFAULTS.get(command, "").split(), *words]
    out = [] if command in ("fly", "view") or line == "train nonsense" else ["--out", "out"]
    assert main([command, *words, *out]) == 2
    captured = capsys.readouterr()
    lines = captured.err.strip().splitlines()
    assert message in lines[-1]
    assert len(lines) == 1 or command in ("run", "explore")  # what the sequence lacks comes first
    assert captured.out == ""
    assert list(tmp_path.iterdir()) == []
