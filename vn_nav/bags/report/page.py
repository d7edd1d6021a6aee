"""The HTML page of `vn_nav bag show`: a drive at a glance, in one file."""

from __future__ import annotations

import datetime
import html
import math

from vn_nav import __version__
from vn_nav.bags.doctor.figures import ERROR, Finding, TopicFigures
from vn_nav.bags.report.figures import MAX_STRIP_PICTURES, Timeline
from vn_nav.bags.report.page_agreement import policy_part
from vn_nav.bags.report.page_charts import action_bars, path_map, rate_chart, velocity_chart
from vn_nav.bags.report.show import Shown
from vn_nav.report.page import cards, page, picture, table

MAX_LISTED_TOPICS = 60  # listed, at most
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
    policy = policy_part(shown.agreement, checkpoint) if shown.agreement else ''
    return page(f'{name}: vn_nav bag show', f"""{STYLE}<h1>{name}</h1>
<p class="soft">{html.escape(bag)}, recorded from {when:%Y-%m-%d %H:%M:%S} UTC.
vn_nav {__version__}.</p>
{_cards(shown)}
{_findings(shown.diagnosis.findings)}
{_film(shown)}
<div class="pair"><div><h2>Where it went</h2>{path_map(shown)}</div>
<div><h2>What it did</h2>{action_bars(shown)}</div></div>
<h2>How fast</h2>{velocity_chart(shown.velocities, shown.odometer.progress)}
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


def _topics(shown: Shown) -> str:
    own = {name: role for role, name in vars(shown.topics).items() if name}
    topics = sorted(shown.diagnosis.topics, key=lambda t: (t.topic not in own, t.topic))
    rows = [_topic(t, own.get(t.topic, ''), shown.rates) for t in topics[:MAX_LISTED_TOPICS]]
    more = len(topics) - MAX_LISTED_TOPICS
    rest = f'<p>{more} more.</p>' if more > 0 else ''
    return f"""<p class="soft">Messages a second over the {_duration(shown.diagnosis.seconds)} of
the recording, by stretches of {shown.rates.width:g} s.</p>
{table(['topic', 'type', 'role', 'rate over time', 'most', 'median Hz', 'worst gap', 'messages',
        'MB'], rows, text=4)}{rest}"""


def _topic(figures: TopicFigures, role: str, rates: Timeline) -> list[str]:
    times, rate = rates.rate(figures.topic)
    spark = ''
    if figures.count > 1:
        spark = f'<div class="spark">{rate_chart(times, rate, figures.topic)}</div>'
    return [html.escape(figures.topic), html.escape(figures.type.replace('/msg/', '/')), role,
            spark, f'{rate.max():.3g}' if spark else '',
            '' if figures.rate is None else f'{figures.rate:.3g}',
            '' if figures.worst_gap is None else f'{figures.worst_gap:.2f} s',
            f'{figures.count:,}', f'{figures.bytes / 1e6:.2f}']


def _duration(seconds: float) -> str:
    if seconds < 100:
        return f'{seconds:.1f} s'
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f'{hours} h {minutes:02d} min' if hours else f'{minutes} min {rest:02d} s'
