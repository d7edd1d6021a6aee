"""The HTML page of `vn_nav bag show`: a drive at a glance, in one file."""

from __future__ import annotations

import datetime
import html
import math

import numpy as np

from vn_nav import __version__
from vn_nav.bags.doctor.figures import ERROR, Finding, TopicFigures
from vn_nav.bags.poses import COMMAND_TIMEOUT_S
from vn_nav.bags.report.agreement import END, OTHER, STOP, Agreement, Disagreement, Judged
from vn_nav.bags.report.figures import MAX_STRIP_PICTURES, Shot, Timeline
from vn_nav.bags.report.show import AXES, Shown
from vn_nav.bags.segmenter import ACTION_LENGTH_TOLERANCE
from vn_nav.report.chart import Line, Series, Shape, Text, legend, panel, ticks, to_svg
from vn_nav.report.page import CURVES, cards, page, picture, table

TOPICS = 60  # listed, at most
MAP = 620, 470  # pixels
MARGIN = 0.4  # m around the path, and the least it is drawn wide
MOVING = 0.02  # m/s or rad/s: below that an axis is not drawn
NAMES = {'vx': 'forward [m/s]', 'vy': 'left [m/s]', 'wz': 'turning left [rad/s]'}
STYLE = """<style>
.pair { display:grid; grid-template-columns:3fr 2fr; gap:18px; align-items:start }
.pair > * { min-width:0 } @media (max-width:820px) { .pair { grid-template-columns:1fr } }
.wrap { flex-wrap:wrap } .film img { width:auto; height:130px; image-rendering:auto }
.film b { color:var(--ink) }
.spark { width:240px } .spark svg { border:0; background:none; display:block }
.both { display:flex; gap:3px } table .hit { font-weight:700 } .findings { padding-left:1.2em }
</style>"""


def show_page(bag: str, shown: Shown, checkpoint: str = '') -> str:
    """The page.

    Args:
        bag: path, as the user gave it.
        shown: what is in it.
        checkpoint: path of the policy, if there is one.
    """
    name = html.escape(bag.rstrip('/').rsplit('/', 1)[-1])
    when = datetime.datetime.fromtimestamp(shown.start, datetime.UTC)
    policy = _policy(shown.agreement, checkpoint) if shown.agreement else ''
    return page(f'{name}: vn_nav bag show', f"""{STYLE}<h1>{name}</h1>
<p class="soft">{html.escape(bag)}, recorded from {when:%Y-%m-%d %H:%M:%S} UTC.
vn_nav {__version__}.</p>
{_cards(shown)}
{_findings(shown.diagnosis.findings)}
{_film(shown)}
<div class="pair"><div><h2>Where it went</h2>{_map(shown)}</div>
<div><h2>What it did</h2>{_actions(shown)}</div></div>
<h2>How fast</h2>{_velocities(shown.velocities, shown.odometer.progress)}
{policy}
<h2>What was recorded</h2>{_topics(shown)}""")


def _cards(shown: Shown) -> str:
    report, way = shown.report, shown.odometer
    done = sum(report.actions.values())
    entries = [
        (_duration(shown.diagnosis.seconds), 'recorded',
         f'{sum(t.count for t in shown.diagnosis.topics):,} messages'),
        (f'{way.metres:.1f} m', 'driven', f'turned by {math.degrees(way.turned):,.0f} deg in all'),
        (str(report.episodes), f'episode{"s" * (report.episodes != 1)}',
         f'{shown.goals.count} goal picture{"s" * (shown.goals.count != 1)} shown'),
        (f'{report.pictures:,}', 'pictures', f'{report.without_pose:,} without a pose'),
        (f'{done:,}', "of the robot's actions", f'{report.misfit_share:.0%} of the motions fit '
         'none')]
    if shown.agreement and shown.agreement.counted:
        entries.append((f'{shown.agreement.share:.0%}', 'the policy agrees',
                        f'at {shown.agreement.counted:,} actions'))
    return cards(entries)


def _findings(findings: list[Finding]) -> str:
    if not findings:
        return '<p class="yes">vn_nav bag doctor finds nothing wrong with it.</p>'
    lines = ''.join(
        f'<li><b class="{"no" if f.severity == ERROR else "soft"}">{f.severity}</b> '
        f'{html.escape(f.topic or "the bag")} {html.escape(f.what)}'
        f'{"" if f.when is None else f" (at {f.when:.1f} s)"}; {html.escape(f.remedy)}</li>'
        for f in findings)
    return f'<ul class="findings">{lines}</ul>'


def _film(shown: Shown) -> str:
    if not shown.film:
        return '<h2>What it saw</h2><p>No picture could be shown: none has a pose.</p>'
    figures = ''.join(
        f'<figure><img alt="" src="{picture(shot.picture)}"><figcaption><b>{k + 1}</b> &middot; '
        f'{max(shot.time - shown.start, 0.0):.1f} s</figcaption></figure>'
        for k, shot in enumerate(shown.film))
    goals = ''.join(
        f'<figure class="goal"><img alt="goal picture" src="{picture(rgb)}"><figcaption>goal of '
        f'episode {episode + 1}</figcaption></figure>' for episode, rgb in shown.goals.shown)
    more = (f' (the first {len(shown.goals.shown)} of {shown.goals.count})'
            if shown.goals.count > len(shown.goals.shown) else '')
    asked = (f'<h3>Goal pictures{more}</h3><div class="strip wrap film">{goals}</div>'
             if goals else '')
    return f"""<h2>What it saw</h2><div class="strip wrap film">{figures}</div>
<p class="soft">At most {MAX_STRIP_PICTURES} pictures, evenly along the
way; the map has their numbers.</p>
{asked}"""


def _map(shown: Shown) -> str:
    ways = [way for way in shown.ways.values() if len(way)]
    if not ways:
        return '<p>Nothing: no picture has a pose.</p>'
    points = np.concatenate(ways)[:, :2]
    (width, height), low, high = MAP, points.min(0) - MARGIN, points.max(0) + MARGIN
    scale = min((width - 20) / (high[0] - low[0]), (height - 50) / (high[1] - low[1]))
    corner = np.array([width - scale * (high[0] + low[0]),
                       height - 20 + scale * (high[1] + low[1])]) / 2

    def place(points: np.ndarray) -> np.ndarray:
        return corner + np.asarray(points)[..., :2] * (scale, -scale)

    unit = _unit(max(high - low))
    beyond = (np.array(MAP) / scale - (high - low)) / 2
    shapes: list[Shape] = _grid(place, low - beyond, high + beyond, unit)
    for episode, way in shown.ways.items():
        colour = f'c{episode % CURVES}'
        shapes += [Line(place(way), colour, 2.4, opacity=0.85), _disc(place(way[0]), 12, colour),
                   _ring(place(way[-1]), 13, colour)]
    for k, shot in enumerate(shown.film):
        shapes += _mark(place(shot.pose), shot, str(k + 1))
    base = height - 10
    shapes += [Line(np.array([[14, base], [14 + unit * scale, base]]), 'ink', 2),
               Text(20 + unit * scale, base + 4, f'{unit:g} m', 'start', 'ink')]
    by = ('by odometry' if shown.topics.odometry else 'by the commands alone, which drift: there '
          'is no odometry')
    colours = (f'one colour per episode (again after {CURVES})' if shown.report.episodes > CURVES
               else 'one colour per episode' if shown.report.episodes > 1 else '')
    return f"""<figure>{to_svg(shapes, width, height, 'map of the path')}<figcaption>The path
{by}{", " * bool(colours)}{colours}. Dot: start; ring: end; numbers: pictures of the film strip,
with the direction the robot faced.</figcaption></figure>"""


def _grid(place, low: np.ndarray, high: np.ndarray, unit: float) -> list[Shape]:
    lines: list[Shape] = []
    for axis in (0, 1):
        for value in np.arange(math.ceil(low[axis] / unit), math.floor(high[axis] / unit) + 1):
            ends = np.array([low, high])
            ends[:, axis] = value * unit
            lines.append(Line(place(ends), 'line'))
    return lines


def _unit(span: float) -> float:
    """A round length [m], of which about six fit."""
    marks = ticks(0.0, span, 6)
    return marks[1] - marks[0]


def _mark(at: np.ndarray, shot: Shot, words: str) -> list[Shape]:
    """A number where a picture was taken, with a nose in its direction."""
    ahead = np.array([math.cos(shot.pose[2]), -math.sin(shot.pose[2])])
    side = np.array([-ahead[1], ahead[0]])
    nose = np.array([at + 16 * ahead, at + 6 * side + 6 * ahead, at - 6 * side + 6 * ahead])
    return [Line(nose, 'ink', filled=True), _disc(at, 9, 'ink'),
            Text(at[0], at[1] + 4, words, 'middle', 'card', 11)]


def _disc(at: np.ndarray, radius: float, colour: str) -> Line:
    return Line(_round(at, radius), colour, filled=True)


def _ring(at: np.ndarray, radius: float, colour: str) -> Line:
    return Line(_round(at, radius), colour, 2.4)


def _round(at: np.ndarray, radius: float) -> np.ndarray:
    angles = np.linspace(0, 2 * math.pi, 25)
    return at + radius * np.stack([np.cos(angles), np.sin(angles)], 1)


def _actions(shown: Shown) -> str:
    report = shown.report
    rows = [(name, report.actions[k], 'c0') for k, name in enumerate(shown.robot.action_names)
            if np.any(shown.robot.moves[k])]
    rows.append(('fits none', report.misfits, 'bad'))
    largest, total = max(count for _, count, _ in rows) or 1, sum(count for _, count, _ in rows)
    width, height, left, right = 420, 16 + 34 * len(rows), 112, 326
    shapes: list[Shape] = []
    for k, (name, count, colour) in enumerate(rows):
        y = 12 + 34 * k
        end = left + (right - left) * count / largest
        shapes += [Text(left - 10, y + 16, name.replace('_', ' '), 'end', 'ink', 13),
                   Line(np.array([[left, y], [end, y], [end, y + 22], [left, y + 22]]), colour,
                        filled=True),
                   Text(end + 6, y + 16, f'{count:,} ({count / max(total, 1):.0%})')]
    return f"""<figure>{to_svg(shapes, width, height, 'actions')}<figcaption>The drive, cut into
the actions of the robot {html.escape(shown.robot.name)}. An action counts if its length is right
to {ACTION_LENGTH_TOLERANCE:.0%} and there is little motion along other axes; the rest
matches no action.</figcaption></figure>"""


def _velocities(velocities: Timeline, moved: float) -> str:
    curves = {f'{kind} {axis}': velocities.values(f'{kind} {axis}')
              for kind in ('commanded', 'measured') for axis in AXES}
    known = {name: np.isfinite(values[:, 0]).any() for name, (_, values) in curves.items()}
    kinds = [kind for kind in ('commanded', 'measured') if known[f'{kind} vx']]
    if not kinds:
        return '<p>Neither commands nor odometry were recorded.</p>'
    reach = {axis: _reach([curves[f'{kind} {axis}'][1] for kind in kinds]) for axis in AXES}
    axes = [axis for axis in AXES if axis != 'vy' or max(map(abs, reach['vy'])) > MOVING]
    width, height = 1100, 150
    shapes, top = legend([(kind, _kind_colour(kind)) for kind in kinds], 62, 4, width)
    top += 24
    for number, axis in enumerate(axes):
        series = [_series(kind, *curves[f'{kind} {axis}'], velocities.width) for kind in kinds]
        last = number == len(axes) - 1
        shapes += panel((62, top, width - 16, top + height), series, log=False, marks=(0.0,),
                        title='seconds since the recording began' if last else '',
                        y_range=reach[axis])
        shapes.append(Text(62, top - 7, NAMES[axis], 'start', 'ink', 13))
        top += height + (52 if last else 48)
    silent = 'measured' in kinds and moved > MOVING and not any(
        np.nanmax(np.abs(curves[f'measured {axis}'][1])) > 0 for axis in AXES)
    still = ' The odometry reports no velocities, though its poses move.' if silent else ''
    return f"""<figure>{to_svg(shapes, width, top, 'velocities over time')}<figcaption>Means over
{velocities.width:g} s, with the lowest and highest value in between. Without a command for
{COMMAND_TIMEOUT_S:g} s nothing is commanded.{still}</figcaption></figure>"""


def _reach(values: list[np.ndarray]) -> tuple[float, float]:
    """The range [m/s or rad/s] that shows all values, and zero."""
    low = min(0.0, *(float(np.nanmin(v)) for v in values))
    high = max(0.0, *(float(np.nanmax(v)) for v in values))
    room = max(0.08 * (high - low), MOVING)
    return (low - room if low < 0 else low), high + room


def _kind_colour(kind: str) -> str:
    return {'commanded': 'c1', 'measured': 'c0'}[kind]


def _series(kind: str, times: np.ndarray, values: np.ndarray, width: float) -> Series:
    """A curve; a base holds a command for a while and then stops."""
    values = values.copy()
    heard = np.isfinite(values[:, 0])
    if kind == 'commanded':
        since = math.inf
        for k in range(len(values)):
            since = 0.0 if heard[k] else since + width
            if not heard[k]:
                values[k] = values[k - 1] if since <= COMMAND_TIMEOUT_S else 0.0
    else:
        times, values = times[heard], values[heard]
    return Series(kind, _kind_colour(kind), times, values[:, 0], values[:, 1], values[:, 2],
                  np.ones(len(times), bool))


def _topics(shown: Shown) -> str:
    own = {name: role for role, name in vars(shown.topics).items() if name}
    topics = sorted(shown.diagnosis.topics, key=lambda t: (t.topic not in own, t.topic))
    rows = [_topic(t, own.get(t.topic, ''), shown.rates) for t in topics[:TOPICS]]
    more = f'<p>{len(topics) - TOPICS} more.</p>' if len(topics) > TOPICS else ''
    return f"""<p class="soft">Messages a second over the {_duration(shown.diagnosis.seconds)} of
the recording, by stretches of {shown.rates.width:g} s.</p>
{table(['topic', 'type', 'role', 'rate over time', 'most', 'median Hz', 'worst gap', 'messages',
        'MB'], rows, text=4)}{more}"""


def _topic(figures: TopicFigures, role: str, rates: Timeline) -> list[str]:
    times, rate = rates.rate(figures.topic)
    spark = ''
    if figures.count > 1:
        spark = f'<div class="spark">{_spark(times, rate, figures.topic)}</div>'
    return [html.escape(figures.topic), html.escape(figures.type.replace('/msg/', '/')), role,
            spark, f'{rate.max():.3g}' if spark else '',
            '' if figures.rate is None else f'{figures.rate:.3g}',
            '' if figures.worst_gap is None else f'{figures.worst_gap:.2f} s',
            f'{figures.count:,}', f'{figures.bytes / 1e6:.2f}']


def _spark(times: np.ndarray, rate: np.ndarray, name: str) -> str:
    width, height = 240, 26
    half = times[0]
    x = np.stack([times - half, times + half], 1).ravel() / (times[-1] + half) * width
    y = height - 1 - np.repeat(rate, 2) / max(rate.max(), 1e-9) * (height - 4)
    outline = np.concatenate([[[0, height - 1]], np.stack([x, y], 1), [[width, height - 1]]])
    return to_svg([Line(outline, 'c0', opacity=0.25, filled=True), Line(outline, 'c0', 1.2)],
                  width, height, f'rate of {name} over time')


def _policy(agreement: Agreement, checkpoint: str) -> str:
    episodes = ('' if not agreement.hindsight else f' In {agreement.hindsight} '
                f'episode{"s" * (agreement.hindsight != 1)} no goal was published: the last '
                'picture is used as the goal.')
    stop = (' <i>stop</i>: it would have declared arrival.'
            if STOP in agreement.columns else '')
    sure = ('' if math.isnan(agreement.done_sure) else f' It gave the executed actions a '
            f'probability of {agreement.done_sure:.0%} on average.')
    return f"""<h2>What the policy would have done</h2>
<p>{html.escape(checkpoint)} received the pictures at which actions began, and the executed
actions.{sure}{episodes}</p>
<div class="pair"><div>{_confusion(agreement)}<p class="soft">Rows: what was done; columns: the
action that the policy prefers.{stop} With sampled decoding it does not always take
the action it prefers.</p></div><div>{_steps(agreement)}</div></div>
{_worst(agreement.worst)}"""


def _confusion(agreement: Agreement) -> str:
    rows = []
    for k, name in enumerate(agreement.rows):
        counts = agreement.table[k]
        if counts.sum():
            rows.append([_words(name), *(_cell(count, counts.sum(), name, column)
                                         for count, column in zip(counts, agreement.columns,
                                                                  strict=True))])
    return table(['done \\ would', *map(_words, agreement.columns)], rows)


def _cell(count: int, total: int, done: str, would: str) -> str:
    if not count:
        return '<span class="soft">&middot;</span>'
    same = done == would or (done, would) == (END, STOP)
    # Where nothing was done that it could have done as well, there is no wrong answer.
    colour = 'good' if same else 'soft' if done in (OTHER, END) else 'bad'
    share = round(12 + 60 * count / total)
    return (f'<span class="hit" style="padding:2px 8px;border-radius:5px;background:color-mix('
            f'in srgb, var(--{colour}) {share}%, transparent)">{count:,}</span>')


def _steps(agreement: Agreement) -> str:
    rows = [[f'{j.episode + 1}.{j.step + 1}', _words(j.done), _words(j.would), _percent(j.sure),
             _percent(j.done_sure)] for j in agreement.steps]
    total = int(agreement.table.sum())
    of = f'The first {len(rows)} of {total:,}' if total > len(rows) else f'All {total:,}'
    return f"""<details><summary>{of} steps</summary><div style="max-height:420px;overflow:auto">
{table(['episode.step', 'done', 'would', 'sure', 'of the done'], rows, text=3)}</div></details>"""


def _worst(worst: list[Disagreement]) -> str:
    if not worst:
        return ''
    figures = ''.join(f'<figure><div class="both"><img alt="picture" src="{picture(d.image)}">'
                      f'<div class="goal"><img alt="goal" src="{picture(d.goal)}"></div></div>'
                      f'<figcaption>{_told(d.judged)}</figcaption></figure>' for d in worst)
    return f"""<h3>Where it disagrees most</h3><div class="strip wrap">{figures}</div>
<p class="soft">Left what it saw, right (framed) its goal; its probabilities in brackets.</p>"""


def _told(j: Judged) -> str:
    return (f'<b>{j.episode + 1}.{j.step + 1}</b> did {_words(j.done)} ({_percent(j.done_sure)})'
            f'<br>would {_words(j.would)} ({_percent(j.sure)})')


def _words(name: str) -> str:
    return html.escape(name.replace('_', ' '))


def _percent(share: float) -> str:
    return '' if math.isnan(share) else f'{share:.0%}'


def _duration(seconds: float) -> str:
    if seconds < 100:
        return f'{seconds:.1f} s'
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f'{hours} h {minutes:02d} min' if hours else f'{minutes} min {rest:02d} s'
