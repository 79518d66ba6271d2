"""A process that has imported what takes long, and forks for each command that it is told on standard input.

Each child is what `python -m outlap WORDS` is once it has started, in a process group of its own: it can be killed and
interrupted like one, and costs a tenth of the time.
"""

from __future__ import annotations

import json
import os
import sys


def serve() -> None:
    """Line by line: take a request, fork, tell the child's number, and then its exit code."""
    import sb3_contrib  # noqa: F401
    import torch.utils.tensorboard  # noqa: F401

    import outlap.cli.adapt
    import outlap.cli.evaluate
    import outlap.cli.opponents
    import outlap.cli.reproduce
    import outlap.cli.train
    import outlap.drivers.policy
    import outlap.evaluation.rollout
    import outlap.mql.mql  # noqa: F401

    for line in sys.stdin:
        child = os.fork()
        if child == 0:
            become(**json.loads(line))
        os.setpgid(child, child)  # before anybody signals its group
        print(child, flush=True)
        _, status = os.waitpid(child, 0)
        print(os.waitstatus_to_exitcode(status), flush=True)


def become(words: list[str], folder: str, environment: dict[str, str], stderr: str) -> None:
    """Be the command, and end with it."""
    from outlap.cli.main import run

    code = 1
    try:
        os.setpgid(0, 0)
        os.chdir(folder)
        os.environ.clear()
        os.environ.update(environment)
        os.dup2(os.open(os.devnull, os.O_RDWR), 0)
        os.dup2(os.open(stderr, os.O_WRONLY), 2)
        os.dup2(0, 1)
        sys.argv = ["outlap", *words]
        run()
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else 1
    finally:
        sys.stderr.flush()
        os._exit(code)


if __name__ == "__main__":
    serve()
