"""ResNet-50 as a frozen encoder, and how its weights get in.

Parameters and buffers have torchvision's names, so that its `resnet50-*.pth`, or the same tensors
as safetensors, load as they are. The user brings the file; nothing is downloaded.
"""

from __future__ import annotations

import pickle
from pathlib import Path

import safetensors
import safetensors.torch
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from vn_nav.errors import UserError

SIDE_PX = 224  # pixels that the published weights were trained for
# ImageNet's mean and deviation of red, green and blue, as shares of white.
MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
# Names in torchvision's files that a frozen encoder has no use for.
UNUSED = ('fc.weight', 'fc.bias')


class FixedNorm(nn.Module):
    """Batch normalisation by stored statistics, whether the network trains or not."""

    running_mean: Tensor
    running_var: Tensor

    def __init__(self, channels: int):
        super().__init__()
        self.weight = nn.Parameter(torch.ones(channels))
        self.bias = nn.Parameter(torch.zeros(channels))
        self.register_buffer('running_mean', torch.zeros(channels))
        self.register_buffer('running_var', torch.ones(channels))

    def forward(self, x: Tensor) -> Tensor:
        """[N,C,h,w] -> the same shape."""
        return F.batch_norm(x, self.running_mean, self.running_var, self.weight, self.bias)


class Bottleneck(nn.Module):
    """x -> relu(x + norm(1x1(3x3(1x1(x))))) (He et al. 2016, figure 5, right).

    The stride is that of the 3x3 convolution ("v1.5"): the published weights expect it there.
    """

    def __init__(self, channels: int, width: int, stride: int):
        super().__init__()
        self.conv1 = nn.Conv2d(channels, width, 1, bias=False)
        self.bn1 = FixedNorm(width)
        self.conv2 = nn.Conv2d(width, width, 3, stride, padding=1, bias=False)
        self.bn2 = FixedNorm(width)
        self.conv3 = nn.Conv2d(width, 4 * width, 1, bias=False)
        self.bn3 = FixedNorm(4 * width)
        self.downsample = None
        if stride > 1 or channels != 4 * width:
            self.downsample = nn.Sequential(
                nn.Conv2d(channels, 4 * width, 1, stride, bias=False), FixedNorm(4 * width))

    def forward(self, x: Tensor) -> Tensor:
        """[N,C,h,w] -> [N,4*width,h/stride,w/stride]."""
        short = x if self.downsample is None else self.downsample(x)
        x = F.relu(self.bn1(self.conv1(x)))
        x = F.relu(self.bn2(self.conv2(x)))
        return F.relu(short + self.bn3(self.conv3(x)))


class ResNet50(nn.Module):
    """He et al. 2016 (table 1), without the classifier: pictures to 2048 features.

    Attributes:
        features: how many.
    """

    features = 2048
    layer1: nn.Sequential
    layer2: nn.Sequential
    layer3: nn.Sequential
    layer4: nn.Sequential
    mean: Tensor
    std: Tensor

    def __init__(self):
        super().__init__()
        self.conv1 = nn.Conv2d(3, 64, 7, 2, padding=3, bias=False)
        self.bn1 = FixedNorm(64)
        channels = 64
        for number, (blocks, width) in enumerate(((3, 64), (4, 128), (6, 256), (3, 512)), 1):
            stage = []
            for block in range(blocks):
                stage.append(Bottleneck(channels, width, 2 if number > 1 and block == 0 else 1))
                channels = 4 * width
            setattr(self, f'layer{number}', nn.Sequential(*stage))
        self.register_buffer('mean', torch.tensor(MEAN).view(3, 1, 1), persistent=False)
        self.register_buffer('std', torch.tensor(STD).view(3, 1, 1), persistent=False)

    def forward(self, pictures: Tensor) -> Tensor:
        """[N,3,S,S] uint8, resized to 224 pixels a side -> means of the maps [N,2048]."""
        x = pictures.float() / 255
        if x.shape[-1] != SIDE_PX:
            x = F.interpolate(x, (SIDE_PX, SIDE_PX), mode='bilinear', align_corners=False)
        x = F.relu(self.bn1(self.conv1((x - self.mean) / self.std)))
        x = F.max_pool2d(x, 3, 2, padding=1)
        for stage in (self.layer1, self.layer2, self.layer3, self.layer4):
            x = stage(x)
        return x.mean(dim=(2, 3))


def load_frozen_weights(encoder: nn.Module, path: str | Path) -> None:
    """Weights of a frozen encoder from a file: safetensors, or what `torch.save` wrote.

    All of the encoder's tensors have to be there, and nothing else but the classifier and the
    counters that torch keeps with batch statistics.

    Raises:
        UserError: no such file, another kind of file, other tensors, or numbers not finite.
    """
    path = Path(path)
    if not path.is_file():
        raise UserError('frozen weights are in a file', str(path), 'name the file that has them')
    try:
        if path.suffix == '.safetensors':
            given = safetensors.torch.load_file(path)
        else:
            given = torch.load(path, map_location='cpu', weights_only=True)
    except (safetensors.SafetensorError, pickle.UnpicklingError, RuntimeError, EOFError,
            ValueError, KeyError) as error:
        reason = str(error).partition('\n')[0] or type(error).__name__
        raise UserError('frozen weights are a state dict, as safetensors or as torch.save writes '
                        'it', f'{path}: {reason}', 'get the file again') from error
    if not isinstance(given, dict) or not all(isinstance(t, Tensor) for t in given.values()):
        raise UserError('frozen weights are a state dict: tensors by name',
                        f'{type(given).__name__} in {path}', 'save model.state_dict() alone')
    given = {name: tensor for name, tensor in given.items()
             if name not in UNUSED and not name.endswith('.num_batches_tracked')}
    own = encoder.state_dict()
    for name in sorted(own.keys() | given.keys()):
        wanted, found = (tuple(part[name].shape) if name in part else None
                         for part in (own, given))
        if wanted != found:
            raise UserError(f'the file fits the frozen encoder: {name} is {wanted or "absent"}',
                            f'{found or "absent"} in {path}',
                            'use the weights of this very network')
        if not torch.isfinite(given[name]).all():
            raise UserError('frozen weights are finite numbers', f'{name} in {path}',
                            'get the file again')
    encoder.load_state_dict(given)
