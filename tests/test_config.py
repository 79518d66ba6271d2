"""What is read back is what was saved, and every mistake is one line that says what would be right."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import pytest
import tyro
import yaml
from pydantic import Field, ValidationError

from outlap.config import Config, Number, bounded, bounds, load_config, save_config, validate
from outlap.errors import OutlapError


class Tyre(Config):
    stiffness: Annotated[Number, bounded(above=0.0)] = 10.0


class Vehicle(Config):
    mu: Annotated[Number, bounded(above=0.0, at_most=2.0)] = (0.5, 1.1)
    mass: float = Field(default=3.5, gt=0)  # [kg]
    tyre: Tyre = Tyre()
    spare: Tyre | None = None
    model: Literal["kinematic", "drift"] = "drift"


class Race(Config):
    vehicle: Vehicle = Vehicle()
    seed: int = 0
    tracks: tuple[str, ...] = ("IMS",)
    folder: Path = Path("runs")


def write(folder: Path, text: str) -> Path:
    path = folder / "race.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def test_saved_config_reads_back_equal(tmp_path: Path) -> None:
    race = Race(vehicle=Vehicle(mu=(0.4, 1.0), spare=Tyre(stiffness=1e-05)), seed=7, tracks=("A b", "Ü"))
    assert load_config(Race, save_config(race, tmp_path / "new" / "race.yaml")) == race


def test_a_range_is_saved_as_min_and_max(tmp_path: Path) -> None:
    content = yaml.safe_load(save_config(Race(), tmp_path / "race.yaml").read_text())
    assert content["vehicle"]["mu"] == {"min": 0.5, "max": 1.1}
    assert content["vehicle"]["tyre"]["stiffness"] == 10.0


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0.8", 0.8),
        ("1", 1.0),
        ("1e-3", 0.001),  # a string for YAML 1.1
        ("{min: 0.5, max: 1}", (0.5, 1.0)),
        ("{max: 0.5, min: 0.5}", (0.5, 0.5)),
        ("[0.25, 0.75]", (0.25, 0.75)),
    ],
)
def test_number_from_yaml(tmp_path: Path, text: str, expected: float | tuple[float, float]) -> None:
    mu = load_config(Race, write(tmp_path, f"vehicle: {{mu: {text}}}")).vehicle.mu
    assert mu == expected
    assert type(mu) is type(expected)


def test_an_empty_file_gives_the_defaults(tmp_path: Path) -> None:
    assert load_config(Race, write(tmp_path, "# nothing\n")) == Race()


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("vehicle: {mu: -1}", "vehicle.mu is -1; must be > 0.0 and <= 2.0"),
        ("vehicle: {mu: {min: 0, max: 1}}", "vehicle.mu is {'min': 0, 'max': 1}; must be > 0.0 and <= 2.0"),
        ("vehicle: {mu: {min: 1, max: 3}}", "vehicle.mu is {'min': 1, 'max': 3}; must be > 0.0 and <= 2.0"),
        ("vehicle: {mu: {min: 2, max: 1}}", "vehicle.mu is {'min': 2, 'max': 1}; must have min <= max"),
        ("vehicle: {mu: {min: 1}}", "vehicle.mu is {'min': 1}; must have exactly the two keys min and max"),
        ("vehicle: {mu: .nan}", "vehicle.mu is nan; must be finite"),
        ("vehicle: {mu: yes}", "vehicle.mu is True; must be a number or a range {min: a, max: b}"),
        ("vehicle: {mu: wet}", "vehicle.mu is 'wet'; must be a number or a range {min: a, max: b}"),
        ("vehicle: {mu: [1, 2, 3]}", "vehicle.mu is [1, 2, 3]; must be a number or a range {min: a, max: b}"),
        ("vehicle: {mass: 0}", "vehicle.mass is 0; must be > 0.0"),
        ("vehicle: {mass: .inf}", "vehicle.mass is inf; must be a finite number"),
        ("vehicle: {mas: 3}", "vehicle.mas is not a known field; did you mean mass?"),
        (
            "vehicle: {tyre: {stifness: 3}}",
            "vehicle.tyre.stifness is not a known field; did you mean stiffness?",
        ),
        ("vehicle: {spare: {xyz: 3}}", "vehicle.spare.xyz is not a known field; the fields are stiffness"),
        (
            "vehicle: {model: drft}",
            "vehicle.model is 'drft'; must be 'kinematic' or 'drift'; did you mean 'drift'?",
        ),
        ("vehicle: 3", "vehicle is 3; must be a mapping of fields to values"),
        ("seed: yes", "seed is True; must be a number"),
        ("seed: 1.5", "seed is 1.5; must be a valid integer"),
        ("tracks: IMS", "tracks is 'IMS'; must be a valid tuple"),
        ("[1, 2]", "is [1, 2]; must be a mapping of fields to values"),
        ("seed: 1\nvehicle: {mu: [", "is not valid YAML: .*(line 2)"),
        ("seed: !!python/object/apply:os.getcwd []", "is not valid YAML: could not determine a constructor"),
    ],
)
def test_a_mistake_is_one_line_with_file_field_value_and_remedy(tmp_path: Path, text: str, complaint: str) -> None:
    path = write(tmp_path, text)
    with pytest.raises(OutlapError) as caught:
        load_config(Race, path)
    message = str(caught.value)
    start, _, end = complaint.partition(".*")
    assert message.startswith(f"{path}: {start}")
    assert end in message
    assert "\n" not in message


def test_a_misspelt_field_is_named_before_other_mistakes() -> None:
    with pytest.raises(OutlapError, match=r"did you mean seed\? \(and 1 more\)"):
        validate(Race, {"vehicle": 3, "sed": 4}, "here")


def test_a_long_value_is_shortened() -> None:
    with pytest.raises(OutlapError) as caught:
        validate(Race, {"seed": "x" * 10_000}, "here")
    assert len(str(caught.value)) < 200


@pytest.mark.parametrize("kind", ["missing", "folder", "binary"])
def test_an_unreadable_file_is_named(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "race.yaml"
    if kind == "folder":
        path.mkdir()
    elif kind == "binary":
        path.write_bytes(b"\xff\xfe\x00seed")
    with pytest.raises(OutlapError, match=r"race\.yaml: "):
        load_config(Race, path)


def test_config_is_frozen_and_checks_its_defaults() -> None:
    with pytest.raises(ValidationError):
        Race().seed = 3

    class Wrong(Config):
        mass: float = Field(default=-1.0, gt=0)

    with pytest.raises(ValidationError):
        Wrong()


@pytest.mark.parametrize(("words", "expected"), [(["0.8"], 0.8), (["0.5", "1.1"], (0.5, 1.1))])
def test_number_as_a_flag(words: list[str], expected: float | tuple[float, float]) -> None:
    race = tyro.cli(Race, args=["--vehicle.mu", *words, "--seed", "3"])
    assert race.vehicle.mu == expected
    assert race.seed == 3


def test_bounds_of_a_number() -> None:
    assert bounds(0.8) == (0.8, 0.8)
    assert bounds((0.5, 1.1)) == (0.5, 1.1)
