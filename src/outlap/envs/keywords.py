"""Environments from keywords: the entry points of Gymnasium, and the same for the other interfaces."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple, cast

from gymnasium.vector import AutoresetMode

from outlap.config import validate
from outlap.drivers.driver import Driver
from outlap.drivers.find import Named, driver_name, find_drivers
from outlap.envs.race_config import RaceConfig
from outlap.envs.race_env import RaceEnv
from outlap.envs.race_vector_env import RaceVectorEnv
from outlap.errors import OutlapError
from outlap.track.catalog import load_tracks
from outlap.track.generate import BUILTIN_TRAIN
from outlap.track.track import Track

if TYPE_CHECKING:
    from outlap.envs.parallel_env import RaceParallelEnv
    from outlap.envs.sb3_vec_env import SB3VecEnv


class Parts(NamedTuple):
    """What keywords stand for; None for what the configuration's names give."""

    config: RaceConfig
    tracks: tuple[Track, ...]
    opponents: list[Driver] | None


def make_race(render_mode: str | None = None, **keywords: Any) -> RaceEnv:
    """Make one race: `gymnasium.make("outlap/Race-v0", ...)`.

    Args:
        render_mode: see `RaceEnv`.
        **keywords: see `race_parts`.

    Raises OutlapError as `race_parts` and `RaceEnv` do.
    """
    for name in ("num_envs", "autoreset_mode"):
        if name in keywords:
            raise OutlapError(f"{name}: a single race has none; take gymnasium.make_vec or make_race_vector")
    return RaceEnv(*race_parts(keywords), render_mode)


make_race.metadata = RaceEnv.metadata  # pyright: ignore[reportFunctionMemberAccess] # Gymnasium reads render modes here


def make_race_vector(
    num_envs: int = 1,
    *,
    autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
    render_mode: None = None,
    **keywords: Any,
) -> RaceVectorEnv:
    """Make races in many worlds: `gymnasium.make_vec("outlap/Race-v0", num_envs=..., ...)`.

    Args:
        num_envs: worlds.
        autoreset_mode: see `RaceVectorEnv`; also its value as text, "SameStep" or "Disabled".
        render_mode: only None; a single race renders.
        **keywords: see `race_parts`.

    Raises OutlapError as `race_parts` and `RaceVectorEnv` do.
    """
    if render_mode is not None:
        raise OutlapError(f"render_mode is {render_mode!r}; only None is offered")
    modes: dict[Any, AutoresetMode] = {mode.value: mode for mode in AutoresetMode}
    mode: Any = modes.get(autoreset_mode, autoreset_mode)
    return RaceVectorEnv(num_envs, *race_parts(keywords), autoreset_mode=mode)


def make_sb3(num_envs: int = 1, **keywords: Any) -> SB3VecEnv:
    """Make races in many worlds for Stable-Baselines3.

    Args:
        num_envs: worlds.
        **keywords: see `race_parts`.

    Raises OutlapError as `race_parts` and `RaceVectorEnv` do.
    """
    from outlap.envs.sb3_vec_env import SB3VecEnv  # brings PyTorch

    if "autoreset_mode" in keywords:
        raise OutlapError("autoreset_mode: Stable-Baselines3 knows only SAME_STEP; leave it out")
    return SB3VecEnv(make_race_vector(num_envs, **keywords))


def make_parallel(num_cars: int = 2, **keywords: Any) -> RaceParallelEnv:
    """Make one race whose cars are all agents, for PettingZoo.

    Args:
        num_cars: agents.
        **keywords: see `race_parts`, without the fields of opponents.

    Raises OutlapError as `race_parts` and `RaceParallelEnv` do, and for a keyword that such a race has no use for.
    """
    from outlap.envs.parallel_env import RaceParallelEnv  # needs the extra `multiagent`

    for name in ("num_envs", "autoreset_mode", "opponents", "opponent_speed", "opponent_noise"):
        if name in keywords:
            raise OutlapError(f"{name}: a race whose cars are all agents has none; leave it out")
    parts = race_parts({**keywords, "num_cars": num_cars, "opponents": ()})
    return RaceParallelEnv(parts.config, parts.tracks)


def race_parts(keywords: dict[str, Any]) -> Parts:
    """Return what the keywords of an environment stand for.

    Args:
        keywords: the fields of `RaceConfig`, of which two also take objects:
            tracks: names, map folders or `Track`s, or one of them; without any, the built-in training set.
            opponents: names (see `drivers.find`), `Driver`s or functions, or one of them.

    Raises OutlapError for an unknown or wrong field, and for a track or an opponent that cannot be loaded.
    """
    fields = dict(keywords)
    tracks = _listed(fields.get("tracks", ())) or list(BUILTIN_TRAIN)
    fields["tracks"] = tuple(map(_track_name, tracks))
    opponents: list[Named] | None = None
    if fields.get("opponents") is not None:
        opponents = _listed(fields["opponents"])
        fields["opponents"] = tuple(map(driver_name, opponents))
    config = validate(RaceConfig, fields, "outlap/Race-v0")
    drivers = None
    if opponents is not None and config.num_cars > 1:
        drivers = find_drivers(opponents, config.field_of_view, config.opponent_split, config.opponent_code)
    return Parts(config, load_tracks(tracks), drivers)


def _listed(value: Any) -> list[Any]:
    """A list of what was given, which may be a single object."""
    return [*cast("Sequence[Any]", value)] if isinstance(value, Sequence) and not isinstance(value, str) else [value]


def _track_name(track: Any) -> str:
    """What a configuration calls a track: its name, or the path that was given."""
    if not isinstance(track, (str, os.PathLike, Track)):
        raise OutlapError(f"tracks: {track!r:.60} is not a track; give a name, a map folder or a Track")
    return track.name if isinstance(track, Track) else os.fspath(track)
