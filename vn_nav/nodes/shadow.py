"""Shadow mode: the real `policy_node` along a recorded drive; its commands into a second bag.

The node runs as a process of its own, in mode shadow and lock-step; this process takes the place
of its robot. One thing is asked at a time, and answered before the next: the answers depend on the
bag alone, not on the speed of the machine.

No robot receives the commands, for three reasons, each enough: they leave neither this host (the
Fast DDS profile) nor a ROS domain that nobody else is on, which is looked at all the time; and
their topic is `shadow/cmd_vel` in a namespace that is made up for this run.
"""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path

from vn_nav.bags.shadow.plan import Plan
from vn_nav.bags.storage.writer import BagWriter
from vn_nav.calibration import is_rectified
from vn_nav.errors import UserError
from vn_nav.nodes.process import Ended
from vn_nav.nodes.processes import Processes, ProcessFailure
from vn_nav.nodes.shadow_domain import DOMAINS, Domain
from vn_nav.nodes.shadow_stage import ABSOLUTE, Stage, range_parameters, shadow_topics


@dataclasses.dataclass
class Driven:
    """How it went."""

    bag: Path  # the second one
    complete: bool  # else a signal ended it
    latencies: list[float]  # s of each decision, from the picture to its answer


def drive(plan: Plan, checkpoint: str | Path, out: str | Path, *, robot: Path | None = None,
          decoding: str | None = None, searches: bool = False,
          mount: tuple[float, float, float] = (0.0, 0.0, 0.0), domains: Iterable[int] = DOMAINS,
          say: Callable[[str], None] = lambda _: None) -> Driven:
    """Let a policy see a drive, and record what it would have done.

    Args:
        plan: the drive, cut into the policy's actions.
        checkpoint: folder of the policy.
        out: folder of the second bag; it must not exist.
        robot: YAML file; None: the standard robot.
        decoding: 'sample' or 'greedy'; None: as the checkpoint was measured.
        searches: the policy has a map; it is recorded.
        mount: x ahead, y to the left [m], yaw [rad] of the sensor of `plan.ranges` on the robot.
        domains: to choose from.
        say: called with a line about where the commands end.

    Raises:
        UserError: no free domain, somebody else there, a node that fails or falls silent, or no
            room for the bag. What was recorded before is whole.
    """
    ended = Ended()
    try:
        with (Domain(domains) as domain, tempfile.TemporaryDirectory() as logs,
              BagWriter(out, shadow_topics(searches)) as bag):
            say(f'ROS domain {domain.number}, namespace {domain.namespace}: the commands end '
                'there')
            processes = Processes(Path(logs))
            processes.environment['ROS_DOMAIN_ID'] = str(domain.number)
            stage = Stage(plan, domain, bag, processes, ended, searches=searches)
            try:
                processes.start('policy', 'vn_nav.nodes.policy_node', {
                    'checkpoint': str(checkpoint), 'robot': str(robot or ''), 'mode': 'shadow',
                    'time': 'lock_step', 'use_sim_time': True, 'control_rate': plan.rate,
                    'image_transport': 'compressed' if plan.compressed else 'raw',
                    # The topic has another name there.
                    'rectify': 'never' if is_rectified(plan.topics.image) else 'always',
                    'decoding': decoding or '',
                    **range_parameters(plan, mount)}, (
                        f'__ns:={domain.namespace}',
                        *(f'/{name}:={domain.namespace}/{name}' for name in ABSOLUTE)))
                complete = stage.play()
            except ProcessFailure as error:
                raise UserError('the policy node lives until the drive is over', str(error),
                                'see what it says') from error
            finally:
                processes.stop_all()
        return Driven(Path(out), complete, stage.latencies)
    finally:
        ended.restore()
