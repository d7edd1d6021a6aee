"""The type that networks compute in where nobody chose one."""

from __future__ import annotations

from pathlib import Path

import torch


def has_fast_bfloat16() -> bool:
    """Whether this processor multiplies bfloat16 in hardware (Linux on x86; else False)."""
    try:
        flags = Path('/proc/cpuinfo').read_text()
    except OSError:
        return False
    return 'avx512_bf16' in flags or 'amx_bf16' in flags


def fast_dtype(device: torch.device | str = 'cpu') -> torch.dtype:
    """bfloat16 where the device multiplies it in hardware (any GPU), else float32."""
    if torch.device(device).type != 'cpu' or has_fast_bfloat16():
        return torch.bfloat16
    return torch.float32
