"""A skip that nobody planned fails the session, whichever way it comes about."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

CONFTEST = Path(__file__).with_name('conftest.py')


def run_pytest(tmp_path, source):
    (tmp_path / 'conftest.py').write_text(CONFTEST.read_text())
    (tmp_path / 'test_inner.py').write_text(f'import pytest\n\n\n{source}\n')
    return subprocess.run(
        [sys.executable, '-m', 'pytest', '-p', 'no:cacheprovider', str(tmp_path)],
        cwd=tmp_path, capture_output=True, text=True, timeout=60,
        env={name: value for name, value in os.environ.items() if name != 'PYTEST_ADDOPTS'})


@pytest.mark.parametrize('source', [
    'def test_inner():\n    pytest.skip("no reason")',
    '@pytest.mark.skip(reason="later")\ndef test_inner():\n    pass',
    '@pytest.mark.skipif(True, reason="not here")\ndef test_inner():\n    pass',
    'pytest.importorskip("a_module_that_nobody_has")\n\n\ndef test_inner():\n    pass',
    '@pytest.fixture\ndef thing():\n    pytest.skip("in a fixture")\n\n\n'
    'def test_inner(thing):\n    pass',
], ids=['call', 'mark', 'condition', 'module', 'fixture'])
def test_an_unexpected_skip_fails(tmp_path, source):
    result = run_pytest(tmp_path, source)
    assert result.returncode != 0, result.stdout
    assert 'unexpected skip' in result.stdout


@pytest.mark.parametrize('source', [
    'def test_inner():\n    pytest.skip("expected: no GPU")',
    'def test_inner():\n    pytest.xfail("known")',
    'def test_inner():\n    pass',
], ids=['expected', 'xfail', 'pass'])
def test_the_rest_passes(tmp_path, source):
    result = run_pytest(tmp_path, source)
    assert result.returncode == 0, result.stdout
    assert 'unexpected skip' not in result.stdout


def test_sessions_side_by_side_take_different_domains(tmp_path):
    inner = 'import os\n\n\ndef test_inner():\n    assert os.environ["ROS_DOMAIN_ID"] != "{}"'
    result = run_pytest(tmp_path, inner.format(os.environ['ROS_DOMAIN_ID']))
    assert result.returncode == 0, result.stdout
