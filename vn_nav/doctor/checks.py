"""All checks of a graph, the worst finding first."""

from __future__ import annotations

from vn_nav.doctor import camera_checks, drive_checks, stream_checks, topic_checks
from vn_nav.doctor.seen import ORDER, Finding, Graph
from vn_nav.robot import RobotSpec

CHECKS = (topic_checks.middleware, topic_checks.missing, topic_checks.types, topic_checks.qos,
          stream_checks.pictures, stream_checks.rates, stream_checks.losses, stream_checks.clocks,
          stream_checks.odometry, drive_checks.command, drive_checks.base_timeout)


def examine(graph: Graph, policy: camera_checks.Policy | None = None,
            robot: RobotSpec | None = None) -> list[Finding]:
    """What is wrong with a graph, and what is right.

    Args:
        graph: what was seen.
        policy: that is going to drive; None: the camera is compared with nothing.
        robot: None: nobody has said.
    """
    findings = list(topic_checks.nobody(graph))
    if not findings:
        findings = [finding for check in CHECKS for finding in check(graph)]
    findings += camera_checks.camera(graph, policy, robot)
    return sorted(findings, key=lambda finding: ORDER.index(finding.severity))
