"""Policies kept at half precision decide as they did at single precision.

``decisions.npz`` holds 210 observations of three rooms and what the policies of ``docs/results``
chose before their numbers were rounded (commit 67f790f).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from ms_slam_agents.policy import Policy
from ms_slam_agents.policy_file import read_policy, write_policy
from policy_files import METADATA, make_tensors

ROOT = Path(__file__).resolve().parents[2]
KNOWN = np.load(Path(__file__).with_name("decisions.npz"))
OBSERVATIONS = KNOWN["observations"].astype(np.float64)
MASKS = np.unpackbits(KNOWN["masks"], axis=1, count=49).astype(bool)
KEPT = sorted((ROOT / "docs" / "results").glob("*/*.safetensors"))


@pytest.mark.parametrize("path", KEPT, ids=lambda path: path.parent.name)
def test_a_kept_policy_decides_as_before(path: Path) -> None:
    decided = Policy.load(path).probabilities(OBSERVATIONS, MASKS).argmax(axis=1)
    np.testing.assert_array_equal(decided, KNOWN[path.parent.name])
    assert path.stat().st_size < 500_000  # numbers of two bytes


def test_a_shipped_policy_would_decide_the_same_at_half_precision(tmp_path: Path) -> None:
    path = tmp_path / "half.safetensors"
    file = read_policy(ROOT / "agents" / "policies" / "ppo.safetensors")
    write_policy(path, file.at_half_precision())
    policies = (Policy(file), Policy.load(path))
    full, half = (policy.probabilities(OBSERVATIONS, MASKS) for policy in policies)
    np.testing.assert_array_equal(full.argmax(axis=1), half.argmax(axis=1))
    assert 0 < np.abs(full - half).max() < 1e-3


def test_half_precision_is_read_as_single(tmp_path: Path) -> None:
    file = type(read_policy(KEPT[0]))(METADATA, make_tensors())
    write_policy(tmp_path / "p.safetensors", file.at_half_precision())
    found = read_policy(tmp_path / "p.safetensors")
    assert not found.can_resume
    for name, value in found.tensors.items():
        assert value.dtype == file.tensors[name].dtype
        np.testing.assert_allclose(value, file.tensors[name], rtol=1e-3)
