"""Measurements that take hours: each is kept as JSON, and a second run goes on with the rest."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path

from vn_nav.files import write_file
from vn_nav.policy import search
from vn_nav.policy.checkpoint import LoadedCheckpoint

SEARCH = Path(search.__file__).parent  # what decides is no part of a checkpoint


def conditions_of(checkpoint: LoadedCheckpoint, *, split: str, houses: int, episodes: int,
                  seed: int, max_decisions: int, stops: Sequence[str],
                  stop_threshold: float | None) -> dict:
    """What all figures of a checkpoint depend on: weights, planner, episodes.

    Args:
        checkpoint: the policy.
        split, houses: name, and how many of its scenes.
        episodes: of a measurement, at least.
        seed: of the episodes.
        max_decisions: of an episode.
        stops: what ends the episodes.
        stop_threshold: None: the checkpoint's.
    """
    return {'sha256': checkpoint.info['sha256'], 'planner': planner(), 'split': split,
            'houses': houses, 'episodes': episodes, 'seed': seed, 'max_decisions': max_decisions,
            'stops': list(stops),
            'stop_threshold': (checkpoint.info['stop_threshold'] if stop_threshold is None
                               else stop_threshold)}


def planner() -> str:
    """What decides beside a checkpoint's weights: a hash of the planner's code."""
    return hashlib.sha256(b''.join(
        path.read_bytes() for path in sorted(SEARCH.glob('*.py')))).hexdigest()


def finished(path: Path, wanted: dict) -> dict | None:
    """What was measured before, under these `conditions`; None: nothing, or under others."""
    try:
        found = json.loads(path.read_text())
    except (FileNotFoundError, ValueError):  # no JSON, or no text
        return None
    wanted = json.loads(json.dumps(wanted))  # a tuple is a list there
    return found if isinstance(found, dict) and found.get('conditions') == wanted else None


def keep(path: Path, entry: dict) -> None:
    """Write a measurement; `entry['conditions']` says under what it was made."""
    write_file(path, (json.dumps(entry, indent=2) + '\n').encode())
