"""Numbers by formula: what they give, in which unit, and everything that is refused."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from evaluation.errors import EvaluationError
from evaluation.measures.formula import (
    Value,
    part_nodes,
    powers,
    read_formula,
    read_formulas,
    read_limit,
    unit_of,
)
from evaluation.measures.probes import cfc_filter

TIME = np.linspace(0, 0.02, 41)
SAMPLES = np.arange(0, 0.02, 1e-4)


@dataclass
class Toy:
    """Two runs of eight nodes: the box (nodes 0 to 3) moves along x, the rail turns about z."""

    parts: Mapping[str, NDArray[np.int64]] = field(
        default_factory=lambda: {"crash_box_left": np.arange(4), "rail_left": np.arange(4, 8)}
    )
    x: NDArray[np.float64] = field(default_factory=lambda: np.random.default_rng(0).normal(size=(8, 3)))

    def nodes(self, number: int) -> NDArray[np.int64]:
        return np.array([number - 100]) if 100 <= number < 108 else np.empty(0, np.int64)

    def position(self, nodes: NDArray[np.int64] | None) -> NDArray[np.float64]:
        return self.x if nodes is None else self.x[nodes]

    def displacement(self, nodes: NDArray[np.int64] | None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        u = np.zeros((2, len(TIME), 8, 3))
        for run, speed in enumerate((2.0, 3.0)):
            u[run, :, :4, 0] = -speed * TIME[:, None] * (1 + np.arange(4))
        return TIME, u if nodes is None else u[:, :, nodes]

    def named(self, name: str) -> Value | None:
        wave = np.sin(2 * np.pi * 50 * SAMPLES) * np.array([[1e3], [2e3]])
        if name == "thickness":
            return Value(np.array([1e-3, 2e-3]), (), None, "m")
        if name in ("wall_force_x", "wall_force_y"):
            return Value(wave * (3 if name.endswith("x") else 4), ("time",), SAMPLES, "N")
        return None

    @property
    def names(self) -> Sequence[str]:
        return ("wall_force_x", "wall_force_y", "thickness")


def of(text: str) -> Value:
    return read_formula(text).number(Toy())


def test_the_largest_displacement_of_a_part_along_an_axis() -> None:
    found = of("max(displacement(part=box, along=-x))")
    np.testing.assert_allclose(found.array, [2 * 0.02 * 4, 3 * 0.02 * 4])
    assert found.unit == "m"
    np.testing.assert_allclose(of("min(displacement(part=box, along=x))").array, -found.array)
    np.testing.assert_allclose(of("displacement(part='crash_*').max()").array, found.array)


def test_velocity_and_time_of_a_node() -> None:
    found = of("max(velocity(node=102, along=-x))")
    np.testing.assert_allclose(found.array, [6, 9])
    assert found.unit == "m s-1"
    np.testing.assert_allclose(of("at(displacement(node=102), '10 ms').max()").array, [0.06, 0.09])
    np.testing.assert_allclose(of("displacement(node=102).time_of_max().max()").array, 0.02)


def test_against_a_part_takes_its_rigid_motion_out() -> None:
    still = of("max(displacement(part=box, against=rail))").array
    np.testing.assert_allclose(still, of("max(displacement(part=box))").array)
    np.testing.assert_allclose(of("max(displacement(part=rail, against=rail))").array, 0, atol=1e-12)


def test_a_force_is_the_resultant_of_its_components_and_is_filtered_as_j211_says() -> None:
    assert of("wall_force.max()").array == pytest.approx([5e3, 1e4], rel=1e-3)
    raw = Toy().named("wall_force_x")
    assert raw is not None
    np.testing.assert_allclose(
        of("cfc180(wall_force_x).max()").array, cfc_filter(SAMPLES, raw.array.T, 180).max(axis=0), rtol=1e-12
    )


def test_units_follow_arithmetic() -> None:
    assert of("max(wall_force_x) * max(displacement(part=box))").unit == "J"
    assert of("integral(wall_force_x)").unit == unit_of(powers("N s"))
    assert of("max(wall_force_x) / 9.81").unit == "N"
    assert of("sqrt(max(displacement()) ** 2)").unit == "m"
    assert of("max(displacement()) / thickness").unit == "1"
    with pytest.raises(EvaluationError, match="N and m are added"):
        of("max(wall_force_x) + max(displacement())")


def test_numbers_may_name_each_other_but_not_in_a_circle() -> None:
    formulas = read_formulas({"intrusion": "max(displacement(part=box))", "share": "intrusion / thickness"})
    assert formulas["share"].number(Toy(), formulas).array == pytest.approx([160, 120])
    with pytest.raises(EvaluationError, match="a -> b -> a"):
        read_formulas({"a": "b + 1", "b": "a + 1"})


def test_gaps_are_left_out() -> None:
    class Eroding(Toy):
        def displacement(self, nodes: NDArray[np.int64] | None) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
            time, u = Toy.displacement(self, None)
            u[0, 20:, 3] = np.nan
            return time, u if nodes is None else u[:, :, nodes]

    toy = Eroding()
    np.testing.assert_allclose(read_formula("max(displacement(part=box))").number(toy).array, [0.12, 0.24])
    np.testing.assert_allclose(read_formula("last(displacement(node=103)).max()").number(toy).array, [0.076, 0.24])


def test_limits_have_units() -> None:
    formulas = read_formulas({"intrusion": "max(displacement(part=box))"})
    limit = read_limit("intrusion < 200 mm", formulas)
    assert limit.bound == pytest.approx(0.2)
    assert list(limit.kept(limit.formula.number(Toy(), formulas))) == [True, False]
    with pytest.raises(EvaluationError, match="the limit is in N"):
        read_limit("intrusion < 5 kN", formulas).kept(limit.formula.number(Toy()))
    with pytest.raises(EvaluationError, match=r"intrusion < 200: .* is in m; write the unit of the limit"):
        read_limit("intrusion < 200", formulas).kept(limit.formula.number(Toy()))
    for bad in ("intrusion", "intrusion < ", "1 < intrusion < 2", "intrusion == 3", "intrusion < 3 parsec2x"):
        with pytest.raises(EvaluationError, match=r"limit|unit"):
            read_limit(bad, formulas)


@pytest.mark.parametrize(
    "text",
    [
        "__import__('os').system('true')", "(lambda: 1)()", "displacement.__class__", "[1, 2]", "max(x for x in y)",
        "open('file')", "thickness if 1 else 2", "f'{1}'", "9 ** 9 ** 9", "thickness ** -1", "max(*thickness)",
        "displacement(box)", "displacement(layer=3)", "max(1, key=2)", "1e999", "True", "", "max(", "x; y", "a = 1",
        "thickness & 1", "not thickness", "b'x'", "1j", "...", "(" * 300 + "1" + ")" * 300,
    ],
)  # fmt: skip
def test_what_is_not_on_the_list_is_refused(text: str) -> None:
    with pytest.raises(EvaluationError):
        read_formula(text, "kpi")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("max(displacement(part=door))", "no part 'door'; there are crash_box_left, rail_left"),
        ("displacement(part=box)", "a value for each time and node"),
        ("airbag.max()", "airbag is no history, parameter or number; there are wall_force_x"),
        ("displacement(node=7).max()", "there is no node 7"),
        ("max(displacement(along=up))", "along=up is no direction"),
        ("cfc1000(displacement(node=101)).max()", "CFC 1000 needs 10 kHz"),
        ("max(wall_force_x, 3)", "max of values in N, 1"),
        ("at(wall_force_x, '1 s')", "lies outside the times"),
    ],
)
def test_what_the_runs_do_not_have_is_named(text: str, said: str) -> None:
    with pytest.raises(EvaluationError, match=said):
        of(text)


def test_a_part_is_meant_by_name_pattern_or_word() -> None:
    parts = {"rail": np.array([1]), "rail_left": np.array([2]), "Box Right": np.array([3, 1])}
    assert list(part_nodes(parts, "rail")) == [1]
    assert list(part_nodes(parts, "rail*")) == [1, 2]
    assert list(part_nodes(parts, "box")) == [1, 3]


@given(st.text(alphabet="max(displ=bo,x)*/+-.0123_'ahtikne ", max_size=60))
def test_any_text_is_read_or_refused_in_one_line(text: str) -> None:
    try:
        read_formula(text)
    except EvaluationError as error:
        assert "\n" not in str(error)  # noqa: PT017


@given(st.dictionaries(st.sampled_from(["kg", "m", "s", "K"]), st.integers(-4, 4)))
def test_units_go_there_and_back(exponents: dict[str, int]) -> None:
    assert powers(unit_of(exponents)) == {base: p for base, p in exponents.items() if p}


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("max(displacement(part=box)", "lacks a closing bracket"),
        ("max(displacement(part='b)x'", "lacks 2 closing brackets"),
        ("max(speed))", "lacks an opening bracket"),
    ],
)
def test_a_missing_bracket_is_named(text: str, told: str) -> None:
    with pytest.raises(EvaluationError, match=told):
        read_formula(text)
