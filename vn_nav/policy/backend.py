"""What computes a policy's networks on a robot: PyTorch or ONNX Runtime."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np

from vn_nav.errors import UserError
from vn_nav.policy.checkpoint_info import (
    CONFIG,
    EXPORT,
    ONNX_FILES,
    PLACE_CHECKSUM,
    WEIGHTS,
    read_config,
)
from vn_nav.policy.network_config import NetworkConfig
from vn_nav.policy.search.eyes import Eyes


class Decision(NamedTuple):
    """What the network says of one picture."""

    logits: np.ndarray  # [1,A] float32 of the actions
    arrival: float | None  # logit; None: it has no such head
    state: Any  # what it remembers from now on


class Backend(Protocol):
    """A policy in memory, for one robot.

    Attributes:
        config: of the network; info: what else the checkpoint says.
        engine: what computes it, for people.
        eyes: of a policy that searches; None: it is another.
    """

    config: NetworkConfig
    info: dict
    engine: str
    eyes: Eyes | None

    def encode_goal(self, goal: np.ndarray) -> np.ndarray:
        """What is kept of a goal picture [1,3,S,S] uint8."""

    def initial_state(self) -> Any:
        """The memory where an episode begins."""

    def decide(self, image: np.ndarray, goal: np.ndarray, last_action: np.ndarray,
               state: Any) -> Decision:
        """Look at a picture; not for a policy that searches.

        Args:
            image: [1,3,S,S] uint8; goal: of `encode_goal`.
            last_action: [1], -1 where an episode begins; state: what is remembered.
        """

    def choose(self, logits: np.ndarray, offsets: np.ndarray | None, decoding: str
               ) -> tuple[int, bool, bool]:
        """An action by logits [1,A], with the offsets [1,A] of an action filter.

        Returns:
            The action; whether the filter acted; and whether another action would have come out
            without it, by the same random number.

        Raises:
            FloatingPointError: a logit is not finite.
        """


def load_backend(folder: Path, seed: int) -> Backend:
    """An export by ONNX Runtime, which is faster, also one in a checkpoint's folder; else PyTorch.

    Args:
        folder: of either; seed: of the sampled actions.

    Raises:
        UserError: see `vn_nav.policy.checkpoint.load_checkpoint` and `vn_nav.policy.onnx_backend`;
            what has to compute it is not installed.
    """
    export = folder if any((folder / name).is_file() for name in ONNX_FILES) else (
        own_export(folder) if importlib.util.find_spec('onnxruntime') else None)
    if export is not None:
        from vn_nav.policy.onnx_backend import OnnxBackend
        return OnnxBackend(export, seed)
    try:
        from vn_nav.policy.torch_backend import TorchBackend
    except ImportError as error:
        if not (error.name or '').startswith('torch'):
            raise
        raise UserError('a checkpoint is computed by PyTorch', f'{folder}: {error}',
                        'pip install torch; or run `vn_nav export` where it is installed, and '
                        'pass that folder') from error
    return TorchBackend(folder, seed)


def own_export(folder: Path) -> Path | None:
    """The export in a checkpoint's folder; None: there is none, or of another state of it.

    Raises:
        UserError: see `read_config`.
    """
    export = folder / EXPORT
    if not (export / CONFIG).is_file():
        return None
    (own, info), (other, others) = (read_config(folder, (WEIGHTS,)),
                                    read_config(export, ONNX_FILES))
    same = info == others and all(own.get(key) == other.get(key)
                                  for key in ('sha256', PLACE_CHECKSUM))
    return export if same else None
