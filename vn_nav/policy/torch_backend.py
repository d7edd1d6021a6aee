"""A checkpoint by PyTorch, see `vn_nav.policy.backend.Backend`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from vn_nav.observation import Observation
from vn_nav.policy.backend import Decision
from vn_nav.policy.batched import choose_filtered
from vn_nav.policy.checkpoint import load_checkpoint
from vn_nav.policy.memory import RecurrentState
from vn_nav.policy.search.eyes import Eyes
from vn_nav.policy.search.network import SearchPolicy
from vn_nav.policy.search.torch_eyes import TorchEyes


class TorchBackend:
    """See `Backend`. PyTorch has one thread from then on.

    Args:
        folder: a checkpoint; seed: of the sampled actions.

    Raises:
        UserError: see `load_checkpoint`.
    """

    def __init__(self, folder: Path, seed: int):
        checkpoint = load_checkpoint(folder)
        self.engine = f'PyTorch ({folder}; ONNX Runtime is faster: vn_nav export {folder})'
        torch.set_num_threads(1)
        self.config, self.info, self._network = (
            checkpoint.config, checkpoint.info, checkpoint.network)
        self.eyes: Eyes | None = (TorchEyes(self._network)
                                  if isinstance(self._network, SearchPolicy) else None)
        self._generator = torch.Generator().manual_seed(seed)
        self._reward = torch.zeros(1, 1)  # a robot gets none

    @torch.inference_mode()
    def encode_goal(self, goal: np.ndarray) -> np.ndarray:
        """See `Backend`."""
        return self._network.encode_goals(torch.from_numpy(goal)).numpy()

    def initial_state(self) -> RecurrentState | None:
        """See `Backend`."""
        return None if self.eyes is not None else self._network.initial_state(1)

    @torch.inference_mode()
    def decide(self, image: np.ndarray, goal: np.ndarray, last_action: np.ndarray,
               state: RecurrentState) -> Decision:
        """See `Backend`."""
        last = torch.from_numpy(last_action)[None]
        seen = Observation(torch.from_numpy(image)[None], None, None, last, self._reward)
        output, after = self._network(seen, last < 0, state, torch.from_numpy(goal))
        arrival = None if output.arrival is None else float(output.arrival[0, 0])
        return Decision(output.logits[0].numpy(), arrival, after)

    def choose(self, logits: np.ndarray, offsets: np.ndarray | None, decoding: str
               ) -> tuple[int, bool, bool]:
        """See `Backend`."""
        actions, _, acted, changed = choose_filtered(torch.from_numpy(logits), offsets, decoding,
                                                     self._generator)
        return int(actions), bool(acted[0]), bool(changed[0])
