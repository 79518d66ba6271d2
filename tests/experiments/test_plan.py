"""From the names of tables to units of work: what is shared, what depends on what, and what nobody trains on."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from outlap.config import bounds
from outlap.errors import OutlapError
from outlap.experiments.definitions import FOLDERS, Budget
from outlap.experiments.opponent_units import OpponentUnit
from outlap.experiments.paper_units import ClippingUnit, RaceUnit, TrainingUnit, adaptation_settings
from outlap.experiments.plan import Plan, artefacts, make_plan, remember_tracks
from outlap.mql.propensity import AdaptiveBetaClip


@pytest.fixture(scope="module", autouse=True)
def no_real_circuits() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("OUTLAP_TRACKS", raising=False)
        yield


@pytest.fixture(scope="module")
def whole() -> Plan:
    return make_plan(["all"], "cpu")


def budget_file(folder: Path, name: str, **changes) -> str:
    content = yaml.safe_load((FOLDERS[Budget] / "cpu.yaml").read_text())
    for path, value in changes.items():
        *outer, last = path.split("__")
        inside = content
        for key in outer:
            inside = inside.setdefault(key, {})
        inside[last] = value
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump(content))
    return str(path)


def test_every_unit_is_there_once_and_after_what_it_needs(whole: Plan):
    seen: set[str] = set()
    for unit in whole.units:
        assert unit.key not in seen
        assert {needed.key for needed in unit.needs} <= seen
        seen.add(unit.key)


def test_methods_with_equal_trainings_share_them(whole: Plan):
    races = [race for table in whole.tables for race in table.races if race.table == "table-3" and race.seed == 2]
    trainings = {race.method: race.training.key for race in races if race.training}
    mql = {trainings[name] for name in ("mql", "mql-abc", "mql-no-clip", "mql-no-adaptation")}
    assert len(mql) == 1
    assert len({*trainings.values()}) == 4  # MQL, TD3, PPO, RecurrentPPO
    assert next(race for race in races if race.method == "follow-the-gap").training is None
    # Tables of one task set race the same trainings.
    table_2 = {
        race.training.key for table in whole.tables for race in table.races if race.table == "table-2" and race.training
    }
    table_3 = {
        race.training.key for table in whole.tables for race in table.races if race.table == "table-3" and race.training
    }
    assert table_2 == table_3


def test_every_method_is_raced_on_the_same_tasks_cars_and_rewards(whole: Plan):
    for table in whole.tables:
        assert {race.method for race in table.races} == {*whole.methods}
        assert len({str((race.env, race.tasks, race.episodes, race.time_limit)) for race in table.races}) == 1
        race = table.races[0]
        assert (race.score.preset, race.score.collision_max) == ("paper", 1.0)
        assert race.env.reward.preset == "fast"  # what a context is shown
        wanted = whole.budget.episodes * whole.task_sets[table.task_set].tables[table.name].share
        assert 0 <= race.episodes * len(race.tasks) - wanted < len(race.tasks)


def test_nothing_that_is_held_out_is_trained_on(whole: Plan):
    for unit in whole.units:
        if isinstance(unit, TrainingUnit):
            config = unit.config
            assert config.env.opponent_split == "train"
            assert not {*config.env.tracks} & {*config.held_out_tracks}
            if isinstance(config.env.opponent_speed, tuple):
                assert config.env.opponent_speed[1] <= 6.0
    for table in whole.tables:
        for race in table.races:
            if race.training and race.table == "table-3":
                assert {task.track for task in race.tasks} == {*race.training.config.held_out_tracks}
    members = {unit.name: unit.split for unit in whole.units if isinstance(unit, OpponentUnit)}
    assert sorted(name for name, split in members.items() if split == "held_out") == ["Emberley-6.5", "Emberley-7.0"]
    assert len(members) == 11


def test_vehicles_are_tested_on_both_sides_of_the_range_of_training(whole: Plan):
    race = next(race for table in whole.tables for race in table.races if race.table == "vehicles" and race.training)
    assert race.training is not None
    trained = race.training.config.env.vehicle
    for name in ("mu", "m", "I", "C_Sf", "C_Sr", "a_max"):
        low, high = bounds(getattr(trained, name))
        cars = [task.changes["vehicle"][name] for task in race.tasks]  # a task is one car
        assert cars == sorted(cars)
        assert cars[1] < low < high < cars[2]


def test_a_change_makes_anew_what_depends_on_it_and_nothing_else(tmp_path: Path):
    before = {unit.key: unit for unit in make_plan(["all"], budget_file(tmp_path, "a"), seeds=1).units}

    def new(**changes) -> set[str]:
        units = make_plan(["all"], budget_file(tmp_path, "b", **changes), seeds=1).units
        found = set()
        for unit in units:
            if unit.key not in before:
                found.add(f"{unit.kind} {unit.method}" if isinstance(unit, RaceUnit) else f"{unit.kind} {unit.name}")
        return found

    adapting = {"races mql", "races mql-abc", "races mql-no-clip"}
    assert new() == set()
    changed = new(adaptation__replay_steps=21)
    assert {name for name in changed if not name.startswith("clipping")} == adapting
    assert {name for name in changed if name.startswith("trainings")} == set()
    changed = new(training__ppo__total_steps=1_500_001)
    assert {name for name in changed if name.startswith("races")} == {"races vanilla-dr"}
    assert all("-ppo-" in name for name in changed if name.startswith("trainings"))
    assert len([name for name in changed if name.startswith("trainings")]) == 4  # task sets
    assert all(name.startswith("races") for name in new(episodes=501))
    assert all(name.startswith("clipping") for name in new(gradient_batches=33))
    # Opponents are trained anew, and all that race them.
    changed = new(population__total_steps=1_000_001)
    assert len([name for name in changed if name.startswith("opponents")]) == 11
    assert {name.split("-")[0] for name in changed if name.startswith("trainings")} == {"trainings opponents"}


def test_only_what_is_asked_for_is_planned():
    plan = make_plan(["table-3"], "cpu", ["vanilla-dr"], seeds=2)
    assert [(unit.kind, unit.name) for unit in plan.units] == [
        ("trainings", "tracks-ppo-0"),
        ("races", "table-3-vanilla-dr-0"),
        ("trainings", "tracks-ppo-1"),
        ("races", "table-3-vanilla-dr-1"),
    ]
    figure = make_plan(["figure-2"], "cpu").units
    assert {unit.kind for unit in figure} == {"trainings", "clipping"}
    clipping = [unit for unit in figure if isinstance(unit, ClippingUnit)]
    assert len({unit.adaptation_seed for unit in clipping}) == len(clipping) == 10
    appendix = make_plan(["appendix"], "cpu")
    assert {unit.kind for unit in appendix.units} == {"trainings", "clipping", "opponents", "populations"}


def test_a_task_set_of_ones_own_brings_its_tables(tmp_path: Path):
    path = tmp_path / "fast.yaml"
    path.write_text(
        "title: Fast\ncircuits: [{title: here, train: [Foxglove], held_out: [Nightjar]}]\n"
        "env: {vehicle: {v_max: 12.0}}\ntables: {fast: {title: Faster, circuits: held_out}}\n"
    )
    plan = make_plan([str(path)], "smoke", ["td3"], seeds=1)
    (table,) = plan.tables
    assert (table.name, table.races[0].env.vehicle.v_max, table.races[0].tasks[0].track) == ("fast", 12.0, "Nightjar")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((["table-9"], "cpu"), "'table-9' is no table or figure; must be one of"),
        (([], "cpu"), "nothing to make; name some of"),
        ((["all"], "cpu", ["nobody"]), "method is 'nobody'"),
    ],
)
def test_a_mistake_is_one_line(arguments, said: str):
    with pytest.raises(OutlapError, match=said):
        make_plan(*arguments)


def test_a_budget_with_an_unknown_field_is_found_before_any_work(tmp_path: Path):
    with pytest.raises(OutlapError, match="adaptation: replay_step is not a known field"):
        make_plan(["table-3"], budget_file(tmp_path, "c", adaptation__replay_step=3))
    with pytest.raises(OutlapError, match=r"training of .* total_step is not a known field; did you mean total_steps"):
        make_plan(["table-3"], budget_file(tmp_path, "d", training__ppo__total_step=3))


def test_all_methods_of_a_budget_are_trained_for_the_same_penalties(whole: Plan):
    for unit in whole.units:
        if isinstance(unit, TrainingUnit):
            reward = unit.config.env.reward
            assert (reward.resolved()["collision"], reward.collision_min) == (0.3, 1.0)
            assert (reward.collision_max, reward.collision_growth) == (15.8, 2.0)
    for unit in make_plan(["all"], "paper", seeds=1).units:
        if isinstance(unit, TrainingUnit):
            assert (unit.config.env.reward.preset, unit.config.env.reward.collision_max) == ("paper", 1.0)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("training: {algorithm: mql}\nadaptation: {clip: half}", "adaptation: clip is 'half'; must be"),
        (
            "training: {algorithm: mql}\nadaptation: {clip: {rule: abc, kk: 2}}",
            "adaptation: clip.abc.kk is not a known",
        ),
        (
            "training: {algorithm: mql}\nadaptation: {clip: abc, iterations: 2.5}",
            "iterations is 2.5; must be a valid integer",
        ),
        ("training: {algorithm: a2c}", "algorithm is 'a2c'; must be one of ppo"),
        ("driver: nobody", "driver is 'nobody'; must be"),
        ("driver: antigravity:fly", "driver antigravity:fly: is a module, which runs code when it is imported"),
        ("driver: follow-the-gap\nagainst: [nobody]", "is to be compared with 'nobody'"),
    ],
)
def test_a_wrong_method_is_found_before_any_work(content: str, said: str, tmp_path: Path):
    path = tmp_path / "mine.yaml"
    path.write_text(f"title: Mine\n{content}\n")
    with pytest.raises(OutlapError) as error:
        make_plan(["table-3"], "cpu", [str(path)], 1)
    assert said in str(error.value)


def test_a_clip_rule_takes_constants_of_its_own():
    settings = adaptation_settings({"clip": {"rule": "abc", "k": 2}, "replay_steps": 7})
    assert (settings.clip, settings.replay_steps) == (AdaptiveBetaClip(k=2), 7)


def test_names_are_not_taken_twice(tmp_path: Path):
    (tmp_path / "mql.yaml").write_text("title: Mine\ntraining: {algorithm: mql}\n")
    with pytest.raises(OutlapError, match="another one is called mql; rename the file"):
        make_plan(["table-3"], "cpu", [str(tmp_path / "mql.yaml")])
    path = tmp_path / "mine.yaml"
    path.write_text(
        "title: x\ncircuits: [{title: x, train: [Foxglove]}]\ntables: {vehicles: {title: x, circuits: train}}\n"
    )
    with pytest.raises(OutlapError, match="is called vehicles already"):
        make_plan([str(path)], "cpu")


def test_a_track_that_changes_under_its_name_is_noticed(tmp_path: Path):
    plan = make_plan(["table-1"], "smoke", ["follow-the-gap"], 1)
    assert plan.tracks == ["Emberley"]
    remember_tracks(plan.tracks, tmp_path)
    remember_tracks(plan.tracks, tmp_path)
    (tmp_path / "tracks.json").write_text('{"Emberley": "another"}')
    with pytest.raises(OutlapError, match="was made with another track called Emberley"):
        remember_tracks(plan.tracks, tmp_path)


def test_the_papers_tables_and_figures_can_be_named():
    assert {"table-1", "table-2", "table-3", "figure-2", "appendix", "all"} <= {*artefacts()}
