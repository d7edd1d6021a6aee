"""Faults that tests make happen."""

import resource
import shutil
import subprocess
from contextlib import contextmanager

import pytest


@contextmanager
def no_file_beyond(size):
    """Fail a write as a full disk does, at a chosen byte."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def own_mounts(folder, *options):
    """Words before a command that may mount a small disk; else the test is skipped.

    Args:
        folder: where a mount is tried.
        options: more of `unshare`.
    """
    probe = ['sh', '-c', f'mount -t tmpfs tmpfs {folder}']
    for own in ('-m', '-rm'):
        words = ['unshare', own, *options]
        if shutil.which('unshare') and subprocess.run(
                [*words, *probe], capture_output=True).returncode == 0:
            return words
    pytest.skip('expected: this machine lets nobody mount a small disk')
