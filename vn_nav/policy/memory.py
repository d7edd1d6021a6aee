"""What a policy remembers within an episode: an LSTM, or nothing but its last pictures."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from vn_nav.policy.encoders import apply, uniform_by_fan_in


class RecurrentState(NamedTuple):
    """Memory between calls: hidden and cell of the LSTM, [B,H] each.

    A policy that tracks the goal (`GoalTracker`) keeps its estimate in further columns of
    `hidden`. A policy on stacked frames keeps its last pictures in `hidden` ([B,K-1,3,S,S] uint8)
    instead, or their frozen features ([B,K-1,F] float32), and nothing in `cell` ([B,0]).
    """

    hidden: Tensor
    cell: Tensor


def stack_frames(image: Tensor, starts: Tensor, before: Tensor) -> tuple[Tensor, Tensor]:
    """The last K pictures of every step as channels, the newest last.

    An episode's first picture stands for those before it.

    Args:
        image: [T,B,3,S,S], or any rows [T,B,C,...]; starts: [T,B] bool.
        before: [B,K-1,3,S,S], the pictures before the first row, oldest first.

    Returns:
        [T*B,3*K,S,S], and the pictures to pass as `before` next time.
    """
    steps, batch = starts.shape
    kept = before.shape[1]
    if steps == 1:  # a robot acts: no time to look up, and operations that ONNX knows
        now = image[0].unsqueeze(1)
        begun = starts[0].view(batch, *[1] * (before.dim() - 1))
        rows = torch.cat([torch.where(begun, now, before), now], dim=1)
        return rows.flatten(1, 2), rows[:, 1:]
    rows = torch.cat([before.transpose(0, 1), image])  # [K-1+T,B,...]
    time = torch.arange(steps, device=starts.device).unsqueeze(1)
    # The episode's first row; far in the past where it began before this call.
    first = torch.where(starts, time, -kept).cummax(dim=0).values
    column = torch.arange(batch, device=starts.device)
    stack = [rows[torch.maximum(time - back, first) + kept, column]
             for back in range(kept, -1, -1)]
    last = torch.stack([s[-1] for s in stack[1:]], dim=1)
    return torch.cat(stack, dim=2).flatten(0, 1), last


class Feedforward(nn.Module):
    """A linear layer and ReLU where the LSTM would be (thesis, 5.4: frame concatenation)."""

    def __init__(self, inputs: int, hidden: int):
        super().__init__()
        self.linear = nn.Linear(inputs, hidden)
        uniform_by_fan_in(self)

    def forward(self, inputs: Tensor, starts: Tensor, state: RecurrentState
                ) -> tuple[Tensor, RecurrentState]:
        """[T,B,I] -> [T,B,H] float32; the state passes through."""
        return F.relu(apply(self.linear, inputs)).float(), state


class MaskedLSTM(nn.Module):
    """One LSTM layer whose memory is zeroed wherever an episode starts.

    The input's share of all gates is one matrix product over T x B; only the recurrent share steps
    through time, without cutting the sequence at resets. Gate order: input, forget, output, cell.
    """

    def __init__(self, inputs: int, hidden: int, *, thesis: bool = False):
        super().__init__()
        self.input_weight = nn.Parameter(torch.empty(4 * hidden, inputs))
        self.recurrent_weight = nn.Parameter(torch.empty(4 * hidden, hidden))
        self.bias = nn.Parameter(torch.zeros(4 * hidden))
        if thesis:  # as the published code: whole matrices, no bias
            nn.init.xavier_uniform_(self.input_weight)
            nn.init.orthogonal_(self.recurrent_weight)
            return
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
        if torch.jit.is_tracing():  # for ONNX, which knows no autograd functions
            return self._one_step(gates, keep, state)
        outputs, cell = _Recurrence.apply(gates, self.recurrent_weight, state.hidden, state.cell,
                                          keep, inputs.dtype)
        return outputs, RecurrentState(outputs[-1], cell)

    def _one_step(self, gates: Tensor, keep: Tensor, state: RecurrentState
                  ) -> tuple[Tensor, RecurrentState]:
        """What `_Recurrence` computes for T = 1, in plain operations."""
        gates = gates[0] + F.linear(state.hidden * keep[0], self.recurrent_weight)
        i, f, o, g = gates.chunk(4, dim=1)
        cell = torch.sigmoid(i) * torch.tanh(g) + torch.sigmoid(f) * (state.cell * keep[0])
        hidden = torch.sigmoid(o) * torch.tanh(cell)
        return hidden.unsqueeze(0), RecurrentState(hidden, cell)


class GoalTracker(nn.Module):
    """Where the goal stands relative to the robot, carried along while it is out of sight.

    A filter without weights to learn: each action moves the estimate as commanded (dead
    reckoning), and each look at the goal corrects it by its confidence against that of
    the estimate, which fades with every move. The memory sees the estimate.

    Args:
        moves: [A,3] of the actions: dx forward, dy left [m], dyaw [rad].
    """

    WIDTH = 5  # numbers of the estimate: x, y [m], cos and sin of the heading, weight
    FADE = 0.95  # of the weight, each action
    MOST = 100.0  # the weight of an estimate

    shift: Tensor  # [A+1,2] m
    turn: Tensor  # [A+1,2] cos and sin

    def __init__(self, moves: tuple[tuple[float, float, float], ...]):
        super().__init__()
        table = torch.tensor([*moves, (0.0, 0.0, 0.0)])  # the last row: no action yet
        self.register_buffer('shift', table[:, :2].contiguous(), persistent=False)
        self.register_buffer('turn', torch.stack([table[:, 2].cos(), table[:, 2].sin()], dim=1),
                             persistent=False)

    @torch.no_grad()
    def forward(self, position: Tensor, heading: Tensor, co_visible: Tensor, last_action: Tensor,
                starts: Tensor, estimate: Tensor) -> tuple[Tensor, Tensor]:
        """Track through T steps.

        Args:
            position: [T,B,2] m; heading: [T,B,2]; co_visible: [T,B] logit: see `heads.Pose`.
            last_action: [T,B], -1 where there is none; starts: [T,B] bool.
            estimate: [B,5] before the first row.

        Returns:
            [T,B,5] what the memory sees, within about [-2, 2] and vanishing with the confidence;
            and the estimate [B,5] after the last row.
        """
        shift, turn = self.shift[last_action], self.turn[last_action]
        # The square of the odds: a hundred doubtful looks do not make a goal.
        weight = (2 * co_visible.clamp(-4.0, 2.3)).exp().unsqueeze(2)
        look = torch.cat([position, heading], dim=2)
        keep = self.FADE * (~starts).unsqueeze(2)
        rows = []
        for t in range(len(starts)):
            c, s = turn[t, :, 0], turn[t, :, 1]
            x, y = (estimate[:, :2] - shift[t]).unbind(1)
            cos, sin = estimate[:, 2], estimate[:, 3]
            moved = torch.stack([c * x + s * y, c * y - s * x, c * cos + s * sin,
                                 c * sin - s * cos], dim=1)
            before = keep[t] * estimate[:, 4:]
            total = (before + weight[t]).clamp(max=self.MOST)
            gain = weight[t] / (before + weight[t])
            estimate = torch.cat([moved + gain * (look[t] - moved), total], dim=1)
            rows.append(estimate)
        track = torch.stack(rows)
        sure = track[..., 4:] / (1 + track[..., 4:])
        seen = torch.cat([sure * (track[..., :2] / 3.0).clamp(-2.0, 2.0),
                          sure * track[..., 2:4].clamp(-1.0, 1.0), sure], dim=2)
        return seen, estimate


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
