"""Saved states: what is no state is refused and changes nothing, whatever is wrong with it."""

import copy
import dataclasses
import pickle
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import ms_slam_env
from ms_slam_env import slam
from ms_slam_env.env import ActiveSlamEnv
from ms_slam_env.env.wrappers import Perturbed
from ms_slam_env.errors import InputError

OPTIONS = {"scene": "table", "scene_seed": 0, "image_size": "80x60"}


def _negative(value):
    if not isinstance(value, np.ndarray):
        return -1
    if value.dtype.names:
        fields = {name: _negative(value[name]) for name in value.dtype.names}
        whole = np.empty_like(value)
        for name, field in fields.items():
            whole[name] = field
        return whole
    return ~value if value.dtype.kind == "b" else -np.ones_like(value)


MUTATIONS = {
    "gone": lambda value: KeyError,
    "none": lambda value: None,
    "text": lambda value: "x",
    "number": lambda value: 7.5,
    "object": lambda value: object(),
    "empty list": lambda value: [],
    "negative": lambda value: _negative(value),
    "huge": lambda value: value + 10**9 if isinstance(value, int) else 10**400,
    "nan": lambda value: _filled(value, np.nan),
    "infinite": lambda value: _filled(value, -np.inf),
    "scaled": lambda value: value * 2 if _is_floats(value) else np.zeros((3, 3)),
    "another row": lambda value: np.concatenate([value, value[:1]]) if _has_rows(value) else (),
    "no row": lambda value: value[:0] if _has_rows(value) else {},
    "flat": lambda value: value.ravel() if isinstance(value, np.ndarray) else [value],
    "other type": lambda value: value.astype("f2") if _is_floats(value) else np.zeros(2, object),
}


def _is_floats(value):
    return isinstance(value, np.ndarray) and value.dtype.kind == "f"


def _has_rows(value):
    return isinstance(value, np.ndarray) and value.ndim > 0 and len(value) > 0


def _filled(value, number):
    return np.full_like(value, number) if _is_floats(value) else number


def places(value, path=()):
    """Paths of everything in a state but the settings, in order."""
    if path[:1] != ("settings",):
        yield path
        for key in _keys(value):
            yield from places(_child(value, key), (*path, key))


def _keys(value):
    if isinstance(value, dict):
        return list(value)
    if isinstance(value, (list, tuple)):
        return range(min(len(value), 2))
    return list(vars(value)) if hasattr(value, "__dict__") else []


def _child(value, key):
    return value[key] if isinstance(value, (dict, list, tuple)) else getattr(value, key)


def mutated(state, path, mutation):
    """A copy of a state with another value at a path."""
    state = copy.deepcopy(state)
    owner = state
    for key in path[:-1]:
        owner = _child(owner, key)
    value = MUTATIONS[mutation](_child(owner, path[-1]))
    if isinstance(owner, (dict, list)):
        if value is KeyError:
            del owner[path[-1]]
        else:
            owner[path[-1]] = value
    elif value is KeyError:
        del owner.__dict__[path[-1]]
    else:
        owner.__dict__[path[-1]] = value
    return state


def same(a, b):
    """Whether two states are the same to the bit."""
    if isinstance(a, np.ndarray):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if _keys(a):
        keys = range(len(a)) if isinstance(a, (list, tuple)) else _keys(a)
        sizes = not isinstance(a, (list, tuple)) or len(a) == len(b)
        return type(a) is type(b) and sizes and all(same(_child(a, k), _child(b, k)) for k in keys)
    return type(a) is type(b) and a == b


def an_action(env, rng):
    mask = env.action_masks()[: env.simulation.embodiment_type.num_motions]
    motion = int(rng.choice(np.flatnonzero(mask)))
    is_pair = isinstance(env.action_space, gym.spaces.MultiDiscrete)
    return np.array([motion, int(rng.integers(3))]) if is_pair else motion


def after_steps(env, count):
    env.reset(seed=3)
    rng = np.random.default_rng(0)
    for _ in range(count):
        env.step(an_action(env.unwrapped, rng))
    return env


ARM = {"model": str(Path(__file__).parents[1] / "robot" / "second_arm.xml"), "camera_site": "lens"}
FREE, ADAPTIVE = "MSActiveSLAM-FreeCamera-v0", "MSActiveSLAM-Adaptive-v0"
BUDGET = {"name": "budget", "share": 0.5, "gain": 0.5}
SLOW = {"scene": "wall", "step_m": 0.03, "step_rad": 0.03}
VARIANTS = {
    "plain": (FREE, {"scene": "living_room", "image_size": "160x120"}),
    "line": ("MSActiveSLAM-FixedTranslation-v0", {}),
    "arm": ("MSActiveSLAM-v0", {"arm": {"frames_per_action": 2}}),
    "second arm": ("MSActiveSLAM-v0", {"arm": {**ARM, "frames_per_action": 1}}),
    "adaptive": (ADAPTIVE, {"embodiment": "free", "image_size": "320x240"}),
    "loops": (FREE, {"slam_config": {"loop_closure": "deformation"}}),
    "unregistered colour": (FREE, {"slam_config": {"color_registration": "estimated"}}),
    "features": (FREE, {"slam_config": {"relocalisation": "features"}}),
    **{seen: (FREE, {"observation": seen}) for seen in ("map", "goals", "held", "candidates")},
    **{
        f"{name} behind a filter": (FREE, {**SLOW, "slam": name, "frame_management": BUDGET})
        for name in sorted(slam.BACKENDS)
    },
    "perturbed": (FREE, {"perturbed": ("auto-exposure", "moving-objects", "frame-skipping")}),
}


def make(variant):
    env_id, own = VARIANTS[variant]
    options = {**OPTIONS, **own}
    needs = {"volumetric": "open3d", "kinectfusion": "open3d", "sparse": "gtsam"}
    pytest.importorskip(needs.get(options.get("slam"), "numpy"), exc_type=ImportError)
    perturbations = options.pop("perturbed", ())
    env = gym.make(env_id, disable_env_checker=True, **options)
    for name in perturbations:
        env = Perturbed(env.unwrapped, name, **{"moving-objects": {"count": 1}}.get(name, {}))
    return env


def went_on(env, steps=3):
    """Outcomes of further steps, and the state after them."""
    rng = np.random.default_rng(1)
    outcomes = [env.step(an_action(env.unwrapped, rng)) for _ in range(steps)]
    return [*outcomes, env.unwrapped.lookahead(), env.unwrapped.save_state()]


@pytest.mark.parametrize("variant", VARIANTS)
def test_an_environment_goes_on_to_the_bit_in_itself_in_a_fresh_one_and_in_a_copy(variant):
    env = make(variant)
    at_first = after_steps(env, 0).unwrapped.save_state()
    at_first["episode"].predicted_divergences = None  # whoever goes on predicts by its own options
    state = after_steps(env, 3).unwrapped.save_state()
    kept, copied = pickle.dumps(state), pickle.loads(pickle.dumps(env))
    expected = went_on(env)
    frames = env.unwrapped.episode.processed
    assert 0 < frames.sum() < len(frames) or "behind a filter" not in variant
    assert same(state, pickle.loads(kept))  # what came after it left it as it was
    env.unwrapped.load_state(at_first)
    assert same(env.unwrapped.save_state(), at_first)
    fresh = make(variant)
    fresh.unwrapped.load_state(state)  # without a reset
    env.unwrapped.load_state(pickle.loads(kept))
    for other in (env, fresh, copied):
        assert same(went_on(other), expected)


@pytest.mark.parametrize(
    ("saver", "loader", "message"),
    [
        ({"noise": "none"}, {}, "saved with noise = 'none'.*has 'kinect'"),
        ({"noise": {"strength": 1}}, {"noise": {"strength": 2}}, "saved with noise"),
        ({"slam": "odometry"}, {}, r"saved with slam = 'odometry'.*has 'surfel'"),
        ({"frame_management": BUDGET}, {"frame_management": "regular"}, "frame_management"),
        ({"perturbed": "auto-exposure"}, {}, "perturbations"),
        (
            {"observation": "rgbd"},
            {"observation": "goals"},
            r"saved with observation = 'rgbd'; .* has observation = 'goals', which needs an occ",
        ),
        (
            {"observation": "map"},
            {"observation": "lookahead"},
            r"saved with observation = 'map', which keeps an occupancy grid; this environment has "
            r"observation = 'lookahead', which keeps no such grid",
        ),
        (
            {},
            {"mask": "map"},
            r"saved with mask = 'true'; this environment has mask = 'map', which needs an occupan",
        ),
    ],
)
def test_a_state_of_another_environment_is_refused_and_changes_nothing(saver, loader, message):
    options = {name: value for name, value in saver.items() if name != "perturbed"}
    one, other = (gym.make(FREE, **OPTIONS, **own).unwrapped for own in (options, loader))
    if "perturbed" in saver:
        Perturbed(one, saver["perturbed"])
    before = after_steps(other, 1).save_state()
    with pytest.raises(InputError, match=message):
        other.load_state(after_steps(one, 1).save_state())
    assert same(other.save_state(), before)


def test_a_state_of_another_observation_goes_on_where_both_keep_the_same():
    one, other = (
        gym.make(FREE, **OPTIONS, observation=name).unwrapped for name in ("rgbd", "pixels")
    )
    other.load_state(after_steps(one, 1).save_state())
    assert one.step(0)[1] == other.step(0)[1]


@pytest.fixture(scope="module", params=ms_slam_env.ENV_IDS)
def played(request):
    """An environment after some steps, its state, an earlier one, and all places in that."""
    env = after_steps(gym.make(request.param, **OPTIONS).unwrapped, 1)
    earlier = env.save_state()
    after_steps(env, 3)
    paths = [path for path in places(earlier) if path]
    return Played(env=env, before=env.save_state(), earlier=earlier, paths=paths)


class Played(dict):
    """With a short text, which Hypothesis writes into its reports."""

    def __repr__(self):
        return str(self["env"])


@settings(
    max_examples=60,
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(data=st.data())
def test_a_mutated_state_is_refused_whole_or_can_be_gone_on_from(played, data):
    env, before, earlier, paths = played.values()
    path = paths[data.draw(st.integers(0, len(paths) - 1))]
    state = mutated(earlier, path, data.draw(st.sampled_from(sorted(MUTATIONS))))
    complaint = None
    try:
        env.load_state(state)
    except InputError as error:
        complaint = str(error)
    if complaint:
        assert "\n" not in complaint
        assert same(env.save_state(), before)
    else:
        observation, reward, *_ = env.step(an_action(env, np.random.default_rng(1)))
        assert observation in env.observation_space
        assert np.isfinite(reward)
        env.load_state(before)


@pytest.mark.parametrize("part", ["slam", "episode", "random", "settings", "coverage"])
def test_a_state_without_a_part_is_refused_by_its_name(played, part):
    env, before, earlier, _ = played.values()
    with pytest.raises(InputError, match=f"lacks \\['{part}'\\]"):
        env.load_state({name: value for name, value in earlier.items() if name != part})
    assert same(env.save_state(), before)


def test_settings_of_arrays_are_other_settings(played):
    env, before, earlier, _ = played.values()
    for name in earlier["settings"]:
        for value in (np.zeros(2), [np.zeros(2)]):
            state = {**earlier, "settings": {**earlier["settings"], name: value}}
            with pytest.raises(InputError, match=f"saved with {name} = "):
                env.load_state(state)
    camera = copy.deepcopy(earlier["settings"])
    owner = next(value for value in camera.values() if hasattr(value, "__dataclass_fields__"))
    object.__setattr__(owner, next(iter(owner.__dataclass_fields__)), np.zeros(2))
    with pytest.raises(InputError, match="this environment has"):
        env.load_state({**earlier, "settings": camera})
    assert same(env.save_state(), before)


def test_settings_that_are_missing_and_counts_below_zero_are_refused(played):
    env, before, earlier, _ = played.values()
    settings = {k: v for k, v in earlier["settings"].items() if k != "field_of_view_deg"}
    with pytest.raises(InputError, match=r"settings lacks \['field_of_view_deg'\]"):
        env.load_state({**earlier, "settings": settings})
    state = copy.deepcopy(earlier)
    lost = next(part for part in parts(state["slam"]) if "lost" in part)["lost"]
    lost[:] = -1
    with pytest.raises(InputError, match=r"lost counts to -1"):
        env.load_state(state)
    assert same(env.save_state(), before)


def parts(value):
    """All mappings in a tree."""
    if isinstance(value, dict):
        yield value
        for one in value.values():
            yield from parts(one)


@pytest.mark.parametrize("state", [None, 3, [], "state", {}])
def test_what_is_no_state_is_refused(played, state):
    with pytest.raises(InputError, match="state"):
        played["env"].load_state(state)


def test_the_scene_of_a_state_is_one_of_ours_and_no_code(tmp_path, monkeypatch):
    """A name of code or of a file is taken from the options alone."""
    (tmp_path / "strange_scene.py").write_text("raise SystemExit('executed')")
    monkeypatch.chdir(tmp_path)
    env = after_steps(ActiveSlamEnv(**OPTIONS), 1)
    before = env.save_state()
    for name in ("strange_scene:scene", "os:system", str(tmp_path / "room.ply"), ""):
        state = copy.deepcopy(before)
        state["episode"].scene = name
        with pytest.raises(InputError, match="unknown scene of a state"):
            env.load_state(state)
    assert "strange_scene" not in sys.modules
    assert same(env.save_state(), before)
    other = copy.deepcopy(before)
    other["episode"].scene = "wall"
    other["coverage"] = after_steps(ActiveSlamEnv(**{**OPTIONS, "scene": "wall"}), 0).save_state()[
        "coverage"
    ]
    env.load_state(other)
    assert env.scene.name == "wall"


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("squared_error_sum", -1e30, "squared_error_sum"),
        ("squared_error_sum", 1e-3, "squared_error_sum is not that of its frames"),
        ("inlier_fraction", 1.5, "inlier_fraction"),
        ("energy_j", -1.0, "energy_j"),
        ("steps_lost", 3, "steps_lost counts to 3"),
        ("steps_away", 10**6, "steps_away"),
        ("action", 49, "action counts to 49"),
        ("scene_seed", 2**31, "scene_seed"),
    ],
)
def test_an_episode_that_cannot_be_is_refused(field, value, message):
    env = after_steps(ActiveSlamEnv(**OPTIONS), 1)
    state = env.save_state()
    setattr(state["episode"], field, value)
    with pytest.raises(InputError, match=message):
        env.load_state(state)


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("pose_error", 0.5, "pose_error that its poses do not have"),
        ("time_s", 0.0, "goes back in time"),
        ("submap", 7, "submap counts to 7"),
    ],
)
def test_a_record_of_a_frame_that_cannot_be_is_refused(field, value, message):
    env = after_steps(ActiveSlamEnv(**OPTIONS), 2)
    state = env.save_state()
    frames = state["episode"].frames
    frames[-1] = dataclasses.replace(frames[-1], **{field: value})
    with pytest.raises(InputError, match=message):
        env.load_state(state)


def test_counts_that_overflow_in_a_later_step_are_refused():
    env = after_steps(ActiveSlamEnv(slam="surfel", **OPTIONS), 1)
    before = env.save_state()
    for part, name in (("", "time"), ("", "lost"), ("surfels", "seen"), ("surfels", "created")):
        state = copy.deepcopy(before)
        values = state["slam"]["map"][part][0] if part else state["slam"]
        values[name][:] = 2**31 - 1
        with pytest.raises(InputError, match=f"{name} counts to 2147483647"):
            env.load_state(state)
    assert same(env.save_state(), before)


def test_dead_surfels_are_as_many_as_the_counters_say():
    env = after_steps(ActiveSlamEnv(slam="surfel", **OPTIONS), 1)
    state = env.save_state()
    state["slam"]["map"]["surfels"][0]["confidence"][:] = 0
    with pytest.raises(InputError, match="counters of others than its"):
        env.load_state(state)


def test_a_pose_of_another_shape_and_an_empty_episode_are_refused(played):
    env, before, earlier, _ = played.values()
    for change, message in (
        (lambda s: s.__setitem__("T_world_kinematic", np.eye(3)), "shape"),
        (lambda s: s["episode"].__dict__.__setitem__("frames", []), "no frame"),
    ):
        state = copy.deepcopy(earlier)
        change(state)
        with pytest.raises(InputError, match=message):
            env.load_state(state)
        assert same(env.save_state(), before)


def test_a_map_larger_than_there_is_room_for_is_refused(played):
    env, before, earlier, _ = played.values()
    state = copy.deepcopy(earlier)
    slam = state["slam"].get("backend", state["slam"])["map"]
    rows = np.zeros(env.config.slam_config.get("max_surfels", 10**6) + 1, dtype=int)
    slam["surfels"] = [{name: array[rows] for name, array in slam["surfels"][0].items()}]
    slam["counters"]["count"] = np.array([len(rows)], dtype=np.int32)
    with pytest.raises(InputError, match="there is room for"):
        env.load_state(state)
    assert same(env.save_state(), before)


@pytest.mark.parametrize("slam", ["odometry", "sparse", "volumetric"])
def test_other_backends_refuse_whole_too(slam):
    pytest.importorskip({"sparse": "gtsam", "volumetric": "open3d"}.get(slam, "numpy"))
    env = after_steps(ActiveSlamEnv(slam=slam, **OPTIONS), 2)
    before = env.save_state()
    for part in list(before["slam"]):
        for mutation in ("gone", "text", "object"):
            with pytest.raises(InputError):
                env.load_state(mutated(before, ("slam", part), mutation))
    assert same(env.save_state(), before)
    env.load_state(before)
    env.step(0)


def test_the_time_limit_counts_the_steps_of_the_episode_loaded():
    env = gym.make("MSActiveSLAM-FreeCamera-v0", max_episode_steps=4, **OPTIONS)
    env.reset(seed=0)
    env.step(0)
    env.step(0)
    state = env.unwrapped.save_state()
    for _ in range(3):  # six steps since the reset, never more than four of an episode
        env.unwrapped.load_state(state)
        assert [env.step(0)[3] for _ in range(2)] == [False, True]


def test_the_time_limit_of_a_pickled_environment_goes_on():
    env = gym.make("MSActiveSLAM-FreeCamera-v0", max_episode_steps=4, **OPTIONS)
    env.reset(seed=0)
    state = env.unwrapped.save_state()
    env.step(0)
    twin = pickle.loads(pickle.dumps(env))
    assert [twin.step(0)[3] for _ in range(3)] == [False, False, True]
    twin.unwrapped.load_state(state)
    assert not twin.step(0)[3]
