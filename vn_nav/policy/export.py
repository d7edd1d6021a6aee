"""A checkpoint as ONNX, for robots without PyTorch: `policy.onnx`, and `goal.onnx` beside it.

`goal.onnx` runs once for each goal: `picture` uint8 [1,3,S,S] -> `goal`. A policy that looks at no
goal has none. `policy.onnx` is one decision of one robot. It has those of these inputs and outputs
that its network uses:

| input | | |
|---|---|---|
| `image` | uint8 [1,3,S,S] | the picture, RGB, as `vn_nav.observation.preprocess` makes it |
| `goal` | float32 | what `goal.onnx` said |
| `last_action` | int64 [1] | -1 at an episode's start |
| `last_reward` | float32 [1] | of the task; a robot gets none: 0 |
| `start` | bool [1] | an episode begins: what is remembered does not count |
| `hidden`, `cell` | | the memory: zeros at first, then `next_hidden` and `next_cell` |
| `scene` | int64 [1] | number of the scene, of a network with layers for several (`icra2017`) |

| output | | |
|---|---|---|
| `logits` | float32 [1,A] | unnormalised log-probabilities of the actions |
| `value` | float32 [1] | of the state |
| `arrival` | float32 [1] | logit: the robot stands where the goal was taken |
| `next_hidden`, `next_cell` | | the memory, to pass next time |

What is kept in mind of the spot (`vn_nav.policy.spot`) is not in the files: with a policy that
knows its moves add it to the logits.

The metadata of both files are strings: `action_names` (JSON, in the order of the logits), `size`
(S), `camera_fov_deg`, `camera_height` [m], `decoding` (sample or greedy), `stop_threshold`
(probability of arrival; empty: none), `world_version`, `task`, `sha256` of the checkpoint's
weights, `opset`, and `inputs` and `outputs` (JSON: name to type and shape).
"""

from __future__ import annotations

import io
import json
import warnings
from pathlib import Path

import torch
from torch import Tensor, nn

from vn_nav.errors import UserError
from vn_nav.files import write_file
from vn_nav.observation import Observation
from vn_nav.policy.checkpoint import LoadedCheckpoint
from vn_nav.policy.memory import RecurrentState
from vn_nav.policy.network import Policy

POLICY, GOAL = 'policy.onnx', 'goal.onnx'
OPSET = 17


def export_onnx(checkpoint: LoadedCheckpoint, folder: str | Path) -> list[Path]:
    """Write a checkpoint as ONNX.

    Args:
        checkpoint: what to export.
        folder: where; made if need be. Files of an earlier export are replaced.

    Returns:
        The files: `policy.onnx`, and `goal.onnx` if the policy looks at goals.

    Raises:
        UserError: the package onnx is not installed, or the folder cannot be written.
    """
    step, folder = _Step(checkpoint.network), Path(folder)
    models: dict[str, tuple[nn.Module, dict[str, Tensor], list[str]]] = {
        POLICY: (step, step.example, step.output_names)}
    if 'goal' in step.example:
        models[GOAL] = (_Goal(checkpoint.network), {'picture': step.example['image']}, ['goal'])
    files = {name: _export(*model, checkpoint) for name, model in models.items()}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / GOAL).unlink(missing_ok=True)  # of another policy, which looked at goals
        for name, data in files.items():
            write_file(folder / name, data)
    except OSError as error:
        raise UserError('an export is written to a folder',
                        f'{error.filename or folder}: {error.strerror}',
                        'choose a folder that may be written') from error
    return [folder / name for name in files]


class _Goal(nn.Module):
    """What a policy keeps of a goal picture."""

    def __init__(self, network: Policy):
        super().__init__()
        self.network = network

    def forward(self, picture: Tensor) -> Tensor:
        return self.network.encode_goals(picture)


class _Step(nn.Module):
    """One decision of one robot, in tensors alone.

    Attributes:
        example: inputs by name, those of an episode's start.
        output_names: in the order of what `forward` returns.
    """

    def __init__(self, network: Policy):
        super().__init__()
        self.network, config = network, network.config
        self.example = {'image': torch.zeros(1, 3, config.size, config.size, dtype=torch.uint8)}
        goal = network.encode_goals(self.example['image'])
        if goal.numel():
            self.example['goal'] = goal
        if not network.frozen:
            self.example |= {'last_action': torch.tensor([-1]), 'last_reward': torch.zeros(1)}
        memory = network.initial_state(1)
        self.memory = [name for name in ('hidden', 'cell') if getattr(memory, name).numel()
                       and (not network.frozen or config.frames > 1)]
        if self.memory:
            self.example['start'] = torch.tensor([True])
            self.example |= {name: getattr(memory, name) for name in self.memory}
        if config.scenes > 1:
            self.example['scene'] = torch.tensor([0])
        self.output_names = ['logits', 'value',
                             *(['arrival'] if 'arrival' in network.heads else []),
                             *(f'next_{name}' for name in self.memory)]
        self.unused = {'last_action': torch.tensor([-1]), 'last_reward': torch.zeros(1),
                       'start': torch.tensor([True]), 'goal': goal, **memory._asdict()}

    def forward(self, *values: Tensor) -> tuple[Tensor, ...]:
        given = self.unused | dict(zip(self.example, values, strict=True))
        extras = {'scene': given['scene'].view(1, 1)} if 'scene' in given else None
        seen = Observation(given['image'].unsqueeze(0), None, None,
                           given['last_action'].view(1, 1), given['last_reward'].view(1, 1),
                           extras)
        output, state = self.network(seen, given['start'].view(1, 1),
                                     RecurrentState(given['hidden'], given['cell']),
                                     given['goal'])
        said = [part[0] for part in output if part is not None]
        return *said, *(getattr(state, name) for name in self.memory)


def _export(module: nn.Module, example: dict[str, Tensor], outputs: list[str],
            checkpoint: LoadedCheckpoint) -> bytes:
    try:
        import onnx
    except ImportError as error:
        raise UserError('an export needs the package onnx', str(error),
                        'pip install "vn_nav[onnx]"') from error
    buffer = io.BytesIO()
    with warnings.catch_warnings(), torch.no_grad():
        # Tracing knows shapes as numbers, and says so; they are fixed here. And torch recommends
        # its newer exporter, which needs more packages.
        warnings.simplefilter('ignore', torch.jit.TracerWarning)
        warnings.simplefilter('ignore', DeprecationWarning)
        # torch's annotations know only the new exporter, which takes no open file.
        torch.onnx.export(module.eval(), tuple(example.values()),
                          buffer, dynamo=False,  # type: ignore[arg-type]
                          opset_version=OPSET, input_names=list(example), output_names=outputs)
    model = onnx.load_from_string(buffer.getvalue())
    info, config = checkpoint.info, checkpoint.config
    facts = {
        'action_names': json.dumps(config.actions), 'size': config.size, 'opset': OPSET,
        **{name: info[name] for name in ('camera_fov_deg', 'camera_height', 'decoding',
                                         'world_version', 'task', 'sha256')},
        'stop_threshold': '' if info['stop_threshold'] is None else info['stop_threshold'],
        'inputs': _signature(model.graph.input), 'outputs': _signature(model.graph.output),
    }
    onnx.helper.set_model_props(model, {name: str(value) for name, value in facts.items()})
    onnx.checker.check_model(model, full_check=True)
    return model.SerializeToString()


def _signature(values) -> str:
    """JSON: name to type and shape."""
    import onnx
    return json.dumps({value.name: [
        onnx.TensorProto.DataType.Name(value.type.tensor_type.elem_type).lower(),
        [part.dim_value for part in value.type.tensor_type.shape.dim]] for value in values})
