"""Policy files: what is written comes back; what is broken, or a trap, is refused in one line."""

import io
import json
import os
import pickle
import zipfile
from dataclasses import asdict, replace

import numpy as np
import pytest
from ms_slam_agents.policy import Policy
from ms_slam_agents.policy_file import STEP, PolicyFile, read_policy, write_policy
from ms_slam_agents.policy_planner import TrainedPolicy
from policy_files import METADATA, as_bytes, make_tensors
from safetensors.numpy import save

from ms_slam_env.cli import main
from ms_slam_env.errors import InputError

BIAS = "policy.action_net.bias"


def words(**changes):
    """The metadata's text with other values; ``...`` leaves one out."""
    content = {k: v for k, v in (asdict(METADATA) | changes).items() if v is not ...}
    return json.dumps(content)


def header(**tensors):
    """A file that declares tensors and holds no byte of them."""
    text = json.dumps(tensors).encode()
    return len(text).to_bytes(8, "little") + text


class Trap:
    """Makes a folder when it is unpickled."""

    def __init__(self, path):
        self.path = str(path)

    def __reduce__(self):
        return os.mkdir, (self.path,)


@pytest.mark.parametrize("with_optimizer", [True, False])
def test_what_is_written_comes_back_to_the_bit(tmp_path, with_optimizer):
    tensors = make_tensors(with_optimizer=with_optimizer)
    write_policy(tmp_path / "a.safetensors", PolicyFile(METADATA, tensors))
    found = read_policy(tmp_path / "a.safetensors")
    assert found.metadata == METADATA
    assert found.can_resume == with_optimizer
    assert found.tensors.keys() == tensors.keys()
    for name, value in tensors.items():
        assert found.tensors[name].dtype == value.dtype
        np.testing.assert_array_equal(found.tensors[name], value)
    assert STEP not in found.without_optimizer().tensors


def test_tensors_that_do_not_fit_are_not_written(tmp_path):
    tensors = make_tensors() | {BIAS: np.full(7, np.inf, np.float32)}
    with pytest.raises(InputError, match="NaN or infinity"):
        write_policy(tmp_path / "a", PolicyFile(METADATA, tensors))
    with pytest.raises(InputError, match="no tensor optimizer"):
        write_policy(
            tmp_path / "a", PolicyFile(replace(METADATA, hidden=(4, 3, 2)), make_tensors())
        )
    assert not list(tmp_path.iterdir())


BROKEN = {
    "empty": (b"", "not a policy"),
    "text": (b"not a policy at all", "not a policy"),
    "truncated": (as_bytes()[:-100], "not a policy"),
    "header cut short": (as_bytes()[:50], "not a policy"),
    "appended bytes": (as_bytes() + b"\0" * 8, "not a policy"),
    "huge header": ((2**62).to_bytes(8, "little") + b"{}", "not a policy"),
    "huge tensor": (
        header(a={"dtype": "F32", "shape": [2**40], "data_offsets": [0, 2**42]}),
        "not a policy",
    ),
    "overflowing shape": (
        header(a={"dtype": "F32", "shape": [2**62, 2**62], "data_offsets": [0, 0]}),
        "not a policy",
    ),
    "a pickle": (pickle.dumps({"policy": 1}), "not a policy"),
    "other safetensors": (save(make_tensors()), "a safetensors file of something else"),
    "no JSON": (as_bytes("{"), "metadata: "),
    "a list": (as_bytes("[]"), "metadata: "),
    "NaN in JSON": (as_bytes(words(minutes=float("nan"))), "metadata: NaN"),
    "number of 5000 digits": (as_bytes('{"version": ' + "9" * 5000 + "}"), "metadata: "),
    "deep nesting": (as_bytes("[" * 100_000), "metadata: "),
    "other version": (as_bytes(words(version=2)), "format version 2, this package reads 1"),
    "no version": (as_bytes(words(version=...)), "format version None"),
    "missing key": (as_bytes(words(inputs=...)), "metadata: missing 1 required .* 'inputs'"),
    "unknown key": (as_bytes(words(colour="red")), "unexpected keyword argument 'colour'"),
    "text for a number": (as_bytes(words(inputs="5")), "inputs is str"),
    "number for a text": (as_bytes(words(env_id=5)), "env_id is int"),
    "null": (as_bytes(words(hidden=None)), "hidden is not a list"),
    "list for a mapping": (as_bytes(words(env_options=[])), "env_options is list"),
    "endless time": (as_bytes(words(minutes=1e400).replace("Infinity", "1e400")), "minutes = inf"),
    "more steps than there are": (as_bytes(words(timesteps=10**400)), "metadata: "),
    "an age of training": (as_bytes(words(minutes=1e300)), r"minutes = 1e\+300 is outside"),
    "unknown algorithm": (as_bytes(words(algorithm="sac")), "unknown algorithm 'sac'"),
    "module as environment": (as_bytes(words(env_id="evil:Env-v0")), "env_id 'evil:Env-v0' is not"),
    "module as observation": (as_bytes(words(observation="evil:Seen")), "observation 'evil:Seen'"),
    "other option": (as_bytes(words(env_options={"slam": "evil:Slam"})), "'slam'; valid"),
    "option of other type": (as_bytes(words(env_options={"step_m": [1]})), r"step_m = \[1\] is"),
    "steps backwards": (as_bytes(words(env_options={"step_m": -1})), "step_m = -1 is outside"),
    "turns for ever": (as_bytes(words(env_options={"step_rad": 9})), "step_rad = 9 is outside"),
    "module as robot": (as_bytes(words(env_options={"embodiment": "x:Y"})), "embodiment 'x:Y'"),
    "negative layer": (as_bytes(words(hidden=[4, -3])), "not valid layer sizes"),
    "huge layer": (as_bytes(words(hidden=[4, 10**9])), "not valid layer sizes"),
    "many layers": (as_bytes(words(hidden=[4] * 100_000)), "not valid layer sizes"),
    "other observation": (as_bytes(words(inputs=6)), r"shape \(4, 5\), not \(4, 6\)"),
    "other actions": (as_bytes(words(actions=[7, 2])), "shape"),
    "wrong shape": (as_bytes(**{BIAS: np.zeros(8, np.float32)}), r"bias has shape \(8,\)"),
    "wrong type": (as_bytes(**{BIAS: np.zeros(7, np.int64)}), "type I64"),
    "missing tensor": (as_bytes(**{BIAS: None}), f"no tensor {BIAS}"),
    "extra tensor": (as_bytes(extra=np.zeros(3)), "unknown tensor extra"),
    "half an optimiser": (as_bytes(**{STEP: None}), "unknown tensor optimizer"),
    "NaN weights": (as_bytes(**{BIAS: np.full(7, np.nan, np.float32)}), "NaN or infinity"),
    "huge weights": (
        as_bytes(**{BIAS: np.full(7, 3e38, np.float32)}),
        f"tensor {BIAS} holds numbers beyond",
    ),
    "huge count": (as_bytes(**{"return.count": np.array(1e300)}), "return.count holds numbers"),
    "huge moments": (as_bytes(**{"observation.mean": -np.full(5, 1e300)}), "mean holds numbers"),
    "negative variance": (as_bytes(**{"observation.var": -np.ones(5)}), "negative"),
}


@pytest.mark.parametrize(("content", "message"), BROKEN.values(), ids=BROKEN)
def test_a_broken_policy_is_refused_in_one_line(tmp_path, content, message):
    path = tmp_path / "policy.safetensors"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message) as caught:
        read_policy(path)
    assert str(path) in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1
    assert len(str(caught.value)) < 500


def test_what_is_no_regular_file_is_refused_at_once(tmp_path):
    os.mkfifo(tmp_path / "fifo")
    (tmp_path / "sparse").touch()
    os.truncate(tmp_path / "sparse", 2**40)
    (tmp_path / "dangling").symlink_to(tmp_path / "nowhere")
    for name, message in (
        ("fifo", "not a regular file"),
        (".", "not a regular file"),
        ("sparse", "larger than 1024 MiB"),
        ("dangling", "no policy file"),
        ("nothing", "no policy file"),
    ):
        with pytest.raises(InputError, match=message):
            read_policy(tmp_path / name)
    with pytest.raises(InputError, match="not a regular file"):
        read_policy("/dev/zero")


def test_the_command_line_says_it_in_one_line(tmp_path, capsys):
    path = tmp_path / "policy.safetensors"
    path.write_bytes(as_bytes(words(version=2)))
    planner = f"policy,path={path}"
    words_ = ["benchmark", "--planners", planner, "--scenes", "table", "--episodes", "1"]
    assert main([*words_, "--steps", "1", "--out", str(tmp_path / "out")]) != 0
    error = capsys.readouterr().err
    assert "format version 2, this package reads 1" in error
    assert "Traceback" not in error


def traps(folder):
    """Files with a pickle that makes ``folder / sprung`` wherever a reader may look for one."""
    trap = pickle.dumps(Trap(folder / "sprung"))
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as members:
        members.writestr("data", json.dumps({"extra": {":type:": "x", ":serialized:": "gASV"}}))
        for name in ("policy.pth", "policy.optimizer.pth", "pytorch_variables.pth", "extra.pkl"):
            members.writestr(name, trap)
        members.writestr("ms_slam_env.json", "{}")
    return {
        "pickle": trap,
        "archive": archive.getvalue(),
        "extra tensor": as_bytes(extra=np.frombuffer(trap, np.uint8)),
        "metadata": as_bytes(words(extra=trap.hex())),
        "appended": as_bytes() + trap,
    }


def test_the_trap_works(tmp_path):
    pickle.loads(traps(tmp_path)["pickle"])
    assert (tmp_path / "sprung").is_dir()


@pytest.mark.parametrize("kind", ["pickle", "archive", "extra tensor", "metadata", "appended"])
def test_no_loading_path_executes_a_pickle(tmp_path, capsys, kind):
    train_sb3 = pytest.importorskip("ms_slam_agents.train_sb3")
    path = tmp_path / "latest.safetensors"
    path.write_bytes(traps(tmp_path)[kind])
    for load in (
        read_policy,
        Policy.load,
        lambda given: TrainedPolicy(None, path=str(given)),
    ):
        with pytest.raises(InputError):
            load(path)
    assert train_sb3.main(["--out", str(tmp_path), "--resume"]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
    assert not (tmp_path / "sprung").exists()
