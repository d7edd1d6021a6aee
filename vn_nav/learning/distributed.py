"""Several processes that train one policy together (DD-PPO: Wijmans et al., arXiv 1911.00357).

Started by `torchrun`, each process has its own environments, random numbers and replay memory, and
the same weights. DistributedDataParallel averages the gradients. It hooks into one forward pass of
one module, and a step of ours has many (the rollout, and a window for each replayed task), so what
it wraps is the whole loss: a module that owns the network and returns the loss of a batch.

A mean of means is not the mean: processes have different numbers of frames in a batch (reset rows
are none). So inside the loss every count that a mean divides by is averaged over the processes
first (`returns.counted_together`), and the averaged gradient is the one of a single process that
has all their batches.
"""

from __future__ import annotations

import contextlib
import datetime
import hashlib
import os
import time
import uuid
import warnings
from collections.abc import Callable
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor, nn

from vn_nav.errors import UserError
from vn_nav.learning import returns

WAIT_MIN = 30.0  # min that a process waits for another one
MEET_MIN = 5.0  # min that it waits for all of them at the start
POLL_PERIOD_S = 0.05  # s between looks for the others


def _meeting_point() -> dict[str, Any]:
    """Where the processes of this attempt find each other, as arguments of init_process_group.

    Newer torchruns (2.13 does) keep one store for all their attempts: what the processes before a
    restart wrote is still in it, and whoever reads the address of a dead one waits for ever.
    So each process leaves a fresh token and lists the tokens that it sees; when all see the same
    ones, all are of this attempt, because nothing old can name a fresh token. Under the name of
    that view the store is empty.
    """
    if os.environ.get('TORCHELASTIC_USE_AGENT_STORE') != 'True':
        return {}  # torchrun has made a new store for this attempt
    rank, count = int(os.environ['RANK']), int(os.environ['WORLD_SIZE'])
    store = dist.TCPStore(os.environ['MASTER_ADDR'], int(os.environ['MASTER_PORT']), count,
                          is_master=False, timeout=datetime.timedelta(minutes=MEET_MIN))
    token = uuid.uuid4().hex
    store.set(f'vn_nav/token/{rank}', token)
    until = time.monotonic() + 60 * MEET_MIN

    def left(kind: str) -> list[bytes]:
        names = [f'vn_nav/{kind}/{other}' for other in range(count)]
        return [store.get(name) if store.check([name]) else b'' for name in names]
    while True:
        tokens = left('token')
        view = hashlib.sha256(b' '.join(tokens)).hexdigest()
        store.set(f'vn_nav/view/{rank}', view)
        if all(tokens) and set(left('view')) == {view.encode()}:
            return {'store': dist.PrefixStore(view, store), 'rank': rank, 'world_size': count}
        if time.monotonic() > until:
            raise UserError(f'all {count} processes start within {MEET_MIN:g} minutes',
                            f'{sum(map(bool, tokens))} of them', 'see what torchrun says of the '
                            'others, on every machine')
        time.sleep(POLL_PERIOD_S)


class Objective(nn.Module):
    """The loss of a batch as a module, for DistributedDataParallel to wrap."""

    def __init__(self, network: nn.Module, loss: Callable):
        super().__init__()
        self.network = network  # registers the parameters
        self.loss = loss

    def forward(self, *batch):
        return self.loss(*batch)


class Processes:
    """The processes that train together; used as a context. One process needs no torchrun.

    Every method is to be called by all of them, in the same order.

    Attributes:
        rank: of this process; 0 alone writes files.
        count: of the processes.
        restarted: torchrun started them again after one had died.
    """

    def __init__(self, rank: int = 0, count: int = 1, restarted: bool = False):
        self.rank, self.count, self.restarted = rank, count, restarted
        self.owner = False

    @classmethod
    def join(cls, patience: float = 0.0) -> Processes:
        """Those that torchrun started, or that a process group already has; else this one.

        Args:
            patience: minutes that the others may have to wait for one process, beyond `WAIT_MIN`.
        """
        launched = dist.is_torchelastic_launched()
        if not launched and not dist.is_initialized():
            return cls()
        owner = not dist.is_initialized()
        if owner:
            gpu = torch.cuda.is_available()
            if gpu:  # the one that `cuda` names from here on
                torch.cuda.set_device(int(os.environ['LOCAL_RANK']) % torch.cuda.device_count())
            dist.init_process_group(
                'cpu:gloo,cuda:nccl' if gpu else 'gloo', **_meeting_point(),
                timeout=datetime.timedelta(minutes=WAIT_MIN + patience))
        restarts = os.environ['TORCHELASTIC_RESTART_COUNT'] if launched else 0
        processes = cls(dist.get_rank(), dist.get_world_size(), int(restarts) > 0)
        processes.owner = owner
        return processes

    def __enter__(self) -> Processes:
        return self

    def __exit__(self, kind, *_):
        if self.owner and kind is None:  # after an error the others may never answer
            dist.destroy_process_group()

    @property
    def leads(self) -> bool:
        """Whether this process writes the files."""
        return self.rank == 0

    def objective(self, network: nn.Module, loss: Callable, unused: bool = False) -> nn.Module:
        """The loss as a module whose gradients are averaged; weights become rank 0's.

        Args:
            network: owner of the parameters.
            loss: of a batch, with the loss first among what it returns.
            unused: some parameters have no part in the loss.
        """
        module = Objective(network, loss)
        if self.count == 1:
            return module
        # It takes the stride of a dimension of size 1 for a difference.
        warnings.filterwarnings('ignore', 'Grad strides do not match bucket view strides')
        return nn.parallel.DistributedDataParallel(module, find_unused_parameters=unused)

    def counted_together(self) -> contextlib.AbstractContextManager:
        """Masked means inside divide by the mean count of all processes."""
        if self.count == 1:
            return contextlib.nullcontext()
        return returns.counted_together(lambda count: self._sum(count).clamp(min=1) / self.count)

    def normalise(self, x: Tensor, mask: Tensor) -> Tensor:
        """`returns.normalise` with mean and deviation over the batches of all processes."""
        if self.count == 1:
            return returns.normalise(x, mask)

        def mean(values: Tensor) -> Tensor:
            total = torch.where(mask, values, 0.0).sum()
            count, total = self._sum(torch.stack([mask.sum().to(total.dtype), total]))
            return total / count.clamp(min=1)
        shifted = x - mean(x)
        return shifted / (mean(shifted ** 2).sqrt() + 1e-8)

    def any(self, flag: bool) -> bool:
        """Whether it holds anywhere."""
        return flag if self.count == 1 else bool(self._sum(torch.tensor(int(flag))))

    def gather(self, value: Any) -> list:
        """Every process's value, by rank."""
        if self.count == 1:
            return [value]
        values = [None] * self.count
        dist.all_gather_object(values, value)
        return values

    def from_leader(self, find: Callable[[], Any]) -> Any:
        """A value that the leading process finds, for all. Its error ends the others' waiting."""
        values = [find() if self.leads else None]
        if self.count > 1:
            dist.broadcast_object_list(values, 0)
        return values[0]

    def copy_weights(self, network: nn.Module) -> None:
        """Give all networks the weights of the leading process."""
        if self.count > 1:
            for tensor in network.state_dict().values():
                dist.broadcast(tensor, 0)

    @staticmethod
    def _sum(tensor: Tensor) -> Tensor:
        total = tensor.detach().clone()
        dist.all_reduce(total)
        return total
