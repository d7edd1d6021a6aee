"""Learning: rollouts, returns, losses and the trainer.

`train`, `pretrain` and `teach` are functions of frozen dataclasses, as the commands of these names
call them; examples/ shows each.
"""

import importlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vn_nav.learning.presets import TrainConfig, preset
    from vn_nav.learning.pretrain_config import PretrainConfig
    from vn_nav.learning.pretrain_job import PretrainJob, pretrain
    from vn_nav.learning.teach_job import TeachJob
    from vn_nav.learning.teaching import teach
    from vn_nav.learning.trainer import train

__all__ = ['PretrainConfig', 'PretrainJob', 'TeachJob', 'TrainConfig', 'preset', 'pretrain',
           'teach', 'train']
# Where each is; no module has the name of one, which would hide it.
_HOMES = {'PretrainConfig': 'pretraining', 'PretrainJob': 'pretrain_job', 'TeachJob': 'teach_job',
          'TrainConfig': 'presets', 'preset': 'presets', 'pretrain': 'pretrain_job',
          'teach': 'teaching', 'train': 'trainer'}


def __getattr__(name: str):
    """What is exported, imported when it is asked for: curves alone need no torch."""
    if name in _HOMES:
        return getattr(importlib.import_module(f'{__name__}.{_HOMES[name]}'), name)
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
