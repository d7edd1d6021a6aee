"""The network of Zhu et al., ICRA 2017: `icra2017`.

"Target-driven Visual Navigation in Indoor Scenes using Deep Reinforcement Learning", section IV-C
and figure 4. Frozen features of the last four pictures, and of the goal four times over, pass one
shared layer; both embeddings are fused by a second; the third layer, actor and critic belong to a
scene each. Nothing is recurrent, and neither the last action nor the last reward is looked at.

Shapes: N frames, G distinct goals, F frozen features of a picture, K pictures in a stack, H width.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from vn_nav.errors import UserError
from vn_nav.policy.encoders import add_goals, apply, orthogonal, uniform_by_fan_in
from vn_nav.policy.resnet import ResNet50

BATCH = 32  # pictures that pass the frozen encoder at a time: large ones need much memory


class RandomFeatures(nn.Module):
    """256 features by three convolutions with random weights, the same ones every time.

    Pictures are resized to 64 pixels a side; convolutions 3->32 8x8/4, 32->64 4x4/2, 64->64 3x3/2,
    ReLU after each: 64 maps of side 2. For tests, and where there are no weights of a ResNet.
    """

    features = 256
    SIDE, SEED = 64, 0

    def __init__(self):
        super().__init__()
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(self.SEED)
            self.conv1 = nn.Conv2d(3, 32, 8, 4)
            self.conv2 = nn.Conv2d(32, 64, 4, 2)
            self.conv3 = nn.Conv2d(64, 64, 3, 2)
            orthogonal(self)

    def forward(self, pictures: Tensor) -> Tensor:
        """[N,3,S,S] uint8 -> [N,256] float32."""
        x = (pictures.float() - 120) / 36
        if x.shape[-1] != self.SIDE:
            x = F.interpolate(x, (self.SIDE, self.SIDE), mode='bilinear', align_corners=False)
        for layer in (self.conv1, self.conv2, self.conv3):
            x = F.relu(layer(x))
        return x.flatten(1)


class GivenFeatures(nn.Module):
    """No encoder: the 2048 features of ResNet-50 come with the pictures, out of a scene's file."""

    features = ResNet50.features

    def forward(self, pictures: Tensor) -> Tensor:
        """There is nothing to compute them with.

        Raises:
            UserError: always.
        """
        raise UserError('this network takes the features that the files of its scenes hold',
                        'pictures alone', 'use it in grid scenes with resnet_feature, or train '
                        'one with --frozen-weights FILE')


class Siamese(nn.Module):
    """Frozen features, the layer that pictures and goal share, and the layer that fuses them.

    The frozen encoder computes in float32 and learns nothing; its weights are part of the network,
    and so of its checkpoint. The fusing layer's share of a goal is computed once a goal, as the
    convolutional encoders do it (`vn_nav.policy.encoders`).

    Args:
        frozen: of `FROZEN`: '' the small random one, 'resnet50', or 'given' (`GivenFeatures`).
        frames: K; width: H.
    """

    def __init__(self, frozen: str, frames: int, width: int):
        super().__init__()
        self.frames, self.features = frames, width
        self.frozen: ResNet50 | RandomFeatures | GivenFeatures = (
            ResNet50() if frozen == 'resnet50' else
            GivenFeatures() if frozen == 'given' else RandomFeatures())
        self.shared = nn.Linear(frames * self.frozen.features, width)
        self.fuse = nn.Linear(2 * width, width)
        for layer in (self.shared, self.fuse):
            uniform_by_fan_in(layer)
        self.frozen.requires_grad_(False)

    @torch.no_grad()
    def look(self, pictures: Tensor) -> Tensor:
        """Frozen features [...,F] of pictures [...,3,S,S] uint8."""
        rows = [self.frozen(part) for part in pictures.flatten(0, -4).split(BATCH)]
        return torch.cat(rows).view(*pictures.shape[:-3], -1)

    def encode_goals(self, goals: Tensor, dtype: torch.dtype) -> Tensor:
        """The goals' share of the fusing layer, [G,H], of pictures or of their features [G,F]."""
        if goals.dtype == torch.uint8:
            goals = self.look(goals)
        embedded = F.relu(apply(self.shared, goals.repeat(1, self.frames).to(dtype)))
        return F.linear(embedded, self.fuse.weight[:, self.features:].to(dtype))

    def forward(self, stack: Tensor, goal_maps: Tensor, goal_index: Tensor | None,
                dtype: torch.dtype) -> tuple[Tensor, Tensor]:
        """No maps [N,0], and features [N,H], of the last pictures' features [N,K*F]."""
        embedded = F.relu(apply(self.shared, stack.to(dtype)))
        own = F.linear(embedded, self.fuse.weight[:, :self.features].to(dtype),
                       self.fuse.bias.to(dtype))
        return own[:, :0], F.relu(add_goals(own, goal_maps, goal_index))


class SceneLinear(nn.Module):
    """A linear layer for each of C scenes."""

    def __init__(self, inputs: int, outputs: int, scenes: int):
        super().__init__()
        self.weight = nn.Parameter(torch.empty(scenes, outputs, inputs))
        self.bias = nn.Parameter(torch.zeros(scenes, outputs))
        nn.init.uniform_(self.weight, -inputs**-0.5, inputs**-0.5)

    def forward(self, x: Tensor, scene: Tensor) -> Tensor:
        """[T,B,I] in the type of x, rows of scene [T,B] int64 through its layer -> [T,B,O]."""
        rows, where = x.flatten(0, 1), scene.flatten()
        weight, bias = self.weight.to(x.dtype), self.bias.to(x.dtype)
        if len(weight) == 1:
            out = F.linear(rows, weight[0], bias[0])
        elif len(rows) == 1:  # a robot is in one scene: nothing to sort
            out = F.linear(rows, weight.index_select(0, where)[0], bias.index_select(0, where)[0])
        else:
            out = rows.new_zeros(len(rows), weight.shape[1])
            for number in torch.unique(where):
                here = torch.nonzero(where == number).squeeze(1)
                out = out.index_copy(0, here, F.linear(rows[here], weight[number], bias[number]))
        return out.view(*x.shape[:2], -1)


def check_scenes(scene: np.ndarray, scenes: int) -> np.ndarray:
    """Numbers of scenes [N] int64, each below `scenes`.

    Raises:
        UserError: a scene that the network has no layers for.
    """
    scene = np.asarray(scene, np.int64)
    unknown = scene[(scene < 0) | (scene >= scenes)]
    if len(unknown):
        raise UserError(f'the network has layers for {scenes} scenes, numbered from 0',
                        f'scene {unknown[0]}', 'use it in the scenes that it was trained in, or '
                        'train one with as many scenes')
    return scene


def scene_numbers(scenes: Sequence[str], known: Sequence[str]) -> np.ndarray:
    """Numbers [N] of scenes, by the names of those that a network was trained in.

    Raises:
        UserError: a scene that the network was not trained in.
    """
    for scene in scenes:
        if scene not in known:
            raise UserError('a network with layers for several scenes knows the scenes '
                            f'{", ".join(known)} alone', scene,
                            'evaluate it there, or train one with a single scene')
    return np.array([list(known).index(scene) for scene in scenes], np.int64)
