"""A network that looks at an image by convolutions: NumPy against PyTorch, a run, bad files."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
import torch
from learnable_fake import NUM_ACTIONS, LearnableFake, read_curve, with_moments, words_of

pytest.importorskip("sb3_contrib")

from ms_slam_agents import options, ppo, qrdqn
from ms_slam_agents.network import Network, load_parameters
from ms_slam_agents.policy import Policy
from ms_slam_agents.policy_file import Metadata, image_width, read_policy

from ms_slam_env.errors import InputError

IMAGE = (2, 17, 22)
STATE = 3
INPUTS = STATE + 2 * 17 * 22
ENV_ID = "LearnableImage-v0"


class Bright(LearnableFake):
    """The right action says in which part of the image something is bright, somewhere in it."""

    inputs = INPUTS

    def _next(self):
        super()._next()
        image = self.np_random.uniform(0, 0.2, IMAGE)
        row = int(self.np_random.integers(14))
        image[:, row : row + 3, 3 * self.right : 3 * self.right + 3] = 1
        state = self.np_random.uniform(size=STATE)
        return np.concatenate([state, image.ravel()]).astype(np.float32)


gym.register(ENV_ID, Bright)


@pytest.fixture(autouse=True)
def image_of_the_fake(monkeypatch):
    own = property(lambda args: IMAGE if args.observation == "pixels" else ())
    monkeypatch.setattr(options.Problem, "image", own)


def make_network(memory=0):
    torch.manual_seed(0)
    network = Network(INPUTS, 16, NUM_ACTIONS, memory, image=IMAGE)
    for parameter in network.parameters():
        torch.nn.init.normal_(parameter, 0, 0.3)
    return network


def file_of(network, memory=0):
    metadata = Metadata(
        *("masked_ppo", ENV_ID, "pixels", INPUTS, (16, 16), (NUM_ACTIONS,), 1, 1, 0.0),
        memory=memory,
        image=IMAGE,
    )
    return with_moments(network, metadata)


@pytest.mark.parametrize("image", [(1, 17, 17), (4, 30, 40), (3, 19, 18), (2, 16, 30)])
def test_the_width_is_what_the_convolutions_make(image):
    width = image_width(image)
    if min(image[1:]) < 17:
        assert width == 0
    else:
        made = Network(4 + int(np.prod(image)), 8, 3, image=image).image(torch.zeros(1, *image))
        assert made.numel() == width


def words(out, *more, steps):
    learns = {"total_timesteps": steps, "batch_size": 64, "learning_rate": 0.003}
    judged = {"observation": "pixels", "eval_episodes": 6, "eval_every": 0}
    return words_of(out, more, ENV_ID, **learns | judged)


def test_ppo_learns_where_to_look_and_goes_on(tmp_path, capsys):
    more = ("--n-steps", "256", "--n-epochs", "8", "--gamma", "0.1")
    assert ppo.main(words(tmp_path / "a", *more, steps=3072)) == 0
    first, last = (p["return"] for p in read_curve(tmp_path / "a").points)
    assert last > first + 2
    assert ppo.main(words(tmp_path / "a", *more, "--resume", steps=3328)) == 0
    best = tmp_path / "a" / "latest.safetensors"
    assert read_policy(best).metadata.image == IMAGE
    own = ("--init", str(best), *more)
    assert ppo.main(words(tmp_path / "b", *own, steps=256)) == 0
    capsys.readouterr()
    assert ppo.main(words(tmp_path / "c", *own, "--observation", "features", steps=64)) == 2
    assert "is for observation 'pixels', not 'features'" in capsys.readouterr().err


def test_quantiles_are_learnt_of_images_too(tmp_path):
    more = ("--learning-starts", "20", "--batch-size", "8", "--buffer-size", "100")
    assert qrdqn.main(words(tmp_path, *more, steps=60)) == 0
    file = read_policy(tmp_path / "latest.safetensors")
    rng, policy = np.random.default_rng(0), Policy(file)
    network = Network(INPUTS, 16, NUM_ACTIONS, quantiles=file.metadata.quantiles, image=IMAGE)
    load_parameters(network, file)
    seen, masks = rng.uniform(size=(20, INPUTS)), rng.random((20, NUM_ACTIONS)) < 0.5
    masks[:, 2] = True
    scaled = torch.as_tensor(policy._scaled(seen), dtype=torch.float32)
    worth = network.quantiles(scaled).mean(dim=2).masked_fill(~torch.as_tensor(masks), -1e9)
    found = policy.probabilities(seen, masks).argmax(axis=1)
    np.testing.assert_array_equal(found, worth.argmax(dim=1))
    assert len(set(found)) > 1


@pytest.mark.parametrize(
    "change",
    [
        {"image": (2, 17)},
        {"image": (2, 17, 4)},
        {"image": (0, 17, 22)},
        {"image": (True, 17, 22)},
        {"image": (2, 17, 40)},
        {"inputs": STATE + 2 * 17 * 22 + 7, "candidates": 1},
    ],
)
def test_files_with_another_image_are_refused(change):
    file = file_of(make_network())
    file.metadata.check()
    with pytest.raises(InputError, match=r"image = \("):
        replace(file.metadata, **change).check()
