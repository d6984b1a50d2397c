"""Options that the training scripts have in common, and the tasks that set them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar, Literal, TypeVar, get_args, get_origin, get_type_hints

from ms_slam_env._runtime.input_files import read_text
from ms_slam_env.config import Checked, bounded, chosen, from_dict, load_yaml
from ms_slam_env.env.registry import POINT as OBSERVATIONS
from ms_slam_env.env.reward import RewardConfig
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.slam.configuration import is_file_name


@dataclass(frozen=True)
class Problem(Checked):
    """Where a policy is trained and judged.

    Attributes:
        out: folder for everything the run writes.
        resume: go on with the run in ``out``; options that are not given are those of the run so
            far. Files, modules and addresses among them must be given again.
        task: whose options to begin with: a name, of a file in ``hyperparameters/``, or a YAML file
            of your own; what is given beside it counts more.
        env_id: id of the environment.
        embodiment: what carries the camera; None: what the id says.
        observation: a variant by name, of one vector; `held` shows what the motions would show if
            they were held for some steps, and taught most of those that were compared; `features`
            takes the least time.
        scenes: trained and validated on, with training and validation seeds.
        scene_seeds: seeds of each scene, from the split's first; as many as the agents that are
            shipped had. Few are learnt by heart.
        episode_steps: time limit of an episode.
        step_m: translation of a motion; None: the environment's default.
        step_deg: rotation of a motion; None: the environment's default.
        frames_per_action: frames of a motion; None: of an arm as many as arrive while it moves,
            some ten, of a free camera those of the environment. With ``--embodiment arm-kinematic
            --frames-per-action 1`` a step costs little more than the free camera's: a world to
            train in before the arm itself (``--init``).
        reward: preset of the environment's reward, `default` or `paper`.
        without: terms of the reward that count nothing.
        image_size: of the camera in training and validation, width x height; None: the
            environment's own. At 80x60 a step costs half as much, and SLAM holds on less: a world
            to begin in. Which one it was is no part of the policy.
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
    reward: str = chosen("default", *RewardConfig.named())
    without: tuple[str, ...] = ()
    image_size: str | None = None
    num_envs: int = bounded(2, 1, 100_000)
    seed: int = bounded(0, 0, 2**31 - 1)
    eval_episodes: int = bounded(24, 1, 100_000)
    deterministic_eval: bool = False

    algorithms: ClassVar[tuple[str, ...]] = ()
    """What a policy file of such a training may say that it is of."""

    def __post_init__(self) -> None:
        """Refuse values out of range, and training nowhere."""
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
        """Numbers of each action that our own networks look at one by one; 0 without any."""
        return int(getattr(OBSERVATIONS.find(self.observation), "candidate_numbers", 0))

    @property
    def image(self) -> tuple[int, ...]:
        """Channels, rows and columns of an image that convolutions look at; empty without one."""
        return tuple(getattr(OBSERVATIONS.find(self.observation), "image_shape", ()))

    @property
    def layers(self) -> dict[str, Any]:
        """What the file of a policy to begin with has to say of its layers, beside their width."""
        return {"memory": 0, "candidates": self.candidates, "image": self.image, "quantiles": 0}


@dataclass(frozen=True)
class Training(Problem):
    """How long a policy learns from the steps that it makes, and what from.

    Attributes:
        init: policy file to begin with, as of ``ms-slam train imitation``; its network and
            normalisation, not its steps.
        through: planner that the policy acts through, in validation too: `agent-home` has goals for
            the way to what is not near by, and lets the policy choose among motions that are not
            likely to slip. None: the policy acts by itself.
        total_timesteps: environment steps, all runs of a resumed training together.
        minutes: stop this run after training for so much wall-clock time; evaluations and the
            episodes of the references come on top. None: by steps alone.
        eval_every: environment steps between evaluations; 0: only first and last.
        references: play the validation episodes with random walk, standing still and the greedy
            planner too, before training.
        learning_rate: of Adam.
        gamma: discount factor.
        hidden: width of the two hidden layers.
        curriculum: YAML file of stages, from easy to the problem itself: see ``curriculum.py``.
        episodes_per_scene: episodes in a row in a scene that was drawn. To build a room takes a
            second, a home longer, where it is not one of the last 20 rooms or five homes. Episodes
            of a stage that draws noise or perturbations draw a scene each.
        also: further tasks to train in, named as ``task`` is: the parallel environments are of the
            problem itself and of these in turn. Of them count where they are, how long and with
            which motions. Validation knows the problem alone.
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

    kept: ClassVar[tuple[str, ...]] = ()
    """Options beside `resume.KEPT` that a run keeps when it is resumed."""


@dataclass(frozen=True)
class PpoTraining(Training):
    """How proximal policy optimisation learns.

    Attributes:
        n_steps: steps of each environment between updates; of ``ms-slam train sb3`` fewer where
            ``total_timesteps`` leaves fewer.
        batch_size: of the gradient steps, in steps.
        n_epochs: passes over the data of one update.
        gae_lambda: trade-off between bias and variance of the advantages.
        ent_coef: weight of the entropy bonus.
        clip_range: of PPO's objective.
    """

    n_steps: int = bounded(512, 2, 1_000_000)  # advantages of one sample have no spread
    batch_size: int = bounded(256, 2, 1_000_000)
    n_epochs: int = bounded(6, 1, 1000)
    gae_lambda: float = bounded(0.95, 0, 1)
    ent_coef: float = bounded(0.003, 0, 1)
    clip_range: float = bounded(0.2, 0, 1)


TASKS = Path(__file__).parent / "hyperparameters"
P = TypeVar("P", bound=Problem)


def named_in(arguments: Sequence[str]) -> dict[str, str]:
    """The options that a command line names, each with the word after it."""
    words = [part for word in arguments for part in word.split("=", int(word.startswith("--")))]
    pairs = pairwise([*words, ""])
    return {one[2:].replace("-", "_"): after for one, after in pairs if one.startswith("--")}


def shipped_tasks() -> list[str]:
    """Names of the files in ``hyperparameters/``."""
    return sorted(one.stem for one in TASKS.glob("*.yaml"))


def of_task(cls: type[P], task: str, trainer: str) -> P:
    """Options ``cls`` of a task: those of ``problem``, and those of the trainer.

    Raises:
        InputError: an unknown task, or a file that does not hold such options.
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
"""Options that a further task to train in has of its own."""


def world_of(args: P, environment: int) -> P:
    """The problem that a training's parallel environment plays, by its number from 0.

    Raises:
        InputError: an unknown task, or a file that does not hold such options.
    """
    also: tuple[str, ...] = getattr(args, "also", ())
    place = environment % (1 + len(also))
    if place == 0:
        return args
    other = of_task(Problem, also[place - 1], "problem")
    return replace(args, **{name: getattr(other, name) for name in WORLD})


SECTIONS = ("problem", "sb3", "imitation", "ppo", "qrdqn", "rllib")
"""Of a file of hyperparameters: the problem, and the options of each trainer."""


def of_types(made: P, what: str) -> P:
    """The same options, all of the types that they are declared with."""
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
