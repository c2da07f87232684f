"""A comparison as a paragraph of text, which can be pasted into a paper."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

from sierra.model import Value
from sierra.stats.comparison.model import Analysis, Effect, Omnibus, Pair, Verdict
from sierra.util.text import counted, verb

BRIEF = 5
"""The largest number of sentences of a brief text."""
SENTENCES = 8
"""The largest number of pairs with a sentence each; more pairs are counted."""


def paragraph(result: Analysis, subject: str) -> str:
    """Return the text: what was compared, how, and each conclusion. `subject` is the compared quantity, in words."""
    return " ".join((_opening(result, subject), *_findings(result), *_method(result), *_left_out(result)))


def brief(result: Analysis, subject: str) -> str:
    """Return the most important sentences of the paragraph: the conclusions, what is left out, and then the method."""
    findings = [*map(_effect, result.effects), *(_pair(pair, result) for pair in result.pairs)]
    if len(findings) > BRIEF - 3:
        findings = [_effects(result)] if result.effects else [_verdicts(result)]
    every = (_opening(result, subject), *findings, *_left_out(result), _pairing(result), *_method(result))
    return " ".join(every[:BRIEF])


def number(value: float) -> str:
    """Return a number with three significant digits."""
    return f"{value:.3g}".replace("e+0", "e").replace("e+", "e").replace("e-0", "e-")


def p_value(value: float) -> str:
    """Return a p value as papers write it."""
    return "p < 0.001" if value < 0.001 else f"p = {value:.2g}"


def runs_of(pair: Pair, *, paired: bool) -> str:
    """Return the numbers of runs of a pair, as in `n = 6`, `n = 6 and 8`, `n = 6 pairs`."""
    n = f"n = {pair.n_first}" if pair.n_first == pair.n_second else f"n = {pair.n_first} and {pair.n_second}"
    return f"{n} pairs" if paired else n


def where(point: Mapping[str, Value]) -> str:
    """Return the beginning of a text about a point; empty for the only point."""
    values = ", ".join(f"{name} = {value}" for name, value in point.items())
    return f"for {values}, " if values else ""


def magnitude(value: float) -> str:
    """Return the word for an A12: Vargha and Delaney's limits are 0.56, 0.64 and 0.71."""
    distance = abs(value - 0.5) + 1e-12
    words = ((0.21, "large"), (0.14, "medium"), (0.06, "small"), (0.0, "negligible"))
    return next(word for limit, word in words if distance >= limit)


def interval(pair: Pair, alpha: float) -> str:
    """Return the estimate of a difference and its interval."""
    if pair.difference is None:
        return f"{pair.estimate}: not known"
    if pair.low is None or pair.high is None:
        return f"{pair.estimate} {number(pair.difference)}"
    return f"{pair.estimate} {number(pair.difference)}, {_level(alpha)} CI [{number(pair.low)}, {number(pair.high)}]"


def covers_zero(pair: Pair) -> bool:
    """Return whether the interval of a difference contains 0, or is not known."""
    return pair.low is None or pair.high is None or pair.low <= 0 <= pair.high


def _level(alpha: float) -> str:
    return f"{100 * (1 - alpha):.4g} %"


def _opening(result: Analysis, subject: str) -> str:
    if result.effects:
        factors = [effect.name for effect in result.effects if "×" not in effect.name]
        return f"The effects of {_and(factors)} on {subject} were tested."
    groups = _and(result.groups) if len(result.groups) <= 6 else f"{len(result.groups)} groups"
    cells = len(dict.fromkeys(tuple(pair.point.items()) for pair in result.pairs))
    where = f" in {counted(cells, 'experiment')}" if cells > 1 else ""
    return _sentence(f"{subject} was compared between {groups}{where}")


def _findings(result: Analysis) -> Iterator[str]:
    yield _pairing(result)
    yield from map(_effect, result.effects)
    yield from (_omnibus(test, result) for test in result.omnibus[:SENTENCES])
    if len(result.omnibus) > SENTENCES:
        more = len(result.omnibus) - SENTENCES
        yield f"The other {counted(more, 'omnibus test')} {verb(more, 'is', 'are')} in the table."
    if len(result.pairs) <= SENTENCES:
        yield from (_pair(pair, result) for pair in result.pairs)
        return
    yield _verdicts(result)


def _verdicts(result: Analysis) -> str:
    counts = Counter(pair.verdict for pair in result.pairs)
    shown = ", ".join(f"{verdict.value}: {counts[verdict]}" for verdict in Verdict if counts[verdict])
    return f"The verdicts of the {len(result.pairs)} comparisons of two groups are: {shown}."


def _effects(result: Analysis) -> str:
    shown = [effect.name for effect in result.effects if effect.p_adjusted <= result.question.alpha]
    return f"Of {len(result.effects)} effects and interactions, these were shown: {', '.join(shown) or 'none'}."


def _pairing(result: Analysis) -> str:
    reason, r = result.pairing.reason, result.pairing.correlation
    if r is not None:
        within = f"mean rank correlation {r:.2f})"
        reason = f"{reason[:-1]}, {within}" if reason.endswith(")") else f"{reason} ({within}"
    return _sentence(reason)


def _effect(effect: Effect) -> str:
    kind = "interaction" if "×" in effect.name else "main effect"
    details = f"F({effect.df}, {effect.df_error}) = {number(effect.f)}, {p_value(effect.p_adjusted)}"
    return f"The {kind} of {effect.name}: {details}, partial η² = {effect.eta:.2f}."


def _omnibus(test: Omnibus, result: Analysis) -> str:
    shown = test.p_adjusted <= result.question.alpha
    differ = "at least one group differs" if shown else "no difference among all groups was shown"
    critical = ""
    if test.critical_difference is not None:
        critical = f"; critical difference of mean ranks {number(test.critical_difference)}"
    statistic = "" if test.statistic is None else f"χ²({test.df}) = {number(test.statistic)}, "
    details = f"{statistic}n = {test.n}, {p_value(test.p_adjusted)}"
    return _sentence(f"{where(test.point)}{differ} ({test.test}, {details}{critical})")


def _pair(pair: Pair, result: Analysis) -> str:
    alpha = result.question.alpha
    pairs = runs_of(pair, paired=result.pairing.paired)
    size = "" if pair.a12 is None else f", A12 = {pair.a12:.2f} ({magnitude(pair.a12)})"
    details = f"{interval(pair, alpha)}; {pair.test}, {pairs}, {p_value(pair.p_adjusted)}{size}"
    if pair.never_first + pair.never_second:
        details += f"; not reached by {pair.never_first} runs of {pair.first} and {pair.never_second} of {pair.second}"
    if pair.p_equivalent_adjusted is not None and result.question.margin is not None:
        details += f"; TOST with margin {number(result.question.margin)}: {p_value(pair.p_equivalent_adjusted)}"
    if pair.verdict in (Verdict.open, Verdict.too_few) and not covers_zero(pair) and len(result.pairs) > 1:
        details += f"; the interval is of this pair alone, not corrected for {len(result.pairs)} pairs"
    text = f"{where(pair.point)}{_conclusion(pair, result)} ({details})"
    return f"{text}." if text.startswith(pair.second) else _sentence(text)


def _conclusion(pair: Pair, result: Analysis) -> str:
    margin = "" if result.question.margin is None else number(result.question.margin)
    match pair.verdict:
        case Verdict.different:
            return f"{pair.second} {_direction(pair)} than {pair.first}"
        case Verdict.both:
            return f"{pair.second} {_direction(pair)} than {pair.first}, but by less than {margin}"
        case Verdict.equivalent:
            return f"{pair.second} and {pair.first} are equivalent within ±{margin}"
        case Verdict.too_few:
            return f"n is too small for any verdict on {pair.first} and {pair.second} at alpha = {result.question.alpha:g}"
        case Verdict.open:
            missing = "difference" if result.question.margin is None else "difference and no equivalence"
            return f"no {missing} of {pair.first} and {pair.second} was shown"


def _direction(pair: Pair) -> str:
    if pair.statistic is not None:
        return "reaches the threshold later" if pair.direction > 0 else "reaches the threshold earlier"
    return "is greater" if pair.direction > 0 else "is less"


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:]}."


def _method(result: Analysis) -> Iterator[str]:
    if result.estimates and any(pair.difference is not None for pair in result.pairs):
        yield f"Differences (second group minus first) are {result.estimates}."
    if result.effects:
        yield f"The tests are by {result.title}."
    if result.tests > 1:
        yield f"The p values are corrected for {result.tests} tests (Holm)."
    if len(result.omnibus) > 1:
        yield f"Those of the {len(result.omnibus)} omnibus tests are corrected for each other only; they decide about no pair."
    elif result.omnibus:
        yield f"The {result.omnibus[0].test} is not among these tests; it decides about no pair."
    if len(result.pairs) > 1 and any(pair.low is not None for pair in result.pairs):
        yield f"Each interval is of one pair alone, not corrected for {len(result.pairs)} pairs."


def _left_out(result: Analysis) -> Iterator[str]:
    yield from map(_sentence, (*result.notes, *result.limits))


def _and(names: Sequence[str]) -> str:
    return " and ".join(filter(None, (", ".join(names[:-1]), names[-1])))
