"""`outlap`: finds the command, runs it, and turns every mistake into one line and an exit code.

Exit codes: 0 done; 1 a bug, with its traceback; 2 wrong arguments or bad input; 130 after Ctrl-C or SIGTERM; 141 when
the reader of the output has gone. Only the module of the command that was asked for is imported.
"""

from __future__ import annotations

import contextlib
import difflib
import errno
import importlib
import logging
import os
import signal
import sys
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple

from outlap.cli.output import (
    STANDARD_OUTPUT,
    check_json_path,
    deliver,
    standard_output_kept_clean,
)
from outlap.errors import OutlapError

if TYPE_CHECKING:
    from outlap.cli.command import Command

# A full disk, a quota, a file system or a folder that cannot be written: no bugs.
STORAGE_FAULTS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EACCES, errno.ENOTDIR)
DONE, BAD_INPUT, INTERRUPTED, OUTPUT_CLOSED = 0, 2, 130, 141


class Entry(NamedTuple):
    words: str  # what the user types after `outlap`
    target: str  # module:class, imported when it is asked for
    summary: str


COMMANDS = (
    Entry("tracks list", "outlap.cli.tracks:ListTracks", "the tracks that can be used by name"),
    Entry("tracks show", "outlap.cli.tracks:ShowTrack", "draw a track: map, centreline, curvature"),
    Entry("tracks generate", "outlap.cli.tracks:GenerateTrack", "make a random closed circuit from a seed"),
    Entry("tracks import", "outlap.cli.tracks:ImportTrack", "make an F1TENTH map folder of a centreline csv"),
    Entry("tracks download", "outlap.cli.tracks:DownloadTracks", "get circuits from the official archive"),
    Entry("raceline", "outlap.cli.raceline:PlanRaceline", "plan the fastest line around a track for a car"),
    Entry("train ppo", "outlap.cli.train:TrainPPO", "train a policy with PPO and domain randomization"),
    Entry("train mql", "outlap.cli.train:TrainMQL", "meta-train a policy with Meta-Q-Learning"),
    Entry("train recurrent-ppo", "outlap.cli.train:TrainRecurrentPPO", "train PPO with a memory"),
    Entry("tune", "outlap.cli.tune:Tune", "search for hyper-parameters: train and race trials, stopping early"),
    Entry("compare", "outlap.cli.compare:Compare", "race runs on the same episodes, and what that shows"),
    Entry("reproduce", "outlap.cli.reproduce:Reproduce", "make every table and figure of the paper"),
    Entry("opponents train", "outlap.cli.opponents:TrainOpponents", "train a population of opponents"),
    Entry("opponents verify", "outlap.cli.opponents:VerifyOpponents", "race every opponent alone again"),
    Entry("opponents record", "outlap.cli.opponents:RecordLap", "record a lap that a ghost can drive again"),
    Entry("opponents list", "outlap.cli.opponents:ListOpponents", "list the opponents of a population"),
    Entry("adapt", "outlap.cli.adapt:Adapt", "adapt a meta-trained policy to tracks, and race it before and after"),
    Entry("evaluate", "outlap.cli.evaluate:Evaluate", "race a trained policy on tracks and measure it"),
    Entry("export", "outlap.cli.export:Export", "write a policy as one ONNX file for a car"),
    Entry("watch", "outlap.cli.viewers:WatchRaces", "watch races in a window, and drive in them"),
    Entry("replay", "outlap.cli.viewers:Replay", "write races as one HTML file that plays in a browser"),
    Entry("video", "outlap.cli.viewers:Video", "write races as a video or an animated picture"),
    Entry("plot trajectories", "outlap.cli.plot:PlotTrajectories", "draw where cars drove, coloured by speed"),
    Entry("plot friction", "outlap.cli.plot:PlotFriction", "draw how much of the tyres' grip was used"),
    Entry("plot lap-times", "outlap.cli.plot:PlotLapTimes", "draw lap times over the least possible, by track"),
    Entry("plot crashes", "outlap.cli.plot:PlotCrashes", "draw where cars crashed, with the hot spots"),
    Entry("plot learning", "outlap.cli.plot:PlotLearning", "draw learning curves of runs"),
    Entry("plot contexts", "outlap.cli.plot:PlotContexts", "draw how a policy's context tells tasks apart"),
    Entry("benchmark simulator", "outlap.cli.benchmark:BenchmarkSimulator", "measure the simulator's speed"),
    Entry(
        "benchmark adaptation",
        "outlap.cli.benchmark_adaptation:BenchmarkAdaptation",
        "compare drivers in cars that they never met",
    ),
    Entry("benchmark mql", "outlap.cli.benchmark:BenchmarkMQL", "measure updates of Meta-Q-Learning"),
    Entry("benchmark car", "outlap.cli.benchmark:BenchmarkCar", "measure an exported policy's latency"),
    Entry("demo", "outlap.cli.demo:Demo", "meta-train, adapt and race on built-in circuits in a few minutes"),
)


def run() -> None:
    """The console script."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # as Ctrl-C
    sys.exit(main())


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        argv: the words after `outlap`; those of the process if None.

    Returns:
        The exit code.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    prog = "outlap"
    try:
        text = _information(arguments)
        if text is not None:
            print(text, flush=True)
            return DONE
        entry = _find(arguments)
        prog = f"outlap {entry.words}"
        return _execute(entry, arguments[len(entry.words.split()) :], prog)
    except OutlapError as error:
        print(f"{prog}: error: {' '.join(str(error).splitlines())}", file=sys.stderr)
        return BAD_INPUT
    except KeyboardInterrupt:
        print(f"{prog}: interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        # `| head` has seen enough; nor may the interpreter complain when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return OUTPUT_CLOSED
    except OSError as error:
        if error.errno not in STORAGE_FAULTS:
            raise
        where = f"{error.filename}: " if error.filename else ""
        print(f"{prog}: error: {where}cannot be written: {error.strerror}", file=sys.stderr)
        return BAD_INPUT


@contextlib.contextmanager
def _log_shown(quiet: bool) -> Iterator[None]:
    """What outlap logs goes to standard error: what takes long, unless quiet, and what was left out.

    Afterwards the process logs as before: it may be a notebook, and standard error may be another by then.
    """
    log = logging.getLogger("outlap")
    level, shown = log.level, logging.StreamHandler()
    log.setLevel(logging.WARNING if quiet else logging.INFO)
    log.addHandler(shown)
    try:
        yield
    finally:
        log.removeHandler(shown)
        log.setLevel(level)


def _execute(entry: Entry, arguments: Sequence[str], prog: str) -> int:
    from outlap.cli.arguments import parse

    module, _, name = entry.target.partition(":")
    command_class: type[Command] = getattr(importlib.import_module(module), name)
    try:
        command = parse(command_class, arguments, prog)
    except SystemExit:  # after --help
        return DONE
    check_json_path(command.json)
    only_json = command.json == STANDARD_OUTPUT
    with _log_shown(quiet=getattr(command, "quiet", False)):
        with standard_output_kept_clean() if only_json else contextlib.nullcontext():
            result = command.run()
        deliver(result, command.json)
    return DONE


def _information(arguments: Sequence[str]) -> str | None:
    """The text for `--version` and for `--help` of outlap or of a group; None where a command is meant."""
    if list(arguments) == ["--version"]:
        from importlib.metadata import version

        return f"outlap {version('outlap')}"
    if not arguments or arguments[-1] not in ("-h", "--help"):
        return None
    group = list(arguments[:-1])
    entries = [entry for entry in COMMANDS if entry.words.split()[: len(group)] == group]
    if not entries or any(entry.words.split() == group for entry in entries):
        return None
    width = max(len(entry.words) for entry in COMMANDS)
    return "\n".join(
        [
            f"usage: {' '.join(['outlap', *group])} COMMAND [--flags]",
            "",
            "F1TENTH racing policies that adapt within an out-lap.",
            "",
            *(f"  {entry.words:{width}}  {entry.summary}" for entry in entries),
            "",
            "`outlap COMMAND --help` lists the flags of one command. Every command takes `--json PATH`;",
            "`-` is standard output. Exit codes: 0 done, 2 wrong arguments or input, 130 after Ctrl-C.",
        ]
    )


def _find(arguments: Sequence[str]) -> Entry:
    group: list[str] = []
    while True:
        entries = [entry for entry in COMMANDS if entry.words.split()[: len(group)] == group]
        if len(entries) == 1 and entries[0].words.split() == group:
            return entries[0]
        choices = list(dict.fromkeys(entry.words.split()[len(group)] for entry in entries))
        word = arguments[len(group)] if len(group) < len(arguments) else None
        if word in choices:
            group.append(word)
            continue
        close = difflib.get_close_matches(word or "", choices, 1)
        hint = f"choose from {', '.join(choices)}"
        if close:
            hint = f"did you mean {' '.join([*group, *close])!r}?"
        if word is None:
            fault = f"{group[-1]} needs a command" if group else "no command"
        else:
            fault = f"{' '.join([*group, word])!r} is not a command"
        raise OutlapError(f"{fault}; {hint}")
