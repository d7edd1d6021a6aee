"""The weights that a training begins with: of a checkpoint, as far as its network is the same.

A policy may be pre-trained in one simulator and go on in another (thesis, 5.3: DeepMind Lab for
the others). Encoder, memory and critic are shared. What belongs to actions goes by their names,
what belongs to classes of labels by theirs; what differs begins anew, and is said.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from torch import Tensor

from vn_nav.errors import UserError
from vn_nav.policy.checkpoint import load_checkpoint
from vn_nav.policy.network import Policy
from vn_nav.policy.network_config import NetworkConfig

SEGMENTATIONS = ('segmentation', 'goal_segmentation')  # heads that draw classes of labels
BY_ACTION = 'pixel_control'  # the head whose maps are one an action
MEMORY = ('memory.input_weight', 'memory.linear.weight')  # read features, action, reward and more


class Start(NamedTuple):
    """Weights to begin with."""

    weights: dict[str, Tensor]
    words: list[str]  # what was not taken over, and why


def initial_weights(source: str | Path, network: Policy, label_names: Sequence[str] = ()) -> Start:
    """The weights of a checkpoint, and a network's own where the two differ.

    Args:
        source: the checkpoint.
        network: that begins with them.
        label_names: behind the classes that its segmentation heads draw; empty: nobody knows.

    Raises:
        UserError: no such checkpoint, the same actions in another order, or another encoder,
            memory or size.
    """
    config = network.config
    given = load_checkpoint(source)
    if sorted(given.config.actions) == sorted(config.actions):
        given = load_checkpoint(source, config.actions)  # or says that the order is another
    own, taken, words = network.state_dict(), given.network.state_dict(), []
    fresh = _new_heads(given.config, config, taken, own,
                       _other_names(given.info['label_names'], label_names))
    words += [f'head {name} is new: {why}' for name, why in fresh.items() if why]
    words += [f"the checkpoint's head {name} is left out: this training has none"
              for name in given.config.heads if name not in config.heads]
    if given.config.actions != config.actions:
        words.append(_action_words(given.config, config))
    if _more_inputs(given.config) != _more_inputs(config):
        words.append('what the memory sees beside features, action and reward is new')
    found = {}
    for name, tensor in own.items():
        head = name.split('.')[1] if name.startswith('heads.') else ''
        before = None if head in fresh else taken.get(name)
        if before is not None and name in MEMORY:
            before = _memory_columns(before, tensor, given.config, config,
                                     network.encoder.features)
        elif before is not None and name.startswith('actor.'):
            before = _actor_rows(before, tensor, given.config, config)
        if not head and (before is None or before.shape != tensor.shape):
            raise UserError(
                f'a training begins with a checkpoint of the same network: {name} is '
                f'{tuple(tensor.shape)}', tuple(taken[name].shape) if name in taken else 'absent',
                'choose the same architecture, size, channels, features and hidden, or leave '
                'out --init')
        found[name] = tensor if before is None else before
    return Start(found, words)


def _more_inputs(config: NetworkConfig) -> tuple[bool, bool, bool]:
    """What the memory reads beside features, last action and reward."""
    return config.pose_to_memory, bool(config.moves), bool(config.places)


def _other_names(given: Sequence[str], own: Sequence[str]) -> bool:
    """Whether two lists of classes are known to differ."""
    return bool(given and own) and list(given) != list(own)


def _new_heads(given: NetworkConfig, config: NetworkConfig, taken: dict[str, Tensor],
               own: dict[str, Tensor], other_names: bool) -> dict[str, str]:
    """Heads that begin anew, and why in words."""
    found = {}
    for head in config.heads:
        shapes = [{name: tensor.shape for name, tensor in weights.items()
                   if name.startswith(f'heads.{head}.')} for weights in (taken, own)]
        if head not in given.heads:
            found[head] = 'the checkpoint has none'
        elif head in SEGMENTATIONS and (other_names or given.classes != config.classes):
            found[head] = 'its classes of labels are others here'
        elif head == BY_ACTION and given.actions != config.actions:
            found[head] = 'its actions are others here'
        elif shapes[0] != shapes[1]:
            found[head] = 'it has another shape here'
    return found


def _action_words(given: NetworkConfig, config: NetworkConfig) -> str:
    shared = [name for name in config.actions if name in given.actions]
    new = [name for name in config.actions if name not in given.actions]
    gone = [name for name in given.actions if name not in config.actions]
    words = f"actions go by their names: {', '.join(shared) or 'none'} as in the checkpoint"
    words += f'; new: {", ".join(new)}' if new else ''
    return words + (f'; left out: {", ".join(gone)}' if gone else '')


def _actor_rows(before: Tensor, own: Tensor, given: NetworkConfig, config: NetworkConfig
                ) -> Tensor:
    """What the actor [..,A,..] says of actions that both know; its own of the others."""
    if given.actions == config.actions:
        return before
    if before.shape[1:] != own.shape[1:] or config.architecture == 'icra2017':
        return before  # of another network, or of several scenes: the caller says so
    rows = own.clone()
    for k, name in enumerate(config.actions):
        if name in given.actions:
            rows[k] = before[given.actions.index(name)]
    return rows


def _memory_columns(before: Tensor, own: Tensor, given: NetworkConfig, config: NetworkConfig,
                    features: int) -> Tensor:
    """What the memory reads [R,I]: features, one-hot action, reward, and what may follow."""
    alike = given.actions == config.actions and _more_inputs(given) == _more_inputs(config)
    other = (before.shape[0] != own.shape[0] or given.architecture != config.architecture
             or given.features != config.features or given.size != config.size)
    if alike or other:  # of another network: the caller says so
        return before
    columns = own.clone()
    columns[:, :features] = before[:, :features]
    for k, name in enumerate(config.actions):
        if name in given.actions:
            columns[:, features + k] = before[:, features + given.actions.index(name)]
    ends = features + len(given.actions), features + len(config.actions)
    columns[:, ends[1]] = before[:, ends[0]]  # the reward
    rest = before[:, ends[0] + 1:], own[:, ends[1] + 1:]
    if rest[0].shape == rest[1].shape:
        columns[:, ends[1] + 1:] = rest[0]
    return columns
