"""How long commands take to end after Ctrl-C: real processes, interrupted at several moments as a terminal does it.

    python benchmarks/interrupts.py --json benchmarks/interrupts.json
    python benchmarks/interrupts.py --commands "reproduce ray" "tune ray" --moments 15 30 45

SIGINT goes to the whole process group. A row a command and moment: the seconds from the signal until the command has
ended, and until all the processes that it began are gone, Ray's as well; the exit code, what was said, and whether that
was a traceback. Works in a temporary folder.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

MOMENTS = (3.0, 12.0, 25.0)  # [s] after the start: from imports to the midst of the work
PATIENCE = 60.0  # [s] until a process is taken for one that hangs
ENDLESS = "1_000_000_000"
LEAVING = 20.0  # [s] that processes have after the command
RAY = ["--engine", "ray", "--address", "local"]
SEARCH = """
algorithm: ppo
training: {total_steps: 1000000000, env: {tracks: [Foxglove]}}
search: {gamma: [0.9, 0.99]}
"""

# What each command is started with; META stands for a run folder of `train mql`, SEARCH for a file of `tune`, OUT for
# a new folder.
COMMANDS: dict[str, list[str]] = {
    "train ppo": ["--total-steps", ENDLESS, "--out", "OUT"],
    "train recurrent-ppo": ["--total-steps", ENDLESS, "--out", "OUT"],
    "train mql": ["--total-steps", ENDLESS, "--learning-starts", "5_000", "--out", "OUT"],
    "opponents train": ["--track", "Foxglove", "--total-steps", ENDLESS, "--out", "OUT"],
    "reproduce": ["table-1", "table-2", "--budget", "smoke", "--out", "OUT"],
    "evaluate": ["META", "--episodes", "5_000", "--out", "OUT"],
    "adapt": ["META", "--seeds", "100", "--out", "OUT"],
}
# On a cluster that they begin on this machine.
WITH_RAY: dict[str, list[str]] = {
    "reproduce ray": [*COMMANDS["reproduce"], *RAY],
    "opponents train ray": [*COMMANDS["opponents train"], *RAY],
    "tune ray": ["SEARCH", "--out", "OUT", *RAY],
}


class Interrupted(NamedTuple):
    """One command, interrupted once."""

    command: str
    after_s: float  # [s] from its start to the signal
    seconds: float | None  # from the signal until it had ended; None: it was done before the signal
    all_gone_s: float | None  # until its processes were gone, too; None: some were there after `LEAVING`
    code: int
    traceback: bool
    said: str  # the last lines


def main() -> None:
    commands = COMMANDS | WITH_RAY
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--commands", nargs="+", choices=commands, default=list(COMMANDS), help="those to interrupt")
    parser.add_argument("--moments", nargs="+", type=float, default=MOMENTS, help="[s] after the start")
    parser.add_argument("--full-replay", type=int, default=0, help="rows of a replay that `train mql` goes on with")
    parser.add_argument("--json", type=Path, help="where the rows are written")
    flags = parser.parse_args()
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        here = Path(folder)
        (here / "search.yaml").write_text(SEARCH)
        if {"evaluate", "adapt"} & set(flags.commands):
            words = ["--total-steps", "8_000", "--learning-starts", "4_000", "--out", "meta", "--quiet"]
            outlap("train", "mql", *words, cwd=here).wait()
        if flags.full_replay:
            full_run(here / "full", flags.full_replay)
        for name in flags.commands:
            for number, moment in enumerate(flags.moments):
                known = {"META": "meta", "SEARCH": "search.yaml", "OUT": f"out-{flags.commands.index(name)}-{number}"}
                words = [known.get(word, word) for word in commands[name]]
                if name == "train mql" and flags.full_replay:
                    words = ["--resume", "full"]
                rows.append(interrupt(name, words, moment, here))
                show(rows[-1])
    print(f"\nslowest: {max(row.all_gone_s or row.seconds or 0.0 for row in rows):.2f} s")
    if flags.json:
        facts = {
            "command": " ".join(["python", *sys.argv]),
            "machine": {"system": platform.platform(), "cores": os.cpu_count()},
            "rows": [row._asdict() for row in rows],
        }
        flags.json.write_text(json.dumps(facts, indent=2) + "\n")


def outlap(*words: str, cwd: Path, stderr: int | None = None) -> subprocess.Popen[str]:
    """The command in a session of its own, heeding Ctrl-C."""
    return subprocess.Popen(
        [sys.executable, "-m", "outlap", *words],
        cwd=cwd, stdout=subprocess.DEVNULL, stderr=stderr, text=True, start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip


def interrupt(name: str, words: list[str], moment: float, cwd: Path) -> Interrupted:
    """Start a command, send Ctrl-C to its group after `moment` seconds, and wait until its session is empty."""
    process = outlap(*name.removesuffix(" ray").split(), *words, cwd=cwd, stderr=subprocess.PIPE)
    try:
        _, said = process.communicate(timeout=moment)
        return Interrupted(name, moment, None, None, process.returncode, "Traceback" in said, tail(said))
    except subprocess.TimeoutExpired:
        pass
    begun = time.monotonic()
    os.killpg(process.pid, signal.SIGINT)
    try:
        _, said = process.communicate(timeout=PATIENCE)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        _, said = process.communicate()
    seconds = time.monotonic() - begun
    while (left := members(process.pid)) and time.monotonic() - begun < seconds + LEAVING:
        time.sleep(0.05)
    all_gone = None if left else round(time.monotonic() - begun, 2)
    for number in left:
        with suppress(ProcessLookupError):
            os.kill(number, signal.SIGKILL)
    return Interrupted(
        name, moment, round(seconds, 2), all_gone, process.returncode, "Traceback" in said, tail(said)
    )  # fmt: skip


def members(session: int) -> list[int]:
    """Processes of a session that run: all that its first one began, and they began, unless they left it."""
    listed = subprocess.run(["ps", "-e", "-o", "pid=,sess=,stat="], capture_output=True, text=True, check=True).stdout
    rows = (line.split() for line in listed.splitlines())
    return [int(pid) for pid, its, state in rows if int(its) == session and not state.startswith("Z")]


def tail(said: str) -> str:
    return " | ".join(line for line in said.splitlines()[-3:] if line)


def full_run(folder: Path, rows: int) -> None:
    """Make a run of `train mql` whose replay is as full as it gets: what takes longest to save."""
    import numpy as np

    from outlap.envs.race_vector_env import RaceVectorEnv
    from outlap.envs.sb3_vec_env import SB3VecEnv
    from outlap.mql.context_vec_env import ContextVecEnv
    from outlap.mql.mql import MQL
    from outlap.training.checkpoints import save_checkpoint
    from outlap.training.mql import MQLConfig
    from outlap.training.run import create_run

    config = MQLConfig(total_steps=1_000_000_000, learning_starts=0, buffer_size=rows)
    model = config.make_model(SB3VecEnv(RaceVectorEnv(config.num_envs, config.env)))
    env = model.env
    assert isinstance(model, MQL)
    assert isinstance(env, ContextVecEnv)
    buffer = model.replay_buffer
    observation = env.reset()
    buffer.begin_all(env, observation)  # type: ignore[arg-type]
    rng = np.random.default_rng(0)
    while buffer.added < rows:
        action = rng.uniform(-1.0, 1.0, (config.num_envs, 2)).astype(np.float32)
        observation, reward, dones, infos = env.step(model.policy.unscale_action(action))
        buffer.add_step(env, observation, action, reward, dones, infos)  # type: ignore[arg-type]
    run = create_run(folder, config)
    model.num_timesteps = 1000
    save_checkpoint(run, model, "checkpoints/step_000001000.zip", "checkpoints/step_000001000.npz")


def show(row: Interrupted) -> None:
    seconds = "done before" if row.seconds is None else f"{row.seconds:6.2f} s, all gone after {row.all_gone_s} s"
    print(
        f"{row.command:20} after {row.after_s:5.1f} s: {seconds}  exit {row.code}"
        f"{'  TRACEBACK' if row.traceback else ''}  {row.said[-200:]}",
        flush=True,
    )


if __name__ == "__main__":
    main()
