"""A population of opponents: a folder of drivers with a manifest that says how each was trained and verified."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from pydantic import Field

from outlap.config import Config, validate
from outlap.drivers.mlp import MLPDriver
from outlap.errors import OutlapError
from outlap.files import atomic_write, to_json

MANIFEST = "manifest.json"
SHIPPED = Path(__file__).parent / "shipped_population"  # comes with outlap: trained on a built-in track
Split = Literal["train", "held_out"]


class Member(Config):
    """An opponent, as the manifest has it."""

    name: str = Field(pattern=r"^[\w.-]+$")  # of its two files, too
    max_speed_mps: float = Field(gt=0)
    split: Split
    track: str  # that it was trained on
    verified_laps: int = Field(ge=0)  # consecutive laps that every one of its verification runs completed
    crash_rate: float = Field(ge=0, le=1)  # of those runs
    lap_time_s: float = Field(gt=0)  # their mean
    command: str  # that trained it
    sha256: dict[str, str]  # of its files, by their names


class Manifest(Config):
    """What the manifest's file holds."""

    opponents: tuple[Member, ...]


def read_manifest(folder: str | os.PathLike[str], *, may_be_empty: bool = False) -> tuple[Member, ...]:
    """The members of a population.

    Raises OutlapError for a folder without a manifest, one that is broken, or one that names nobody.
    """
    path = Path(folder) / MANIFEST
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise OutlapError(
            f"{folder}: is no population, it has no {MANIFEST}; make one with outlap opponents train"
        ) from None
    except (OSError, ValueError, RecursionError) as error:
        raise OutlapError(f"{path}: cannot be read: {error}") from None
    members = validate(Manifest, content, str(path)).opponents
    if not members and not may_be_empty:
        raise OutlapError(f"{path}: names no opponent; make some with outlap opponents train, and verify them")
    return members


def write_manifest(folder: str | os.PathLike[str], members: Sequence[Member]) -> Path:
    """Write the manifest of a population, slowest first."""
    ordered = sorted(members, key=lambda member: (member.max_speed_mps, member.name))
    return atomic_write(Path(folder) / MANIFEST, to_json({"opponents": ordered}))


def load_population(
    folder: str | os.PathLike[str], split: Split | None = "train", name: str | None = None
) -> list[MLPDriver]:
    """The drivers of one half of a population, slowest first; runs no code from its files.

    Args:
        folder: of the population.
        split: the half; None: both.
        name: of the only one that is wanted.

    Raises OutlapError for a population that is empty or broken, a file that is not the one that was verified, a member
    that is not there or in the other half.
    """
    folder = Path(folder)
    drivers = []
    for member in read_manifest(folder):
        if name not in (None, member.name):
            continue
        if split not in (None, member.split):
            if name is None:
                continue
            raise OutlapError(
                f"{folder / name}: is {member.split.replace('_', ' ')}, and a {split} driver is asked for"
            )
        for file in file_names(member.name):
            found = hashlib.sha256((folder / file).read_bytes()).hexdigest() if (folder / file).is_file() else "missing"
            if found != member.sha256.get(file):
                raise OutlapError(
                    f"{folder / file}: its SHA-256 is {found}, and {MANIFEST} has {member.sha256.get(file)}; "
                    "get the population anew, or train it again with outlap opponents train"
                )
        driver = MLPDriver.load(folder / member.name)
        if driver.name != member.name:
            raise OutlapError(f"{folder / member.name}.json: name is {driver.name!r}; must be {member.name!r}")
        drivers.append(driver)
    if not drivers and name is not None:
        there = ", ".join(member.name for member in read_manifest(folder))
        raise OutlapError(f"{folder}: has no opponent {name!r}; there are {there}")
    if not drivers:
        raise OutlapError(f"{folder}: has no opponent in its {split} half")
    return drivers


def file_names(name: str) -> tuple[str, str]:
    """The files of a member."""
    return f"{name}.json", f"{name}.safetensors"


def file_hashes(folder: Path, name: str) -> dict[str, str]:
    """SHA-256 of a member's files, by their names."""
    return {each: hashlib.sha256((folder / each).read_bytes()).hexdigest() for each in file_names(name)}
