from __future__ import annotations

import math
from collections.abc import Mapping
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sierra.errors import ConfigError
from sierra.model import Value
from sierra.templates.arithmetic import MAX_LENGTH, fill, names, names_in, number
from tests.effort import is_cheap

AXES: Mapping[str, Value] = {"population_size": 8, "noise": 0.25, "scenario": "low", "seed": 42}


@pytest.mark.parametrize(
    ("text", "filled"),
    [
        ("plain", "plain"),
        ("", ""),
        ("{population_size}", "8"),
        ("{ population_size * 2 }", "16"),
        ("a{population_size}b{noise}c", "a8b0.25c"),
        ("{population_size / 2}", "4"),
        ("{7 / 2}", "3.5"),
        ("{8.0 / 2}", "4.0"),
        ("{7 // 2} {7 % 4} {2 ** 10} {-population_size} {+3}", "3 3 1024 -8 3"),
        ("{(1 + 2) * 3}", "9"),
        ("{2\n+ 3}", "5"),
        ("{round(2.5)} {round(2.345, 2)} {round(2.5, 0)}", "2 2.35 2.0"),
        ("{floor(2.7)} {ceil(2.1)} {abs(-3)} {sqrt(16)} {min(3, noise)} {max(1, 2, 3)}", "2 3 3 4.0 0.25 3"),
        ("{log(8, 2)} {exp(0)} {sin(0)} {cos(0)}", "3.0 1.0 0.0 1.0"),
        ("{pi}", repr(math.pi)),
        ("{noise * 1e-9}", "2.5e-10"),
        ("{scenario}-{seed}", "low-42"),
        ("{{{seed}}} {{literal}}", "{42} {literal}"),
    ],
)
def test_expressions_are_replaced_by_their_values(text: str, filled: str) -> None:
    assert fill(text, AXES) == filled


def test_a_given_value_overrides_pi() -> None:
    assert fill("{pi}", {"pi": 3}) == "3"


def test_a_variable_may_be_named_like_a_keyword_or_a_function() -> None:
    assert fill("{lambda} {min} {min(min, 2)}", {"lambda": 1, "min": 5}) == "1 5 2"


def test_texts_are_inserted_unchanged() -> None:
    assert fill("{name}", {"name": "{seed} \" '\n<&>"}) == "{seed} \" '\n<&>"


@given(st.text())
def test_any_text_with_doubled_braces_stays_unchanged(text: str) -> None:
    assert fill(text.replace("{", "{{").replace("}", "}}"), {}) == text


@st.composite
def calculations(draw: st.DrawFn, depth: int = 3) -> str:
    if depth == 0 or draw(st.booleans()):
        return draw(st.sampled_from(["a", "b", "7", "12", "0"]))
    left, right = draw(calculations(depth - 1)), draw(calculations(depth - 1))
    return draw(st.sampled_from([f"({left} {sign} {right})" for sign in "+-*"] + [f"-{left}", f"abs({left})"]))


@pytest.mark.integration
@given(calculations(), st.integers(-1000, 1000), st.integers(-1000, 1000))
def test_integers_are_calculated_as_in_python(source: str, a: int, b: int) -> None:
    assert fill(f"{{{source}}}", {"a": a, "b": b}) == str(eval(source, {"a": a, "b": b}))  # noqa: S307


@given(st.integers(), st.integers().filter(bool))
def test_a_division_without_remainder_is_an_exact_integer(a: int, b: int) -> None:
    filled = fill("{a * b / b}", {"a": a % 2**200, "b": b % 2**200 + 1})
    assert filled == str(a % 2**200)


@given(st.integers(-(10**6), 10**6), st.integers(1, 10**6))
def test_floor_division_and_remainders_equal_those_of_python(a: int, b: int) -> None:
    assert fill("{a // b} {a % b}", {"a": a, "b": b}) == f"{a // b} {a % b}"
    assert float(fill("{a / b}", {"a": a, "b": b})) == float(Fraction(a, b))


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_a_float_is_written_so_that_it_is_read_back_exactly(value: float) -> None:
    assert fill("{x}", {"x": value}) == repr(value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "{populaton_size * 2}",
            "unknown name 'populaton_size'.*did you mean 'population_size'.*noise, population_size",
        ),
        ("{zzz}", "unknown name 'zzz'.*known are noise, population_size, scenario, seed"),
        ("{sqr(2)}", "unknown function 'sqr'.*did you mean 'sqrt'"),
        ("{scenario * 2}", "'scenario' is the text 'low', not a number"),
        ("{scenario + scenario}", "not a number"),
        ("{1 / 0}", "'{1 / 0}' has no value: division by zero"),
        ("{0 ** -1}", "division by zero"),
        ("{sqrt(-1)}", "'{sqrt.*}' has no value"),
        ("{(-1) ** 0.5}", "complex"),
        ("{sqrt()}", "has no value"),
        ("{min()}", "has no value"),
        ("{round(1, 2.5)}", "2.5 digits"),
        ("{", "write {{ for a literal {"),
        ("}", "write }} for a literal }"),
        ("{seed", "write {{"),
        ("{}", "contains no expression"),
        ("{  }", "contains no expression"),
        ("{1 +}", "is not an expression"),
        ("{1 2}", "is not an expression"),
        ("{1; 2}", "is not an expression"),
        ("{a := 1}", "is not an expression"),
        ("{" + "1+" * MAX_LENGTH + "1}", "longer than 200"),
    ],
)
def test_invalid_expressions_are_reported_in_one_line(text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message) as caught:
        fill(text, AXES)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "hostile",
    [
        "{__import__('os').system('true')}",
        "{seed.__class__}",
        "{[x for x in (1,)]}",
        "{(lambda: 1)()}",
        "{seed[0]}",
        "{'text'}",
        "{b'bytes'}",
        "{f(1)}",
        "{min(*seed)}",
        "{round(1.5, ndigits=1)}",
        "{1 if seed else 2}",
        "{1 < 2}",
        "{seed and 1}",
        "{not seed}",
        "{~seed}",
        "{1 << 1000000}",
        "{seed @ seed}",
        "{True}",
        "{1j}",
        "{...}",
        "{(1, 2)}",
        "{print}",
        "{seed\0}",
        "{\ud800}",
    ],
)
def test_expressions_that_are_not_arithmetic_are_refused(hostile: str) -> None:
    with pytest.raises(ConfigError) as caught:
        fill(hostile, AXES)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "bomb",
    [
        "{9 ** 9 ** 9}",
        "{(2 ** 1000) ** 1000}",
        "{(-7) ** 99999999999}",
        "{2 ** 1000 * 2 ** 1000}",
        "{1e999}",
        "{1e308 * 10}",
        "{1e308 * 10 - 1e308 * 10}",
        "{exp(1000)}",
        "{10.0 ** 400}",
        "{round(5, -10 ** 9)}",
        "{" + "(" * 99 + "1" + ")" * 99 + "**9**9**9}",
        "{" + "-" * 199 + "x}",
    ],
)
def test_huge_and_infinite_results_are_refused_quickly(bomb: str) -> None:
    def refused() -> None:
        with pytest.raises(ConfigError):
            fill(bomb, AXES)

    assert is_cheap(refused, 10)


@pytest.mark.parametrize(
    "vanishing",
    [
        "1e-400",
        "-1e-400",
        "1e-200 * 1e-200",
        "1e-200 / 1e200",
        "1 / 10 ** 308 / 10 ** 308",
        "0.5 ** 2000",
        "10 ** -400",
        "exp(-1000)",
        "-exp(-1000)",
        "exp(-1000) * 1e300 + 0",
        "max(0, exp(-1000))",
        "tiny * tiny",
    ],
)
def test_a_result_that_is_too_close_to_0_is_refused(vanishing: str) -> None:
    with pytest.raises(ConfigError, match=r"has no value: .*too close to 0$"):
        fill(f"{{{vanishing}}}", {"tiny": 1e-300})


@pytest.mark.parametrize(
    ("expression", "value"),
    [
        ("1 / (1 + exp(-1000))", "1.0"),
        ("round(exp(-1000), 3)", "0.0"),
        ("floor(exp(-1000))", "0"),
        ("exp(-1000) * 0", "0.0"),
        ("0 * 1e-300", "0.0"),
        ("0.0 ** 2", "0.0"),
        ("0 / 5", "0"),
        ("1.5 - 1.5", "0.0"),
        ("0e-400", "0.0"),
        ("2e-310", "2e-310"),
    ],
)
def test_a_result_that_is_0_or_not_affected_by_a_tiny_value_stays(expression: str, value: str) -> None:
    assert fill(f"{{{expression}}}", {}) == value


def test_a_prediction_that_is_too_close_to_0_is_0() -> None:
    assert number("exp(-t)", {"t": 1000}) == 0.0


@pytest.mark.parametrize("value", [math.inf, -math.inf, math.nan, 2**2000])
def test_a_value_that_is_not_finite_is_refused(value: float) -> None:
    with pytest.raises(ConfigError):
        fill("{x}", {"x": value})


@given(st.text(alphabet="{}0123456789abx.+-*/%(), \n_'\"\\#:=<ifelsornt\0é", max_size=30))
def test_any_text_is_filled_or_refused_in_one_line(text: str) -> None:
    message = ""
    try:
        fill(text, {"a": 3, "b": 0.5, "x": "text"})
    except ConfigError as error:
        message = str(error)
    assert "\n" not in message


def test_names_are_the_variables_that_a_text_needs() -> None:
    assert names("{min(a, -b) + pi} {c} {{d}} e") == {"a", "b", "c"}
    assert names("no braces, {{none}}") == frozenset()


def test_an_expression_without_braces_has_a_number_and_names() -> None:
    assert number("1 - exp(-n * t) / 2", {"n": 0, "t": 3}) == 0.5
    assert names_in("1 - exp(-n * t) / pi") == {"n", "t"}
    with pytest.raises(ConfigError, match=r"'n / t' has no value: division by zero"):
        number("n / t", {"n": 1, "t": 0})
    with pytest.raises(ConfigError, match="is not allowed in"):
        names_in("{n}")


def test_names_refuses_invalid_expressions_like_fill() -> None:
    with pytest.raises(ConfigError, match="is not an expression"):
        names("{1 +}")


def test_filling_ten_thousand_times_is_fast() -> None:
    def fill_all() -> None:
        for seed in range(10_000):
            fill("{seed}:{population_size * 2}", {"seed": seed, "population_size": 8})

    assert is_cheap(fill_all, 20)
