"""The design space: named parameters of a SLAM configuration, and configurations from values."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from ms_slam_env.config import load_yaml
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.slam import check_parameters
from ms_slam_env.slam.configuration import SlamConfiguration, merged
from ms_slam_env.slam.machine import clock_range_mhz, why_no_clock
from ms_slam_env.slam.registry import given_or_default
from ms_slam_env.slam.surfel.surfel_config import PAPER
from ms_slam_env.tuning.parameters import Choice, Float, Integer, Parameter

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution

# Algorithmic parameters of the paper, section IV-A, with its ranges.
_PAPER: dict[str, Parameter] = {name: Float(low, high) for name, (_, low, high) in PAPER.items()}
_PAPER["depth_cutoff_m"] = Float(0.5, 10.0)  # nothing is nearer than the sensor's 0.5 m
_ALGORITHM: dict[str, Parameter] = {
    **_PAPER,
    "iterations.0": Integer(0, 12),
    "iterations.1": Integer(0, 12),
    "iterations.2": Integer(0, 15),
    "points_per_level": Integer(500, 20_000, log=True),
    "surfel_radius_px": Float(0.5, 2.0),
    "coverage_px": Float(0.5, 1.0),
    "bilateral_radius_px": Integer(0, 3),
    "icp_distance_m": Float(0.02, 0.3, log=True),
    "fusion_distance_m": Float(0.005, 0.1, log=True),
    "unstable_window": Integer(10, 400, log=True),
}
_MOTION: dict[str, Parameter] = {"keep_every": Integer(1, 6)}
# Parameters that decide the cost of a frame: pyramid, iterations, points, map resolution and size.
_FRAME: dict[str, Parameter] = {
    "pyramid_levels": Integer(1, 3),
    **{name: _ALGORITHM[name] for name in ("iterations.0", "iterations.1", "iterations.2")},
    "points_per_level": _ALGORITHM["points_per_level"],
    "surfel_radius_px": Float(0.5, 2.0),
    "coverage_px": Float(0.5, 1.0),
    "bilateral_radius_px": Integer(0, 3),
    "depth_cutoff_m": _ALGORITHM["depth_cutoff_m"],
    "unstable_window": _ALGORITHM["unstable_window"],
    "compaction_interval": Integer(2, 50, log=True),
}
_COMPILER: dict[str, Parameter] = {
    "compiler.optimization_level": Choice((None, 1, 3)),
    "compiler.fast_math": Choice((False, True)),
    "compiler.vectorise": Choice((True, False)),
    "compiler.grid_stride": Choice((True, False)),
    "compiler.fuse_fp": Choice((True, False)),
    "compiler.block_dim": Choice((64, 128, 256, 512)),
}
_OTHERS: dict[str, Parameter] = {
    "max_confidence": Float(5.0, 500.0, log=True),
    "cauchy_icp": Float(0.5, 10.0, log=True),
    "cauchy_rgb": Float(0.3, 10.0, log=True),
    "intensity_noise": Float(0.2, 10.0, log=True),
    "depth_noise_m": Float(0.001, 0.01, log=True),
    "icp_angle_deg": Float(10.0, 80.0),
    "fusion_angle_deg": Float(10.0, 80.0),
    "normal_edge_per_m": Float(0.01, 0.1, log=True),
    "image_size": Choice(("80x60", "160x120", "320x240")),
    "threads": Choice((1, 2)),
    "device": Choice(("cpu", "cuda")),
}
# KinectFusion's, which the paper's authors searched first; icp_threshold and rate as published.
_KINECT_FUSION: dict[str, Parameter] = {
    "volume_size_m": Float(4.0, 12.0),
    "volume_resolution": Choice((64, 128, 256, 512)),
    "mu_m": Float(0.01, 0.5, log=True),
    "icp_threshold": Float(1e-6, 1e2, log=True),
    "integration_rate": Integer(1, 30),
}
_OF_SURFELS = {**_ALGORITHM, **_MOTION, **_FRAME, **_OTHERS, **_COMPILER}
KNOWN: dict[str, Parameter] = {**_OF_SURFELS, **_KINECT_FUSION}
"""Parameters of the backends surfel and kinectfusion that have a default range."""

GROUPS: dict[str, tuple[str, ...]] = {
    "paper": tuple(_PAPER),
    "algorithm": tuple(_ALGORITHM),
    "frame": tuple(_FRAME),
    "compiler": tuple(_COMPILER),
    "machine": ("threads", "device", "cpu_mhz", "gpu_mhz", "precision"),
    "kinectfusion": (*_KINECT_FUSION, "iterations.0", "iterations.1", "iterations.2"),
}
"""Group names to their parameters; ``compiler`` and ``machine`` leave out those that the machine
or the backend lacks (see ``why_absent``)."""

_OF_CONFIGURATION = ("image_size", "keep_every", "threads", "cpu_mhz")
_LEVELS = "pyramid_levels"
_COMPILER_PREFIX = "compiler."


@dataclass(frozen=True)
class SearchSpace:
    """Parameters by name, and the configuration that they start from.

    Names are those of the backend, with dots for nested parameters and for list items
    (``iterations.0``); ``pyramid_levels`` for the number of ``iterations`` in use; ``image_size``,
    ``keep_every``, ``threads`` and ``cpu_mhz`` of the configuration; or ``compiler.`` and an
    option.

    Raises:
        InputError: no parameter, one that the backend does not have, one whose range excludes its
            start value, or a value that the backend refuses.
    """

    parameters: Mapping[str, Parameter]
    base: SlamConfiguration = dataclasses.field(default_factory=SlamConfiguration)

    def __post_init__(self) -> None:
        """Refuse parameters that cannot be explored."""
        if not self.parameters:
            raise InputError("no parameter to explore")
        for name, value in self.defaults().items():
            if not self.parameters[name].contains(value):
                raise InputError(
                    f"parameter {name!r} starts at {value!r}, which is not one of "
                    f"{self.parameters[name]}"
                )
        for name, parameter in self.parameters.items():
            for value in parameter.ends():
                self.configuration({name: value})

    def defaults(self) -> dict[str, Any]:
        """The value of each parameter that the exploration starts from."""
        return {name: default_of(name, self.base) for name in self.parameters}

    def distributions(self) -> dict[str, BaseDistribution]:
        """What Optuna draws from, by name."""
        return {name: parameter.distribution() for name, parameter in self.parameters.items()}

    def configuration(self, values: Mapping[str, Any]) -> SlamConfiguration:
        """The base configuration with ``values`` replaced.

        Raises:
            InputError: values that the backend refuses.
        """
        direct: dict[str, Any] = {n: values[n] for n in _OF_CONFIGURATION if n in values}
        params = dict(self.base.slam_config)
        compiler = dict(self.base.compiler)
        for name, value in values.items():
            if name.startswith(_COMPILER_PREFIX):
                compiler[name.removeprefix(_COMPILER_PREFIX)] = value
            elif name not in (*_OF_CONFIGURATION, _LEVELS):
                params = merged(params, self._nested(name, value, params))
        if _LEVELS in values:
            of_all = default_of("iterations", dataclasses.replace(self.base, slam_config=params))
            params["iterations"] = list(of_all[: values[_LEVELS]])
        return dataclasses.replace(self.base, slam_config=params, compiler=compiler, **direct)

    def _nested(self, name: str, value: Any, params: dict[str, Any]) -> Any:
        """Options that set ``name``, with the other items of its list taken from ``params``."""
        *path, last = name.split(".")
        if last.isdigit():
            listed = ".".join(path)
            whole = list(default_of(listed, dataclasses.replace(self.base, slam_config=params)))
            whole[int(last)] = value
            return self._nested(listed, whole, params)
        for part in [last, *reversed(path)]:
            value = {part: value}
        return value


def default_of(name: str, base: SlamConfiguration) -> Any:
    """Value of parameter ``name`` in ``base``, or the backend's default if it is not set there.

    Raises:
        InputError: no such parameter.
    """
    if name == "device":
        return base.slam_config.get("device", "cpu")
    if name in _OF_CONFIGURATION:
        value = getattr(base, name)
        if value is None and name == "cpu_mhz":
            return clock_range_mhz()[1]
        return {"image_size": "160x120", "threads": 1}[name] if value is None else value
    if name == _LEVELS:
        return len(default_of("iterations", base))
    found: Any = check_parameters(base.slam, base.slam_config)
    if isinstance(found, dict):  # a user's class has no dataclass of its options
        found = given_or_default(base.slam, found)
    if name.startswith(_COMPILER_PREFIX):
        found, name = base.compiler_options(), name.removeprefix(_COMPILER_PREFIX)
    for part in name.split("."):
        if part.isdigit() and isinstance(found, tuple) and int(part) < len(found):
            found = found[int(part)]
        elif dataclasses.is_dataclass(found) and part in found.__dataclass_fields__:
            found = getattr(found, part)
        elif isinstance(found, dict) and part in found:
            found = found[part]
        else:
            valid = [*(found if isinstance(found, dict) else KNOWN), *_OF_CONFIGURATION]
            if dataclasses.is_dataclass(found):
                valid = [*found.__dataclass_fields__, *_OF_CONFIGURATION, *GROUPS]
            raise unknown("parameter", name, dict.fromkeys(valid))
    return found


def make_space(texts: Sequence[str], base: SlamConfiguration | None = None) -> SearchSpace:
    """Make a space from texts: ``NAME``, ``NAME=low:high``, ``NAME=a,b,c``, or a group.

    The range holds only integers if the parameter's default is an integer; ``low:high:log`` makes
    equal ratios equally likely. Parameters of a group that this machine or the backend lacks are
    left out.

    Raises:
        InputError: an unknown parameter, one that is not available here, one without a known range,
            or an invalid range.
    """
    base = base or SlamConfiguration()
    parameters: dict[str, Parameter] = {}
    for text in texts:
        name, equals, values = text.partition("=")
        for member in GROUPS.get(name, (name,)):
            absent = why_absent(member, base)
            if absent and name in GROUPS:
                continue
            if absent:
                raise InputError(f"parameter {member!r} is absent: {absent}")
            try:
                default = default_of(member, base)
            except InputError as error:
                if name not in GROUPS:
                    raise
                misfit = f"group {name!r} of parameters does not fit backend {base.slam!r}"
                raise InputError(f"{misfit}: {error}") from None
            if equals:
                parameters[member] = _parse_values(member, values, default)
            elif member == "cpu_mhz":
                parameters[member] = Integer(*clock_range_mhz())
            elif member not in KNOWN:
                raise InputError(f"parameter {member!r} needs a range, as in {member}=1:10")
            else:
                parameters[member] = KNOWN[member]
    if not parameters and texts:
        raise InputError("; ".join(absences(texts, base)))
    return SearchSpace(parameters, base)


def absences(texts: Sequence[str], base: SlamConfiguration) -> list[str]:
    """Parameters of the groups in ``texts`` that are not available here, one line per reason."""
    members = [member for text in texts for member in GROUPS.get(text, ())]
    absent: dict[str, list[str]] = {}
    for member in members:
        absent.setdefault(why_absent(member, base), []).append(member)
    absent.pop("", None)
    verb = {why: "is" if len(names) == 1 else "are" for why, names in absent.items()}
    return [f"{', '.join(names)} {verb[why]} absent: {why}" for why, names in absent.items()]


def _parse_values(name: str, text: str, default: Any) -> Parameter:
    low, *rest = text.split(":")
    if not rest:
        return Choice(tuple(_scalar(name, part) for part in text.split(",")))
    is_log = rest[1:] == ["log"]
    numbers = [_scalar(name, part) for part in (low, rest[0])]
    if (len(rest) > 1 and not is_log) or not all(isinstance(n, (int, float)) for n in numbers):
        raise InputError(f"parameter {name!r}: {text!r} is not low:high or low:high:log")
    if all(isinstance(n, int) for n in numbers) and isinstance(default, int):
        return Integer(numbers[0], numbers[1], is_log)
    return Float(float(numbers[0]), float(numbers[1]), is_log)


def _scalar(name: str, text: str) -> Any:
    try:
        value = load_yaml(text)
    except ValueError:
        value = []
    if value is not None and not isinstance(value, (str, int, float, bool)):
        raise InputError(f"parameter {name!r}: {text!r} is not one value")
    return value


_ON_A_CPU = {
    "compiler.fuse_fp": "on a CPU it changes no bit and no time of the kernels",
    "compiler.block_dim": "a CPU runs one thread of a block",
}
_EVERYWHERE = {
    "gpu_mhz": "a GPU's clock belongs to all who share it, and is not touched",
    "precision": "the kernels of SLAM work on 32-bit numbers alone",
}
_ON_A_GPU = {"compiler.vectorise": "it is an option of the CPU's compiler, and the device is a GPU"}


def why_absent(name: str, base: SlamConfiguration) -> str:
    """Why parameter ``name`` has no effect on ``base`` on this machine; empty if it has one."""
    is_surfel = base.slam == "surfel"
    if name.startswith("compiler.") and not is_surfel:
        return f"backend {base.slam!r} takes no options of the compiler"
    on_gpu = str(base.slam_config.get("device", "cpu")).startswith("cuda")
    if name == "threads" and is_surfel:
        return "Warp runs a kernel on one thread of the CPU, or on a GPU"
    if name == "device":
        return _why_no_device(base)
    if name == "cpu_mhz":
        return why_no_clock()
    return {**_EVERYWHERE, **(_ON_A_GPU if on_gpu else _ON_A_CPU)}.get(name, "")


def _why_no_device(base: SlamConfiguration) -> str:
    if base.slam != "surfel":
        return f"backend {base.slam!r} runs on the CPU alone"
    from ms_slam_env._runtime.warp import wp

    return "" if wp.is_cuda_available() else "this machine has no CUDA device beside its CPU"
