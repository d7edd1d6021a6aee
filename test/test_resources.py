"""Shipped files are found beside the code, in a source tree and in an installation."""

import os
import shutil
import subprocess
import sys

import pytest
from paths import ROOT

from vn_nav.errors import UserError
from vn_nav.resources import share_file

ASK = ('from vn_nav.resources import share_file; '
       'print(share_file("config/robots/standard.yaml").read_text())')


def test_source_tree():
    assert share_file('config/robots/standard.yaml') == ROOT / 'config/robots/standard.yaml'
    assert share_file('config').is_dir()


def test_missing_file_says_what_is_wrong():
    with pytest.raises(UserError, match=r"'models/nobody'.*install the package again"):
        share_file('models/nobody')


@pytest.fixture
def installed(tmp_path):
    """A prefix with the code and no package.xml beside it, as pip and colcon make them."""
    code = tmp_path / 'prefix' / 'lib' / 'python3' / 'site-packages' / 'vn_nav'
    code.mkdir(parents=True)
    for name in ('__init__.py', 'errors.py', 'resources.py'):
        shutil.copy(ROOT / 'vn_nav' / name, code)
    return code.parent


def place(prefix, text):
    path = prefix / 'share' / 'vn_nav' / 'config' / 'robots' / 'standard.yaml'
    path.parent.mkdir(parents=True)
    path.write_text(text)


def ask(packages, ament_prefix_path=''):
    environment = {**os.environ, 'PYTHONPATH': str(packages),
                   'AMENT_PREFIX_PATH': ament_prefix_path}
    return subprocess.run([sys.executable, '-c', ASK], cwd=packages, env=environment,
                          capture_output=True, text=True, timeout=60)


def test_its_own_prefix_comes_first(installed, tmp_path):
    place(tmp_path / 'prefix', 'own')
    place(tmp_path / 'other', 'other')
    assert ask(installed, str(tmp_path / 'other')).stdout == 'own\n'


def test_the_ament_index_comes_last(installed, tmp_path):
    place(tmp_path / 'first', 'first')
    place(tmp_path / 'second', 'second')
    path = os.pathsep.join(str(tmp_path / name) for name in ('empty', 'first', 'second'))
    assert ask(installed, path).stdout == 'first\n'


def test_nowhere(installed):
    result = ask(installed)
    assert result.returncode != 0 and 'config/robots/standard.yaml' in result.stderr
