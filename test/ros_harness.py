"""Real nodes in child processes for the two-process tests."""

import contextlib
import math
import os
import signal
import subprocess
import sys
import time

import torch

from vn_nav.nodes.service_call import ServiceCall
from vn_nav.policy.checkpoint import save_checkpoint
from vn_nav.policy.network_config import NetworkConfig
from vn_nav.policy.zhu_policy import build_policy
from vn_nav.robot import DRIVE_ACTIONS
from vn_sim_bridge.simulators.house import WORLD_VERSION

PATIENCE = 100.0  # s for what has no limit of its own: starting a node on a loaded machine


def write_checkpoint(folder, size=84, seed=0, *, arrival=None, stop_threshold=None, **fields):
    """A small real checkpoint with seeded random weights: nearly uniform actions.

    With `arrival` it has that head, which says this probability of whatever it sees.
    """
    torch.manual_seed(seed)
    network = build_policy(NetworkConfig(**{
        'actions': DRIVE_ACTIONS, 'size': size, 'channels': (4, 4, 4), 'features': 16,
        'hidden': 16, 'heads': () if arrival is None else ('arrival',), **fields}))
    if arrival is not None:
        layer = network.heads['arrival'].out
        torch.nn.init.zeros_(layer.weight)
        torch.nn.init.constant_(layer.bias, math.log(arrival / (1 - arrival)))
    save_checkpoint(folder, network, {'world_version': WORLD_VERSION, 'camera_fov_deg': 90.0,
                                      'camera_height': 1.0, 'scenes': ['house:7'],
                                      'stop_threshold': stop_threshold})
    return folder


@contextlib.contextmanager
def child(module, log, *, rules=(), **parameters):
    """A node as a process, with remapping rules; killed at the end if it still runs."""
    words = [sys.executable, '-m', module, '--ros-args']
    for rule in rules:
        words += ['-r', rule]
    for name, value in parameters.items():
        words += ['-p', f'{name}:={str(value).lower() if isinstance(value, bool) else value}']
    with open(log, 'w') as file:
        process = subprocess.Popen(words, stdout=file, stderr=subprocess.STDOUT,
                                   start_new_session=True,
                                   env=os.environ | {'OMP_NUM_THREADS': '1'})
    try:
        yield process
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


# Limits of a node beside others that start up: for tests that are not about its watchdog.
PATIENT = {'inference_timeout': 2.0, 'frame_timeout': 3.0, 'frame_stop_timeout': 10.0,
           'max_frame_age': 3.0, 'odometry_timeout': 5.0}


def wait_until(condition, spin, seconds=PATIENCE, what=''):
    """Call `spin` until the condition holds; the seconds it took.

    `what` tells of a failure: a text, or what makes one then.
    """
    begun = time.monotonic()
    while not condition():
        assert time.monotonic() - begun < seconds, (
            f'not within {seconds} s: {what() if callable(what) else what or condition}')
        spin()
    return time.monotonic() - begun


def ask(client, request, spin, seconds=PATIENCE):
    """The answer of a service, and how often it was asked: again where none comes.

    What may not be done twice is to be asked of a client that has had an answer before.
    """
    wait_until(client.service_is_ready, spin, seconds, f'{client.srv_name} is not there')
    call = ServiceCall(client, request)
    wait_until(call.is_answered, spin, seconds, f'{client.srv_name} does not answer')
    return call.answer, call.asked
