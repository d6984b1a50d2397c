"""SLAM configurations as YAML files: backend, its parameters, and how frames are fed to it."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from ms_slam_env._runtime.input_files import read_text
from ms_slam_env._runtime.output_files import write_text
from ms_slam_env._runtime.threads import limited_threads
from ms_slam_env.camera import Intrinsics, parse_image_size
from ms_slam_env.config import Checked, bounded, from_dict, load_yaml
from ms_slam_env.errors import InputError, unknown
from ms_slam_env.slam.machine import CompilerOptions, compiled, limited_clock
from ms_slam_env.slam.registry import BACKENDS, backend_name, check_parameters, make_backend
from ms_slam_env.slam.shared.state_file import read_about
from ms_slam_env.slam.slam_backend import SlamBackend

SUFFIXES = (".yaml", ".yml")
_MAX_BYTES = 1_000_000


@dataclass(frozen=True)
class SlamConfiguration(Checked):
    """A backend with its parameters, and how it is run.

    Attributes:
        slam: name of the backend.
        slam_config: the backend's parameters, such as the fields of ``SurfelConfig``.
        image_size: size that frames are reduced to, such as 160x120 or 160x120+crop; None leaves it
            to whoever runs the configuration.
        keep_every: process every n-th frame of a recorded or rendered sequence. Environments ignore
            it.
        threads: cores that the backend may use; None for no limit. Ignored where other work shares
            the process, as in an environment.
        about: origin of the configuration, such as the trial and its measurements.
        compiler: options of the kernel compiler (``CompilerOptions``); ignored in the same cases as
            ``threads``.
        cpu_mhz: highest frequency of the processor; None for no limit; ignored in the same cases as
            ``threads``.

    Raises:
        InputError: an unknown backend, parameter or size, or a value out of range.
    """

    slam: str = "surfel"
    slam_config: dict[str, Any] = field(default_factory=dict)
    image_size: str | None = None
    keep_every: int = bounded(1, 1, 1000)
    threads: int | None = bounded(None, 1, 1024)
    about: dict[str, Any] = field(default_factory=dict)
    compiler: dict[str, Any] = field(default_factory=dict)
    cpu_mhz: int | None = bounded(None, 1, 100_000)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_parameters(self.slam, self.slam_config)
        self.compiler_options()
        if self.image_size is not None:
            parse_image_size(self.image_size)

    def compiler_options(self) -> CompilerOptions:
        """``compiler`` as ``CompilerOptions``."""
        return from_dict(CompilerOptions, self.compiler, "compiler")

    @contextmanager
    def machine(self) -> Iterator[None]:
        """Apply its compiler options, cores and clock to the enclosed code, then restore them."""
        compiler = compiled(self.compiler_options())
        with compiler, limited_threads(self.threads), limited_clock(self.cpu_mhz):
            yield

    def __str__(self) -> str:
        """Describe it briefly: image size, parameters such as iterations, share of the frames."""
        parts = [self.image_size or "full size"]
        for key, value in self.slam_config.items():
            is_list = isinstance(value, (tuple, list))
            text = "-".join(map(str, value)) if is_list else str(value)
            parts.append(f"{text} {key.replace('_', ' ').replace(' per level', '')}")
        every = self.keep_every
        return ", ".join([*parts, "every frame" if every == 1 else f"one frame in {every}"])


def make(
    name: str | Path | type[SlamBackend], intrinsics: Intrinsics, **params: Any
) -> SlamBackend:
    """Make the SLAM backend ``name`` for a camera.

    Args:
        name: one of ``BACKENDS``, an entry point (group ``ms_slam_env.slam``), ``module:Class``, a
            class, or a configuration file (YAML) that names one with parameters. The frame size
            always comes from ``intrinsics``.
        intrinsics: intrinsics of every frame.
        params: parameters of the backend, such as the fields of ``SurfelConfig``; ``device`` =
            "cpu" or "cuda" if the backend has a choice. They override those of a file.

    Raises:
        InputError: unknown backend, unknown parameter or value out of range, or a bad file.
    """
    if isinstance(name, (str, Path)) and is_file_name(name):
        configuration = read_configuration(name)
        name, params = configuration.slam, merged(configuration.slam_config, params)
    return make_backend(name, intrinsics, params)


def open_map(
    path: str | Path,
    lost: bool = True,
    backend: str | type[SlamBackend] | None = None,
    **params: Any,
) -> SlamBackend:
    """Open a saved map: make the backend that wrote it, for the same camera, and load the map.

    Args:
        path: path of a file that ``SlamBackend.save`` wrote.
        lost: whether the camera has moved since; see ``SlamBackend.load``.
        backend: the backend, if it is not one of ``BACKENDS``: a file never says whose code runs.
            Its parameters are then only ``params``, which must be those it had.
        params: parameters of the backend; they override the saved ones.

    Raises:
        InputError: as in ``SlamBackend.load``; the map comes from another backend, or from one that
            must be named; a parameter is unknown or does not fit the map.
    """
    about = read_about(Path(path))
    intrinsics = _part(about, "intrinsics", path)
    camera = from_dict(Intrinsics, intrinsics, f"{path}: intrinsics")
    name, saved = _maker(about, path, backend, params)
    try:
        made = make_backend(name, camera, merged(saved, params))
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    made.load(path, lost)
    return made


def configuration_of_map(
    path: str | Path, backend: str | None = None, params: Mapping[str, Any] | None = None
) -> SlamConfiguration:
    """Backend, parameters and image size that wrote a map.

    Args:
        path: path of the file.
        backend: backend, as in ``open_map``; it must be made with ``params``.
        params: parameters given in addition.

    Raises:
        InputError: no such file, not a map, the map of another backend, of one that must be named,
            or of one that needs more parameters.
    """
    about = read_about(Path(path))
    name, own = _maker(about, path, backend, params or {})
    camera = about.get("intrinsics")
    size = None
    if isinstance(camera, Mapping) and {"width", "height"} <= camera.keys():
        size = f"{camera['width']}x{camera['height']}"
    try:
        return SlamConfiguration(name, own, size)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def _maker(
    about: Mapping[str, Any], path: str | Path, backend: Any, given: Mapping[str, Any]
) -> tuple[Any, dict[str, Any]]:
    """The backend that wrote a map, and its parameters if it is built in.

    For a user's backend, the file gives only the names of the parameters: they must be ``given``.
    """
    cls, module = about.get("backend"), about.get("module")
    own = backend_name(cls, module)
    if own is not None:
        if backend not in (None, own):
            raise InputError(f"{path} holds a map of {own}, not of {backend}")
        return own, dict(_part(about, "config", path))
    if not isinstance(cls, str):
        raise InputError(f"{path}: {unknown('SLAM backend', cls, BACKENDS)}")
    if backend is None:
        told = f"{module}:{cls}" if module else f"{cls}"
        raise InputError(
            f"{path} holds a map of {told!r}, none of {', '.join(BACKENDS)}: name that backend as "
            "well, as in --backend module:Class or open_map(..., backend=...)"
        )
    options = about.get("options")
    for option, value in options.items() if isinstance(options, Mapping) else ():
        if option not in given:
            raise InputError(
                f"{path} was made with option {option!r} = {str(value)!r}: give it again"
            )
    return backend, {}


def _part(about: Mapping[str, Any], key: str, path: str | Path) -> Mapping[str, Any]:
    part = about.get(key)
    if not isinstance(part, Mapping):
        raise InputError(f"{path} has no {key}")
    return part


def is_file_name(name: object) -> bool:
    """Whether ``name`` denotes a configuration file: a path, or text with a YAML suffix."""
    return isinstance(name, Path) or (isinstance(name, str) and name.lower().endswith(SUFFIXES))


def read_configuration(path: str | Path) -> SlamConfiguration:
    """Read a configuration file.

    Raises:
        InputError: no such file, not YAML, an unknown or repeated key, or a bad value. The message
            is one line that names the file and the key.
    """
    text = read_text(path, "configuration", _MAX_BYTES)
    try:
        content = load_yaml(text)
    except ValueError as error:
        raise InputError(f"{path}: not YAML: {error}") from None
    if not isinstance(content, Mapping):
        fields = ", ".join(field.name for field in dataclasses.fields(SlamConfiguration))
        raise InputError(f"{path}: must hold a mapping of {fields}")
    try:
        return from_dict(SlamConfiguration, content)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None


def read_levels(path: str | Path, part: str) -> Mapping[str, Any]:
    """Read the section ``part`` of a levels file, which a design-space exploration writes.

    Raises:
        InputError: no such file, not YAML, or no section ``part``.
    """
    try:
        content = load_yaml(read_text(path, "levels", _MAX_BYTES))
    except ValueError as error:
        raise InputError(f"{path}: not YAML: {error}") from None
    found = content.get(part) if isinstance(content, Mapping) else None
    if not isinstance(found, Mapping):
        raise InputError(f"{path}: has no section {part!r}")
    return found


def write_levels(path: str | Path, content: Mapping[str, Any]) -> None:
    """Write a file that ``read_levels`` reads."""
    write_text(Path(path), yaml.safe_dump(_plain(content), sort_keys=False))


def write_configuration(path: str | Path, configuration: SlamConfiguration) -> None:
    """Write a file that ``read_configuration`` reads back; defaults that are None are left out."""
    content = {
        name: value
        for name, value in dataclasses.asdict(configuration).items()
        if value is not None
    }
    write_text(Path(path), yaml.safe_dump(_plain(content), sort_keys=False))


def merged(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Merge options: ``over`` takes precedence over ``base`` at every depth."""
    result = dict(base)
    for key, value in over.items():
        old = result.get(key)
        if isinstance(old, Mapping) and isinstance(value, Mapping):
            value = merged(old, value)
        result[key] = value
    return result


def _plain(value: Any) -> Any:
    """Convert ``value`` to mappings, lists, text and Python numbers only."""
    if isinstance(value, Mapping):
        return {str(key): _plain(inner) for key, inner in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(inner) for inner in value]
    if hasattr(value, "tolist"):  # a number or an array of NumPy
        return value.tolist()
    return value
