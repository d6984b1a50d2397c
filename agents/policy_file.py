"""A trained policy as one safetensors file: numbers and a JSON text, nothing executable.

Tensors: ``policy.*``, the network under Stable-Baselines3's names; ``observation.*`` and
``return.*``, the running moments that normalised training; in a file to resume from also
``optimizer.*``, the moments of Adam, and ``target.*``, the network that gives the targets of
quantiles. The text is :class:`Metadata`. Everything is checked before it is loaded, since policies
may come from untrusted sources.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from ms_slam_env._runtime.output_files import write_bytes
from ms_slam_env.env.embodiments import EMBODIMENTS
from ms_slam_env.env.env_config import EnvConfig
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.report.records import build, to_plain

Tensors = dict[str, NDArray[Any]]
Shapes = dict[str, tuple[int, ...]]

ALGORITHMS = ("maskable_ppo", "ppo", "dqn", "imitation", "masked_ppo", "rllib_ppo", "qr_dqn")
VERSION = 1
STEP = "optimizer.step"
MOMENTS = ("exp_avg", "exp_avg_sq")  # of Adam, each of its parameter's shape

_OF_TRAINING = ("optimizer.", "target.")
_TEXT = "ms_slam_policy"
_LARGEST_FILE = 2**30  # bytes
_LARGEST_LAYER = 100_000
_MOST_LAYERS = 16
_NAME = re.compile(r"[\w-]+")  # what stands before a colon would be imported
_ENV_OPTIONS = ("embodiment", "step_m", "step_rad")
_MOST = {"timesteps": 1e12, "epochs": 1e9, "minutes": 1e9}
_LARGEST_WEIGHT = 1e6  # that of a trained network is below 100
_LARGEST_NUMBER = 1e12  # of moments and counts


@dataclass(frozen=True)
class Metadata:
    """Description of the numbers in a policy file.

    Attributes:
        algorithm: one of ``ALGORITHMS``.
        env_id: id of the environment it was trained in.
        env_options: options of that environment that differ from its defaults, among
            ``embodiment``, ``step_m`` and ``step_rad``.
        observation: observation variant that the policy expects.
        inputs: numbers of an observation.
        hidden: widths of the hidden layers, tanh between them.
        actions: choices of each number that an action consists of.
        memory: width of the recurrent unit before the layers; 0 without one.
        candidates: numbers of each action at the end of an observation, which one encoder sees,
            the same for all, and one score is given for; 0: the layers see it all as it is.
        image: channels, rows and columns of an image at the end of an observation, which
            convolutions see (``CONVOLUTIONS``); empty: the layers see it all as it is.
        quantiles: of the return, that the network says of each action; 0: it says how probable
            each is, and beside it a value.
        timesteps: environment steps trained.
        epochs: passes over its experience that the network learnt from; 0: it is untrained.
        minutes: wall-clock time trained, evaluations left out.
        options: the training script's options.
        provenance: command, versions, commit and machine.
        version: of this format.
    """

    algorithm: str
    env_id: str
    observation: str
    inputs: int
    hidden: Sequence[int]
    actions: Sequence[int]
    timesteps: int
    epochs: int
    minutes: float
    memory: int = 0
    candidates: int = 0
    image: Sequence[int] = ()
    quantiles: int = 0
    env_options: dict[str, Any] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    provenance: dict[str, Any] = field(default_factory=dict)
    version: int = VERSION

    def __post_init__(self) -> None:
        """Convert sequences to tuples."""
        for name in ("hidden", "actions", "image"):
            if isinstance(getattr(self, name), list):
                object.__setattr__(self, name, tuple(getattr(self, name)))

    def check(self) -> None:
        """Refuse values that no policy can have.

        Raises:
            InputError: naming the value.
        """
        if self.algorithm not in ALGORITHMS:
            raise unknown("algorithm", self.algorithm, ALGORITHMS)
        for name in ("env_id", "observation"):
            if not _NAME.fullmatch(getattr(self, name)):
                raise InputError(f"{name} {getattr(self, name)!r} is not a valid name")
        for name, value in self.env_options.items():
            if name not in _ENV_OPTIONS:
                raise unknown("option of env_options", name, _ENV_OPTIONS)
            if name != "embodiment":
                EnvConfig(**{name: value})  # refuses what is no length of a motion
            elif value not in EMBODIMENTS:
                raise unknown("embodiment", value, EMBODIMENTS)
        for name, sizes in (
            ("inputs", (self.inputs,)), ("hidden", self.hidden), ("actions", self.actions)
        ):  # fmt: skip
            many = 0 < len(sizes) <= _MOST_LAYERS
            if not many or not all(0 < size <= _LARGEST_LAYER for size in sizes):
                raise InputError(f"{name} = {str(sizes)[:80]} are not valid layer sizes")
        for name in ("memory", "candidates", "quantiles"):
            if not 0 <= getattr(self, name) <= _LARGEST_LAYER:
                raise InputError(f"{name} = {getattr(self, name)} is not a valid width")
        if self.candidates and (len(self.actions) > 1 or self.num_state < 0):
            raise InputError(
                f"{self.inputs} numbers do not hold {self.candidates} for each of {self.actions}"
            )
        if self.image and (
            len(self.image) != 3
            or self.candidates
            or not all(type(size) is int and 0 < size <= self.inputs for size in self.image)
            or self.num_state < 0
            or image_width(self.image) <= 0
        ):
            raise InputError(
                f"image = {str(self.image)[:80]} does not fit in {self.inputs} numbers"
            )
        if self.quantiles and (self.memory or len(self.actions) > 1):
            raise InputError("quantiles go with one number an action, and with no memory")
        for name, most in _MOST.items():
            if not 0 <= getattr(self, name) <= most:
                raise InputError(f"{name} = {getattr(self, name)} is outside [0, {most:g}]")

    def check_sizes(self, path: Path, inputs: int, *actions: int) -> None:
        """Refuse numbers of inputs or actions that differ from a training's.

        Raises:
            InputError: naming the ``path`` of the file, its numbers and those of the training.
        """
        if (self.inputs, tuple(self.actions)) != (inputs, actions):
            raise InputError(
                f"{path} is for {self.inputs} numbers and {math.prod(self.actions)} actions, "
                f"not for {inputs} and {math.prod(actions)}"
            )

    @property
    def num_state(self) -> int:
        """Numbers of an observation before those of the candidates or of the image."""
        image = math.prod(self.image) if self.image else 0
        return self.inputs - sum(self.actions) * self.candidates - image

    @property
    def encoded(self) -> int:
        """Width of a candidate's encoding."""
        return encoded_width(self.hidden[0])


def encoded_width(hidden: int) -> int:
    """Width of a candidate's encoding, given the width of a hidden layer."""
    return max(8, hidden // 4)


CONVOLUTIONS = ((16, 5, 2), (32, 3, 2), (32, 3, 2))
"""Channels, edge and stride of the layers that look at an image, a rectifier after each."""


def image_width(image: Sequence[int]) -> int:
    """Length of the last convolution's output for an image (channels, rows, columns), or 0."""
    rows, columns = image[1:]
    for _, edge, stride in CONVOLUTIONS:
        rows, columns = ((max(0, size - edge + stride) // stride) for size in (rows, columns))
    return CONVOLUTIONS[-1][0] * rows * columns


@dataclass(frozen=True)
class PolicyFile:
    """Contents of a policy file.

    Attributes:
        metadata: description of the policy.
        tensors: name to array; shapes as in ``tensor_shapes``.
    """

    metadata: Metadata
    tensors: Tensors

    @property
    def can_resume(self) -> bool:
        """Whether the file has the state of the optimiser."""
        return STEP in self.tensors

    def part(self, name: str) -> Tensors:
        """The tensors ``name.*``, by the rest of their names."""
        start = f"{name}."
        return {k.removeprefix(start): v for k, v in self.tensors.items() if k.startswith(start)}

    def untrained(self) -> PolicyFile:
        """The same policy as the start of another training."""
        metadata = replace(self.metadata, timesteps=0, epochs=0)
        return replace(self.without_optimizer(), metadata=metadata)

    def at_half_precision(self) -> PolicyFile:
        """The same policy with 16-bit network weights, half the size, for storage."""
        tensors = self.without_optimizer().tensors
        half = {k: v.astype(np.float16) for k, v in tensors.items() if k.startswith("policy.")}
        return PolicyFile(self.metadata, tensors | half)

    def without_optimizer(self) -> PolicyFile:
        """The same policy for inference only, a third of the size."""
        kept = {k: v for k, v in self.tensors.items() if not k.startswith(_OF_TRAINING)}
        return PolicyFile(self.metadata, kept)


def network_shapes(metadata: Metadata) -> Shapes:
    """Shapes of the network's parameters, by Stable-Baselines3's names, in its order."""
    width, encoded = metadata.memory, metadata.encoded
    seen = metadata.inputs
    shapes: Shapes = {}
    head = (sum(metadata.actions), metadata.hidden[-1])
    if metadata.candidates:
        seen = metadata.num_state + 2 * encoded  # their mean and their largest
        shapes |= _linear("encoder.0", encoded, metadata.candidates)
        shapes |= _linear("encoder.2", encoded, encoded)
        shapes |= _linear("score", encoded, encoded + metadata.hidden[-1])
        head = (1, encoded)
    if metadata.image:
        seen = metadata.num_state + image_width(metadata.image)
        before = metadata.image[0]
        for i, (channels, edge, _) in enumerate(CONVOLUTIONS):  # rectifiers at the odd places
            shapes[f"image.{2 * i}.weight"] = (channels, before, edge, edge)
            shapes[f"image.{2 * i}.bias"] = (channels,)
            before = channels
    if width:  # three gates one above the other, as PyTorch has them
        shapes |= {"memory.weight_ih": (3 * width, seen)}
        shapes |= {"memory.weight_hh": (3 * width, width)}
        shapes |= {"memory.bias_ih": (3 * width,), "memory.bias_hh": (3 * width,)}
    sizes = (seen + width, *metadata.hidden)
    layers = list(zip(sizes[1:], sizes[:-1], strict=True))
    for net in ("policy_net", "value_net")[: 1 if metadata.quantiles else 2]:
        for i, shape in enumerate(layers):
            shapes |= _linear(f"mlp_extractor.{net}.{2 * i}", *shape)  # tanh at the odd places
    shapes |= _linear("action_net", head[0] * (metadata.quantiles or 1), head[1])
    return shapes if metadata.quantiles else shapes | _linear("value_net", 1, sizes[-1])


def _linear(name: str, outputs: int, inputs: int) -> Shapes:
    return {f"{name}.weight": (outputs, inputs), f"{name}.bias": (outputs,)}


def tensor_shapes(metadata: Metadata, with_optimizer: bool) -> Shapes:
    """Shapes of all tensors of a file, by name."""
    network = network_shapes(metadata)
    shapes = {f"policy.{name}": shape for name, shape in network.items()}
    for moments, shape in (("observation", (metadata.inputs,)), ("return", ())):
        shapes |= {f"{moments}.mean": shape, f"{moments}.var": shape, f"{moments}.count": ()}
    if with_optimizer:
        shapes[STEP] = ()
        for moment in MOMENTS:
            shapes |= {f"optimizer.{name}.{moment}": shape for name, shape in network.items()}
        if metadata.quantiles:
            shapes |= {f"target.{name}": shape for name, shape in network.items()}
    return shapes


def write_policy(path: Path, policy: PolicyFile) -> None:
    """Write a policy file, as `output_files.write_bytes` does.

    Raises:
        InputError: tensors that do not fit the metadata, or invalid numbers.
    """
    _check_values(path, {k: _at_least_single(v) for k, v in policy.tensors.items()})
    shapes = tensor_shapes(policy.metadata, STEP in policy.tensors)
    _check_shapes({name: np.shape(value) for name, value in policy.tensors.items()}, shapes)
    text = json.dumps(to_plain(policy.metadata), allow_nan=False)
    # np.array: in C order, and () stays (), as np.ascontiguousarray would not have it.
    tensors = {name: np.array(value, order="C") for name, value in policy.tensors.items()}
    write_bytes(path, save(tensors, {_TEXT: text}))


def read_policy(path: str | Path) -> PolicyFile:
    """Read a policy file. Nothing in it is executed, whoever wrote it.

    Numbers of half precision come as float32.

    Raises:
        InputError: no such file, or not a complete policy file of this version.
    """
    path = Path(path)
    _check_file(path)
    try:
        with safe_open(path, framework="numpy") as file:
            metadata = _read_metadata((file.metadata() or {}).get(_TEXT))
            found = {name: file.get_slice(name) for name in file.keys()}  # noqa: SIM118 -- no dict
            shapes = tensor_shapes(metadata, with_optimizer=STEP in found)
            # Before any is read into memory.
            _check_shapes({name: tuple(t.get_shape()) for name, t in found.items()}, shapes)
            _check_types({name: t.get_dtype() for name, t in found.items()})
            tensors = {name: _at_least_single(file.get_tensor(name)) for name in shapes}
    except InputError as error:
        raise InputError(f"{str(path)!r} is not a policy: {error}") from None
    except (SafetensorError, OSError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{str(path)!r} is not a policy: {reason}") from None
    _check_values(path, tensors)
    return PolicyFile(metadata, tensors)


def _at_least_single(value: NDArray[Any]) -> NDArray[Any]:
    return value.astype(np.float32) if np.asarray(value).dtype == np.float16 else value


def _check_file(path: Path) -> None:
    """Refuse irregular and oversized files; opening a FIFO would wait for ever."""
    if not path.exists():
        raise InputError(f"no policy file {str(path)!r}")
    if not path.is_file():
        raise InputError(f"{str(path)!r} is not a policy: not a regular file")
    if path.stat().st_size > _LARGEST_FILE:
        raise InputError(f"{str(path)!r} is not a policy: larger than {_LARGEST_FILE >> 20} MiB")
    with path.open("rb") as file:
        if file.read(4) == b"PK\x03\x04":
            raise InputError(
                f"{str(path)!r} is an archive of Stable-Baselines3, which can hold code: "
                "a planner of your own can load it, see docs/rl.md"
            )


def _read_metadata(text: str | None) -> Metadata:
    """The metadata in ``text``.

    Raises:
        InputError: saying what is wrong with it.
    """
    if text is None:
        raise InputError("a safetensors file of something else")
    try:
        content = json.loads(text, parse_constant=_refuse_constant)
        version = content.get("version")
        if version != VERSION or isinstance(version, bool):
            raise InputError(f"format version {version!r}, this package reads {VERSION}")
        metadata = build(Metadata, content)
        metadata.check()
    except InputError:
        raise
    except (ValueError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        reason = str(error).replace("Metadata.__init__() ", "").splitlines()[0]
        raise InputError(f"metadata: {reason}") from None
    return metadata


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name} is no JSON")


def _check_shapes(found: Shapes, shapes: Shapes) -> None:
    if found.keys() != shapes.keys():
        missing, extra = sorted(shapes.keys() - found), sorted(found.keys() - shapes)
        raise InputError(f"no tensor {missing[0]}" if missing else f"unknown tensor {extra[0]}")
    for name, shape in shapes.items():
        if found[name] != shape:
            raise InputError(f"tensor {name} has shape {found[name]}, not {shape}")


def _check_types(found: Mapping[str, str]) -> None:
    for name, kind in found.items():
        if kind not in ("F16", "F32", "F64"):
            raise InputError(f"tensor {name} has type {kind}, not F16, F32 or F64")


def _check_values(path: Path, tensors: Tensors) -> None:
    for name, value in tensors.items():
        if not np.isfinite(value).all():
            raise InputError(f"{str(path)!r}: tensor {name} holds NaN or infinity")
        most = _LARGEST_WEIGHT if name.startswith(("policy.", "target.")) else _LARGEST_NUMBER
        if (np.abs(value) > most).any():
            raise InputError(f"{str(path)!r}: tensor {name} holds numbers beyond {most:g}")
        if name.endswith((".var", ".count", ".step", ".exp_avg_sq")) and (value < 0).any():
            raise InputError(f"{str(path)!r}: tensor {name} holds negative numbers")
