"""Options common to the training scripts, and the tasks that set them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeVar, get_args, get_origin, get_type_hints

from ms_slam_env._runtime.input_files import read_text
from ms_slam_env.config import Checked, bounded, chosen, from_dict, load_yaml
from ms_slam_env.env.registry import POINT as OBSERVATIONS
from ms_slam_env.env.reward import DEFAULT, RewardConfig
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.slam.configuration import is_file_name


@dataclass(frozen=True)
class Problem(Checked):
    """Where a policy is trained and evaluated.

    Attributes:
        out: folder for everything the run writes.
        resume: resume the run in ``out``; options not given keep their values from the run. Files,
            modules and addresses must be given again.
        task: preset of options: a name of a file in ``hyperparameters/``, or your own YAML file;
            options given explicitly override it.
        env_id: id of the environment.
        embodiment: carrier of the camera; None: that of the id.
        observation: name of a variant that is one vector; `held` shows what the motions would
            reveal if repeated for some steps, and gave the best imitation results; `features` is
            the fastest.
        scenes: scenes to train and validate on, with training and validation seeds.
        scene_seeds: number of seeds per scene, from the split's first; the default is that of the
            shipped agents. A policy memorizes few.
        episode_steps: time limit of an episode.
        step_m: translation of a motion; None: the environment's default.
        step_deg: rotation of a motion; None: the environment's default.
        frames_per_action: frames per motion; None: for an arm as many as arrive while it moves,
            some ten, for a free camera the environment's default. With ``--embodiment arm-kinematic
            --frames-per-action 1`` a step costs little more than the free camera's, which suits
            pretraining for the arm itself (``--init``).
        reward: `divergence-and-error`, `mapping` or `paper`; `default`: `mapping` in the id of a
            task, else `divergence-and-error`.
        without: reward terms to ignore.
        image_size: of the camera in training and validation, width x height; None: the
            environment's default. At 80x60 a step costs half as much, and SLAM loses track more
            easily: use it to begin with. The policy file does not depend on it.
        num_envs: parallel environments, one process and one thread each.
        seed: of network, training episodes and sampling.
        eval_episodes: validation episodes, the same at each evaluation, with the same random
            numbers.
        deterministic_eval: evaluate the most probable action instead of sampling.
    """

    out: Path = Path("runs/policy")
    resume: bool = False
    task: str | None = None
    env_id: str = "MSActiveSLAM-FreeCamera-v0"
    embodiment: str | None = None
    observation: str = "features"
    scenes: tuple[str, ...] = ("living_room", "corridor", "table")
    scene_seeds: int = bounded(100, 1, 100_000)
    episode_steps: int = bounded(150, 1, 100_000)
    step_m: float | None = bounded(None, 0, 1)
    step_deg: float | None = bounded(None, 0, 90)
    frames_per_action: int | None = bounded(None, 1, 1000)
    reward: str = chosen(DEFAULT, DEFAULT, *RewardConfig.named())
    without: tuple[str, ...] = ()
    image_size: str | None = None
    num_envs: int = bounded(2, 1, 100_000)
    seed: int = bounded(0, 0, 2**31 - 1)
    eval_episodes: int = bounded(24, 1, 100_000)
    deterministic_eval: bool = False

    algorithms: ClassVar[tuple[str, ...]] = ()
    """Values of ``algorithm`` in the policy files of such a training."""

    def __post_init__(self) -> None:
        """Refuse values out of range, and a training without scenes."""
        super().__post_init__()
        if not self.scenes:
            raise InputError(f"{type(self).__name__}.scenes names no scene")
        terms = [term.name for term in fields(RewardConfig)]
        if not isinstance(self.without, tuple):
            given = f"{type(self).__name__}.without = {self.without!r}"
            raise InputError(f"{given} must be a list of terms")
        for name in self.without:
            if name not in terms:
                raise unknown("term of the reward", name, terms)
        object.__setattr__(self, "without", tuple(sorted(set(self.without))))
        if self.observation not in OBSERVATIONS.names():  # a policy file names no module
            raise unknown("observation", self.observation, OBSERVATIONS.names())

    @property
    def candidates(self) -> int:
        """Values per action that our networks encode action by action; 0 without any."""
        return int(getattr(OBSERVATIONS.find(self.observation), "candidate_numbers", 0))

    @property
    def image(self) -> tuple[int, ...]:
        """Channels, rows and columns of an image for convolutions; empty without one."""
        return tuple(getattr(OBSERVATIONS.find(self.observation), "image_shape", ()))

    @property
    def layers(self) -> dict[str, Any]:
        """Settings of the layers, besides their width, that an initial policy must share."""
        return {"memory": 0, "candidates": self.candidates, "image": self.image, "quantiles": 0}


@dataclass(frozen=True)
class Training(Problem):
    """How long a policy learns from its own steps, and from where it starts.

    Attributes:
        init: policy file to start from, such as one of ``ms-slam train imitation``; its network and
            normalisation are used, its step count is not.
        through: planner through which the policy acts, also in validation: `agent-home` goes to
            distant goals itself, and lets the policy choose among motions unlikely to slip. None:
            the policy acts by itself.
        total_timesteps: environment steps of a training, including the runs before it was resumed.
        minutes: stop this run after so many minutes of training; evaluations and reference episodes
            are not counted. None: no such limit.
        eval_every: environment steps between evaluations; 0: only first and last.
        references: before training, also play the validation episodes with random walk, standing
            still and the greedy planner.
        learning_rate: of Adam.
        gamma: discount factor.
        hidden: width of the two hidden layers.
        curriculum: YAML file of stages, from easy to the problem itself: see ``curriculum.py``.
        episodes_per_scene: consecutive episodes in a drawn scene. Building a room takes a second, a
            home longer, unless it is one of the last 20 rooms or five homes. In a stage that draws
            noise or perturbations, each episode draws a scene.
        also: further tasks to train in, named like ``task``; the parallel environments alternate
            between the problem itself and these. Only their scenes, episode lengths and motions are
            used. Validation uses the problem alone.
        batched: device on which all training environments step at once, in this process, for
            `features` in `MSActiveSLAM-Room-v0` and `-FreeCamera-v0`; `no`: a process each.
    """

    init: Path | None = None
    through: str | None = None
    total_timesteps: int = bounded(200_000, 2, 1_000_000_000)
    minutes: float | None = bounded(None, 0, 1_000_000)
    eval_every: int = bounded(20_000, 0, 1_000_000_000)
    references: bool = False
    learning_rate: float = bounded(2.5e-4, 0, 1)
    gamma: float = bounded(0.98, 0, 1)
    hidden: int = bounded(256, 1, 4096)
    curriculum: Path | None = None
    episodes_per_scene: int = bounded(5, 1, 1_000_000)
    also: tuple[str, ...] = ()
    batched: str = chosen("no", "no", "cpu", "cuda")

    kept: ClassVar[tuple[str, ...]] = ()
    """Options beside `resume.KEPT` that a run keeps when it is resumed."""

    def __post_init__(self) -> None:
        """Refuse values out of range, and what a batch does not have."""
        super().__post_init__()
        for name in ("also", "curriculum", "through") if self.batched != "no" else ():
            if getattr(self, name):
                without = "; --also without a name leaves it out" if name == "also" else ""
                raise InputError(f"batched = {self.batched!r}: a batch has no {name}{without}")


@dataclass(frozen=True)
class PpoTraining(Training):
    """Options of proximal policy optimisation.

    Attributes:
        n_steps: steps of each environment between updates; fewer in ``ms-slam train sb3`` if fewer
            remain of ``total_timesteps``.
        batch_size: environment steps per gradient step.
        n_epochs: passes over the data in one update.
        gae_lambda: trade-off between bias and variance of the advantages.
        ent_coef: weight of the entropy bonus.
        clip_range: clipping range of PPO's objective.
    """

    n_steps: int = bounded(512, 2, 1_000_000)  # advantages of one sample have no spread
    batch_size: int = bounded(256, 2, 1_000_000)
    n_epochs: int = bounded(6, 1, 1000)
    gae_lambda: float = bounded(0.95, 0, 1)
    ent_coef: float = bounded(0.003, 0, 1)
    clip_range: float = bounded(0.2, 0, 1)


@dataclass(frozen=True)
class ReplayTraining(Training):
    """Options of learning from a replay of past steps.

    Attributes:
        buffer_size: transitions kept; each holds two observations of 4-byte numbers.
        learning_starts: environment steps before the first gradient step, of each run.
        train_every: environment steps between gradient steps.
        target_every: gradient steps between copies of the network to the target's.
        epsilon: final share of random actions, from 1 at the start.
        exploration: share of ``total_timesteps`` over which the share of random actions falls.
        save_every: environment steps between saved files.
    """

    buffer_size: int = bounded(100_000, 2, 100_000_000)
    learning_starts: int = bounded(5_000, 1, 1_000_000_000)
    train_every: int = bounded(4, 1, 1_000_000)
    target_every: int = bounded(500, 1, 1_000_000_000)
    epsilon: float = bounded(0.02, 0, 1)
    exploration: float = bounded(0.2, 0, 1)
    save_every: int = bounded(2_000, 1, 1_000_000_000)


TASKS = Path(__file__).parent / "hyperparameters"
P = TypeVar("P", bound=Problem)


def named_in(arguments: Sequence[str]) -> dict[str, str]:
    """The options given on a command line, each with the word after it."""
    words = [part for word in arguments for part in word.split("=", int(word.startswith("--")))]
    pairs = pairwise([*words, ""])
    return {one[2:].replace("-", "_"): after for one, after in pairs if one.startswith("--")}


def shipped_tasks() -> list[str]:
    """Names of the files in ``hyperparameters/``."""
    return sorted(one.stem for one in TASKS.glob("*.yaml"))


def of_task(cls: type[P], task: str, trainer: str) -> P:
    """Read the options ``cls`` of a task: its sections ``problem`` and that of the trainer.

    Raises:
        InputError: an unknown task, or a file without such options.
    """
    path = Path(task) if is_file_name(task) else TASKS / f"{task}.yaml"
    if not is_file_name(task) and task not in shipped_tasks():
        raise unknown("task", task, shipped_tasks())
    text = read_text(path, "hyperparameters")
    try:
        content = load_yaml(text)
    except ValueError as error:
        raise InputError(f"{path}: not YAML: {error}") from None
    values: dict[str, Any] = {"task": task}
    for name, part in content.items() if isinstance(content, Mapping) else [("", content)]:
        if name not in SECTIONS or not isinstance(part, Mapping):
            raise InputError(f"{path}: {name!r} must be one of {', '.join(SECTIONS)}, a mapping")
        if name in ("problem", trainer):
            values |= {key: tuple(v) if isinstance(v, list) else v for key, v in part.items()}
    try:
        return of_types(from_dict(cls, values), "option")
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


WORLD = (
    "env_id",
    "embodiment",
    "scenes",
    "episode_steps",
    "step_m",
    "step_deg",
    "frames_per_action",
)
"""Options that a task of ``also`` sets for its environments."""


def world_of(args: P, environment: int) -> P:
    """The problem of a training's parallel environment, numbered from 0.

    Raises:
        InputError: an unknown task, or a file without such options.
    """
    also: tuple[str, ...] = getattr(args, "also", ())
    place = environment % (1 + len(also))
    if place == 0:
        return args
    other = of_task(Problem, also[place - 1], "problem")
    return replace(args, **{name: getattr(other, name) for name in WORLD})


SECTIONS = ("problem", "sb3", "imitation", "ppo", "qrdqn", "rllib")
"""Sections of a hyperparameter file: the problem, and the options of each trainer."""


def of_types(made: P, what: str) -> P:
    """Check that all options have their declared types, and return them."""
    for name, hint in get_type_hints(type(made)).items():
        if not _is_of(getattr(made, name), hint):
            raise InputError(f"{what} {name} = {getattr(made, name)!r} is of the wrong type")
    return made


def _is_of(value: Any, hint: Any) -> bool:
    """Whether ``value`` is of the type ``hint`` of an option."""
    parts = get_args(hint)
    if get_origin(hint) is Literal:
        return value in parts
    if get_origin(hint) is tuple:
        return isinstance(value, tuple) and all(isinstance(part, parts[0]) for part in value)
    if parts:
        return any(_is_of(value, part) for part in parts)
    return isinstance(value, (int, float) if hint is float else hint)
