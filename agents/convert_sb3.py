"""Turn a policy of before the present format, an archive of Stable-Baselines3, into a policy file.

    ms-slam train sb3 convert old.zip --out policy.safetensors --trust

Such an archive can hold pickles, which run code when they are loaded. Those of the archive's own
description are never loaded here, the tensors by PyTorch's reader that knows tensors alone
(``weights_only``). That reader is PyTorch's promise, not ours, hence ``--trust``.
"""

from __future__ import annotations

import io
import json
import math
import pickle
import re
import warnings
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import tyro
from ms_slam_agents.policy_file import (
    Metadata,
    PolicyFile,
    Tensors,
    write_policy,
)
from ms_slam_agents.sb3_state import optimizer_tensors

from ms_slam_env.command_line import parse
from ms_slam_env.errors import InputError
from ms_slam_env.output_files import check_out_file
from ms_slam_env.report.provenance import provenance

_LARGEST_MEMBER = 2**29  # bytes, unpacked


@dataclass(frozen=True)
class Arguments:
    """Convert an archive of Stable-Baselines3 into a policy file that can hold no code."""

    archive: tyro.conf.Positional[Path]
    """The old policy, a zip file."""
    out: Path = Path("policy.safetensors")
    """The new one."""
    trust: bool = False
    """Say that you know where the archive comes from."""
    optimizer: bool = True
    """Keep the state of the optimiser, to resume training from."""


def main(arguments: Sequence[str]) -> int:
    """Convert as the command line says; return the exit code."""
    args = parse(Arguments, arguments, "ms-slam train sb3 convert", check_out_file)
    if not args.trust:
        raise InputError(
            f"{args.archive} may hold code: add --trust if you know where it comes from"
        )
    if args.out.exists() and not args.out.is_file():
        raise InputError(f"{args.out} is not a regular file")
    policy = convert(args.archive)
    args.out.parent.mkdir(parents=True, exist_ok=True)
    write_policy(args.out, policy if args.optimizer else policy.without_optimizer())
    metadata = policy.metadata
    print(f"{args.out}: {metadata.algorithm}, {metadata.observation}, {metadata.timesteps} steps")
    return 0


def convert(archive: Path) -> PolicyFile:
    """Read an archive.

    Raises:
        InputError: no such archive, or one with something else in it.
    """
    if not archive.is_file():
        raise InputError(f"no archive {str(archive)!r}")
    try:
        with zipfile.ZipFile(archive) as members:
            return _convert(
                json.loads(_member(members, "ms_slam_env.json")),
                json.loads(_member(members, "data")),
                _tensors(members, "policy.pth"),
                _tensors(members, "policy.optimizer.pth"),
            )
    except InputError as error:
        raise InputError(f"{archive}: {error}") from None
    except _BROKEN as error:
        reason = str(error).splitlines()[0] if str(error) else repr(error)
        raise InputError(f"{archive} is no policy of Stable-Baselines3: {reason}") from None


_BROKEN = (
    *(zipfile.BadZipFile, RuntimeError, NotImplementedError, EOFError),
    *(KeyError, ValueError, TypeError, AttributeError, IndexError, OverflowError, RecursionError),
)
"""What the readers of broken archives raise."""


def _convert(
    description: dict[str, Any],
    data: dict[str, Any],
    network: dict[str, torch.Tensor],
    optimizer: dict[str, Any],
) -> PolicyFile:
    given = description["options"]
    step_deg = given.get("step_deg")
    env_options = {
        "embodiment": given.get("embodiment"),
        "step_m": given.get("step_m"),
        "step_rad": None if step_deg is None else math.radians(step_deg),
    }
    hidden = [network[f"mlp_extractor.policy_net.{i}.weight"].shape[0] for i in (0, 2)]
    metadata = Metadata(
        algorithm=description["algorithm"],
        env_id=description["env_id"],
        env_options={name: value for name, value in env_options.items() if value is not None},
        observation=description["observation"],
        inputs=len(description["observation_moments"]["mean"]),
        hidden=hidden,
        actions=_action_parts(data["action_space"]),
        timesteps=int(description["timesteps"]),
        epochs=int(data["_n_updates"]),
        minutes=float(description["minutes"]),
        options=given,
        provenance=provenance(),
    )
    metadata.check()
    tensors: Tensors = {f"policy.{name}": value.numpy() for name, value in network.items()}
    for name in ("observation", "return"):
        moments = description[f"{name}_moments"]
        for part in ("mean", "var", "count"):
            tensors[f"{name}.{part}"] = np.array(moments[part], dtype=np.float64)
    tensors |= optimizer_tensors(list(network), optimizer)
    return PolicyFile(metadata, tensors)


def _action_parts(space: dict[str, Any]) -> list[int]:
    """Choices of each number of an action, from the archive's words beside the pickled space."""
    return [int(number) for number in re.findall(r"\d+", space.get("nvec") or space["n"])]


def _member(members: zipfile.ZipFile, name: str) -> bytes:
    if members.getinfo(name).file_size > _LARGEST_MEMBER:
        raise InputError(f"{name} is larger than {_LARGEST_MEMBER >> 20} MiB")
    return members.read(name)


def _tensors(members: zipfile.ZipFile, name: str) -> dict[str, Any]:
    data = io.BytesIO(_member(members, name))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return dict(torch.load(data, map_location="cpu", weights_only=True))
    except pickle.UnpicklingError:  # its text recommends to load the file without that guard
        raise InputError(f"{name} holds something else than tensors") from None
