"""Every reader of files from outside, with a valid file of its kind: for the tests and for the fuzzer."""

from __future__ import annotations

import shutil
import tarfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np

from outlap.config import load_config, save_config
from outlap.drivers.ghost import Ghost
from outlap.drivers.mlp import MLPDriver
from outlap.drivers.population import MANIFEST, SHIPPED, load_population, read_manifest
from outlap.errors import OutlapError
from outlap.evaluation.recording import Recording
from outlap.mql.replay import ReplayBuffer
from outlap.planning.friction import FrictionMap
from outlap.track.archive import extract
from outlap.track.generate import generate_track
from outlap.track.map_io import read_raceline_csv, read_track, read_tum_centerline, write_raceline_csv, write_track
from outlap.track.raceline import Raceline
from outlap.training.ppo import PPOConfig
from recordings import circling
from synthetic_tracks import ring


def replay_file(folder: Path) -> Path:
    box = gym.spaces.Box(-np.inf, np.inf, (3,), np.float32)
    buffer = ReplayBuffer(20, gym.spaces.Dict({"vel": box}), 2, 1)
    one = np.zeros(1, np.int64)
    buffer.begin(one, {"vel": np.ones((1, 3), np.float32)}, ["a"])
    for _ in range(6):
        buffer.add(one, {"vel": np.ones((1, 3), np.float32)}, np.zeros((1, 2)), np.ones(1), np.zeros(1, bool))
    path = folder / "replay.npz"
    buffer.save(path)
    return path


def track_file(ending: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        write_track(ring(radius=4.0, resolution=0.1), folder)
        return next(folder.glob(f"*{ending}"))

    return make


def of_folder(reader: Callable[[Path], Any]) -> Callable[[Path], Any]:
    return lambda path: reader(path.parent)


def shipped(name: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        for file in SHIPPED.iterdir():
            if file.name == MANIFEST or file.stem == "Emberley-2.0":
                shutil.copyfile(file, folder / file.name)
        return folder / name

    return make


def lines(name: str, text: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        path = folder / name
        path.write_text(text)
        return path

    return make


def raceline_file(folder: Path) -> Path:
    s = np.linspace(0.0, 20.0, 40, endpoint=False)
    line = Raceline(s, np.cos(s), np.sin(s), s, np.ones(40), np.full(40, 3.0), np.zeros(40))
    return write_raceline_csv(line, folder / "line.csv")


def archive_file(folder: Path) -> Path:
    write_track(generate_track(1, length=40.0, resolution=0.2), folder / "maps")
    path = folder / "maps.tar.xz"
    with tarfile.open(path, "w:xz") as archive:
        archive.add(folder / "maps", "maps")
    return path


def config_file(folder: Path) -> Path:
    return save_config(PPOConfig(), folder / "config.yaml")


GHOST = "t_s,x_m,y_m,yaw_rad,vx_mps\n" + "".join(
    f"{2.0 * a:.3f},{6 * np.cos(a):.3f},{6 * np.sin(a):.3f},{a + 1.571:.3f},3\n" for a in np.linspace(0, 6.2, 60)
)
TUM = "".join(f"{5 * np.cos(a):.4f},{5 * np.sin(a):.4f},1.1,1.1\n" for a in np.linspace(0, 6.2, 60))
FRICTION = "s_m,d_m,mu\n" + "".join(f"{s},{d},{0.8}\n" for s in range(0, 20, 5) for d in (-1, 1))

READERS: dict[str, tuple[Callable[[Path], Path], Callable[[Path], Any]]] = {
    "recording": (lambda folder: circling(ring(), beams=5).save(folder / "a.npz"), Recording.load),
    "replay": (replay_file, ReplayBuffer.load),
    "map yaml": (track_file(".yaml"), of_folder(read_track)),
    "map png": (track_file(".png"), of_folder(read_track)),
    "centreline": (track_file("centerline.csv"), of_folder(read_track)),
    "raceline": (raceline_file, read_raceline_csv),
    "TUM centreline": (lines("tum.csv", TUM), read_tum_centerline),
    "ghost": (lines("lap.csv", GHOST), Ghost.load),
    "friction": (lines("mu.csv", FRICTION), lambda path: FrictionMap.read(path, 20.0)),
    "manifest": (shipped(MANIFEST), of_folder(read_manifest)),
    "weights": (shipped("Emberley-2.0.safetensors"), lambda path: MLPDriver.load(path.with_suffix(""))),
    "facts of weights": (shipped("Emberley-2.0.json"), lambda path: MLPDriver.load(path.with_suffix(""))),
    "population": (shipped(MANIFEST), of_folder(lambda folder: load_population(folder, None, "Emberley-2.0"))),
    "archive": (archive_file, lambda path: extract(path, path.parent / "out")),
    "configuration": (config_file, lambda path: load_config(PPOConfig, path)),
}


def read_or_say(kind: str, path: Path) -> None:
    """Read a file: a value, or an OutlapError of one short line; anything else is raised."""
    _, read = READERS[kind]
    said = ""
    try:
        read(path)
    except OutlapError as error:
        said = str(error)
    finally:
        shutil.rmtree(path.parent / "out", ignore_errors=True)
    assert "\n" not in said
    assert len(said) < 2_000
