"""The model card of a checkpoint: what people read of it."""

from __future__ import annotations

from vn_nav.policy.action_filter import NONE
from vn_nav.policy.checkpoint_info import PLACE, PLACE_CHECKSUM
from vn_nav.policy.network_config import SEARCH


def model_card(config: dict, parameters: int, size: int) -> str:
    """The README of a checkpoint, from the content of its `config.json`."""
    network = config['network']
    side, scenes = network['size'], config['scenes']
    searches = network['architecture'] == SEARCH
    home = 'its training environment'
    if scenes:
        home = (f'{len(scenes)} scene{"s" * (len(scenes) > 1)} ({", ".join(scenes[:8])}'
                f'{", ..." * (len(scenes) > 8)})')
    facts = {
        'Input': f'RGB {side} x {side} from a camera {config["camera_height"]:g} m above the '
                 f'floor, {config["camera_fov_deg"]:g} deg field of view; the goal picture alike',
        'Actions': ', '.join(config['action_names']),
        **({} if searches else {'Decoding': {
            'sample': 'sampled from the policy', 'greedy': 'the likeliest action'}[
            config['decoding']]}),
        'Network': f'{_describe(network)}; {parameters:,} parameters, {size / 1e6:.1f} MB',
        **({'Action filter': 'blocked actions: an action without progress is not repeated '
            'from the same place; part of every figure (docs/method.md)'}
           if network.get('action_filter', NONE) != NONE else {}),
        'Trained in': config['data'] or home,
        **({'Losses': ', '.join(config['losses']).replace('_', ' ')} if config['losses'] else {}),
        'Training': ('no episode was driven; ' if config['data'] and not config['frames'] else
                     f'{config["frames"]:,} frames (agent decisions) in ')
        + f'{config["minutes"]:.1f} minutes, seed {config["seed"]}',
        'World version': config['world_version'],
        'Weights': f'SHA-256 `{config["sha256"]}`',
        **({'Place': f'key pictures and a map in `{PLACE}`, SHA-256 `{config[PLACE_CHECKSUM]}`'}
           if PLACE_CHECKSUM in config else {}),
    }
    lines = ['# Visual navigation policy', '', _purpose(config, searches), '',
             '| | |', '|---|---|', *(f'| {key} | {value} |' for key, value in facts.items())]
    if config['command']:
        lines += ['', 'Trained with', '', '```', str(config['command']), '```']
    lines += ['', '## Measured', '']
    lines += _results_table(config['results']) or ['Nothing yet.']
    if config['notes']:
        lines += ['', '## Notes', '', str(config['notes'])]
    return '\n'.join(lines) + '\n'


def _purpose(config: dict, searches: bool) -> str:
    """What it does, and what it is given for that."""
    if searches:
        taught = (' In the place that it was taught it finds out where it is by key pictures, and '
                  'uses the map of that drive.' if PLACE_CHECKSUM in config else '')
        return ('Drives a robot to the place where a picture was taken: its networks see in each '
                'picture how far the place is free and where the goal stands; a map of the place, '
                'drawn along the way from these and from odometry, and a planner on it decide. It '
                'is given its camera, the goal picture and odometry, or else its own last action; '
                f'no {"" if taught else "map beforehand, no "}depth.{taught}')
    purpose = ('Drives a robot to the place where a picture was taken.' if not config['losses']
               else 'Weights to begin a training with (`vn_nav train --init`), pre-trained on '
               'recorded pictures. No episode was driven: whether it arrives is not known.')
    return (f'{purpose} It sees its camera, the goal picture and its own last action; no map, no '
            'depth, no pose.')


def _describe(network: dict) -> str:
    """A short description of the network."""
    if network['architecture'] == 'icra2017':
        frozen = {'': 'the small random encoder', 'resnet50': 'ResNet-50',
                  'given': "ResNet-50 in the scenes' files"}[network['frozen']]
        return (f'Zhu et al. 2017 on frozen features of {frozen}; {network["frames"]} stacked '
                f'frames; layers for {network["scenes"]} scene{"s" * (network["scenes"] > 1)}')
    if network['architecture'] == SEARCH:
        return (f'convolutions {" / ".join(map(str, network["channels"]))}, picture and goal '
                f'compared place by place (correlation volume), {network["blocks"]} residual '
                f'block(s), {network["features"]} features: pose of the goal, co-visibility, '
                'arrival; and ranges of the first obstacle along 32 bearings')
    convolutions = f'convolutions {" / ".join(map(str, network["channels"]))}, picture and goal'
    features = f'{network["features"]} features'
    parts = [{'thesis': "the thesis's two streams", 'unreal': "UNREAL's single stream",
              'fused': f'{convolutions} fused in the first; {features}',
              'matching': f'{convolutions} compared place by place (correlation volume); '
                          f'{features}'}[network['architecture']]]
    if network['blocks']:
        parts.append(f'{network["blocks"]} residual block(s) a stage')
    if network.get('moves'):
        parts.append('the goal tracked by dead reckoning')
    parts.append(f'{network["frames"]} stacked frames' if network['frames'] > 1
                 else f'LSTM {network["hidden"]}')
    if network['heads']:
        parts.append(f'heads {", ".join(network["heads"]).replace("_", " ")}')
    return '; '.join(parts)


def _results_table(results: dict) -> list[str]:
    """One row for each nested mapping, its figures as columns; other values as a list.

    Rows that have no figure in common stand in tables of their own.
    """
    rows = {name: row for name, row in results.items() if isinstance(row, dict)}
    tables: list[dict[str, dict]] = []
    for name, row in rows.items():
        for own in tables:
            if not row or any(row.keys() & other.keys() for other in own.values()):
                own[name] = row
                break
        else:
            tables.append({name: row})
    lines: list[str] = []
    for own in tables:
        columns = list(dict.fromkeys(key for row in own.values() for key in row))
        lines += [*([''] if lines else []),
                  '| | ' + ' | '.join(key.replace('_', ' ') for key in columns) + ' |',
                  '|---' * (len(columns) + 1) + '|']
        lines += [f'| {name.replace("_", " ")} | '
                  + ' | '.join(_figure(row.get(key, '')) for key in columns) + ' |'
                  for name, row in own.items()]
    single = [f'- {name.replace("_", " ")}: {_figure(value)}' for name, value in results.items()
              if name not in rows]
    return lines + ([''] if rows and single else []) + single


def _figure(value: object) -> str:
    if isinstance(value, float):
        return f'{value:.3g}' if abs(value) < 1000 else f'{value:,.0f}'
    if isinstance(value, (list, tuple)):
        return ' to '.join(_figure(part) for part in value)
    return str(value)
