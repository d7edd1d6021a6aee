"""The part of `vn_nav bag show` about what a policy would have done along the drive."""

from __future__ import annotations

import html
import math

from vn_nav.bags.report.agreement import END, OTHER, STOP, Agreement, Disagreement, Judged
from vn_nav.report.page import picture, table


def policy_part(agreement: Agreement, checkpoint: str) -> str:
    """Heading, table and pictures.

    Args:
        agreement: of the policy with the drive.
        checkpoint: path of the policy.
    """
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
            rows.append([_label(name), *(_cell(count, counts.sum(), name, column)
                                         for count, column in zip(counts, agreement.columns,
                                                                  strict=True))])
    return table(['done \\ would', *map(_label, agreement.columns)], rows)


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
    rows = [[f'{j.episode + 1}.{j.step + 1}', _label(j.done), _label(j.would), _percent(j.sure),
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
                      f'<figcaption>{_caption(d.judged)}</figcaption></figure>' for d in worst)
    return f"""<h3>Where it disagrees most</h3><div class="strip wrap">{figures}</div>
<p class="soft">Left what it saw, right (framed) its goal; its probabilities in brackets.</p>"""


def _caption(j: Judged) -> str:
    return (f'<b>{j.episode + 1}.{j.step + 1}</b> did {_label(j.done)} ({_percent(j.done_sure)})'
            f'<br>would {_label(j.would)} ({_percent(j.sure)})')


def _label(name: str) -> str:
    return html.escape(name.replace('_', ' '))


def _percent(share: float) -> str:
    return '' if math.isnan(share) else f'{share:.0%}'
