"""Criteria are parsed exactly, written canonically, and refused with helpful errors; ranges contain exact values."""

from __future__ import annotations

import math
import re
from fractions import Fraction
from unicodedata import normalize

import pytest
from hypothesis import assume, example, given
from hypothesis import strategies as st

from sierra.design.query import grammar, ranges
from sierra.errors import QueryError
from sierra.model import ConstantDensity, Criterion, Linear, Listed, Log, MonteCarlo, Scale, Span, Steps, VariableDensity
from sierra.util.quoted_values import quoted
from tests.effort import is_cheap

NAMES = st.from_regex(r"[A-Za-z_][A-Za-z0-9_]{0,12}", fullmatch=True).filter(lambda name: name != "montecarlo")
WHOLES = st.integers(-ranges.LARGEST, ranges.LARGEST)
COUNTS = st.integers(2, 40)
DECIMALS = st.builds(Fraction, st.integers(-(10**24), 10**24), st.integers(0, 18).map(lambda places: 10**places)).filter(
    lambda number: abs(number) <= ranges.LARGEST
)
POSITIVES = DECIMALS.map(abs).filter(bool)
FLOATS = st.floats(allow_nan=False, allow_infinity=False)
CATEGORIES = st.from_regex(r"[A-Za-z][A-Za-z0-9_.-]{0,8}", fullmatch=True).filter(
    lambda word: word.lower() not in ("nan", "inf", "infinity")
)

TEXTS = st.one_of(
    st.text(min_size=1, max_size=9)
    .map(lambda text: normalize("NFC", text))
    .filter(lambda text: text.isprintable() and not set(text) & set("\u115f\u1160\u3164\uffa0")),
    st.text('"\\\\ ,:=()1.a', min_size=1, max_size=9),
    st.one_of(WHOLES, FLOATS).map(str),
    CATEGORIES,
)


@st.composite
def steps(draw: st.DrawFn) -> Steps:
    start, gap, count = (
        draw(st.integers(-(10**9), 10**9)),
        draw(st.integers(-(10**6), 10**6).filter(bool)),
        draw(COUNTS),
    )
    return Steps(start, start + gap * (count - 1), count)


@st.composite
def spans(draw: st.DrawFn) -> Span:
    span = Span(draw(DECIMALS), draw(DECIMALS), draw(COUNTS))
    assume(right(span))
    return span


def right(scale: Scale) -> bool:
    try:
        ranges.check(scale)
    except QueryError:
        return False
    return True


SCALES: st.SearchStrategy[Scale] = st.one_of(
    st.integers(0, 62).map(lambda power: Log(2**power)),
    st.builds(lambda step, count: Linear(step * count, count), st.integers(1, 10**9), st.integers(1, 40)),
    steps(),
    spans(),
    st.lists(st.one_of(WHOLES, FLOATS), min_size=1, max_size=9, unique=True)
    .map(lambda each: Listed(tuple(each)))
    .filter(right),
    st.lists(CATEGORIES, min_size=1, max_size=9, unique=True).map(lambda each: Listed(tuple(each))),
    st.lists(TEXTS, min_size=1, max_size=9, unique=True)
    .filter(lambda texts: any(isinstance(grammar.value(quoted(each)), str) for each in texts))
    .map(lambda texts: Listed(tuple(texts))),
    st.builds(ConstantDensity, POSITIVES, POSITIVES, st.integers(1, 40)),
)
CRITERIA = st.one_of(
    st.builds(Criterion, NAMES.filter(lambda name: name != "population_variable_density"), SCALES),
    st.builds(Criterion, st.just("montecarlo"), st.integers(1, ranges.MOST).map(MonteCarlo)),
    st.builds(VariableDensity, POSITIVES, POSITIVES, COUNTS)
    .filter(lambda scale: scale.start != scale.end)
    .map(lambda scale: Criterion("population_variable_density", scale)),
)
SUGGESTION = re.compile(r"Log\d+|Linear\d+(?:\.C\d+)?|=[-\d:]+|\.-?\d+\.-?\d+\.C\d+")
ALPHABET = st.sampled_from(
    [*'ab_.=,:-+pCIe0159 \n"\\()', "Log", "Linear", "Lgo", "x.", "x=", "montecarlo", ".C", "٣", "é", "\u2028"]
)


# Criteria and their values


@pytest.mark.parametrize(
    ("text", "scale", "values"),
    [
        ("population_size.Log8", Log(8), (1, 2, 4, 8)),
        ("population_size.Log1", Log(1), (1,)),
        ("population_size.Linear100.C10", Linear(100, 10), tuple(range(10, 101, 10))),
        ("population_size.Linear100", Linear(100, 10), tuple(range(10, 101, 10))),
        ("max_speed.1.9.C5", Steps(1, 9, 5), (1, 3, 5, 7, 9)),
        ("slope.5.-5.C3", Steps(5, -5, 3), (5, 0, -5)),
        ("slope.-0p5.0p5.C3", Span(Fraction(-1, 2), Fraction(1, 2), 3), (-0.5, 0, 0.5)),
        ("max_speed=0.2,0.4,1.6", Listed((0.2, 0.4, 1.6)), (0.2, 0.4, 1.6)),
        ("rate=1e-3,1,-2E1,.5", Listed((0.001, 1, -20.0, 0.5)), (0.001, 1, -20.0, 0.5)),
        ("noise=0:1:5", Span(Fraction(0), Fraction(1), 5), (0, 0.25, 0.5, 0.75, 1)),
        ("noise=1e-1:0.7:7", Span(Fraction(1, 10), Fraction(7, 10), 7), (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7)),
        ("scenario=low,high", Listed(("low", "high")), ("low", "high")),
        (
            "release=1.2.3,v2-rc.1,2024-01-01",
            Listed(("1.2.3", "v2-rc.1", "2024-01-01")),
            ("1.2.3", "v2-rc.1", "2024-01-01"),
        ),
        ("policy=p5,e1", Listed(("p5", "e1")), ("p5", "e1")),
        ('interval="exponential(0.2s)"', Listed(("exponential(0.2s)",)), ("exponential(0.2s)",)),
        (
            'law="random walk","levy (0.5)",none',
            Listed(("random walk", "levy (0.5)", "none")),
            ("random walk", "levy (0.5)", "none"),
        ),
        (r'x="a,b","c:d:5","=","\"\\"', Listed(("a,b", "c:d:5", "=", '"\\')), ("a,b", "c:d:5", "=", '"\\')),
        ('x="ångström","龍 1","🤖\u200d🔧"', Listed(("ångström", "龍 1", "🤖\u200d🔧")), ("ångström", "龍 1", "🤖\u200d🔧")),
        ('x="1",0.5,"-2"', Listed((1, 0.5, -2)), (1, 0.5, -2)),
        ('x=1,"a b",2.50', Listed(("1", "a b", "2.50")), ("1", "a b", "2.50")),
        ('version="1.10","1.9","007","1e3"', Listed(("1.10", "1.9", "007", "1e3")), ("1.10", "1.9", "007", "1e3")),
        ('x="nan"', Listed(("nan",)), ("nan",)),
        ("montecarlo.C3", MonteCarlo(3), (1, 2, 3)),
    ],
)
def test_a_criterion_is_expanded_to_its_values(text: str, scale: Scale, values: tuple[object, ...]) -> None:
    criterion = grammar.parse(text)
    assert criterion == Criterion(re.split("[.=]", text)[0], scale)
    made = ranges.values(criterion.scale)
    assert [(type(value), value) for value in made] == [(type(value), value) for value in values]


def test_a_constant_density_has_growing_arenas() -> None:
    scale = grammar.parse("population_constant_density.5p0.I16.C4").scale
    assert scale == ConstantDensity(Fraction(5), Fraction(16), 4)
    assert ranges.growths(scale) == tuple(map(Fraction, (0, 16, 32, 48)))


def test_a_variable_density_has_exact_densities() -> None:
    scale = grammar.parse("population_variable_density.1p0.5p0.C4").scale
    assert scale == VariableDensity(Fraction(1), Fraction(5), 4)
    assert ranges.densities(scale) == (Fraction(1), Fraction(7, 3), Fraction(11, 3), Fraction(5))


@pytest.mark.parametrize("text", ["x.5p0.I16.C4", "population_variable_density.1p0.5p0.C4"])
def test_densities_have_no_values_without_a_platform(text: str) -> None:
    with pytest.raises(QueryError, match="platform"):
        ranges.values(grammar.parse(text).scale)


@pytest.mark.parametrize(
    ("text", "canonical"),
    [
        ("population_size.Linear100", "population_size.Linear100.C10"),
        ("max_speed.0p50.2p5.C5", "max_speed=0.5:2.5:5"),
        ("noise=+1e-3:1.0:2", "noise=0.001:1:2"),
        ("rate=1E3,1e+22,-0.0,+7", "rate=1000.0,1e22,0.0,7"),
        ("population_variable_density.1.2p50.C4", "population_variable_density.1p0.2p5.C4"),
        ("population_constant_density.5.I0p5.C4", "population_constant_density.5p0.I0p5.C4"),
        ('x="low","v2-rc.1","1.2.3"', "x=low,v2-rc.1,1.2.3"),
        ('x="1","2.5"', "x=1,2.5"),
        ('x=1,"low"', 'x="1",low'),
    ],
)
def test_criteria_are_written_as_one_canonical_text(text: str, canonical: str) -> None:
    assert grammar.text(grammar.parse(text)) == canonical


@pytest.mark.integration
@given(CRITERIA)
def test_a_written_criterion_is_parsed_to_the_same_criterion(criterion: Criterion) -> None:
    written = grammar.text(criterion)
    again = grammar.parse(written)
    assert again == criterion
    assert grammar.text(again) == written
    if isinstance(criterion.scale, Listed) and isinstance(again.scale, Listed):
        assert [type(value) for value in again.scale.values] == [type(value) for value in criterion.scale.values]


@given(st.one_of(st.lists(ALPHABET, max_size=12).map("".join), st.text(max_size=30), CRITERIA.map(grammar.text)), st.data())
@example("x=" + "1" * 5000, None)
@example("x.Log" + "9" * 5000, None)
@example("x=0:1e999999999:3", None)
@example("x=\ud800", None)
@example("x=1e1000", None)
def test_any_text_is_a_criterion_or_gives_an_error_of_one_line(text: str, data: st.DataObject | None) -> None:
    if data is not None and text and data.draw(st.booleans()):
        at = data.draw(st.integers(0, len(text) - 1))
        text = text[:at] + data.draw(ALPHABET) + text[at + 1 :]
    criterion, complaint = read(text)
    if criterion is None:
        assert len(complaint.splitlines()) == 1
        assert complaint.encode()
    else:
        assert grammar.parse(grammar.text(criterion)) == criterion
        if ranges.count(criterion.scale) < 1000 and not isinstance(criterion.scale, ConstantDensity | VariableDensity):
            assert len(set(ranges.values(criterion.scale))) == ranges.count(criterion.scale)


def read(text: str) -> tuple[Criterion | None, str]:
    """Return the criterion, or the text of the error."""
    try:
        return grammar.parse(text), ""
    except QueryError as error:
        return None, str(error)


@pytest.mark.parametrize(
    "text",
    [
        "x=" + "1" * 200_000 + "!",
        "x=" + "-" * 200_000 + "!",
        "x." + "1." * 200_000,
        "L" * 200_000,
        'x="' + '\\"' * 100_000,
        'x="' * 70_000,
    ],
)
def test_a_long_invalid_text_is_refused_quickly(text: str) -> None:
    def refused() -> None:
        with pytest.raises(QueryError):
            grammar.parse(text)

    assert is_cheap(refused, 40)


# Refused criteria


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "'': a criterion must not be empty; use population_size.Log8"),
        ("noise = 1", "'noise = 1': a criterion must not contain blanks; use noise=0,0.5,1"),
        ("noise\n=1", r"'noise\n=1': a criterion must not contain blanks; use noise=0,0.5,1"),
        (
            "law=slow law,fast",
            """'law=slow law,fast': a value with blanks needs quotes; use 'law="slow law",fast'""",
        ),
        (
            "law='slow law', fast",
            """"law='slow law', fast": a value with blanks needs quotes; use 'law="slow law",fast'""",
        ),
        ("law=slow law,a=b", """'law=slow law,a=b': a value with blanks needs quotes; use 'law="slow law","a=b"'"""),
        (
            "interval=exponential(0.2s)",
            "'interval=exponential(0.2s)': 'exponential(0.2s)' needs quotes: it is no number, and no name of letters, digits, "
            "_ - and .; use 'interval=\"exponential(0.2s)\"'",
        ),
        (
            "t=uniform(1,2),x",
            "'t=uniform(1,2),x': 'uniform(1' needs quotes: it is no number, and no name of letters, digits, _ - and .; "
            "use 't=\"uniform(1,2)\",x'",
        ),
        (
            "who=it's",
            """"who=it's": "it's" needs quotes: it is no number, and no name of letters, digits, _ - and .; """
            """use 'who="it'"'"'s"'""",
        ),
        (
            'law="slow',
            """'law="slow': '"slow' should begin and end with quotes, with \\" for a quote and \\\\ for a backslash in it; """
            """use 'law="random walk",low'""",
        ),
        ('x=""', """'x=""': a value must not be empty; leave it out, or use a name such as none"""),
        (
            'x="a\tb"',
            """'x="a\\tb"': '"a\\tb"' contains '\\t', which cannot be seen; use scenarios whose changes set such values""",
        ),
        ('x="1",1', """'x="1",1': 1 is listed twice; use it once"""),
        ('x="a b","a b"', """'x="a b","a b"': 'a b' is listed twice; use it once"""),
        ("2fast=1", "'2fast=1': '2fast' is not a name of letters, digits and _; use fast"),
        ("max-speed=1", "'max-speed=1': 'max-speed' is not a name of letters, digits and _; use max_speed"),
        ("=1", "'=1': '' is not a name of letters, digits and _; use population_size.Log8"),
        ("n.Log1000", "'n.Log1000': 1000 is not a power of two; use Log512 or Log1024"),
        ("n.Log0", "'n.Log0': Log must end at 1 or more, not 0; use Log8"),
        ("n.Log-8", "'n.Log-8': Log must end at 1 or more, not -8; use Log8"),
        ("n.Log08", "'n.Log08': 08 is not in the number format of queries; use 8"),
        ("n.Lgo8", "'n.Lgo8': unknown range 'Lgo8'; did you mean n.Log8?"),
        ("n.linear50.c5", "'n.linear50.c5': unknown range 'linear50.c5'; did you mean n.Linear50.C5?"),
        ("n.Log", "'n.Log': '' is not a whole number; use Log8"),
        ("n.Linear8", "'n.Linear8': 8 cannot be divided into 10 equal whole steps; use Linear8.C8 or Linear10"),
        (
            "n.Linear100.C8",
            "'n.Linear100.C8': 100 cannot be divided into 8 equal whole steps; "
            "use Linear100.C5, Linear100, Linear96.C8 or Linear104.C8",
        ),
        ("n.Linear0", "'n.Linear0': Linear must end at 1 or more, not 0; use Linear100.C10"),
        ("n.Linear100.C0", "'n.Linear100.C0': a count must be 1 or more, not 0; use C5"),
        ("v.1.9.C4", "'v.1.9.C4': 1 to 9 cannot be divided into 3 equal whole steps; use =1:9:4, .1.9.C3 or .1.9.C5"),
        ("v.1.9.C1", "'v.1.9.C1': a range needs at least two values; use a count of 2 or more"),
        ("v.1.9.C-2", "'v.1.9.C-2': a count must be 1 or more, not -2; use C5"),
        ("v.9.9.C2", "'v.9.9.C2': its start and end are the same, 9; use =9 for one value"),
        ("v.1.9", "'v.1.9': the number of values from 1 to 9 is missing; use v.1.9.C5"),
        (
            "v.0.2.0.8.C4",
            "'v.0.2.0.8.C4': steps need from, to and a count, with p for the decimal point; use v.0p5.2p5.C5",
        ),
        ("v=0p2,0p4", "'v=0p2,0p4': 0p2 is not in the number format of queries; use 0.2"),
        ("v=1,000", "'v=1,000': 000 is not in the number format of queries; use 0"),
        ("v=1_000", "'v=1_000': 1_000 is not in the number format of queries; use 1000"),
        ("v=nan", "'v=nan': 'nan' is not a number; use a number such as 5, -0.5 or 1e-3"),
        ("v=1e999", "'v=1e999': 1e999 is outside the range of floats; use a number from 1e-307 to 1e308"),
        ("v=1e-999", "'v=1e-999': 1e-999 is outside the range of floats; use a number from 1e-307 to 1e308"),
        ("v=9223372036854775808", "'v=9223372036854775808': a number is too large; use a number up to 9223372036854775807"),
        ("v=1,low", "'v=1,low': 'low' is a name in a list of numbers; use only numbers, or only names"),
        ("v=1,2,1", "'v=1,2,1': 1 is listed twice; use it once"),
        ("v=1,1.0", "'v=1,1.0': 1.0 is listed twice; use it once"),
        ("v=low,low", "'v=low,low': 'low' is listed twice; use it once"),
        ("v=1..10", "'v=1..10': '1..10' is not a range; use 1:10:COUNT, or a list of values: 1,10"),
        ("v=a,0.5...2", "'v=a,0.5...2': '0.5...2' is not a range; use 0.5:2:COUNT, or a list of values: 0.5,2"),
        ("v=..", "'v=..': '..' is not a value; use a number, or a name of letters, digits, _ - and ."),
        ("v=1,", "'v=1,': '' is not a value; use a number, or a name of letters, digits, _ - and ."),
        ("v=0:1", "'v=0:1': a range needs from, to and a count; use v=0:1:5"),
        ("v=0:1:0", "'v=0:1:0': a count must be 1 or more, not 0; use C5"),
        ("v=0:1:1000001", "'v=0:1:1000001': 1000001 values are too many; use at most 1000000"),
        ("montecarlo.C2000000", "'montecarlo.C2000000': 2000000 values are too many; use at most 1000000"),
        ("montecarlo.Log8", "'montecarlo.Log8': montecarlo takes only a count; use montecarlo.C20"),
        ("MonteCarlo.C5", "'MonteCarlo.C5': MonteCarlo must be in small letters; use montecarlo.C5"),
        ("v.C5", "'v.C5': v has a count, but no range; use v.1.9.C5, or montecarlo.C5 to vary seeds only"),
        ("d.0p0.I16.C4", "'d.0p0.I16.C4': a density must be more than 0, not 0; use 5p0"),
        ("d.5p0.I0.C4", "'d.5p0.I0.C4': an increment must be more than 0, not 0; use I16"),
    ],
)
def test_errors_say_what_is_wrong_and_suggest_a_correction(text: str, message: str) -> None:
    with pytest.raises(QueryError) as caught:
        grammar.parse(text)
    assert str(caught.value) == message


@pytest.mark.parametrize("text", ["noise", "noise.", "noise=", "noise.Exp8", "noise._"])
def test_the_error_for_a_missing_range_shows_all_forms(text: str) -> None:
    with pytest.raises(
        QueryError, match=re.escape("noise.Log8, noise.Linear100.C10, noise.1.9.C5, noise=0:1:5 or noise=1,2,4")
    ):
        grammar.parse(text)


@given(
    st.one_of(
        st.builds("Log{}".format, st.integers(-5, 2**64)),
        st.builds("Linear{}.C{}".format, st.integers(-5, 2**64), st.integers(-5, 3000)),
        st.builds(".{}.{}.C{}".format, WHOLES, WHOLES, st.integers(-5, 3000)).map(lambda scale: scale[1:]),
        st.builds("{}.{}.C{}".format, st.integers(-99, 99), st.integers(-99, 99), st.integers(1, 99)),
        st.builds("Linear{}".format, st.integers(-5, 2000)),
    )
)
def test_suggestions_of_errors_are_valid_criteria(scale: str) -> None:
    _, complaint = read(f"x.{scale}")
    suggestions = SUGGESTION.findall(complaint.partition("; use ")[2])
    assert suggestions or "divide" not in complaint
    for suggestion in suggestions:
        assert grammar.parse("x" + suggestion if suggestion[0] in ".=" else f"x.{suggestion}").name == "x"


@pytest.mark.parametrize(
    "criterion",
    [
        Criterion("max_speed", MonteCarlo(3)),
        Criterion("max_speed", VariableDensity(Fraction(1), Fraction(5), 3)),
        Criterion("not a name", Log(8)),
        Criterion("x", Log(1000)),
        Criterion("x", Span(Fraction(1, 3), Fraction(1), 3)),
        Criterion("x", Listed(())),
        Criterion("x", Listed(("1", "2"))),
        Criterion("x", Listed(("a\nb",))),
        Criterion("x", Listed(("",))),
        Criterion("x", Listed((math.nan,))),
        Criterion("x", Listed((True,))),
    ],
)
def test_criteria_that_no_text_can_express_are_not_written(criterion: Criterion) -> None:
    with pytest.raises(QueryError):
        grammar.text(criterion)


# Several criteria


def test_criteria_keep_their_order() -> None:
    assert [each.name for each in grammar.parse_all(["noise=0:1:5", "population_size.Log8"])] == [
        "noise",
        "population_size",
    ]


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (["n.Log8", "N=1,2"], "'N=1,2': 'N' is already an axis, by 'n.Log8'; use one of them"),
        (["n.Log8", "n.Log8"], "'n.Log8': 'n' is already an axis, by 'n.Log8'; use one of them"),
        (["Seed=1,2"], "'Seed=1,2': 'Seed' is a column of the store; use another name, for example my_Seed"),
        (
            ["a=0:1:2000", "b=0:1:2000"],
            "'a=0:1:2000 b=0:1:2000' expand to more than 1000000 experiments; use fewer values",
        ),
        ([], "a query needs at least one criterion; use population_size.Log8"),
    ],
)
def test_conflicting_criteria_are_refused(texts: list[str], message: str) -> None:
    with pytest.raises(QueryError) as caught:
        grammar.parse_all(texts)
    assert str(caught.value) == message


@pytest.mark.parametrize("name", sorted(grammar.RESERVED))
def test_axes_named_like_a_column_of_the_store_are_refused(name: str) -> None:
    with pytest.raises(QueryError, match="column of the store"):
        grammar.parse_all([f"{name}=1,2"])


# Values


@pytest.mark.integration
@given(SCALES.filter(lambda scale: not isinstance(scale, ConstantDensity)))
def test_values_are_distinct_and_their_number_equals_the_count(scale: Scale) -> None:
    values = ranges.values(scale)
    assert len(values) == len(set(values)) == ranges.count(scale)


@given(st.one_of(spans(), steps()))
def test_each_value_is_the_nearest_number_to_the_exact_step(scale: Span | Steps) -> None:
    values = ranges.values(scale)
    for index, value in enumerate(values):
        exact = scale.start + Fraction(scale.end - scale.start) * index / (scale.count - 1)
        assert value == (int(exact) if exact.denominator == 1 else float(exact))
        assert isinstance(value, int) == (exact.denominator == 1)


@given(st.integers(1, 62), st.integers(1, 10**6), st.integers(1, 40))
def test_log_ranges_double_and_linear_ranges_have_even_steps(power: int, step: int, count: int) -> None:
    assert ranges.values(Log(2**power)) == tuple(2**each for each in range(power + 1))
    assert ranges.values(Linear(step * count, count)) == tuple(step * (each + 1) for each in range(count))


def test_values_that_floats_cannot_distinguish_are_refused() -> None:
    with pytest.raises(QueryError, match="too close together to differ as floats"):
        grammar.parse("x=100:100.00000000000001:5")


@pytest.mark.parametrize("scale", [Log(1000), Linear(8, 10), Steps(1, 9, 4), Listed((1, 1)), MonteCarlo(0)])
def test_ranges_built_in_code_obey_the_same_rules(scale: Scale) -> None:
    with pytest.raises(QueryError):
        ranges.values(scale)


def test_a_range_may_have_a_million_values() -> None:
    values = ranges.values(grammar.parse("x=0:0.3:1000000").scale)
    assert (len(values), values[0], values[-1]) == (1_000_000, 0, 0.3)
