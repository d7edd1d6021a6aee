"""What `vn_nav bag doctor` sees in a whole bag only: missing topics, gaps, clocks, no motion."""

from __future__ import annotations

import collections

from vn_nav.bags.doctor.content_checks import ContentChecks
from vn_nav.bags.doctor.figures import ERROR, WARNING, Findings, Neighbours, ReceivedTopic
from vn_nav.bags.roles import TYPES, Topics, fits, full_name, proposal, remedy, replaced
from vn_nav.bags.stamped import EPISODE_GAP_S, STAMP_WINDOW_S
from vn_nav.bags.storage.stream import UNLISTED, Bag

MIN_TRAVEL_M_RAD = 0.05  # m and rad: a robot that moves less stands still
CLOCK_JUMP_NS = 1_000_000_000  # ns by which clocks may disagree from one message to the next
CLOCK_SKEW_NS = 500_000_000  # ns by which two sensors' stamps may lag behind differently
# Three years: stamps farther from the recorder's time are simulated time.
SIMULATED_OFFSET_NS = 10**17
MAX_SHARE_WITHOUT_POSE = 0.05  # share of pictures that may be without a matching pose
MAX_LISTED_DAMAGE = 5  # places of damage that are listed
STAMPED = ('image', 'depth', 'labels', 'odometry')  # roles that are put together by their stamps
CLOCK = 'rosgraph_msgs/msg/Clock'
RECOVER = 'save what is whole with `vn_nav bag recover`'


class BagChecks:
    """Checks a bag that has been read to its end.

    Args:
        findings: gets what is wrong.
        topics: what was received, by name.
        names: of the roles.
        contents: what the messages held.
        poses: how many pictures have none.
    """

    def __init__(self, findings: Findings, topics: dict[str, ReceivedTopic], names: Topics,
                 contents: ContentChecks, poses: Neighbours):
        self._add, self._topics, self._names = findings.add, topics, names
        self._contents, self._poses = contents, poses

    def run(self, bag: Bag) -> None:
        """All of them."""
        self._damage(bag)
        roles = collections.defaultdict(list)
        for topic in self._topics.values():
            if topic.role is not None:
                roles[topic.role].append(topic)
        self._missing(roles)
        lags = {topic.connection.topic: lag for role in STAMPED for topic in roles[role]
                if topic.stamps.last and (lag := topic.lag.median()) is not None}
        simulated = bool(lags) and min(map(abs, lags.values())) > SIMULATED_OFFSET_NS or any(
            full_name(topic.connection.type) == CLOCK for topic in self._topics.values())
        for topic in (t for role in STAMPED for t in roles[role]):
            self._gaps(topic, simulated)
            if topic.stamps.last is not None and topic.stamps.last == 0 and topic.count > 1:
                self._add(ERROR, topic.connection.topic, 'none', 'has stamps of zero', None,
                          'have its driver stamp what it publishes')
        self._set_back(roles)
        if lags and not simulated:  # simulated time runs as it likes
            self._clocks(roles, lags)
        self._standing(roles)

    def _damage(self, bag: Bag) -> None:
        for number, loss in enumerate(bag.losses):
            at = loss.before if loss.before is not None else loss.after
            key = f'damage {number}' if number < MAX_LISTED_DAMAGE else 'damage'
            what = f'{loss.path}, byte {loss.offset}: {loss.reason}'
            if number >= MAX_LISTED_DAMAGE:
                what = f'further occurrences: {what}'
            self._add(WARNING if loss.reason == UNLISTED else ERROR, '', key, what, at, RECOVER)
        if bag.path.is_dir() and not (bag.path / 'metadata.yaml').is_file():
            self._add(WARNING, '', 'metadata', 'has no metadata.yaml', None, 'other programs need '
                      'it: ' + RECOVER)

    def _missing(self, roles: dict[str, list[ReceivedTopic]]) -> None:
        free = {t.connection.topic: t.connection.type for t in self._topics.values()
                if t.role is None}
        kinds = {role: same[0].connection.type for role, same in roles.items() if same}
        for role, topic in ((role, t) for role, same in roles.items() for t in same):
            if not fits(role, topic.connection.type):
                self._add(ERROR, topic.connection.topic, 'type', 'is '
                          f'{topic.connection.type or "of no type"}, not '
                          f'{" or ".join(TYPES[role])}', None,
                          remedy(role, free, replaced(role, kinds)))

        def candidates(role: str) -> str:
            return proposal(role, free) or 'record it'

        if not roles['image']:
            self._add(ERROR, '', 'image', f'has no camera picture ({self._names.image})', None,
                      candidates('image'))
        if not (roles['odometry'] or roles['command']):
            self._add(ERROR, '', 'odometry', f'has neither odometry ({self._names.odometry}) nor '
                      f'commands ({self._names.command})', None, candidates('odometry'))
        elif not roles['odometry']:
            self._add(WARNING, '', 'odometry', f'has no odometry ({self._names.odometry}): '
                      'poses are integrated from commands and drift', None, candidates('odometry'))
        if roles['image'] and not roles['camera_info']:
            self._add(WARNING, '', 'camera_info', 'has no camera calibration '
                      f'({self._names.camera_info})', None, candidates('camera_info'))

    def _gaps(self, topic: ReceivedTopic, simulated: bool) -> None:
        times = topic.stamps if topic.stamps.last else topic.logged
        name, median = topic.connection.topic, times.gaps.median()
        if topic.role in ('image', 'odometry') and times.worst > EPISODE_GAP_S * 1e9:
            self._add(WARNING, name, 'gap', f'pauses for up to {times.worst * 1e-9:.1f} s',
                      times.worst_at, 'episodes end there' + (
                          ': have the simulator publish it more often' if simulated else
                          '; record with a faster disk or network'))
        if (topic.role == 'odometry' and median is not None and median > 2e9 * STAMP_WINDOW_S
                and self._poses.alone > MAX_SHARE_WITHOUT_POSE * self._poses.pictures):
            share = self._poses.alone / self._poses.pictures
            self._add(ERROR, name, 'rate', f'comes at {1e9 / median:.1f} Hz: {share:.0%} of the '
                      f'pictures have no pose within {STAMP_WINDOW_S * 1e3:.0f} ms', None,
                      f'publish it at {1 / STAMP_WINDOW_S:.0f} Hz')

    def _set_back(self, roles: dict[str, list[ReceivedTopic]]) -> None:
        """Clocks that were set back: of the stamps, and of the recorder."""
        for what, chosen, of in (
                ('is stamped', STAMPED, lambda topic: topic.set_back),
                ('was recorded', (*STAMPED, 'command'), lambda topic: topic.recorder_back)):
            moving = [t for role in ('image', 'odometry' if roles['odometry'] else 'command')
                      for t in roles[role] if role in chosen]
            alike = all(of(topic).count for topic in moving)
            for topic in self._topics.values():
                back = of(topic)
                if topic.role not in chosen or not back.count:
                    continue
                serious = not alike and topic in moving
                self._add(ERROR if serious else WARNING, topic.connection.topic, what,
                          f'{what} by a clock that was set back by {-back.first * 1e-9:.1f} s',
                          back.at, 'pictures and poses do not match after it: '
                          'synchronise the clocks (chrony), and record again' if serious else
                          'a simulator was reset, or these are two takes: an episode ends there',
                          back.count)

    def _clocks(self, roles: dict[str, list[ReceivedTopic]], lags: dict[str, float]) -> None:
        """Stamps against the recorder's clock, and of one sensor against another's."""
        for topic in (t for role in STAMPED for t in roles[role]):
            if topic.jump is None:
                continue
            jump, at = topic.jump
            self._add(ERROR, topic.connection.topic, 'jump', 'is stamped by a clock that jumps by '
                      f'{jump * 1e-9:.1f} s', at, 'synchronise the clocks (chrony) before '
                      'recording; split the bag here')
        for name, lag in lags.items():
            if abs(lag) > CLOCK_JUMP_NS:
                self._add(WARNING, name, 'skew', f'is stamped {lag * 1e-9:.1f} s before it is '
                          'recorded', None, 'synchronise the clocks (chrony)')
        late, early = max(lags, key=lags.__getitem__), min(lags, key=lags.__getitem__)
        if lags[late] - lags[early] > CLOCK_SKEW_NS:
            self._add(ERROR, late, 'skew to others', 'is stamped '
                      f'{(lags[late] - lags[early]) * 1e-9:.1f} s earlier than {early} at the '
                      'same time', None, 'synchronise the clocks (chrony), or stamp both on one '
                      'computer')

    def _standing(self, roles: dict[str, list[ReceivedTopic]]) -> None:
        commanded = self._contents.command.total > MIN_TRAVEL_M_RAD
        if self._contents.odometry.poses and self._contents.odometry.reach < MIN_TRAVEL_M_RAD:
            self._add(ERROR, roles['odometry'][0].connection.topic, 'still',
                      'never moves' + ', although the commands are not zero' * commanded, None,
                      'check the wheel encoders' if commanded else 'drive while recording')
        elif not roles['odometry'] and roles['command'] and not commanded:
            self._add(ERROR, roles['command'][0].connection.topic, 'still', 'never moves the '
                      'robot', None, 'drive while recording')
