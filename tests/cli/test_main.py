"""The command line's promises: exit codes, one line on standard error, clean JSON, and a quick start."""

from __future__ import annotations

import contextlib
import errno
import json
import logging
import os
import signal
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pytest
import tyro

from outlap.cli import main as cli
from outlap.cli.output import CommandResult
from outlap.config import Config, Number, bounded, load_config
from outlap.errors import OutlapError
from outlap.files import to_json


class Vehicle(Config):
    mu: Annotated[Number, bounded(above=0.0)] = 1.0


class Settings(Config):
    vehicle: Vehicle = Vehicle()
    my_seed: int = 0


@dataclass
class Lap:
    """A command that does nothing but answer with its flags."""

    settings: Annotated[Settings, tyro.conf.arg(name="")] = field(default_factory=Settings)
    weather: Literal["wet", "dry"] = "dry"
    fail: str = ""
    config: Path | None = None
    json: str | None = None

    @classmethod
    def from_config(cls, path: str) -> Lap:
        return cls(settings=load_config(Settings, path))

    def run(self) -> CommandResult:
        print("chatter of a library")
        os.system("echo chatter of a child process")
        if self.fail == "input":
            raise OutlapError("map.yaml: resolution is 0;\nmust be positive")
        if self.fail == "interrupt":
            raise KeyboardInterrupt
        if self.fail == "bug":
            raise ZeroDivisionError("a bug")
        data = {"mu": self.settings.vehicle.mu, "seed": self.settings.my_seed, "lap_time_s": float("nan")}
        return CommandResult(data, lambda console: console.print(f"a table, mu {data['mu']}"))


@pytest.fixture(autouse=True)
def _lap_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "lap_command", sys.modules[__name__])
    entry = cli.Entry("test lap", "lap_command:Lap", "answers with its flags")
    monkeypatch.setattr(cli, "COMMANDS", (*cli.COMMANDS, entry))


def outlap(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "outlap", *words], capture_output=True, text=True, check=False)


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        ([], "outlap: error: no command; choose from tracks, raceline, train"),
        (["trcks"], "outlap: error: 'trcks' is not a command; did you mean 'tracks'?"),
        (["tracks"], "outlap: error: tracks needs a command; choose from list, show"),
        (["tracks", "lst"], "outlap: error: 'tracks lst' is not a command; did you mean 'tracks list'?"),
        (["--json", "-"], "outlap: error: '--json' is not a command"),
        (["test", "lap", "--my-sed", "3"], "unrecognized options: --my-sed, 3; did you mean --my-seed?"),
        (
            ["test", "lap", "--my-seed", "x"],
            "--my-seed: invalid literal for int() with base 10: 'x'; must be",
        ),
        (["test", "lap", "--my-seed"], "missing value for argument '--my-seed'"),
        (["test", "lap", "--weather", "wt"], "('wet', 'dry'); did you mean wet?"),
        (
            ["test", "lap", "--vehicle.mu", "-1"],
            "outlap test lap: error: --vehicle.mu is -1.0; must be > 0.0",
        ),
        (["test", "lap", "--vehicle.mu=2", "1"], "error: --vehicle.mu is (2.0, 1.0); must have min <= max"),
        (
            ["test", "lap", "--vehicle.mu", "wet"],
            "--vehicle.mu is 'wet'; must be --vehicle.mu FLOAT|{FLOAT FLOAT}",
        ),
        (["test", "lap", "p" * 200], "unrecognized options: " + "p" * 200),
        (["test", "lap", "--fail", "input"], "error: map.yaml: resolution is 0; must be positive"),
        (["test", "lap", "--config", "/none.yaml"], "error: /none.yaml: no such file"),
        (["test", "lap", "--json", "/"], "error: --json is '/', a folder"),
        (
            ["test", "lap", "--json", "/dev/null/x.json"],
            "error: --json /dev/null/x.json: cannot make the folder",
        ),
    ],
)
def test_a_mistake_exits_with_2_and_one_line(
    words: list[str], complaint: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(words) == 2
    out, err = capsys.readouterr()
    assert complaint in err
    assert err.count("\n") == 1
    assert err.endswith("\n")
    assert out in ("", "chatter of a library\n")


def test_the_json_path_is_checked_before_the_work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["test", "lap", "--json", str(tmp_path)]) == 2
    assert "chatter" not in capsys.readouterr().out
    assert cli.main(["test", "lap", "--json", str(tmp_path / "new" / "x.json"), "--fail", "input"]) == 2
    assert (tmp_path / "new").is_dir()


def test_interrupt_is_130_and_a_bug_keeps_its_traceback(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["test", "lap", "--fail", "interrupt"]) == 130
    assert capsys.readouterr().err == "outlap test lap: interrupted\n"
    with pytest.raises(ZeroDivisionError):
        cli.main(["test", "lap", "--fail", "bug"])


@pytest.mark.parametrize("fail", ["", "input", "bug"])
def test_the_log_is_shown_while_a_command_runs_and_then_is_as_before(
    fail: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    log = logging.getLogger("outlap")
    before = log.level, list(log.handlers)
    run = Lap.run

    def logs_and_runs(lap: Lap) -> CommandResult:
        logging.getLogger("outlap.lap").info("planning a line")
        return run(lap)

    monkeypatch.setattr(Lap, "run", logs_and_runs)
    with pytest.raises(ZeroDivisionError) if fail == "bug" else contextlib.nullcontext():
        cli.main(["test", "lap", "--fail", fail])
    assert capsys.readouterr().err.startswith("planning a line\n")
    assert (log.level, log.handlers) == before


@pytest.mark.parametrize("fault", [errno.ENOSPC, errno.EROFS, errno.EACCES])
def test_storage_that_fails_is_one_line_and_no_bug(
    fault: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def run(self: Lap) -> None:
        raise OSError(fault, os.strerror(fault), "runs/mine/policy.zip")

    monkeypatch.setattr(Lap, "run", run)
    assert cli.main(["test", "lap"]) == 2
    err = capsys.readouterr().err
    assert err == f"outlap test lap: error: runs/mine/policy.zip: cannot be written: {os.strerror(fault)}\n"


def test_json_on_standard_output_stands_alone(capfd: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["test", "lap", "--json", "-", "--vehicle.mu", "0.5", "1.1"]) == 0
    out, err = capfd.readouterr()
    assert json.loads(out) == {"mu": [0.5, 1.1], "seed": 0, "lap_time_s": None}
    assert "library" in err
    assert "child process" in err


def test_json_to_a_file_leaves_the_table_on_the_screen(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "new" / "lap.json"
    assert cli.main(["test", "lap", "--json", str(path)]) == 0
    assert json.loads(path.read_text())["mu"] == 1.0
    assert "a table, mu 1.0" in capsys.readouterr().out


@pytest.mark.parametrize("after", [False, True])
def test_flags_override_the_config_file_wherever_they_stand(
    tmp_path: Path, after: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "lap.yaml"
    path.write_text("vehicle: {mu: {min: 0.2, max: 0.4}}\nmy_seed: 5\n")
    file, flag = ["--config", str(path)], ["--my-seed", "6"]
    assert cli.main(["test", "lap", *([*flag, *file] if after else [*file, *flag]), "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out) == {"mu": [0.2, 0.4], "seed": 6, "lap_time_s": None}
    assert cli.main(["test", "lap", f"--config={path}", "--json", "-"]) == 0
    assert json.loads(capsys.readouterr().out)["seed"] == 5


def test_to_json_takes_what_results_are_made_of() -> None:
    @dataclass
    class Row:
        laps: int

    data: dict[Any, Any] = {
        "array": np.array([[1.0, np.inf], [np.nan, 2.0]], dtype=np.float32),
        "scalars": (np.float32(0.5), np.float64("nan"), np.int64(3), np.bool_(True)),
        "path": Path("runs") / "a",
        "row": Row(3),
        "config": Vehicle(mu=(0.5, 1.0)),
        4: None,
    }
    assert json.loads(to_json(data)) == {
        "array": [[1.0, None], [None, 2.0]],
        "scalars": [0.5, None, 3, True],
        "path": "runs/a",
        "row": {"laps": 3},
        "config": {"mu": {"min": 0.5, "max": 1.0}},
        "4": None,
    }
    with pytest.raises(TypeError, match="object has no form in JSON"):
        to_json({"x": object()})


@pytest.mark.parametrize("words", [["--help"], ["tracks", "-h"], ["test", "lap", "--help"], ["--version"]])
def test_help_and_version_go_to_standard_output(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(words) == 0
    out, err = capsys.readouterr()
    assert "outlap" in out
    assert err == ""


def test_help_imports_nothing_heavy() -> None:
    program = (
        "import sys; from outlap.cli.main import main; main(['--help'])\n"
        "print(sorted({'torch', 'numba', 'scipy', 'matplotlib', 'stable_baselines3'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


def test_exit_code_and_stream_of_the_real_process() -> None:
    done = outlap("trcks")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == "outlap: error: 'trcks' is not a command; did you mean 'tracks'?\n"
    assert outlap("--version").stdout.startswith("outlap ")


def _process(tmp_path: Path, body: str) -> list[str]:
    """A process whose one command, `work`, runs `body`."""
    lines = [
        "import sys, time",
        "from dataclasses import dataclass",
        "from outlap.cli import main as cli",
        "from outlap.cli.output import CommandResult",
        "@dataclass",
        "class Work:",
        "    json: str | None = None",
        "    def run(self):",
        f"        {body}",
        "cli.COMMANDS = (cli.Entry('work', '__main__:Work', 'works'),)",
        "cli.run()",
    ]
    program = tmp_path / "work.py"
    program.write_text("\n".join(lines))
    return [sys.executable, str(program), "work"]


def _heed_ctrl_c() -> None:
    """A test run in the background hands down an ignored SIGINT."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.mark.parametrize("by", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_and_sigterm_end_the_process_with_130_and_one_line(by: signal.Signals, tmp_path: Path) -> None:
    command = _process(tmp_path, "print('ready', flush=True); time.sleep(60)")
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, preexec_fn=_heed_ctrl_c
    ) as process:
        assert process.stdout is not None
        process.stdout.readline()
        process.send_signal(by)
        _, err = process.communicate(timeout=30)
    assert process.returncode == 130
    assert err == "outlap work: interrupted\n"


@pytest.mark.parametrize("flags", [[], ["--json", "-"]])
def test_a_reader_that_leaves_is_no_error(tmp_path: Path, flags: list[str]) -> None:
    body = "return CommandResult({'x': ['lap'] * 100_000}, lambda c: [c.print('lap') for _ in range(20_000)])"
    command = [*_process(tmp_path, body), *flags]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.readline()
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 141


@pytest.mark.parametrize("entry", cli.COMMANDS, ids=lambda entry: entry.words)
def test_every_command_explains_itself_and_takes_json(entry: cli.Entry, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([*entry.words.split(), "--help"]) == 0
    out, _ = capsys.readouterr()
    assert f"usage: outlap {entry.words}" in out
    assert "--json" in out
