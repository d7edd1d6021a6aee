"""Measure a checkpoint in the house that it knows and in one that it has never seen.

python examples/evaluate.py [CHECKPOINT [EPISODES]]
"""

import sys

from vn_nav.evaluation import EvaluateConfig, evaluate
from vn_nav.policy.checkpoint import load_checkpoint
from vn_nav.resources import share_file
from vn_nav.scenes import house_scene, rooms_of
from vn_sim_bridge.navigation.env import NavigationEnv
from vn_sim_bridge.navigation.env_config import EnvConfig
from vn_sim_bridge.render.randomisation import load_randomisation

UNSEEN_HOUSE = 8  # seed, of a house with as many rooms


def main(folder: str, episodes: int) -> dict:
    """Print the success of the policy and of random actions; the whole result."""
    checkpoint = load_checkpoint(folder)
    info = checkpoint.info

    def make_env(split, scenes, environments, stop):
        return NavigationEnv(EnvConfig(
            scenes=tuple(scenes), num_envs=environments, stop=stop,
            size=checkpoint.config.size, actions=checkpoint.config.actions,
            randomisation=load_randomisation(info['randomisation'])))

    own = info['scenes'][0]
    splits = {'own house': [own], 'unseen house': [house_scene(UNSEEN_HOUSE, rooms_of(own))]}
    config = EvaluateConfig(episodes=episodes, controls=('random actions',))
    result = evaluate(checkpoint, splits, make_env, config, name=folder).result
    for name, split in result['splits'].items():
        for row, figures in split['rows']['arrival'].items():
            print(f'{name}, {row}: success {figures["success"]:.0%}, SPL {figures["spl"]:.2f}')
    return result


if __name__ == '__main__':
    given = sys.argv[1:]
    main(given[0] if given else str(share_file('models/house')),
         int(given[1]) if len(given) > 1 else 20)
