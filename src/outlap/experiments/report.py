"""The report: one folder with Markdown, a single-file page, figures, JSON, and every episode's row."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pandas as pd
import yaml

from outlap.evaluation.results import ROWS, write_rows
from outlap.experiments import figures
from outlap.experiments.document import Document
from outlap.experiments.opponent_units import OpponentUnit
from outlap.experiments.paper_units import COLLECTING_WORLDS, RaceUnit, adaptation_settings
from outlap.experiments.plan import CLIPPING_TASKS, Plan
from outlap.experiments.results import (
    METRICS,
    Cell,
    TableResult,
    entries,
    interval_text,
    ratio_over_adaptations,
    read_rows,
    table_result,
)
from outlap.experiments.unit import done_record
from outlap.files import atomic_write, to_json
from outlap.mql.propensity import CLIP_RULES
from outlap.provenance import provenance

APPENDIX_TITLES = {
    ("opponents", "vanilla-dr"): "Appendix B: Vanilla DR learns against opponents",
    ("opponents", "mql-abc"): "Appendix C: MQL is meta-trained against opponents",
    ("tracks", "vanilla-dr"): "Appendix E: Vanilla DR learns many tracks",
    ("tracks", "mql-abc"): "Appendix F: MQL is meta-trained on many tracks",
}
PAPER_VARIANCES = {"fixed": 2.23e-6, "abc": 8.40e-7}  # of the critic loss, by clip rule


def write_report(plan: Plan, folder: Path) -> dict[str, Any]:
    """Write the report of a plan whose units are all done.

    Args:
        plan: what was made.
        folder: for the report; `folder/work` holds the units.

    Returns:
        What `results.json` holds.
    """
    work = folder / "work"
    titles = {name: method.title for name, method in plan.methods.items()}
    rows = read_rows(plan, work)
    results = [table_result(plan, table, rows) for table in plan.tables]
    document = Document(folder)
    document.clear()
    (folder / ROWS).unlink(missing_ok=True)
    document.text(f"# outlap: the paper's experiments, budget `{plan.budget_name}`", _introduction(plan, work))
    for result in results:
        _write_table(document, plan, work, result, titles)
    if len(results) > 0:
        document.text(
            "## How far every method comes",
            "Performance profiles: the share of trainings and tasks whose mean progress, as a share of what top speed "
            "would give in the time, is above τ.",
        )
        document.figure("profiles", figures.draw_profiles(results, titles, "How far every method comes"))
        document.text("## What went into every method")
        races = [race for table in plan.tables for race in table.races]
        document.table(_effort(method, title, races, work) for method, title in titles.items())
    data: dict[str, Any] = {"tables": {result.plan.name: entries(result) for result in results}}
    data["comparisons"] = {result.plan.name: [asdict(each) for each in result.comparisons] for result in results}
    if plan.clipping:
        data["figure-2"] = _write_clipping(document, plan, work)
    if plan.curves:
        _write_appendix(document, plan, work)
    record = {
        **provenance(),
        "core_seconds": _core_seconds(plan, work),
        "budget": plan.budget,
        "methods": plan.methods,
        "task_sets": plan.task_sets,
        "circuits": {table.name: plan.circuits[table.task_set] for table in plan.tables},
    }
    _write_record(document, plan, record)
    data["record"] = record
    if len(rows):
        write_rows(rows, folder / ROWS)
    atomic_write(folder / "results.json", to_json(data) + "\n")
    document.save(f"outlap: the paper's experiments ({plan.budget_name})")
    return data


def _introduction(plan: Plan, work: Path) -> str:
    budget = plan.budget
    seconds = sum(_core_seconds(plan, work).values())
    effort = f"{seconds / 3600.0:.1f} core hours" if seconds > 3600.0 else f"{seconds / 60.0:.0f} core minutes"
    trainings = "1 training" if budget.seeds == 1 else f"{budget.seeds} trainings"
    return (
        f"Budget `{plan.budget_name}`: {budget.title}; {trainings} of every method, {effort} of work.\n\n"
        "How to read the tables: a number is the mean over trainings with different seeds; in brackets is Student's "
        "95 % interval of that mean, whose unit is the seed. The sd is over episodes, as in the paper. A comparison is "
        "paired by seed and task, and says `better` or `worse` only where the interval of the difference leaves out "
        "zero; intervals are not corrected for the number of comparisons."
    )


def _write_table(document: Document, plan: Plan, work: Path, result: TableResult, titles: Mapping[str, str]) -> None:
    table = result.plan
    race = table.races[0]
    title = f"{result.title}; {plan.circuits[table.task_set].title}"
    document.text(f"## {title}")
    names = ", ".join(dict.fromkeys(task.track for task in race.tasks))
    document.text(
        f"{len(race.tasks)} tasks on {names}; {race.episodes} races of {race.time_limit:g} s on each, for every method "
        "and training."
    )
    if race.population is not None:
        document.text(_verification(race.population.opponents, work))
    paper = [name for name in result.metrics if any(row[name].published is not None for row in result.cells.values())]
    ours = [name for name in result.metrics if name not in paper]
    if paper:
        document.table(
            {"method": titles[method], **{key: text for name in paper for key, text in _reported(name, row[name])}}
            for method, row in result.cells.items()
        )
    document.table(
        {
            "method": titles[method],
            **{METRICS[name].heading: _value(name, row[name]) for name in ours},
            "IQM of progress [m]": _iqm(row["progress_m"]),
        }
        for method, row in result.cells.items()
    )
    document.figure(table.name, figures.draw_intervals(result.cells, ("crashes", "progress_m"), titles, title))
    if result.comparisons:
        document.text("### What this shows")
        document.table(each.row(titles) for each in result.comparisons)


def _value(name: str, cell: Cell) -> str:
    metric = METRICS[name]
    sd = "" if metric.is_count else f" ± {cell.sd:.{metric.digits}f}"
    return f"{cell.mean:.{metric.digits}f}{sd}{interval_text(cell.low, cell.high, metric.digits)}"


def _reported(name: str, cell: Cell) -> list[tuple[str, str]]:
    """Return a number and that of the paper, each with its heading."""
    published = cell.published if isinstance(cell.published, tuple) else (cell.published,)
    text = " ± ".join(f"{number:g}" for number in published if number is not None)
    heading = METRICS[name].heading
    return [(heading, _value(name, cell)), (f"{heading}, the paper", text)]


def _iqm(cell: Cell) -> str:
    return f"{cell.iqm:.1f}{interval_text(cell.iqm_low, cell.iqm_high, 1)}"


def _read_clipping(plan: Plan, work: Path, name: str) -> pd.DataFrame:
    return pd.concat(
        [pd.read_parquet(unit.folder(work) / f"{name}.parquet") for unit in plan.clipping], ignore_index=True
    )


def _write_clipping(document: Document, plan: Plan, work: Path) -> dict[str, Any]:
    """Write figure 2; return the numbers of every rule, and ABC's against the others'."""
    updates, gradients = _read_clipping(plan, work, "updates"), _read_clipping(plan, work, "gradients")
    iterations = _read_clipping(plan, work, "iterations")
    unit = ["seed", "adaptation_seed", "rule"]
    of_losses = updates.pivot_table(index=unit, values="critic_loss", aggfunc="var").reset_index()
    title = f"Figure 2: what clipping does to adaptation; {plan.circuits[CLIPPING_TASKS].title}"
    document.text(
        f"## {title}",
        f"{len(plan.clipping)} adaptations to unseen circuits; for every clip rule the same transitions of the new "
        "circuit, the same replay and the same batches. The two panels at the upper left are of the weighted loss, as "
        "the paper's figure is; sample size and the gradient's variance do not change when all weights are scaled by "
        "one constant. Lines: median over adaptations, with quartiles.",
    )
    document.figure("figure-2", figures.draw_figure_2(updates, gradients, title))
    numbers = (
        ("loss_variance", "variance of the weighted critic loss over updates", of_losses, "critic_loss"),
        ("loss_variance_in_batch", "the same over the transitions of a batch", updates, "critic_loss_variance"),
        ("effective_sample_size", "effective sample size", updates, "effective_sample_size"),
        ("gradient_variance", "gradient variance over batches, β of mean 1", gradients, "gradient_variance"),
        ("replay_td_error", "TD error of the replay, β = 1", updates, "td_error"),
        ("task_td_error", "TD error of the new circuit, β = 1", iterations, "on_task_critic_loss"),
    )
    found = {
        name: _clipping_numbers(source, column, PAPER_VARIANCES if name == "loss_variance" else {})
        for name, _, source, column in numbers
    }
    labels = {name: label for name, label, *_ in numbers}
    document.text("Medians over all adaptations:")
    document.table(
        {"number": labels[name], **{figures.RULES[rule]: _median(each[rule]) for rule in CLIP_RULES}}
        for name, each in found.items()
    )
    document.text(
        f"ABC over another rule: geometric mean of the ratio [95 %]; the unit is the training, of which there are "
        f"{len({unit.seed for unit in plan.clipping})}. Below 1: ABC's is the smaller."
    )
    document.table(
        {"number": labels[name], "ABC over": figures.RULES[other], **_ratio(each[f"abc_over_{other}"])}
        for name, each in found.items()
        for other in ("none", "fixed")
    )
    return found


def _clipping_numbers(source: pd.DataFrame, column: str, paper: Mapping[str, float]) -> dict[str, dict[str, Any]]:
    """Return the median of a number for each clip rule, and ABC's ratio to the others, with what the paper has."""
    medians = source.groupby("rule")[column].median().to_dict()
    found: dict[str, dict[str, Any]] = {
        rule: {"value": medians[rule], "published": paper.get(rule)} for rule in CLIP_RULES
    }
    for other in ("none", "fixed"):
        published = paper["abc"] / paper[other] if other in paper else None
        found[f"abc_over_{other}"] = {**ratio_over_adaptations(source, "abc", other, column), "published": published}
    return found


def _median(number: Mapping[str, Any]) -> str:
    note = "" if number["published"] is None else f" (the paper: {number['published']:.3g})"
    return f"{number['value']:.3g}{note}"


def _ratio(ratio: Mapping[str, Any]) -> dict[str, str]:
    """Return a ratio with its interval, what the paper has, and what that shows."""
    return {
        "ratio": f"{ratio['value']:.3g} [{ratio['low']:.3g}, {ratio['high']:.3g}]",
        "the paper": "" if ratio["published"] is None else f"{ratio['published']:.2g}",
        "shown": "**smaller**" if ratio["high"] < 1.0 else "**larger**" if ratio["low"] > 1.0 else "not shown",
    }


def _write_appendix(document: Document, plan: Plan, work: Path) -> None:
    document.text("## Appendix", "### A: opponents of every top speed learn")
    if plan.opponents:
        document.text(_verification(plan.opponents, work))
        curves = {f"{unit.max_speed_mps:g} m/s": [unit.run_folder(work)] for unit in plan.opponents}
        _write_learning(document, "a", curves, "Appendix A: PPO for every top speed")
    else:
        document.text("Not in this budget: the opponents are those that come with outlap.")
    for letter, (key, title) in zip("BCEF", APPENDIX_TITLES.items(), strict=True):
        units = plan.curves.get(key, ())
        if not units:
            continue
        document.text(f"### {letter}: {title.partition(': ')[2]}; {plan.circuits[key[0]].title}")
        _write_learning(document, letter.lower(), {title: [unit.folder(work) for unit in units]}, title)
        if letter == "C":
            document.text("### D: β and ABC's β during adaptation")
            histograms, updates = _read_clipping(plan, work, "histograms"), _read_clipping(plan, work, "updates")
            title = f"Appendix D: β and ABC's β during adaptation; {plan.circuits[CLIPPING_TASKS].title}"
            document.figure("appendix-d", figures.draw_weights(histograms, updates, title))


def _write_learning(document: Document, letter: str, folders: Mapping[str, Sequence[Path]], title: str) -> None:
    curves = {label: [figures.read_learning(each) for each in runs] for label, runs in folders.items()}
    document.figure(f"appendix-{letter}", figures.draw_learning(curves, title))


def _verification(opponents: Sequence[OpponentUnit], work: Path) -> str:
    """Return which opponents completed their laps."""
    first = opponents[0]
    failed = [
        unit.name
        for unit in opponents
        if pd.read_parquet(unit.folder(work) / ROWS)["completed_laps"].to_numpy().min() < unit.laps
    ]
    passed = f"{len(opponents) - len(failed)} of {len(opponents)} opponents completed {first.laps} laps"
    left_out = f"; left out of all races: {', '.join(failed)}" if failed else ""
    return f"{passed} from each of {first.starts} standing starts, alone on {first.track}{left_out}."


def _effort(method: str, title: str, races: Sequence[RaceUnit], work: Path) -> dict[str, str]:
    """Return what a method was trained with, and what it saw of the tasks that it is tested on."""
    mine = [race for race in races if race.method == method]
    trainings = {race.training.key: race.training for race in mine if race.training}.values()
    actions = sorted({unit.config.total_steps for unit in trainings})
    minutes = [float(done_record(unit, work)["seconds"]) / 60.0 for unit in trainings]
    adapts = next((race.adaptation for race in mine if race.adaptation is not None), None)
    settings = adaptation_settings(adapts) if adapts is not None else None
    seen = settings.iterations * settings.collect_steps * COLLECTING_WORLDS if settings else 0
    return {
        "method": title,
        "actions of a training": ", ".join(f"{number:,}" for number in actions) or "none",
        "core minutes of one, mean": f"{sum(minutes) / len(minutes):.1f}" if minutes else "0",
        "actions on each test task before the races": f"{seen:,}" if seen else "none",
    }


def _core_seconds(plan: Plan, work: Path) -> dict[str, float]:
    """Return what the units took, by kind."""
    seconds: Counter[str] = Counter()
    for unit in plan.units:
        seconds[unit.kind] += done_record(unit, work)["seconds"]
    return dict(seconds)


def _write_record(document: Document, plan: Plan, record: Mapping[str, Any]) -> None:
    """Command, machine, versions, and everything that was configured."""
    machine = record["machine"]
    versions = ", ".join(f"{name} {version}" for name, version in record["versions"].items())
    document.text(
        "## How this was made",
        f"```sh\n{record['command']}\n```",
        f"{machine['processor']}, {machine['cores']} cores, {machine['system']}; {versions}.",
    )
    counts = Counter(unit.kind for unit in plan.units)
    document.table(
        {"work": kind, "units": str(counts[kind]), "core minutes": f"{seconds / 60.0:.0f}"}
        for kind, seconds in record["core_seconds"].items()
    )
    methods = {name: method.model_dump(mode="json", exclude_defaults=True) for name, method in plan.methods.items()}
    settings = {"budget": plan.budget.model_dump(mode="json", exclude_defaults=True), "methods": methods}
    document.text(
        "### Configuration",
        f"```yaml\n{yaml.safe_dump(settings, sort_keys=False, allow_unicode=True)}```",
        f"Every episode is a row of `{ROWS}`; all numbers are in `results.json`, task sets included. The run folder of "
        "each training is under `work/trainings`.",
    )
