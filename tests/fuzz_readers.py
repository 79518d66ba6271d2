"""Coverage-guided fuzzing of every reader of files: run by hand, for as long as one likes.

    pip install -e '.[dev,fuzz]'
    PYTHONPATH=tests python tests/fuzz_readers.py --seconds 600            # shared out over all readers
    PYTHONPATH=tests python tests/fuzz_readers.py --only archive --seconds 60

A reader may give a value or raise an OutlapError of one line. What makes it do anything else is left in
`--findings` as a file of its kind, with what was raised. Corpora are kept from run to run in `--corpora`.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
from importlib import import_module
from pathlib import Path
from typing import Any

# Numba compiles these functions: it cannot read bytecode that counts its branches.
COMPILED = [
    "outlap.simulator", "outlap.track.distance",
    "outlap.planning.corridor", "outlap.planning.speed_profile",
]  # fmt: skip
SLOWEST = 20  # [s] that a file may take
MEMORY = 4096  # [MB]


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--seconds", type=float, default=600.0, help="of all readers together")
    parser.add_argument("--only", nargs="+", help="kinds of files")
    parser.add_argument("--corpora", type=Path, default=Path("runs/fuzz/corpora"))
    parser.add_argument("--findings", type=Path, default=Path("runs/fuzz/findings"))
    options = parser.parse_args()
    from hostile_files import READERS

    kinds = options.only or [*READERS]
    found = 0
    for kind in kinds:
        name = kind.replace(" ", "-")
        corpus, findings = options.corpora / name, options.findings / name
        corpus.mkdir(parents=True, exist_ok=True)
        findings.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory() as folder:
            (corpus / "valid").write_bytes(READERS[kind][0](Path(folder)).read_bytes())
        run = subprocess.run(
            [
                sys.executable, __file__, f"-max_total_time={max(1, round(options.seconds / len(kinds)))}",
                f"-timeout={SLOWEST}", f"-rss_limit_mb={MEMORY}", "-print_final_stats=1", "-max_len=200000",
                f"-artifact_prefix={findings}{os.sep}", str(corpus),
            ],
            env={**os.environ, "OUTLAP_FUZZED": kind}, stderr=subprocess.STDOUT, stdout=subprocess.PIPE, text=True,
            errors="replace", check=False,
        )  # fmt: skip
        executions = re.findall(r"number_of_executed_units: (\d+)", run.stdout)
        covered = re.findall(r"cov: (\d+)", run.stdout)
        print(f"{kind:20} {executions[-1] if executions else '?':>8} files {covered[-1] if covered else '?':>6} edges"
              f"{'' if run.returncode == 0 else '   FOUND: see ' + str(findings)}", flush=True)  # fmt: skip
        if run.returncode:
            found += 1
            (findings / "said.txt").write_text(run.stdout[-20_000:])
    return min(found, 1)


def fuzz(kind: str) -> None:
    """Give the reader of a kind one file after another; never returns."""
    atheris: Any = import_module("atheris")  # of the extra `fuzz`, which not every platform has
    with atheris.instrument_imports(include=["outlap"], exclude=COMPILED):
        from hostile_files import READERS, read_or_say

    folder = Path(tempfile.mkdtemp(prefix="outlap-fuzz-", dir="/dev/shm" if os.path.isdir("/dev/shm") else None))
    path = READERS[kind][0](folder)

    def give(content: bytes) -> None:
        path.write_bytes(content)
        read_or_say(kind, path)

    atheris.Setup(sys.argv, give)
    atheris.Fuzz()


if __name__ == "__main__":
    if "OUTLAP_FUZZED" in os.environ:
        fuzz(os.environ["OUTLAP_FUZZED"])
    else:
        sys.exit(main())
