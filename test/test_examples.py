"""The examples run, on a tiny budget, and give what they say."""

import importlib.util

import pytest
import torch
from paths import ROOT

from vn_nav.policy.checkpoint import load_checkpoint

pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def one_thread():
    torch.set_num_threads(1)


def example(name):
    """The module of an example."""
    spec = importlib.util.spec_from_file_location(name, ROOT / 'examples' / f'{name}.py')
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_checkpoint_is_evaluated_from_python(capsys):
    result = example('evaluate').main(str(ROOT / 'models' / 'house'), 4)
    assert result['splits'].keys() == {'own house', 'unseen house'}
    rows = result['splits']['own house']['rows']
    assert rows['arrival'].keys() == {'right goal, sample', 'random actions'}
    assert rows['arrival']['right goal, sample']['episodes'] >= 4
    assert capsys.readouterr().out.count('success') == 4


def test_a_policy_is_trained_from_python(tmp_path):
    info = load_checkpoint(example('train').main(str(tmp_path / 'run'), 0.02)).info
    assert info['frames'] > 0 and info['scenes'] == ['house:7?rooms=1'] and info['preset'] == ''
