"""What comes out bit for bit the same again: under other threads, and under other instructions of the processor.

    python benchmarks/reproducibility.py            # about ten minutes on one core
    python benchmarks/reproducibility.py --digests  # this process alone: to compare with another machine

Each part is computed in a process of its own setting and reduced to a digest of its bytes. A part that takes in what an
earlier one made (an adaptation, a policy) is given the same file in every setting, so that each answers for itself.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

SETTINGS: dict[str, dict[str, str]] = {
    "the same again": {},
    "PyTorch without AVX": {
        "ATEN_CPU_CAPABILITY": "default", "ONEDNN_MAX_CPU_ISA": "SSE41", "MKL_ENABLE_INSTRUCTIONS": "SSE4_2",
    },
    "OpenBLAS for Haswell": {"OPENBLAS_CORETYPE": "Haswell"},
    "OpenBLAS for Nehalem": {"OPENBLAS_CORETYPE": "Nehalem"},
    "NumPy without AVX": {"NPY_DISABLE_CPU_FEATURES": "X86_V4 X86_V3 AVX512_ICL AVX512_SPR"},
    "Numba for any x86-64": {"NUMBA_CPU_NAME": "generic", "NUMBA_CPU_FEATURES": ""},
    "PyTorch, 2 threads": {"OMP_NUM_THREADS": "2"},
    "PyTorch, 2 threads, again": {"OMP_NUM_THREADS": "2"},
    "Numba, 2 threads": {"NUMBA_NUM_THREADS": "2"},
}  # fmt: skip
ONE_THREAD = {
    "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1",
    "OMP_WAIT_POLICY": "passive", "KMP_BLOCKTIME": "0",  # threads that wait take no time from the others
}  # fmt: skip


def digest(*values: object) -> str:
    """Of the bytes of arrays, and of the text of anything else."""
    total = hashlib.sha256()
    for value in values:
        total.update(np.ascontiguousarray(value).tobytes() if isinstance(value, np.ndarray) else repr(value).encode())
    return total.hexdigest()[:12]


def tracks(folder: Path) -> str:
    from outlap.track.generate import generate_track

    made = [generate_track(seed, length=120.0) for seed in (3, 7)]
    return digest(*(track.fingerprint for track in made), *(track.centerline.table() for track in made))


def simulator(folder: Path) -> str:
    from outlap.envs import make_race_vector
    from outlap.track.generate import generate_track

    found = []
    circuit = generate_track(3, length=120.0)
    for model in ("kinematic", "single_track", "drift"):
        env = make_race_vector(
            64, tracks=[circuit], num_cars=2, model=model, beams=108, vehicle={"mu": (0.5, 1.1)},
            lidar={"noise_std": 0.02}, start={"speed": (0.0, 6.0)},
        )  # fmt: skip
        env.reset(seed=0)
        rng = np.random.default_rng(0)
        for _ in range(200):
            observation, rewards, *_ = env.step(rng.uniform(-1.0, 1.0, (64, 2)))
            found += [rewards, observation["scan"]]
        found += [env.race.worlds.state, env.race.worlds.frenet]
    return digest(*found)


def raceline(folder: Path) -> str:
    from outlap.planning.limits import CarLimits
    from outlap.planning.plan import plan_line
    from outlap.simulator.vehicle import VehicleParams
    from outlap.track.generate import generate_track

    circuit = generate_track(1, length=60.0)
    lines = [plan_line(circuit, CarLimits.of(VehicleParams(v_max=8.0)), how) for how in ("min-curvature", "min-time")]
    return digest(*(array for line in lines for array in (line.path.points, line.speed)))


def _small(config, **changes):
    env = config.env.model_copy(update={"tracks": ("Alderbrook",), "augment_tracks": False})
    return config.model_copy(update={"env": env, "threads": 0, **changes})


def _trained(config, path: Path) -> str:
    """Learning curve and final weights."""
    from outlap.training.model_file import load_model
    from outlap.training.session import train

    rows: list[tuple] = []
    keep = ("steps", "crash_rate", "mean_speed_mps", "progress_m")
    run = train(config, path, on_progress=lambda now: rows.append(tuple(getattr(now, name) for name in keep)))
    policy = load_model(config, run.policy_path).policy
    return digest(rows, *(value.numpy() for value in policy.state_dict().values()))


def ppo(folder: Path) -> str:
    from outlap.training.ppo import PPOConfig

    config = _small(PPOConfig(), total_steps=16_384, num_envs=64, net_arch=(256, 256), checkpoint_every=10**9)
    return _trained(config, folder / "ppo")


def mql(folder: Path) -> str:
    from outlap.training.mql import MQLConfig

    config = _small(MQLConfig(), total_steps=6_400, num_envs=64, learning_starts=3_200, checkpoint_every=10**9)
    return _trained(config, folder / "mql")


def adaptation(folder: Path) -> str:
    from outlap.envs import RaceVectorEnv, SB3VecEnv
    from outlap.mql.adaptation import adapt
    from outlap.mql.config import AdaptationConfig
    from outlap.mql.mql import MQL
    from outlap.training.run import load_run

    run = load_run(folder / "given" / "mql")
    meta = MQL.load(run.policy_path, device="cpu")
    meta.load_replay_buffer(run.replay_path)
    task = SB3VecEnv(RaceVectorEnv(8, run.config.env.model_copy(update={"tracks": ("Brackenfell",)})))
    task.seed(3)
    policy, record = adapt(meta, task, AdaptationConfig(iterations=2, collect_steps=40))
    return digest(repr(record.updates), *(value.numpy() for value in policy.state_dict().values()))


def _rows(driver, folder: Path) -> str:
    from outlap.evaluation.protocol import standing_starts
    from outlap.evaluation.rollout import evaluate
    from outlap.track import load_track
    from outlap.training.run import load_run

    track = load_track("Cinderhill")
    task = standing_starts(load_run(folder / "given" / "ppo").config.env, [track], laps=0, time_limit=15.0)
    return digest(evaluate(driver, task, [track], episodes=16, seed=1).to_csv())


def evaluation(folder: Path) -> str:
    """Of a perceptron of the shipped population, which NumPy multiplies."""
    from outlap.drivers.mlp import MLPDriver
    from outlap.drivers.population import SHIPPED

    return _rows(MLPDriver.load(SHIPPED / "Emberley-2.0"), folder)


def policy_evaluation(folder: Path) -> str:
    """Of a PPO policy, which PyTorch multiplies."""
    from outlap.drivers.policy import PolicyDriver
    from outlap.training.model_file import load_model
    from outlap.training.run import load_run

    run = load_run(folder / "given" / "ppo")
    model = load_model(run.config, run.policy_path)
    return _rows(PolicyDriver(model, scale_observations=True, speeds=(1.0, 8.0)), folder)


def statistics(folder: Path) -> str:
    from outlap.evaluation.statistics import estimate_mean, interquartile_mean, stratified_bootstrap, wilson_interval

    scores = np.random.default_rng(0).normal(size=(5, 40))
    interval = stratified_bootstrap([scores], lambda found: interquartile_mean(found[0]), resamples=500)
    return digest(interval, estimate_mean(scores.mean(axis=1)), wilson_interval(3, 300))


PARTS: dict[str, Callable[[Path], str]] = {
    "generated tracks": tracks,
    "simulator": simulator,
    "racing lines": raceline,
    "training, PPO": ppo,
    "training, MQL": mql,
    "adaptation": adaptation,
    "evaluation, NumPy": evaluation,
    "evaluation, PyTorch": policy_evaluation,
    "statistics": statistics,
}


def digests(folder: Path) -> dict[str, str]:
    """Of every part, in this process; `folder`/given holds the runs to adapt and to evaluate."""
    import torch

    os.environ["OUTLAP_CACHE"] = str(folder / "cache")
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", "1")))  # as the field `threads` does
    found = {}
    for name, part in PARTS.items():
        found[name] = part(folder)
        if name == "training, MQL" and not (folder / "given").exists():
            (folder / "given").mkdir()
            for run in ("ppo", "mql"):
                (folder / "given" / run).symlink_to(folder / run)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--digests", action="store_true", help="of this process alone, as JSON")
    parser.add_argument("--settings", nargs="+", choices=SETTINGS, default=[*SETTINGS], help="by default all")
    parser.add_argument("--folder", type=Path, help="for the runs; by default a temporary one")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        if options.digests:
            print(json.dumps(digests(folder)))
            return
        first = in_process({}, folder / "first")
        print(f"{'':28}" + " | ".join(PARTS))
        for number, name in enumerate(options.settings):
            own = folder / str(number)
            own.mkdir()
            (own / "given").symlink_to(folder / "first")
            found = in_process(SETTINGS[name], own)
            marks = ["same" if found[part] == first[part] else found[part] for part in PARTS]
            print(
                f"{name:28}" + " | ".join(f"{mark:>{len(part)}}" for mark, part in zip(marks, PARTS, strict=True)),
                flush=True,
            )


def in_process(setting: dict[str, str], folder: Path) -> dict[str, str]:
    """The digests of a process with other environment variables."""
    folder.mkdir(parents=True, exist_ok=True)
    command = [sys.executable, __file__, "--digests", "--folder", str(folder)]
    run = subprocess.run(command, env={**os.environ, **ONE_THREAD, **setting}, stdout=subprocess.PIPE, check=True)
    return json.loads(run.stdout.splitlines()[-1])


if __name__ == "__main__":
    main()
