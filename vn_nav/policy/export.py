"""A checkpoint as ONNX, for robots without PyTorch: `policy.onnx`, and `goal.onnx` with it.

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

The action filter of a checkpoint is no part of the network, and not in `policy.onnx`. Where the
metadata name one (`action_filter`), the figures of the checkpoint were measured behind it: add
what `vn_nav.policy.action_filter.BlockedActionFilter` says, which needs NumPy alone, to the
logits, once for each decision (an example is in the exported `README.md`).

The metadata of both files are strings: `action_names` (JSON, in the order of the logits), `size`
(S), `camera_fov_deg`, `camera_height` [m], `decoding` (sample or greedy), `stop_threshold`
(probability of arrival; empty: none), `action_filter` (none or blocked_actions), `moves` (JSON:
dx, dy [m], dyaw [rad] of each action, if the policy knows them), `world_version`,
`task`, `sha256` of the checkpoint's weights, `opset`, and `inputs` and `outputs` (JSON: name to
type and shape).
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
from vn_nav.policy.action_filter import NONE
from vn_nav.policy.checkpoint import LoadedCheckpoint
from vn_nav.policy.memory import RecurrentState
from vn_nav.policy.network import Policy
from vn_nav.policy.network_config import SEARCH

POLICY, GOAL, README = 'policy.onnx', 'goal.onnx', 'README.md'
OPSET = 17


def export_onnx(checkpoint: LoadedCheckpoint, folder: str | Path) -> list[Path]:
    """Write a checkpoint as ONNX.

    Args:
        checkpoint: what to export.
        folder: where; made if need be. Files of an earlier export are replaced.

    Returns:
        The models: `policy.onnx`, and `goal.onnx` if the policy looks at goals. `README.md` says
        how they are used.

    Raises:
        UserError: a policy that is more than a network; the package onnx is not installed, or the
            folder cannot be written.
    """
    if checkpoint.config.architecture == SEARCH:
        raise UserError('an export holds whole decisions as one network',
                        'a policy of the architecture search: a planner on its map decides',
                        'run it with vn_nav, or export a policy of another preset')
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
        write_file(folder / README, _readme(step, checkpoint).encode())
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
        'action_filter': config.filter_name, 'moves': json.dumps(config.moves),
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


def _readme(step: _Step, checkpoint: LoadedCheckpoint) -> str:
    """What the folder holds, and a decision in Python that runs as it stands."""
    config, info = checkpoint.config, checkpoint.info
    about = 'none. Actions are chosen by the logits as they are.'
    code = ['import json', '', 'import numpy as np', 'import onnxruntime', '',
            f"policy = onnxruntime.InferenceSession('{POLICY}')",
            'facts = policy.get_modelmeta().custom_metadata_map',
            "actions = json.loads(facts['action_names'])",
            "types = {'tensor(float)': 'f4', 'tensor(uint8)': 'u1', 'tensor(int64)': 'i8', "
            "'tensor(bool)': '?'}",
            'inputs = {part.name: np.zeros(part.shape, types[part.type])',
            '          for part in policy.get_inputs()}']
    if 'goal' in step.example:
        code += [f"goal = onnxruntime.InferenceSession('{GOAL}')",
                 "inputs['goal'], = goal.run(None, {'picture': goal_picture})  # uint8 [1,3,S,S]"]
    logits = "said['logits']"
    if config.filter_name != NONE:
        about = (f'`{config.filter_name}`. It is no part of the network; the figures of the '
                 'checkpoint were measured behind it.\nAdd its offsets to the logits, once for '
                 'each decision, as below.')
        code.insert(4, 'from vn_nav.policy.action_filter import BlockedActionFilter  # NumPy')
        code += ["blocked = BlockedActionFilter(json.loads(facts['moves']), 1)"]
        logits += " + blocked.offsets(image, given['last_action'], given['start'])"
    code += ['', '', 'def decide(image, last_action):',
             '    """Logits [1,A] for a picture, uint8 [1,3,S,S]; last_action: -1 at a start."""',
             "    given = {'image': image, 'last_action': np.array([last_action]),",
             "             'start': np.array([last_action < 0])}",
             '    inputs.update({name: rows for name, rows in given.items() if name in inputs})',
             '    names = [part.name for part in policy.get_outputs()]',
             '    said = dict(zip(names, policy.run(None, inputs)))',
             *(f"    inputs['{name}'] = said['next_{name}']" for name in step.memory),
             f'    return {logits}']
    return '\n'.join([
        '# A visual navigation policy as ONNX', '',
        f'Exported by vn_nav from weights with SHA-256 `{info["sha256"]}`.', 'The metadata of the '
        'files say what pictures, actions, inputs and outputs are.', '',
        f'Decoding: {info["decoding"]}. Action filter: {about}', '',
        '```python', *code, '```', '',
        'An episode begins, with `last_action` -1, at a new goal and where the robot was moved.',
        ''])
