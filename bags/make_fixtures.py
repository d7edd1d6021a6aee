"""Records the small bags of this folder with the real nodes. Run: python bags/make_fixtures.py

house_drive: one short journey (at most 10 decisions) of the shipped policy in house 7, recorded
by recorder_node from sim_bridge_node and policy_node in lock-step.
"""

import shutil
import tempfile
from pathlib import Path

from vn_nav.demo import Processes
from vn_nav.resources import share_file

FOLDER = Path(__file__).resolve().parent


def main():
    """Replace the bags."""
    bag = FOLDER / 'house_drive'
    shutil.rmtree(bag, ignore_errors=True)
    base = str(share_file('config/robots/demo_base.yaml'))
    with tempfile.TemporaryDirectory() as logs:
        processes = Processes(Path(logs))
        try:
            processes.start('recorder', 'vn_nav.nodes.recorder_node', {'output': str(bag)})
            processes.start('policy', 'vn_nav.nodes.policy_node', {
                'checkpoint': str(share_file('models/house')), 'robot': base,
                'time': 'lock_step', 'auto_enable': True})
            processes.start('bridge', 'vn_sim_bridge.bridge_node', {
                'house': 7, 'robot': base, 'time': 'lock_step', 'episodes': 1,
                'max_decisions': 10, 'exit_when_done': True})
            processes.running['bridge'].wait(60)
        finally:
            processes.stop_all()


if __name__ == '__main__':
    main()
