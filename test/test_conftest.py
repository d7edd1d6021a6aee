"""A skip that nobody planned fails the session, whichever way it comes about."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

CONFTEST = Path(__file__).with_name('conftest.py')


def run_pytest(tmp_path, *sources, options=()):
    """What a session says of one module for each source, all of them in one folder."""
    (tmp_path / 'conftest.py').write_text(CONFTEST.read_text())
    for number, source in enumerate(sources):
        (tmp_path / f'test_inner_{number}.py').write_text(f'import pytest\n\n\n{source}\n')
    return subprocess.run(
        [sys.executable, '-m', 'pytest', '-p', 'no:cacheprovider', *options,
         str(tmp_path)],
        cwd=tmp_path, capture_output=True, text=True, timeout=60,
        env={name: value for name, value in os.environ.items()
             if not name.startswith('PYTEST_')})


def test_an_unexpected_skip_fails(tmp_path):
    sources = [
        'def test_inner():\n    pytest.skip("no reason")',
        '@pytest.mark.skip(reason="later")\ndef test_inner():\n    pass',
        '@pytest.mark.skipif(True, reason="not here")\ndef test_inner():\n    pass',
        '@pytest.fixture\ndef thing():\n    pytest.skip("in a fixture")\n\n\n'
        'def test_inner(thing):\n    pass']
    result = run_pytest(tmp_path, *sources)
    assert result.returncode != 0, result.stdout
    assert ' 1 failed, 3 errors' in result.stdout and 'passed' not in result.stdout
    for number in range(len(sources)):
        assert re.search(rf'(FAILED|ERROR) test_inner_{number}.py.*unexpected skip',
                         result.stdout), (number, result.stdout)


def test_an_unexpected_skip_of_a_module_fails(tmp_path):
    result = run_pytest(
        tmp_path,
        'pytest.importorskip("a_module_that_nobody_has")\n\n\ndef test_inner():\n    pass')
    assert result.returncode != 0, result.stdout
    assert 'unexpected skip' in result.stdout


def test_the_rest_passes(tmp_path):
    result = run_pytest(tmp_path, *(
        'def test_inner():\n    pytest.skip("expected: no GPU")',
        'def test_inner():\n    pytest.xfail("known")',
        'def test_inner():\n    pass'))
    assert result.returncode == 0, result.stdout
    assert 'unexpected skip' not in result.stdout
    assert '1 passed, 1 skipped, 1 xfailed' in result.stdout


def test_sessions_side_by_side_take_different_domains(tmp_path):
    inner = 'import os\n\n\ndef test_inner():\n    assert os.environ["ROS_DOMAIN_ID"] != "{}"'
    result = run_pytest(tmp_path, inner.format(os.environ['ROS_DOMAIN_ID']))
    assert result.returncode == 0, result.stdout


@pytest.mark.slow
def test_colcon_runs_the_fast_tests_unless_it_is_told_otherwise(tmp_path):
    source = ('@pytest.mark.slow\ndef test_slow():\n    pass\n\n\n'
              'def test_fast():\n    pass')
    colcon = ('--junit-prefix=vn_nav', f'--junit-xml={tmp_path / "pytest.xml"}')
    assert '2 passed' in run_pytest(tmp_path, source).stdout
    assert '1 passed, 1 deselected' in run_pytest(tmp_path, source, options=colcon).stdout
    result = run_pytest(tmp_path, source, options=(*colcon, '-m', 'slow or not slow'))
    assert '2 passed' in result.stdout, result.stdout


@pytest.mark.slow
def test_plug_ins_of_an_installed_ros_stay_outside(tmp_path):
    """As pytest finds them where launch_testing_ros is installed: by their entry points."""
    names = {'launch_ros': 'launch_testing_ros_pytest_entrypoint',
             'launch_testing': 'launch_testing_hooks', 'launch_pytest': 'launch_pytest_plugin'}
    for name, module in names.items():
        (tmp_path / f'{module}.py').write_text(
            'def pytest_launch_of_another_pytest():\n    pass\n')
        folder = tmp_path / f'{module}-1.0.dist-info'
        folder.mkdir()
        (folder / 'METADATA').write_text(
            f'Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n')
        (folder / 'entry_points.txt').write_text(f'[pytest11]\n{name} = {module}\n')
    words = [sys.executable, '-m', 'pytest', '-p', 'no:cacheprovider', '--collect-only', '-q']
    environment = {name: value for name, value in os.environ.items()
                   if not name.startswith('PYTEST_')} | {'PYTHONPATH': str(tmp_path)}
    here = subprocess.run([*words, str(CONFTEST.parent / 'nodes' / 'test_robots.py')], text=True,
                          cwd=CONFTEST.parent.parent, capture_output=True, timeout=60,
                          env=environment)
    assert here.returncode == 0, here.stdout + here.stderr
    (tmp_path / 'test_inner.py').write_text('def test_inner():\n    pass\n')
    elsewhere = subprocess.run([*words, '-c', '/dev/null', str(tmp_path / 'test_inner.py')],
                               text=True, capture_output=True, timeout=60, env=environment)
    assert elsewhere.returncode != 0, 'they would break a session that does not block them'
