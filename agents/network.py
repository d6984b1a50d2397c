"""The network of our trainers: a policy and a value, or the quantiles of the returns."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from ms_slam_agents.policy_file import (
    CONVOLUTIONS,
    PolicyFile,
    Tensors,
    encoded_width,
    image_width,
)
from torch import Tensor, nn
from torch.nn.functional import log_softmax

BLOCKED = -1e9  # logit of a blocked action; -inf would make NaN of its entropy


class Network(nn.Module):
    """Two hidden layers for the policy and two for the value, after an optional memory.

    With ``candidates`` values per action at the end of an observation, a shared encoder processes
    each action's values, the layers get the state and the mean and maximum of the encodings, and
    each action gets a score, so that the order of the actions does not matter.
    With ``quantiles`` there is no value: each action has this number of quantiles of the return.
    With an ``image`` (channels, rows, columns) at the end of an observation, the layers get the
    state and the output of convolutions on the image.
    In training, a random share ``dropout`` of the layers' input is set to zero.

    The names of the parameters are Stable-Baselines3's, ``memory.*``, ``encoder.*``, ``score.*``,
    ``image.*``.
    """

    def __init__(
        self,
        inputs: int,
        hidden: int,
        actions: int,
        memory: int = 0,
        candidates: int = 0,
        quantiles: int = 0,
        dropout: float = 0.0,
        image: Sequence[int] = (),
    ) -> None:
        super().__init__()
        self.width, self.actions, self.shape = memory, actions, tuple(image)
        self.num_state = inputs - actions * candidates - (math.prod(image) if image else 0)
        encoded = encoded_width(hidden)
        seen = self.num_state + (2 * encoded if candidates else 0)
        seen += image_width(image) if image else 0
        heads = (1 if candidates else actions) * (quantiles or 1)
        self.dropout = nn.Dropout(dropout)
        self.memory = nn.GRUCell(seen, memory) if memory else None
        self.encoder = _layers(candidates, encoded, encoded) if candidates else None
        self.image = _convolutions(image[0]) if image else None
        names = ("policy_net",) if quantiles else ("policy_net", "value_net")
        self.mlp_extractor = nn.ModuleDict(
            {name: _layers(seen + memory, hidden, hidden) for name in names}
        )
        self.score = nn.Linear(encoded + hidden, encoded) if candidates else None
        self.action_net = nn.Linear(encoded if candidates else hidden, heads)
        self.value_net = None if quantiles else nn.Linear(hidden, 1)
        gains: dict[nn.Module | None, float] = {self.action_net: 0.01, self.value_net: 1.0}
        for module in self.modules():
            if isinstance(module, nn.Linear | nn.Conv2d):
                gain = gains.get(module, math.sqrt(2))
                nn.init.orthogonal_(module.weight, gain)
                if module.bias is not None:
                    nn.init.zeros_(module.bias)

    def remember(self, seen: Tensor, memory: Tensor, begins: Tensor) -> Tensor:
        """The memory (B, M) after observations (B, k); empty where an episode ``begins`` (B,)."""
        if self.memory is None:
            return memory
        return self.memory(self._look(seen)[0], memory * (1 - begins[:, None]))

    def forward(self, seen: Tensor, memory: Tensor, masks: Tensor) -> tuple[Tensor, Tensor]:
        """Log-probabilities (B, n) of the actions, and values (B,)."""
        assert self.value_net is not None
        seen, encoded = self._look(seen)
        x = torch.cat([seen, memory], dim=1)
        logits = self._score(x, encoded).reshape(masks.shape)
        values = self.value_net(self.mlp_extractor["value_net"](x))
        return log_softmax(logits.masked_fill(~masks, BLOCKED), dim=1), values.flatten()

    def along(
        self, seen: Tensor, memory: Tensor, begins: Tensor, masks: Tensor
    ) -> tuple[Tensor, Tensor]:
        """``forward`` of L steps of B episodes, (L, B, ...) flattened to (L B, ...).

        Args:
            seen: observations (L, B, k).
            memory: (B, M) before the first step.
            begins: (L, B) where an episode begins.
            masks: (L, B, n) the possible actions.
        """
        rows = []
        for now, first, possible in zip(seen, begins, masks, strict=True):
            memory = self.remember(now, memory, first)
            rows.append(self(now, memory, possible))
        log_probs, values = (torch.cat(column) for column in zip(*rows, strict=True))
        return log_probs, values

    def quantiles(self, seen: Tensor) -> Tensor:
        """Quantiles (B, n, Q) of the return after each action."""
        scores = self._score(*self._look(seen))
        return scores.reshape(len(seen), self.actions, -1)

    def _look(self, seen: Tensor) -> tuple[Tensor, Tensor | None]:
        """Input of the layers (B, k), and the encoded candidates (B, n, E), if any."""
        if self.image is not None:
            made = self.image(seen[:, self.num_state :].unflatten(1, self.shape)).flatten(1)
            return self.dropout(torch.cat([seen[:, : self.num_state], made], dim=1)), None
        if self.encoder is None:
            return self.dropout(seen), None
        encoded = self.encoder(seen[:, self.num_state :].unflatten(1, (self.actions, -1)))
        parts = [seen[:, : self.num_state], encoded.mean(dim=1), encoded.amax(dim=1)]
        return self.dropout(torch.cat(parts, dim=1)), encoded

    def _score(self, x: Tensor, encoded: Tensor | None) -> Tensor:
        """Output of the last layer, for all actions (B, n Q) or each candidate (B, n, Q)."""
        whole = self.mlp_extractor["policy_net"](x)
        if self.score is not None and encoded is not None:
            beside = whole[:, None].expand(-1, self.actions, -1)
            whole = torch.tanh(self.score(torch.cat([encoded, beside], dim=2)))
        return self.action_net(whole)

    def tensors(self) -> Tensors:
        """The parameters in the form of a policy file."""
        return {f"policy.{n}": p.detach().numpy().copy() for n, p in self.named_parameters()}


def load_parameters(network: nn.Module, file: PolicyFile, part: str = "policy") -> None:
    """Load the parameters from a policy file."""
    network.load_state_dict({name: torch.from_numpy(v) for name, v in file.part(part).items()})


def _convolutions(channels: int) -> nn.Sequential:
    """The layers of ``CONVOLUTIONS``, each followed by a rectifier."""
    made: list[nn.Module] = []
    for more, edge, stride in CONVOLUTIONS:
        made += [nn.Conv2d(channels, more, edge, stride), nn.ReLU()]
        channels = more
    return nn.Sequential(*made)


def _layers(inputs: int, first: int, second: int) -> nn.Sequential:
    """Two layers, tanh after each."""
    return nn.Sequential(nn.Linear(inputs, first), nn.Tanh(), nn.Linear(first, second), nn.Tanh())
