"""An export by ONNX Runtime, see `vn_nav.policy.backend.Backend`: no PyTorch is needed.

Where the policy does not search, no Numba either.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from vn_nav.errors import UserError
from vn_nav.policy.backend import Decision
from vn_nav.policy.checkpoint_info import (
    COMPARE,
    CONFIG,
    GOAL,
    ONNX_FILES,
    PLACE_CHECKSUM,
    POLICY,
    SEARCH,
    SEE,
    read_config,
)
from vn_nav.policy.network_config import NetworkConfig, read_network
from vn_nav.policy.search.eyes import Eyes, Placed, Seen
from vn_nav.policy.search.look import Look, Recognition
from vn_nav.policy.search.rules import Rules
from vn_nav.policy.taught_file import read_place

TYPES = {'tensor(float)': np.float32, 'tensor(uint8)': np.uint8, 'tensor(int64)': np.int64,
         'tensor(bool)': np.bool_}
_AGAIN = 'export the checkpoint again with vn_nav export'


class OnnxBackend:
    """See `Backend`. One thread computes, and does not spin while it waits.

    Args:
        folder: that `vn_nav export` wrote; seed: of the sampled actions.

    Raises:
        UserError: a missing or corrupt file, files of two exports, or no ONNX Runtime.
    """

    def __init__(self, folder: Path, seed: int):
        config, info = read_config(folder, ONNX_FILES)
        self.config = read_network(config, str(folder / CONFIG))
        self.info = {**info, 'sha256': config['sha256']}
        self.engine = f'ONNX Runtime ({folder})'
        self._random = np.random.default_rng(seed)
        self.eyes: Eyes | None = None
        if self.config.architecture == SEARCH:
            self.eyes = OnnxEyes(folder, self.config, config)
            return
        self._policy = _Model(folder / POLICY, config['sha256'])
        self._goal = (_Model(folder / GOAL, config['sha256'])
                      if 'goal' in self._policy.inputs else None)

    def encode_goal(self, goal: np.ndarray) -> np.ndarray:
        """See `Backend`."""
        if self.eyes is not None:
            return self.eyes.encode_goals(goal)
        if self._goal is None:  # it looks at none
            return np.zeros((1, 0), np.float32)
        return self._goal(picture=goal)['goal']

    def initial_state(self) -> dict[str, np.ndarray]:
        """See `Backend`."""
        if self.eyes is not None:
            return {}
        return {name: zeros for name, zeros in self._policy.inputs.items()
                if name in ('hidden', 'cell')}

    def decide(self, image: np.ndarray, goal: np.ndarray, last_action: np.ndarray,
               state: dict[str, np.ndarray]) -> Decision:
        """See `Backend`."""
        given = {'image': image, 'goal': goal, 'last_action': last_action.astype(np.int64),
                 'start': last_action < 0, **state}
        wanted = self._policy.inputs  # zeros for what nobody says: a robot gets no reward
        said = self._policy(**{name: given.get(name, zeros) for name, zeros in wanted.items()})
        arrival = float(said['arrival'][0]) if 'arrival' in said else None
        return Decision(said['logits'], arrival, {name: said[f'next_{name}'] for name in state})

    def choose(self, logits: np.ndarray, offsets: np.ndarray | None, decoding: str
               ) -> tuple[int, bool, bool]:
        """See `Backend`."""
        if not np.isfinite(logits).all():
            raise FloatingPointError('logits of the policy are not finite')
        acted = offsets is not None and bool((offsets != 0).any())
        number = self._random.random()
        plain = _chosen(logits[0], decoding, number)
        if not acted or offsets is None:
            return plain, False, False
        action = _chosen(logits[0] + offsets[0], decoding, number)
        return action, True, action != plain


def _chosen(logits: np.ndarray, decoding: str, number: float) -> int:
    """The likeliest action; or the one that a number in [0, 1) draws."""
    if decoding == 'greedy':
        return int(np.argmax(logits))
    shares = np.exp(logits.astype(float) - logits.max()).cumsum()
    return int(np.searchsorted(shares, number * shares[-1], side='right'))


class OnnxEyes:
    """`Eyes` of an exported policy that searches.

    Args:
        folder: of the export; config: of its network; facts: all of its `config.json`.
    """

    rules: Rules | None = None

    def __init__(self, folder: Path, config: NetworkConfig, facts: dict):
        self.config = config
        self.taught = (read_place(folder, facts[PLACE_CHECKSUM], config.size)
                       if PLACE_CHECKSUM in facts else None)
        self._goal, self._see, self._compare = (
            _Model(folder / name, facts['sha256']) for name in (GOAL, SEE, COMPARE))

    def encode_goals(self, goals: np.ndarray) -> np.ndarray:
        """See `Eyes`."""
        return self._goal(picture=goals)['goal']

    def look(self, image: np.ndarray, goal_maps: np.ndarray) -> Look:
        """See `Eyes`."""
        seen = self._see(picture=image)
        return Look(seen['ranges'], *self.compare(seen['features'], goal_maps))

    def see(self, image: np.ndarray) -> Seen:
        """See `Eyes`."""
        seen = self._see(picture=image)
        return Seen(seen['features'], seen['places'])

    def compare(self, features: np.ndarray, goal_maps: np.ndarray) -> Placed:
        """See `Eyes`."""
        said = self._compare(features=features, goal=goal_maps)
        return Placed.of(Recognition(**said))


class _Model:
    """A file of ONNX, in memory.

    Attributes:
        inputs: zeros for each input, by name; the number of pictures is 1 where it is free.
    """

    def __init__(self, path: Path, digest: str):
        try:
            import onnxruntime
        except ImportError as error:
            raise UserError('an export is computed by ONNX Runtime', f'{path}: {error}',
                            'pip install onnxruntime') from error
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.add_session_config_entry('session.intra_op.allow_spinning', '0')
        try:
            self._session = onnxruntime.InferenceSession(path.read_bytes(), options)
        except OSError as error:
            raise UserError(f'an export holds {path.name}', f'{path}: {error.strerror}',
                            _AGAIN) from error
        except Exception as error:  # of C++, in many classes
            raise UserError(f'{path.name} is a model of ONNX',
                            f'{path}: {" ".join(str(error).split())[:200]}', _AGAIN) from error
        found = self._session.get_modelmeta().custom_metadata_map.get('sha256', 'none')
        if found != digest:
            raise UserError(f'{path.name} is of the weights that {CONFIG} speaks of',
                            f'SHA-256 {found}', _AGAIN)
        self.inputs: dict[str, np.ndarray] = {
            part.name: np.zeros([side if isinstance(side, int) else 1 for side in part.shape],
                                TYPES[part.type]) for part in self._session.get_inputs()}
        self._outputs = [part.name for part in self._session.get_outputs()]

    def __call__(self, **given: Any) -> dict[str, np.ndarray]:
        """Outputs by name."""
        return dict(zip(self._outputs, self._session.run(None, given), strict=True))
