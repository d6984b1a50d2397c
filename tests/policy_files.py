"""A policy file, whole or with parts replaced; for tests of its reader and for the fuzzer."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

import numpy as np
from ms_slam_agents.policy_file import Metadata, tensor_shapes
from safetensors.numpy import save

METADATA = Metadata(
    algorithm="ppo",
    env_id="MSActiveSLAM-FreeCamera-v0",
    observation="features",
    inputs=5,
    hidden=(4, 3),
    actions=(7,),
    timesteps=100,
    epochs=8,
    minutes=1.5,
    env_options={"step_m": 0.1},
)


def make_tensors(with_optimizer: bool = True) -> dict[str, Any]:
    """Tensors that fit ``METADATA``."""
    rng = np.random.default_rng(0)
    return {
        name: np.asarray(rng.uniform(0.1, 1.0, shape), "f4" if name.startswith("policy") else "f8")
        for name, shape in tensor_shapes(METADATA, with_optimizer).items()
    }


def as_bytes(text: str | None = None, **tensors: Any) -> bytes:
    """A file with another text, or with some tensors replaced; None leaves one out."""
    changed = {k: v for k, v in (make_tensors() | tensors).items() if v is not None}
    text = json.dumps(asdict(METADATA)) if text is None else text
    return save(changed, {"ms_slam_policy": text})
