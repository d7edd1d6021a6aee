"""Settings of the whole test session: an unexpected skip fails, and ROS keeps to itself."""

import fcntl
import os
import shutil
import signal
import subprocess
import tempfile
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
DOMAINS = range(1, 102)  # all that leave Linux's ephemeral ports alone, less the default 0

# Set at import: rclpy reads them once, and the processes that tests start inherit them.
for name in ('FASTRTPS_DEFAULT_PROFILES_FILE', 'FASTDDS_DEFAULT_PROFILES_FILE'):
    os.environ[name] = str(ROOT / 'config' / 'fastdds_localhost.xml')
os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'SYSTEM_DEFAULT'
# Under `nohup` or `timeout` SIGHUP is ignored, also by the nodes that tests start, which then do
# not end by it. A handler is no matter of theirs.
if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN:
    signal.signal(signal.SIGHUP, lambda *_: None)


def pytest_configure(config):
    """Take a ROS domain that no other test session uses; `colcon test` runs the fast tests."""
    # It alone gives this option. Others: colcon test --pytest-args -m slow
    if config.option.junitprefix and not config.option.markexpr:
        config.option.markexpr = 'not slow'
    folder = Path(tempfile.gettempdir())
    for domain in DOMAINS:
        try:
            lock = (folder / f'vn_nav_test_domain_{domain}.lock').open('a')
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:  # taken by another session, or the file is another user's
            continue
        config.stash[_DOMAIN_LOCK] = lock  # held until this process ends
        os.environ['ROS_DOMAIN_ID'] = str(domain)
        return
    raise pytest.UsageError(f'a test session needs a ROS domain of its own; all {len(DOMAINS)} '
                            'are taken; end other test sessions')


_DOMAIN_LOCK = pytest.StashKey()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport():
    """Turn the skip of a test into a failure."""
    return _without_unexpected_skip((yield))


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report():
    """Turn the skip of a whole module into an error."""
    return _without_unexpected_skip((yield))


def _without_unexpected_skip(report):
    if not report.skipped or hasattr(report, 'wasxfail'):
        return report
    reason = report.longrepr[2] if isinstance(report.longrepr, tuple) else str(report.longrepr)
    reason = reason.removeprefix('Skipped: ')
    if not reason.startswith('expected:'):
        report.outcome = 'failed'
        report.longrepr = (f'unexpected skip: {reason}\n(a test may skip where its reason starts '
                           "with 'expected:' and names what the machine lacks)")
    return report


@pytest.fixture(autouse=True)
def _own_signals():
    """A test that ran a node's main in this process would leave its signals ignored, for all."""
    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGQUIT, signal.SIGHUP)
    before = [signal.getsignal(number) for number in numbers]
    yield
    assert [signal.getsignal(number) for number in numbers] == before, 'signal handlers changed'


@pytest.fixture
def source_copy(tmp_path):
    """A copy of the source tree as a fresh checkout has it: a build writes into its sources."""
    copy = tmp_path / 'source'
    listed = subprocess.run(
        ['git', 'ls-files', '-z', '--cached', '--others', '--exclude-standard'],
        cwd=ROOT, capture_output=True, text=True)
    if listed.returncode == 0:
        for name in filter(None, listed.stdout.split('\0')):
            if (ROOT / name).is_file():  # a tracked file may be gone
                (copy / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, copy / name)
    else:  # an unpacked archive
        shutil.copytree(ROOT, copy, ignore=shutil.ignore_patterns(
            '.venv', 'runs', 'demo', 'build', 'install', 'log', '*.egg-info', '__pycache__', '.*'))
    return copy


@pytest.fixture(autouse=True)
def nothing_said(monkeypatch):
    """Notes are written once in a process: each test is told anew."""
    from vn_sim_bridge import notices
    monkeypatch.setattr(notices, '_SAID', set())
    monkeypatch.setattr(notices, '_KINDS', notices.Counter())
