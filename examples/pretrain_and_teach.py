"""From a recorded drive to a policy for the place where it was driven.

    python examples/pretrain_and_teach.py BAG OUT [MINUTES]

The bag needs camera pictures and odometry (docs/bags.md).
"""

import sys
from pathlib import Path

from vn_nav.learning import PretrainConfig, PretrainJob, TeachJob, pretrain, teach
from vn_sim_bridge import teach_place


def main(bag: str, out: str, minutes: float = 10.0, epochs: int = 10, size: int = 84,
         episodes: int = 20) -> Path:
    """Pre-train on the drive, teach the place; the folder of the checkpoint."""
    started = pretrain(PretrainJob(
        bags=[bag], out=Path(out, 'pretrained'), size=size,
        # Numbers of the network that are not the preset's.
        changes={'hidden': 128, 'features': 128},
        numbers=PretrainConfig(epochs=epochs)))
    # The simulator's half makes a place out of pictures with poses.
    return teach(TeachJob(bag=bag, out=Path(out, 'taught'), checkpoint=started, minutes=minutes,
                          episodes=episodes), teach_place)


if __name__ == '__main__':
    print(main(*sys.argv[1:3], *map(float, sys.argv[3:4])))
