"""A checkpoint as ONNX, for robots without PyTorch. policy_node takes the folder as `checkpoint`.

The folder holds the checkpoint's `config.json`, its taught place where it has one, and models. A
policy that searches has three, which see; its planner decides, with NumPy and Numba. N is free:

| | inputs | outputs, float32 |
|---|---|---|
| `goal.onnx` | `picture` uint8 [N,3,S,S] | `goal` [N,K]: what is kept of a goal |
| `see.onnx` | the same | `features` [N,2,C,h,w], `places` [N,P,C], `ranges` [N,32,24] |
| `compare.onnx` | `features`, `goal` | the fields of `vn_nav.policy.search.look.Recognition` |

Of another policy there are `policy.onnx`, and `goal.onnx` with it.

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

The metadata of all files are strings: `action_names` (JSON, in the order of the logits), `size`
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
from typing import NamedTuple

import torch
from torch import Tensor, nn

from vn_nav.errors import UserError
from vn_nav.files import write_file
from vn_nav.observation import Observation
from vn_nav.policy.action_filter import NONE
from vn_nav.policy.checkpoint import LoadedCheckpoint, config_file, taught_bytes
from vn_nav.policy.checkpoint_info import COMPARE, CONFIG, GOAL, ONNX_FILES, PLACE, POLICY, SEE
from vn_nav.policy.memory import RecurrentState
from vn_nav.policy.network import Policy
from vn_nav.policy.search.look import Recognition
from vn_nav.policy.search.network import SearchPolicy
from vn_nav.policy.search.torch_eyes import seen_by

README = 'README.md'
OPSET = 17


def export_onnx(checkpoint: LoadedCheckpoint, folder: str | Path) -> list[Path]:
    """Write a checkpoint as ONNX.

    Args:
        checkpoint: what to export.
        folder: where; made if need be. Files of an earlier export are replaced.

    Returns:
        The models, see above. `README.md` says how they are used.

    Raises:
        UserError: the package onnx is not installed, or the folder cannot be written.
    """
    folder, network = Path(folder), checkpoint.network
    if isinstance(network, SearchPolicy):
        models, about = _eyes(network), _SEARCH_README.format(**checkpoint.info)
    else:
        step = _Step(network)
        models = {POLICY: _Graph(step, step.example, step.output_names)}
        if 'goal' in step.example:
            models[GOAL] = _Graph(_Goal(network), {'picture': step.example['image']}, ['goal'])
        about = _readme(step, checkpoint)
    files = {name: _export(model, checkpoint) for name, model in models.items()}
    place = taught_bytes(network)
    info = {name: value for name, value in checkpoint.info.items() if name != 'sha256'}
    _, config = config_file(network, info, checkpoint.info['sha256'], place)
    others = {README: about.encode(), CONFIG: config.encode()}
    if place is not None:
        others[PLACE] = place
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name in (*ONNX_FILES, PLACE):
            (folder / name).unlink(missing_ok=True)  # of another policy
        for name, data in (files | others).items():
            write_file(folder / name, data)
    except OSError as error:
        raise UserError('an export is written to a folder',
                        f'{error.filename or folder}: {error.strerror}',
                        'choose a folder that may be written') from error
    return [folder / name for name in files]


class _Graph(NamedTuple):
    """A model to write."""

    module: nn.Module
    example: dict[str, Tensor]  # inputs by name
    outputs: list[str]
    free: bool = False  # the number of pictures


class _Goal(nn.Module):
    """What a policy keeps of goal pictures."""

    def __init__(self, network: Policy):
        super().__init__()
        self.network = network

    def forward(self, picture: Tensor) -> Tensor:
        return self.network.encode_goals(picture)


class _See(nn.Module):
    """What it sees in pictures alone."""

    def __init__(self, network: SearchPolicy):
        super().__init__()
        self.network = network

    def forward(self, picture: Tensor) -> tuple[Tensor, ...]:
        return *seen_by(self.network, picture), self.network.see_ranges(picture)


class _Compare(nn.Module):
    """Where goals stand from pictures."""

    def __init__(self, network: SearchPolicy):
        super().__init__()
        self.network = network

    def forward(self, features: Tensor, goal: Tensor) -> tuple[Tensor, ...]:
        return tuple(self.network.compare(features, goal))


def _eyes(network: SearchPolicy) -> dict[str, _Graph]:
    """The models of a policy that searches."""
    side = network.config.size
    pictures = torch.zeros(2, 3, side, side, dtype=torch.uint8)
    with torch.no_grad():
        pair = {'features': network.see(pictures), 'goal': network.encode_goals(pictures)}
    return {GOAL: _Graph(_Goal(network), {'picture': pictures}, ['goal'], True),
            SEE: _Graph(_See(network), {'picture': pictures}, ['features', 'places', 'ranges'],
                        True),
            COMPARE: _Graph(_Compare(network), pair, list(Recognition._fields), True)}


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


def _export(graph: _Graph, checkpoint: LoadedCheckpoint) -> bytes:
    try:
        import onnx
    except ImportError as error:
        raise UserError('an export needs the package onnx', str(error),
                        'pip install "vn_nav[onnx]"') from error
    buffer, names = io.BytesIO(), [*graph.example, *graph.outputs]
    with warnings.catch_warnings(), torch.no_grad():
        # Tracing knows shapes as numbers, and says so; they are fixed here. And torch recommends
        # its newer exporter, which needs more packages.
        warnings.simplefilter('ignore', torch.jit.TracerWarning)
        warnings.simplefilter('ignore', DeprecationWarning)
        # The pictures' mirror images.
        warnings.filterwarnings('ignore', 'Constant folding', UserWarning)
        # torch's annotations know only the new exporter, which takes no open file.
        torch.onnx.export(graph.module.eval(), tuple(graph.example.values()),
                          buffer, dynamo=False,  # type: ignore[arg-type]
                          opset_version=OPSET, input_names=list(graph.example),
                          output_names=graph.outputs,
                          dynamic_axes={name: {0: 'N'} for name in names} if graph.free else None)
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
        [part.dim_value or part.dim_param for part in value.type.tensor_type.shape.dim]]
        for value in values})


_SEARCH_README = """# A visual navigation policy as ONNX

Exported by vn_nav from weights with SHA-256 `{sha256}`. It searches: `see.onnx`, `goal.onnx` and
`compare.onnx` see, a planner of vn_nav decides. `vn_nav.policy.export` says what they take and
give, `config.json` what pictures and actions are.

```python
from vn_nav.policy.runtime import PolicyRuntime  # NumPy, OpenCV, Numba, ONNX Runtime

policy = PolicyRuntime('.')
policy.set_goal(goal)  # uint8 [3,S,S] RGB, as policy.prepare makes it
action = policy.action_names[policy.act(picture, odometry)]
```

On a robot: `ros2 run vn_nav policy_node --ros-args -p checkpoint:=THIS_FOLDER`.
"""


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
