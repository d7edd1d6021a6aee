"""Frozen encoders: ResNet-50 against its layers by hand, and files of weights."""


import pytest
import safetensors.torch
import torch
from torch.nn import functional as F

from vn_nav.errors import UserError
from vn_nav.policy.resnet import ResNet50, load_frozen_weights
from vn_nav.policy.zhu import RandomFeatures

STAGES = ((1, 3, 1), (2, 4, 2), (3, 6, 2), (4, 3, 2))  # of ResNet-50: number, blocks, stride


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)
    torch.manual_seed(0)


@pytest.fixture(scope='module')
def resnet():
    """ResNet-50 with random weights and statistics, so that no layer is the identity."""
    generator = torch.Generator().manual_seed(1)
    network = ResNet50()
    for name, tensor in network.state_dict().items():
        if 'bn' in name or 'downsample.1' in name:
            if name.endswith(('weight', 'running_var')):
                tensor.uniform_(0.5, 1.5, generator=generator)
            else:
                tensor.normal_(0, 0.2, generator=generator)
    return network.requires_grad_(False)


def torchvision_file(resnet):
    """What torchvision's `resnet50-*.pth` holds."""
    state = dict(resnet.state_dict())
    for name in [name for name in state if name.endswith('running_var')]:
        state[name.replace('running_var', 'num_batches_tracked')] = torch.tensor(1_000_000)
    return state | {'fc.weight': torch.zeros(1000, 2048), 'fc.bias': torch.zeros(1000)}


def test_resnet_has_the_published_parameters(resnet):
    count = sum(part.numel() for part in resnet.parameters())
    assert count == 23_508_032 and count + 2048 * 1000 + 1000 == 25_557_032
    state = {name: tuple(tensor.shape) for name, tensor in resnet.state_dict().items()}
    assert len(state) == 53 + 53 * 4  # convolutions, and their normalisations
    for name, shape in (('conv1.weight', (64, 3, 7, 7)), ('bn1.running_var', (64,)),
                        ('layer1.0.downsample.0.weight', (256, 64, 1, 1)),
                        ('layer2.0.conv2.weight', (128, 128, 3, 3)),
                        ('layer3.5.bn3.running_mean', (1024,)),
                        ('layer4.0.downsample.1.bias', (2048,)),
                        ('layer4.2.conv3.weight', (2048, 512, 1, 1))):
        assert state[name] == shape


def test_resnet_equals_its_layers_by_hand(resnet):
    state = resnet.state_dict()
    pictures = torch.randint(0, 256, (2, 3, 84, 84), dtype=torch.uint8)

    def normed(x, name):
        mean, var, weight, bias = (state[f'{name}.{part}'].view(-1, 1, 1) for part in (
            'running_mean', 'running_var', 'weight', 'bias'))
        return (x - mean) / torch.sqrt(var + 1e-5) * weight + bias

    x = F.interpolate(pictures / 255, size=224, mode='bilinear')
    for channel, (mean, std) in enumerate(((0.485, 0.229), (0.456, 0.224), (0.406, 0.225))):
        x[:, channel] = (x[:, channel] - mean) / std
    x = normed(F.conv2d(x, state['conv1.weight'], stride=2, padding=3), 'bn1').relu()
    x = F.max_pool2d(x, 3, 2, 1)
    for stage, blocks, stride in STAGES:
        for block in range(blocks):
            at, step = f'layer{stage}.{block}', stride if block == 0 else 1
            y = normed(F.conv2d(x, state[f'{at}.conv1.weight']), f'{at}.bn1').relu()
            y = F.conv2d(y, state[f'{at}.conv2.weight'], stride=step, padding=1)
            y = F.conv2d(normed(y, f'{at}.bn2').relu(), state[f'{at}.conv3.weight'])
            if block == 0:
                x = normed(F.conv2d(x, state[f'{at}.downsample.0.weight'], stride=step),
                           f'{at}.downsample.1')
            x = (x + normed(y, f'{at}.bn3')).relu()
    assert x.shape == (2, 2048, 7, 7)
    found, wanted = resnet(pictures), x.flatten(2).mean(2)
    assert torch.allclose(found, wanted, rtol=1e-3, atol=1e-4 * float(wanted.abs().max()))
    assert torch.equal(resnet.train()(pictures), found), 'statistics stay when others train'


def test_weights_from_torchvisions_file(resnet, tmp_path):
    torch.save(torchvision_file(resnet), tmp_path / 'resnet50.pth')
    loaded = ResNet50()
    load_frozen_weights(loaded, tmp_path / 'resnet50.pth')
    for name, tensor in resnet.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], tensor), name


def test_weights_from_safetensors(tmp_path):
    given = {name: torch.rand_like(part) for name, part in RandomFeatures().state_dict().items()}
    safetensors.torch.save_file(given, tmp_path / 'weights.safetensors')
    loaded = RandomFeatures()
    load_frozen_weights(loaded, tmp_path / 'weights.safetensors')
    for name, tensor in given.items():
        assert torch.equal(loaded.state_dict()[name], tensor), name


@pytest.mark.parametrize('change, words', [
    (lambda s: {name: part for name, part in s.items() if name != 'conv2.bias'}, 'conv2.bias'),
    (lambda s: s | {'conv4.weight': torch.zeros(1)}, 'conv4.weight is absent'),
    (lambda s: s | {'conv1.weight': torch.zeros(32, 3, 3, 3)}, r'\(32, 3, 3, 3\)'),
    (lambda s: s | {'conv1.bias': torch.full((32,), float('nan'))}, 'finite'),
    (lambda s: {'model': s}, 'tensors by name'),
], ids=['missing', 'unknown', 'shape', 'nan', 'nested'])
def test_other_weights_are_refused(tmp_path, change, words):
    torch.save(change(dict(RandomFeatures().state_dict())), tmp_path / 'weights.pth')
    with pytest.raises(UserError, match=words):
        load_frozen_weights(RandomFeatures(), tmp_path / 'weights.pth')


@pytest.mark.parametrize('name', ['weights.pth', 'weights.safetensors'])
def test_what_is_no_file_of_weights_is_refused(tmp_path, name):
    with pytest.raises(UserError, match='are in a file'):
        load_frozen_weights(RandomFeatures(), tmp_path / name)
    for data in (b'', b'not weights at all'):
        (tmp_path / name).write_bytes(data)
        with pytest.raises(UserError, match='state dict'):
            load_frozen_weights(RandomFeatures(), tmp_path / name)


def test_code_in_a_file_of_weights_does_not_run(tmp_path):
    class Harmful:
        def __reduce__(self):
            return (tmp_path / 'ran').touch, ()
    torch.save({'conv1.weight': Harmful()}, tmp_path / 'weights.pth')
    with pytest.raises(UserError, match='state dict'):
        load_frozen_weights(RandomFeatures(), tmp_path / 'weights.pth')
    assert not (tmp_path / 'ran').exists()


def test_the_small_encoder_is_the_same_every_time():
    pictures = torch.randint(0, 256, (2, 3, 84, 84), dtype=torch.uint8)
    first = RandomFeatures()(pictures)
    torch.manual_seed(1)
    assert first.shape == (2, RandomFeatures.features) == (2, 256)
    assert torch.equal(RandomFeatures()(pictures), first)
    assert (first[0] - first[1]).abs().max() > 0.1
