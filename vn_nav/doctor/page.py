"""The HTML page of `vn_nav doctor`."""

from __future__ import annotations

import html

from vn_nav import __version__
from vn_nav.bags.doctor.figures import Diagnosis
from vn_nav.doctor.seen import ERROR, OK, ORDER, WARNING, Finding, Graph, Stream
from vn_nav.report.page import cards, page, table

STYLE = """<style>
.findings td { white-space:normal; vertical-align:top; text-align:left }
.findings code { overflow-wrap:anywhere }
</style>"""
CLASSES = {ERROR: 'no', WARNING: '', OK: 'yes'}


def topic_rows(graph: Graph, *, every: bool = False) -> tuple[list[str], list[list[str]]]:
    """The topics that driving needs: headings, and rows of plain text.

    Args:
        graph: what was seen.
        every: all topics of the contract that somebody publishes or subscribes to.
    """
    headings = ['topic', 'publishers', 'subscribers', 'Hz', 'worst gap', 'lost', 'stamps behind',
                'pictures']
    rows = []
    for seen in graph.topics.values():
        there = every and (seen.publishers or seen.subscribers)
        if there or seen.stream is not None or seen.contract == 'cmd_vel':
            stream = seen.stream or Stream()
            rows.append([
                seen.name, _names(seen.publishers), _names(seen.subscribers),
                f'{1 / stream.period:.3g}' if stream.period else '',
                f'{stream.worst_gap:.2f} s' if stream.period else '',
                str(stream.lost) if stream.count else '',
                f'{stream.lag:.3g} s' if stream.lag is not None else '',
                ', '.join(stream.pictures)])
    return headings, rows


def graph_page(graph: Graph, findings: list[Finding]) -> str:
    """The page of a live graph.

    Args:
        graph: what was seen.
        findings: of it, the worst first.
    """
    headings, rows = topic_rows(graph, every=True)
    escaped = [[html.escape(cell) for cell in row] for row in rows]
    own = graph.middleware
    return _page('the graph', f'Domain {own.domain}, {own.implementation}, {len(graph.nodes)} '
                 f'node(s), listened for {graph.seconds:.1f} s.', findings,
                 f'<h2>Topics</h2>{table(headings, escaped, text=3)}'
                 f'<h2>Nodes</h2><p>{html.escape(", ".join(graph.nodes)) or "none"}</p>')


def bag_page(diagnosis: Diagnosis) -> str:
    """The page of a bag, of what `vn_nav bag doctor` found."""
    findings = [Finding('bag', found.severity, found.topic, found.what + (
        '' if found.when is None else f' (at {found.when:.2f} s, {found.count} times)'),
        found.remedy) for found in diagnosis.findings]
    findings += [Finding('note', OK, '', note) for note in diagnosis.notes]
    rows = [[html.escape(t.topic), html.escape(t.type), str(t.count),
             '' if t.rate is None else f'{t.rate:.3g}',
             '' if t.worst_gap is None else f'{t.worst_gap:.2f} s',
             html.escape(', '.join(t.pictures))] for t in diagnosis.topics]
    headings = ['topic', 'type', 'messages', 'Hz', 'worst gap', 'pictures']
    return _page(diagnosis.bag, f'{diagnosis.seconds:.1f} s recorded.', findings,
                 f'<h2>Topics</h2>{table(headings, rows, text=2)}')


def _page(what: str, about: str, findings: list[Finding], rest: str) -> str:
    counts = {severity: sum(f.severity == severity for f in findings) for severity in ORDER}
    rows = [[f'<b class="{CLASSES[f.severity]}">{f.severity}</b>', html.escape(f.check),
             html.escape(f'{f.topic} {f.seen}'.strip()),
             f'<code>{html.escape(f.fix)}</code>' if f.fix else ''] for f in findings]
    entries = [(str(counts[severity]), severity, '') for severity in ORDER]
    return page(f'{html.escape(what)}: vn_nav doctor', f"""{STYLE}<h1>{html.escape(what)}</h1>
<p class="soft">{html.escape(about)} vn_nav {__version__}.</p>
{cards(entries)}
<h2>Findings</h2><div class="findings">
{table(['', 'check', 'seen', 'fix'], rows, text=4) if rows else '<p>Nothing is wrong.</p>'}</div>
{rest}""")


def _names(ends) -> str:
    return ', '.join(sorted({end.node for end in ends}))
