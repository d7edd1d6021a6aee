"""Evaluation: episodes and their figures; `evaluate` measures a checkpoint."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vn_nav.evaluation.measurement import EvaluateConfig, Evaluation, evaluate

__all__ = ['EvaluateConfig', 'Evaluation', 'evaluate']


def __getattr__(name: str):
    """What is exported, imported when it is asked for: figures alone need no torch."""
    if name in __all__:
        from vn_nav.evaluation import measurement
        return getattr(measurement, name)
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
