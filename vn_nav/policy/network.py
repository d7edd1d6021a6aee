"""The goal-conditioned policy: convolutions over picture and goal, an LSTM, actor and critic.

Shapes are time-major: T steps, B environments, A actions, G distinct goals, H hidden units, S side
of the square pictures [pixels].
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from vn_nav.errors import UserError
from vn_nav.observation import Observation

KERNELS = ((8, 4), (4, 2), (3, 1))  # kernel and stride of the three convolutions


@dataclasses.dataclass(frozen=True)
class NetworkConfig:
    """Everything that fixes the network's shape; stored in the checkpoint."""

    actions: tuple[str, ...]
    size: int = 84  # pixels a side
    channels: tuple[int, int, int] = (32, 64, 32)
    features: int = 256  # of the trunk
    hidden: int = 256  # of the LSTM
    # Grey levels. Standardised input is what made learning work; whole numbers up to 256 less a
    # whole mean stay exact in bfloat16.
    pixel_mean: float = 120.0
    pixel_std: float = 36.0

    def __post_init__(self):
        object.__setattr__(self, 'actions', tuple(self.actions))
        object.__setattr__(self, 'channels', tuple(self.channels))
        rules = (
            (len(self.actions) >= 2 and len(set(self.actions)) == len(self.actions),
             'a policy has at least two actions with distinct names', self.actions),
            (isinstance(self.size, int) and 36 <= self.size <= 1024,
             'the network takes pictures of 36 to 1024 pixels a side', self.size),
            (len(self.channels) == 3 and all(count >= 1 for count in self.channels),
             'the network has three convolutions, each with at least one channel', self.channels),
            (self.features >= 1 and self.hidden >= 1,
             'features and hidden are positive', (self.features, self.hidden)),
            (self.pixel_std > 0, 'the deviation of pixels is positive', self.pixel_std),
        )
        for kept, rule, received in rules:
            if not kept:
                raise UserError(rule, received, 'correct the network configuration')

    @property
    def map_sizes(self) -> tuple[int, int, int]:
        """Side of the maps after each convolution (84 gives 20, 9, 7)."""
        sizes, side = [], self.size
        for kernel, stride in KERNELS:
            side = (side - kernel) // stride + 1
            sizes.append(side)
        return tuple(sizes)


class RecurrentState(NamedTuple):
    """Memory of the LSTM, [B,H] each."""

    hidden: Tensor
    cell: Tensor


class PolicyOutput(NamedTuple):
    """What the network says: unnormalised log-probabilities [T,B,A] and state value [T,B]."""

    logits: Tensor
    value: Tensor


class Policy(nn.Module):
    """Early fusion of picture and goal, at the price of late fusion.

    The first convolution of a six-channel stack (picture above goal) is a sum of two
    three-channel convolutions. So the goal's half runs once for each distinct goal
    (`encode_goals`), not once for each frame, with the same result.

    Attributes:
        compute_dtype: type of the convolutions and matrix products; parameters, LSTM state and
            outputs are float32 in any case.
    """

    def __init__(self, config: NetworkConfig):
        super().__init__()
        self.config = config
        self.compute_dtype = torch.float32
        first, second, third = config.channels
        (k1, s1), (k2, s2), (k3, s3) = KERNELS
        self.picture_conv = nn.Conv2d(3, first, k1, s1)
        self.goal_conv = nn.Conv2d(3, first, k1, s1, bias=False)
        self.conv2 = nn.Conv2d(first, second, k2, s2)
        self.conv3 = nn.Conv2d(second, third, k3, s3)
        self.trunk = nn.Linear(third * config.map_sizes[-1] ** 2, config.features)
        self.memory = MaskedLSTM(config.features + len(config.actions) + 1, config.hidden)
        self.actor = nn.Linear(config.hidden, len(config.actions))
        self.critic = nn.Linear(config.hidden, 1)
        self._initialise()

    def _initialise(self) -> None:
        for layer in (self.conv2, self.conv3, self.trunk):
            nn.init.orthogonal_(layer.weight, 2**0.5)
            nn.init.zeros_(layer.bias)
        # The two halves are one six-channel filter bank, and initialised as one.
        whole = torch.empty(self.config.channels[0], 6, *self.picture_conv.kernel_size)
        nn.init.orthogonal_(whole, 2**0.5)
        with torch.no_grad():
            self.picture_conv.weight.copy_(whole[:, :3])
            self.goal_conv.weight.copy_(whole[:, 3:])
        nn.init.zeros_(self.picture_conv.bias)
        nn.init.orthogonal_(self.actor.weight, 0.01)
        nn.init.orthogonal_(self.critic.weight, 1.0)
        nn.init.zeros_(self.actor.bias)
        nn.init.zeros_(self.critic.bias)
        for module in (self.picture_conv, self.goal_conv, self.conv2, self.conv3):
            module.to(memory_format=torch.channels_last)

    def initial_state(self, batch: int) -> RecurrentState:
        """Zeros, [batch,H] each."""
        zeros = torch.zeros(batch, self.config.hidden)
        return RecurrentState(zeros, zeros.clone())

    def encode_goals(self, goals: Tensor) -> Tensor:
        """The goals' share of the first convolution: [G,3,S,S] uint8 -> [G,C,h,w]."""
        return self._first(goals, self.goal_conv)

    def encode(self, image: Tensor, goal_maps: Tensor, goal_index: Tensor) -> Tensor:
        """Features [N,F] of pictures [N,3,S,S] uint8 beside goals `goal_maps`[goal_index]."""
        dtype = self.compute_dtype
        maps = self._first(image, self.picture_conv)
        # Adding goal_maps[goal_index] as a product with the one-hot matrix [N,G]: one pass
        # forward, and backward one product in place of a slow scatter over the frames that share
        # a goal.
        rows, goal_rows = maps.permute(0, 2, 3, 1), goal_maps.permute(0, 2, 3, 1)
        one_hot = (goal_index.unsqueeze(1) == torch.arange(len(goal_maps))).to(dtype)
        fused = F.relu(torch.addmm(rows.flatten(1), one_hot, goal_rows.flatten(1)))
        x = fused.view(rows.shape).permute(0, 3, 1, 2)
        for conv in (self.conv2, self.conv3):
            x = F.relu(F.conv2d(x, conv.weight.to(dtype), conv.bias.to(dtype), conv.stride))
        # Flattened as [channel, row, column], whatever the memory format.
        trunk = self.trunk
        return F.relu(F.linear(x.flatten(1), trunk.weight.to(dtype), trunk.bias.to(dtype)))

    def forward(self, obs: Observation, starts: Tensor, state: RecurrentState,
                goal_maps: Tensor | None = None) -> tuple[PolicyOutput, RecurrentState]:
        """Run T steps of B environments.

        Args:
            obs: leading dimensions [T,B]; pictures uint8.
            starts: [T,B] bool, true where an episode begins: the memory is zeroed before that row.
            state: memory before the first row.
            goal_maps: `encode_goals(obs.goals)`, if it is known already.

        Returns:
            Logits and values in float32, and the memory after the last row.
        """
        steps, batch = starts.shape
        if goal_maps is None:
            goal_maps = self.encode_goals(obs.goals)
        features = self.encode(obs.image.flatten(0, 1), goal_maps, obs.goal_index.flatten())
        # One-hot of the last action; all zeros (not a class) for -1, an episode's start.
        actions = torch.arange(len(self.config.actions))
        last_action = (obs.last_action.unsqueeze(-1) == actions).to(features.dtype)
        last_reward = obs.last_reward.clamp(-1.0, 1.0).unsqueeze(-1).to(features.dtype)
        inputs = torch.cat(
            [features.view(steps, batch, -1), last_action, last_reward], dim=-1)
        hidden, state = self.memory(inputs, starts, state)
        return PolicyOutput(self.actor(hidden), self.critic(hidden).squeeze(-1)), state

    def _first(self, pictures: Tensor, conv: nn.Conv2d) -> Tensor:
        """First convolution on standardised pixels; the division is folded into the weights."""
        dtype = self.compute_dtype
        pixels = pictures.to(dtype).contiguous(memory_format=torch.channels_last)
        weight = (conv.weight / self.config.pixel_std).to(dtype)
        bias = None if conv.bias is None else conv.bias.to(dtype)
        return F.conv2d(pixels.sub_(self.config.pixel_mean), weight, bias, conv.stride)


class MaskedLSTM(nn.Module):
    """One LSTM layer whose memory is zeroed wherever an episode starts.

    The input's share of all gates is one matrix product over T x B; only the recurrent share steps
    through time, without cutting the sequence at resets. Gate order: input, forget, output, cell.
    """

    def __init__(self, inputs: int, hidden: int):
        super().__init__()
        self.input_weight = nn.Parameter(torch.empty(4 * hidden, inputs))
        self.recurrent_weight = nn.Parameter(torch.empty(4 * hidden, hidden))
        self.bias = nn.Parameter(torch.zeros(4 * hidden))
        with torch.no_grad():
            for gate in range(4):
                rows = slice(gate * hidden, (gate + 1) * hidden)
                nn.init.orthogonal_(self.input_weight[rows])
                nn.init.orthogonal_(self.recurrent_weight[rows])
            self.bias[hidden:2 * hidden] = 1.0  # remember, until taught to forget

    def forward(self, inputs: Tensor, starts: Tensor, state: RecurrentState
                ) -> tuple[Tensor, RecurrentState]:
        """Inputs [T,B,I], starts [T,B] bool -> outputs [T,B,H] float32 and the last memory."""
        gates = F.linear(inputs, self.input_weight.to(inputs.dtype)).float() + self.bias
        keep = (~starts).unsqueeze(-1).to(gates.dtype)
        outputs, cell = _Recurrence.apply(gates, self.recurrent_weight, state.hidden, state.cell,
                                          keep, inputs.dtype)
        return outputs, RecurrentState(outputs[-1], cell)


class _Recurrence(torch.autograd.Function):
    """The recurrent part of an LSTM with a hand-written backward pass.

    Autograd would accumulate the recurrent weight's gradient T times; here it is one product over
    T x B, and everything that does not depend on later steps is computed for all steps at once.
    No gradient flows into the first memory (truncated back-propagation).
    """

    @staticmethod
    def forward(ctx, gates, weight, hidden, cell, keep, dtype):
        steps, batch, width = gates.shape[0], gates.shape[1], hidden.shape[1]
        recurrent = weight.t().to(dtype)
        # `gates` holds the input's share on entry and the activations on exit.
        gates = gates.clone()
        hidden_before = gates.new_empty(steps, batch, width)
        cell_before = gates.new_empty(steps, batch, width)
        cell_tanh = gates.new_empty(steps, batch, width)
        outputs = gates.new_empty(steps, batch, width)
        for t in range(steps):
            torch.mul(hidden, keep[t], out=hidden_before[t])
            torch.mul(cell, keep[t], out=cell_before[t])
            row = gates[t]
            row += hidden_before[t].to(dtype) @ recurrent
            row[:, :3 * width].sigmoid_()
            row[:, 3 * width:].tanh_()
            i, f, o, g = row.view(batch, 4, width).unbind(1)
            cell = torch.addcmul(i * g, f, cell_before[t])
            torch.tanh(cell, out=cell_tanh[t])
            hidden = torch.mul(o, cell_tanh[t], out=outputs[t])
        ctx.save_for_backward(gates, weight, keep, hidden_before, cell_before, cell_tanh)
        ctx.dtype = dtype
        return outputs, cell

    @staticmethod
    def backward(ctx, grad_outputs, grad_cell):
        gates, weight, keep, hidden_before, cell_before, cell_tanh = ctx.saved_tensors
        steps, batch, width = hidden_before.shape
        i, f, o, g = gates.view(steps, batch, 4, width).unbind(2)
        # Derivatives of the cell by the output (to_cell) and of the pre-activations (to_gates).
        to_cell = o * (1 - cell_tanh**2)
        to_gates = torch.stack([g * i * (1 - i), cell_before * f * (1 - f),
                                cell_tanh * o * (1 - o), i * (1 - g**2)], dim=2)
        forget = f * keep
        recurrent = weight.to(ctx.dtype)
        grad_gates = torch.empty_like(to_gates)
        grad_hidden = torch.zeros_like(grad_cell)
        for t in reversed(range(steps)):
            grad_hidden = grad_hidden + grad_outputs[t]
            total = torch.addcmul(grad_cell, grad_hidden, to_cell[t])
            row = torch.mul(to_gates[t], total.unsqueeze(1), out=grad_gates[t])
            torch.mul(to_gates[t, :, 2], grad_hidden, out=row[:, 2])
            grad_cell = total * forget[t]
            grad_hidden = (row.view(batch, -1).to(ctx.dtype) @ recurrent) * keep[t]
        grad_gates = grad_gates.view(steps, batch, 4 * width)
        flat = grad_gates.flatten(0, 1).to(ctx.dtype)
        grad_weight = flat.t() @ hidden_before.flatten(0, 1).to(ctx.dtype)
        return grad_gates, grad_weight.to(weight.dtype), None, None, None, None
