"""Every job for a machine with a GPU, in one command.

    pip install -e '.[gpu,onnx]'
    python bench/gpu/run.py --out results.jsonl --curves curves

Parts: `render` (agreement with the Numba renderer, rendering and environment rates), `train`
(frames/s of whole training loops by preset and number of environments), `learn` (real trainings in
one house, their curves and checkpoints) and `export` (what the GPU-trained weights say on the CPU
and in ONNX Runtime). Where a command may take ten minutes only, `--parts render`, `--parts train`
and `--parts learn export` fit into one each. `--parts reproduce` runs the thesis's experiments at
full size (docs/reproduce.md), as long as it takes, and goes on where it was interrupted;
`--experiments`, `--frames` and `--limit-minutes` say how much.

Prints one JSON line a figure, with the hardware's name. Every part and preset is a process of its
own: one that fails or takes too long leaves a line with its error, and the rest goes on. `--device
cpu` runs the same kernels slowly, to try the script.
"""

import argparse
import contextlib
import gc
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch

from vn_nav.cli.interruption import ended_as_by_ctrl_c
from vn_nav.scenes import house_scenes

PARTS = ('render', 'train', 'learn', 'export')
REPRODUCE = 'reproduce'  # days of work: only where it is named
EXPERIMENTS = ('fig5.4', 'fig5.5', 'fig5.6', 'fig5.7', 'ablation')
PRESETS = ('a2c', 'unreal', 'thesis', 'fast')
LEARNED = ('fast', 'thesis')
ROUNDS = 7
WARM_UP = 2  # updates
PATIENCE = 90.0  # s that trainings may take to save and end
HOUSE, ROOMS, MAX_DECISIONS = 3, 2, 300  # of the table of presets (bench/learning.py)
FACTS = {'camera_fov_deg': 90.0, 'camera_height': 1.0}


def parse():
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--device', default='cuda:0')
    parser.add_argument('--out', type=Path, help='also append the lines here')
    parser.add_argument('--parts', nargs='+', choices=(*PARTS, REPRODUCE),
                        default=list(PARTS))
    parser.add_argument('--limit-minutes', type=float, help='for everything (default: 60, or with '
                        f'{REPRODUCE} no limit)')
    parser.add_argument('--envs', type=int, nargs='+', default=[64, 256, 1024, 4096, 16384],
                        help='of render')
    parser.add_argument('--sizes', type=int, nargs='+', default=[84, 174], help='of render')
    parser.add_argument('--seconds', type=float, default=1.0, help='of a round of render')
    parser.add_argument('--presets', nargs='+', choices=PRESETS, default=list(PRESETS),
                        help='of train, and of learn and export where these are among them')
    parser.add_argument('--train-envs', type=int, nargs='+', default=[256, 1024, 4096, 8192])
    parser.add_argument('--train-size', type=int, default=84, help='of train and learn [pixels]')
    parser.add_argument('--train-seconds', type=float, default=12.0, help='of each figure')
    parser.add_argument('--learn-envs', type=int, default=256)
    parser.add_argument('--learn-minutes', type=float, default=4.0, help='of each training')
    parser.add_argument('--experiments', nargs='+', choices=EXPERIMENTS,
                        default=list(EXPERIMENTS), help='of reproduce')
    parser.add_argument('--frames', type=int, help="of a run of reproduce; default: the thesis's")
    parser.add_argument('--runs', type=Path, default=Path('runs/reproduce'),
                        help='folder of the runs of reproduce')
    parser.add_argument('--curves', type=Path, default=Path('bench/gpu/curves'),
                        help='folder for the curves and checkpoints of learn')
    parser.add_argument('--job', help=argparse.SUPPRESS)  # what a child process does
    arguments = parser.parse_args()
    if arguments.limit_minutes is None:
        arguments.limit_minutes = math.inf if REPRODUCE in arguments.parts else 60.0
    return arguments


def jobs(arguments) -> list[str]:
    """What child processes do, one each."""
    learned = [name for name in LEARNED if name in arguments.presets]
    found = {'render': ['render'], 'train': [f'train {name}' for name in arguments.presets],
             'learn': [f'learn {name}' for name in learned],
             'export': [f'export {name}' for name in learned],
             REPRODUCE: [f'{REPRODUCE} {name}' for name in arguments.experiments]}
    return [job for part in found if part in arguments.parts for job in found[part]]


def hardware(device: str) -> str:
    """The name of the GPU, or of the processor."""
    from vn_nav.cli.world import machine
    return machine(device)


def say(arguments, name, value, unit, conditions, **more):
    """One figure."""
    line = json.dumps({'name': name, 'value': value, 'unit': unit, 'peer': None,
                       'peer_value': None, 'ratio': None,
                       'conditions': f'{conditions}; {hardware(arguments.device)}', **more})
    print(line, flush=True)
    if arguments.out:
        with open(arguments.out, 'a') as file:
            file.write(line + '\n')


def clear(device: str) -> None:
    """Give the memory back before the next figure."""
    gc.collect()
    if device != 'cpu':
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()


def device_env(arguments, **options):
    """The environment on the device."""
    from vn_sim_bridge.navigation.env_config import EnvConfig
    from vn_sim_bridge.navigation.warp_env import WarpNavigationEnv
    return WarpNavigationEnv(EnvConfig(**options), device=arguments.device)


# Part render.

def rate(step, frames: int, device: str, seconds: float) -> list[float]:
    """Frames a second, round by round, after a warm-up; the device finishes before the clock."""
    import warp as wp
    step()
    wp.synchronize_device(device)
    values = []
    for _ in range(ROUNDS):
        begun, count = time.perf_counter(), 0
        while time.perf_counter() - begun < seconds:
            step()
            wp.synchronize_device(device)
            count += frames
        values.append(count / (time.perf_counter() - begun))
    return values


def agreement(arguments) -> dict:
    """How far the device's pictures are from the Numba renderer's, on the same episodes."""
    from vn_sim_bridge.navigation.env import NavigationEnv
    from vn_sim_bridge.navigation.env_config import EnvConfig
    config = {'scenes': house_scenes((1, 2, 3), 6), 'num_envs': 48}
    host, other = NavigationEnv(EnvConfig(**config)), device_env(arguments, **config)
    host.reset(seed=0)
    other.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(20):
        actions = rng.integers(0, len(host.action_names), 48)
        mine, *_, facts = host.step(actions)
        theirs, *_, device_facts = other.step(torch.from_numpy(actions).to(arguments.device))
    labels = host.simulator.observe().labels
    gap = np.abs(mine['image'].astype(int) - theirs['image'].cpu().numpy().astype(int))
    return {'labels_equal': float((labels == device_facts['segmentation'].cpu().numpy()).mean()),
            'rgb_within_2': float((gap <= 2).mean()),
            'largest_pose_difference': float(np.abs(
                facts['pose'] - device_facts['pose'].cpu().numpy()).max())}


def render(arguments):
    """All sizes; what does not fit into the memory is said and left out."""
    say(arguments, 'agreement with the Numba renderer', None, '', '48 environments, 84 x 84',
        **agreement(arguments))
    for size in arguments.sizes:
        for envs in arguments.envs:
            conditions = f'{size} x {size}, {envs} environments, 16 houses of six rooms'
            try:
                env = device_env(arguments, scenes=house_scenes(range(16), 6), num_envs=envs,
                                 size=size)
                env.reset(seed=0)
                actions = torch.randint(0, len(env.action_names), (envs,),
                                        device=arguments.device)
                frames = rate(lambda: env.step(actions), envs, arguments.device,  # noqa: B023
                              arguments.seconds)
                draw = rate(env._observe, envs, arguments.device, arguments.seconds)
            except (RuntimeError, MemoryError) as error:
                say(arguments, 'environment on the device', None, 'frames/s', conditions,
                    error=str(error)[:300])
                continue
            finally:
                env = None
                clear(arguments.device)
            for name, values in (('renderer on the device, RGB + depth + labels', draw),
                                 ('environment on the device', frames)):
                say(arguments, name, round(float(np.median(values))), 'frames/s', conditions,
                    range=[round(min(values)), round(max(values))])


# Parts train and learn: `vn_nav.learning.trainer.train`, and nothing around it.

def run_training(arguments, name: str, envs: int, minutes: float, folder: Path, houses, rooms: int,
                 world: dict, **changes) -> list[dict]:
    """Train a preset on the device; the rows of its metrics."""
    from vn_nav.learning.presets import ENVIRONMENT, preset
    from vn_nav.learning.trainer import train
    config = preset(name, imitation=0.0, teacher_share=0.0, pair_minutes=0.0, frames=10**9,
                    minutes=minutes, device=arguments.device, checkpoint_seconds=3600.0, **changes)
    computed = {'depth', 'segmentation', 'goal_segmentation', 'goal_pose', 'overlap'}
    world = {**ENVIRONMENT[name], **world, 'num_envs': envs}
    del world['envs']
    env = device_env(arguments, scenes=house_scenes(houses, rooms), size=arguments.train_size,
                     privileged=tuple(sorted(set(config.privileged) & computed)), **world)
    rows = []
    facts = FACTS | {'world_version': env.world_version, 'scenes': list(env.config.scenes),
                     'preset': name, 'notes': f'Trained on {hardware(arguments.device)}.'}
    train(env, config, folder, info=facts, on_update=rows.append)
    return rows


def speed(rows: list[dict]) -> tuple[float, float]:
    """Frames a second of a training, and the share of it that collects, after the warm-up."""
    first = min(WARM_UP, len(rows) - 1) - 1
    later = rows[first + 1:]
    begun = rows[first] if first >= 0 else {'frames': 0, 'minutes': 0.0}
    collect, update = (sum(row[f'{part}_seconds'] for row in later)
                       for part in ('collect', 'update'))
    minutes = rows[-1]['minutes'] - begun['minutes']
    return (rows[-1]['frames'] - begun['frames']) / minutes / 60, collect / (collect + update)


def memory(device: str) -> dict:
    """What torch took at its peak, and what the device has given to all by now [GB]."""
    if device == 'cpu':
        return {}
    free, total = torch.cuda.mem_get_info()
    return {'torch_peak_gb': round(torch.cuda.max_memory_reserved() / 1e9, 2),
            'device_used_gb': round((total - free) / 1e9, 2)}


def training(arguments, name: str):
    """Frames/s of the whole loop: acting, simulating, drawing, learning, logging."""
    batches = ['preset', 'environments'] if name in ('unreal', 'thesis') else ['preset']
    for envs in arguments.train_envs:
        for batch in batches:
            # The replayed tasks' share of the work: of the preset's 16 sequences for 16
            # environments, or as many for more of them.
            changes = {'replay_batch': envs} if batch == 'environments' else {}
            conditions = (f'{arguments.train_size} x {arguments.train_size}, {envs} environments, '
                          '16 houses of six rooms, end to end')
            if len(batches) > 1:
                conditions += f', {changes.get("replay_batch", 16)} sequences replayed a task'
            try:
                with tempfile.TemporaryDirectory() as folder:
                    rows = run_training(arguments, name, envs, arguments.train_seconds / 60,
                                        Path(folder) / 'run', tuple(range(16)), 6, {}, **changes)
                frames, collecting = speed(rows)
            except Exception as error:  # whatever it is, the other figures are to come
                say(arguments, f'training on the device, {name}', None, 'frames/s', conditions,
                    error=f'{type(error).__name__}: {str(error)[:300]}')
                clear(arguments.device)
                if 'CUDA error' in str(error):
                    raise  # nothing works any more in this process
                continue
            say(arguments, f'training on the device, {name}', round(frames), 'frames/s',
                conditions, updates=len(rows), collecting=round(collecting, 3),
                updating=round(1 - collecting, 3),
                minutes_for_4e7_frames=round(4e7 / frames / 60, 1), **memory(arguments.device))
            clear(arguments.device)


def learn(arguments, name: str):
    """A real training in one house: its curve, and a checkpoint."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / 'run'
        rows = run_training(arguments, name, arguments.learn_envs, arguments.learn_minutes, run,
                            (HOUSE,), ROOMS, {'max_decisions': MAX_DECISIONS})
        target = arguments.curves / name
        shutil.rmtree(target, ignore_errors=True)
        target.mkdir(parents=True)
        shutil.copy(run / 'metrics.csv', target)
        shutil.copytree(run / 'checkpoint', target / 'checkpoint')
    size = arguments.train_size
    conditions = (f'house {HOUSE}, {ROOMS} rooms, {size} x {size}, {arguments.learn_envs} '
                  f'environments, {arguments.learn_minutes:g} minutes')
    good = [row for row in rows if row['tau'] >= 1 and row['success'] >= 0.9]
    success = rows[-1]['success']
    say(arguments, f'learning on the device, {name}: success of the last 200 episodes',
        round(success, 3) if success >= 0 else None, '', conditions, tau=round(rows[-1]['tau'], 2),
        frames=rows[-1]['frames'], frames_per_second=round(speed(rows)[0]),
        minutes_to_90=round(good[0]['minutes'], 2) if good else None)


# Part export.

def export(arguments, name: str):
    """GPU-trained weights on the CPU and in ONNX Runtime, against the device, on real pictures."""
    from vn_nav.observation import Observation
    from vn_nav.policy.checkpoint import load_checkpoint
    checkpoint = load_checkpoint(arguments.curves / name / 'checkpoint')
    size, steps = checkpoint.config.size, 100
    env = device_env(arguments, scenes=house_scenes((HOUSE,), ROOMS), num_envs=1, size=size)
    draws = torch.Generator().manual_seed(0)
    seen, info = env.reset(seed=0)
    rows = []
    for _ in range(steps):
        rows.append({**{key: value.cpu().clone() for key, value in seen.items()},
                     'start': info['reset'].cpu().clone()})
        action = torch.randint(0, len(env.action_names), (1,), generator=draws)
        seen, *_, info = env.step(action.to(arguments.device))

    @torch.inference_mode()
    def torch_says(network, device):
        state, logits = network.initial_state(1), []
        for row in rows:
            row = {key: value.to(device).unsqueeze(0) for key, value in row.items()}
            observation = Observation(row['image'], env.goals.to(device), row['goal_index'],
                                      row['last_action'], row['last_reward'])
            output, state = network(observation, row['start'], state)
            logits.append(output.logits[0, 0].float().cpu().numpy())
        return np.array(logits)

    host = torch_says(checkpoint.network, 'cpu')
    said = {'PyTorch on the device': torch_says(checkpoint.network.to(arguments.device),
                                                arguments.device)}
    checkpoint.network.cpu()
    try:
        said['ONNX Runtime'] = onnx_says(checkpoint, rows, env.goals.cpu())
    except Exception as error:  # packages may be missing
        say(arguments, f'ONNX Runtime says what PyTorch says, {name}', None, '',
            f'{steps} decisions', error=f'{type(error).__name__}: {str(error)[:300]}')
    for what, logits in said.items():
        say(arguments, f'{what} against PyTorch on the CPU, {name}: largest difference of a logit',
            float(np.abs(logits - host).max()), '', f'{steps} decisions, weights trained here',
            largest_logit=float(np.abs(host).max()),
            likeliest_action_equal=float((logits.argmax(1) == host.argmax(1)).mean()))


def onnx_says(checkpoint, rows, goals) -> np.ndarray:
    """The logits of exported files."""
    import onnxruntime

    from vn_nav.policy.checkpoint_info import GOAL, POLICY
    from vn_nav.policy.export import export_onnx
    with tempfile.TemporaryDirectory() as folder:
        export_onnx(checkpoint, folder)
        goal, policy = (onnxruntime.InferenceSession(
            str(Path(folder) / name), providers=['CPUExecutionProvider'])
            for name in (GOAL, POLICY))
    outputs = [part.name for part in policy.get_outputs()]
    shapes = {part.name: part.shape for part in policy.get_inputs()}
    state = {name: np.zeros(shapes[name], np.float32) for name in ('hidden', 'cell')}
    logits = []
    for row in rows:
        (maps,) = goal.run(None, {'picture': goals[row['goal_index']].numpy()})
        said = dict(zip(outputs, policy.run(None, {
            'image': row['image'].numpy(), 'goal': maps, 'start': row['start'].numpy(),
            'last_action': row['last_action'].numpy(), 'last_reward': row['last_reward'].numpy(),
            **state}), strict=True))
        state = {name: said[f'next_{name}'] for name in state}
        logits.append(said['logits'][0])
    return np.array(logits)


# Part reproduce.

def reproduce(arguments, name: str):
    """An experiment of the thesis at full size: pages and curves beside those of `learn`."""
    words = [] if arguments.frames is None else ['--frames', str(arguments.frames)]
    results = arguments.curves / REPRODUCE
    subprocess.run([sys.executable, '-m', 'vn_nav.cli', 'reproduce', name, '--full', '--device',
                    arguments.device, '--out', str(arguments.runs), '--results', str(results),
                    *words], check=True)
    say(arguments, f'reproduced: {name}', None, '', f'figures in {results}')


def run_job(command: list[str], limit: float) -> None:
    """One job; at the limit, or when somebody ends this one, all that it has started ends first.

    Raises:
        subprocess.SubprocessError: it failed, or took too long.
    """
    with subprocess.Popen(command, start_new_session=True) as process:
        try:
            code = process.wait(None if math.isinf(limit) else limit)
        except BaseException:
            end_group(process)
            raise
    if code:
        raise subprocess.CalledProcessError(code, command)


def end_group(process: subprocess.Popen) -> None:
    """Ask a process and its group to save and end; kill those that do not."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        deadline = time.monotonic() + PATIENCE
        with contextlib.suppress(ProcessLookupError):  # none is left
            os.killpg(process.pid, number)
            while time.monotonic() < deadline:
                process.poll()
                os.killpg(process.pid, 0)
                time.sleep(0.1)
            continue
        break


def main():
    """Run the jobs as children, each within what is left of the time."""
    arguments = parse()
    if arguments.job:
        part, _, name = arguments.job.partition(' ')
        work = {'render': render, 'train': training, 'learn': learn, 'export': export,
                REPRODUCE: reproduce}[part]
        work(arguments, *([name] if name else []))
        return
    with ended_as_by_ctrl_c():
        sys.exit(run_all(arguments) > 0)


def run_all(arguments) -> int:
    """Every job within what is left of the time; how many failed."""
    begun, failed = time.monotonic(), 0
    for job in jobs(arguments):
        left = 60 * arguments.limit_minutes - (time.monotonic() - begun)
        try:
            if left <= 0:
                raise TimeoutError('no time is left')
            run_job([sys.executable, __file__, *sys.argv[1:], '--job', job], left)
        except (subprocess.SubprocessError, TimeoutError) as error:
            failed += 1
            say(arguments, job, None, '', f'limit {arguments.limit_minutes:g} minutes',
                error=f'{type(error).__name__}: {str(error)[-300:]}')
    return failed


if __name__ == '__main__':
    main()
