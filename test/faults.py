"""Faults that tests make happen."""

import resource
from contextlib import contextmanager


@contextmanager
def no_file_beyond(size):
    """Fail a write as a full disk does, at a chosen byte."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
