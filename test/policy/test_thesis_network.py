"""The networks of the thesis and of UNREAL: layers, sizes, first weights, plain computation."""

import math

import pytest
import torch
from random_batch import batch, thesis
from torch.nn import functional as F

from vn_nav.learning.presets import preset
from vn_nav.policy.network import Policy
from vn_nav.robot import DRIVE_ACTIONS

# The layers of thesis-facts.md, section 1: kind, maps in, maps out, kernel, stride, side of the
# maps that come out. Four actions; parameters are counted by hand.
LAYERS = {
    84: {
        'encoder.first.conv': ('conv', 3, 16, 8, 4, 20),
        'encoder.fuse': ('conv', 32, 32, 4, 2, 9),
        'encoder.mix': ('conv', 32, 32, 1, 1, 9),
        'encoder.trunk': ('linear', 2592, 512),
        'actor': ('linear', 512, 4),
        'critic': ('linear', 512, 1),
        'heads.pixel_control.expand': ('linear', 512, 2592),
        'heads.pixel_control.value': ('deconv', 32, 1, 4, 2, 20),
        'heads.pixel_control.advantage': ('deconv', 32, 4, 4, 2, 20),
        'heads.reward_prediction.classify': ('linear', 7776, 3),
        'heads.depth.grow.0': ('deconv', 32, 1, 4, 2, 20),
        'heads.segmentation.grow.0': ('deconv', 32, 3, 4, 2, 20),
        'heads.goal_segmentation.grow.0': ('deconv', 32, 3, 4, 2, 20),
    },
    174: {
        'encoder.first.conv': ('conv', 3, 32, 7, 4, 42),
        'encoder.second': ('conv', 32, 32, 4, 2, 20),
        'encoder.fuse': ('conv', 64, 64, 4, 2, 9),
        'encoder.mix': ('conv', 64, 32, 1, 1, 9),
        'encoder.trunk': ('linear', 2592, 512),
        'actor': ('linear', 512, 4),
        'critic': ('linear', 512, 1),
        'heads.pixel_control.expand': ('linear', 512, 2592),
        'heads.pixel_control.grow.0': ('deconv', 32, 32, 4, 2, 20),
        'heads.pixel_control.value': ('deconv', 32, 1, 4, 2, 42),
        'heads.pixel_control.advantage': ('deconv', 32, 4, 4, 2, 42),
        'heads.reward_prediction.classify': ('linear', 7776, 3),
        'heads.depth.grow.0': ('deconv', 32, 32, 4, 2, 20),
        'heads.depth.grow.1': ('deconv', 32, 1, 4, 2, 42),
        'heads.segmentation.grow.0': ('deconv', 32, 64, 4, 2, 20),
        'heads.segmentation.grow.1': ('deconv', 64, 3, 4, 2, 42),
        'heads.goal_segmentation.grow.0': ('deconv', 32, 64, 4, 2, 20),
        'heads.goal_segmentation.grow.1': ('deconv', 64, 3, 4, 2, 42),
    },
}
LAYERS[172] = LAYERS[174]
KINDS = {'conv': torch.nn.Conv2d, 'deconv': torch.nn.ConvTranspose2d, 'linear': torch.nn.Linear}
LSTM = 2048 * (517 + 512) + 2048  # of 512 features, 4 actions and a reward to 512 units
PARAMETERS = {
    84: sum((3088, 16416, 1056, 1327616, LSTM, 2052, 513, 1329696, 513, 2052, 23331, 513,
             2 * 1539)),
    174: sum((4736, 16416, 65600, 2080, 1327616, LSTM, 2052, 513, 1329696, 16416, 513, 2052,
              23331, 16416, 513, 2 * (32832 + 3075))),
}
PARAMETERS[172] = PARAMETERS[174]


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)
    torch.manual_seed(0)


@pytest.mark.parametrize('size', [84, 172, 174])
def test_the_thesis_network_has_the_layers_of_the_thesis(size):
    network = thesis(size)
    layers = {name: layer for name, layer in network.named_modules()
              if isinstance(layer, tuple(KINDS.values()))}
    assert set(layers) == set(LAYERS[size])
    for name, (kind, into, out, *shape) in LAYERS[size].items():
        layer = layers[name]
        assert type(layer) is KINDS[kind], name
        if kind == 'linear':
            assert (layer.in_features, layer.out_features) == (into, out), name
        else:
            kernel, stride, _ = shape
            assert (layer.in_channels, layer.out_channels) == (into, out), name
            assert layer.kernel_size == (kernel,) * 2 and layer.stride == (stride,) * 2, name
            assert layer.padding == (0, 0) and layer.dilation == (1, 1), name
    assert network.memory.input_weight.shape == (2048, 517)
    assert network.memory.recurrent_weight.shape == (2048, 512)
    assert network.memory.bias.shape == (2048,)
    assert sum(parameter.numel() for parameter in network.parameters()) == PARAMETERS[size]


def plain_thesis_base(network, image, goal):
    """Figure 4.2, layer by layer: shared streams, concatenation, trunk; also the maps' sides."""
    encoder = network.encoder
    sides = {}

    def conv(name, x):
        layer = dict(encoder.named_modules())[name]
        x = F.relu(F.conv2d(x, layer.weight, layer.bias, layer.stride))
        sides[f'encoder.{name}'] = x.shape[-1]
        assert x.shape[-1] == x.shape[-2]
        return x

    def stream(pictures):
        x = conv('first.conv', pictures.float() / 255)
        return x if encoder.second is None else conv('second', x)
    x = torch.cat([stream(image), stream(goal)], dim=1)
    maps = conv('mix', conv('fuse', x))
    return maps, F.relu(F.linear(maps.flatten(1), encoder.trunk.weight, encoder.trunk.bias)), sides


@pytest.mark.parametrize('size', [84, 172, 174])
def test_goals_encoded_once_equal_the_thesis_network(size):
    network = thesis(size)
    observation, _ = batch(1, 5, goals=3, size=size)
    image, goals = observation.image[0], observation.goals
    index = observation.goal_index[0]
    maps, features, sides = plain_thesis_base(network, image, goals[index])
    for shared in (network.encode(image, network.encode_goals(goals), index),
                   network.encode(image, network.encode_goals(goals[index]), None)):
        assert torch.allclose(shared[0], maps, atol=1e-5)
        assert torch.allclose(shared[1], features, atol=1e-5)
    assert maps.shape == (5, 32, 9, 9) and features.shape == (5, 512)
    assert sides == {name: layer[-1] for name, layer in LAYERS[size].items()
                     if layer[0] == 'conv'}


def test_the_base_of_unreal():
    network = Policy(preset('unreal', architecture='unreal', hidden=256).network(
        DRIVE_ACTIONS, 84))
    encoder = network.encoder
    shapes = {name: tuple(parameter.shape) for name, parameter in encoder.named_parameters()
              if name.endswith('weight')}
    assert shapes == {'first.conv.weight': (16, 3, 8, 8), 'conv2.weight': (32, 16, 4, 4),
                      'trunk.weight': (256, 2592)}
    assert network.memory.recurrent_weight.shape == (1024, 256)
    observation, _ = batch(1, 4, size=84)
    x = F.relu(F.conv2d(observation.image[0].float() / 255, encoder.first.conv.weight,
                        encoder.first.conv.bias, 4))
    x = F.relu(F.conv2d(x, encoder.conv2.weight, encoder.conv2.bias, 2))
    maps, features = network.encode(observation.image[0],
                                    network.encode_goals(observation.goals),
                                    observation.goal_index[0])
    assert torch.allclose(maps, x, atol=1e-5)
    assert torch.allclose(features, F.relu(encoder.trunk(x.flatten(1))), atol=1e-5)


@pytest.mark.parametrize('changes', [{}, {'stacked_frames': 4}, {'architecture': 'unreal'}])
@pytest.mark.parametrize('size', [84, 174])
def test_weights_begin_as_in_the_published_code(size, changes):
    network = thesis(size, **changes)
    layers = {name: layer for name, layer in network.named_modules()
              if isinstance(layer, tuple(KINDS.values()))}
    for name, layer in layers.items():
        maps = layer.out_channels if isinstance(layer, torch.nn.ConvTranspose2d) else (
            layer.in_features if isinstance(layer, torch.nn.Linear) else layer.in_channels)
        kernel = math.prod(getattr(layer, 'kernel_size', (1,)))
        bound = (maps * kernel) ** -0.5
        largest = float(layer.weight.detach().abs().max())
        # Of n uniform numbers the largest lies within 1 - 20 / n of the bound, all but surely.
        assert bound * (1 - 20 / layer.weight.numel()) < largest <= bound, name
        assert float(layer.weight.detach().std()) == pytest.approx(bound / 3**0.5, rel=0.1), name
        assert not layer.bias.any(), name
    if network.config.frames > 1:
        assert 'memory.linear' in layers
        return
    memory = network.memory
    bound = (6 / sum(memory.input_weight.shape)) ** 0.5
    assert 0.999 * bound < float(memory.input_weight.detach().abs().max()) <= bound
    assert float(memory.input_weight.detach().std()) == pytest.approx(bound / 3**0.5, rel=0.01)
    square = memory.recurrent_weight.T @ memory.recurrent_weight
    assert torch.allclose(square, torch.eye(len(square)), atol=1e-5)
    assert not memory.bias.any()


@pytest.mark.parametrize('name, size, deconvolutions, side', [
    ('thesis', 84, None, 20), ('thesis', 84, 2, 42), ('thesis', 172, None, 42),
    ('thesis', 174, None, 42), ('unreal', 84, None, 20)])
def test_pictures_that_heads_draw_have_the_sizes_of_the_thesis(name, size, deconvolutions, side):
    heads = {'depth': 1.0, 'segmentation': 1.0, 'goal_segmentation': 1.0}
    network = Policy(preset(name, deconvolutions=deconvolutions, **heads).network(
        DRIVE_ACTIONS, size))
    assert network.target_side == side and network.cell == size // side
    latents, _ = network.latents(*batch(2, 2, size=size))
    for head, channels in (('depth', 1), ('segmentation', 3), ('goal_segmentation', 3)):
        assert network.heads[head](latents.maps).shape == (4, channels, side, side)
    q = network.heads['pixel_control'](latents.hidden.flatten(0, 1))
    assert q.shape == (4, 4, side, side)
    assert latents.maps.shape[1:] == (32, 9, 9)
