"""Train a policy from nothing in one small house, for as many minutes as you give it.

python examples/train.py OUT [MINUTES]
"""

import math
import sys

from vn_nav.learning import preset, train
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import PRIVILEGED, EnvConfig

SCENE = 'house:7?rooms=1'


def main(out: str, minutes: float):
    """Train, and print a line an update; the folder of the checkpoint."""
    # A preset is where every number comes from that is not given.
    config = preset('fast', minutes=minutes, pair_minutes=0.0, channels=(8, 16, 16),
                    features=64, hidden=64)
    # What the policy never sees, but its losses need: poses and distances of the goal.
    env = NavigationEnv(EnvConfig(scenes=(SCENE,), num_envs=16, size=36,
                                  progress_reward=1.0, collision_reward=-0.02,
                                  privileged=tuple(set(config.privileged) & set(PRIVILEGED))))
    facts = {'camera_fov_deg': math.degrees(env.robot.camera_fov),
             'camera_height': env.robot.camera_height, 'scenes': [SCENE]}
    return train(env, config, out, info=facts, on_update=lambda row: print(
        f'{row["frames"]:,} frames, {row["fps"]:.0f} a second, success {row["success"]:.0%}'))


if __name__ == '__main__':
    print(main(sys.argv[1], float(sys.argv[2]) if len(sys.argv) > 2 else 5.0))
