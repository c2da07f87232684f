"""Intervals of quantiles from order statistics: two of the observed values, whatever their distribution is.

Of n values in ascending order, the interval of the quantile p is from x₍l₎ to x₍n+1−m₎, with the largest l and m for which

    P(B(n, p) ≤ l − 1) ≤ α / 2   and   P(B(n, 1 − p) ≤ m − 1) ≤ α / 2

where B is binomial. Its confidence is at least 1 − α (David and Nagaraja 2003, Order Statistics, 7.1). If n is so small that
there is no such l or m, there is no interval: for the median and 95 %, at least 6 values are needed, for q90 at least 36.

Ranks for all n are computed one after the other, because the sum of the first k + 1 probabilities P(n) for n + 1 follows from

    P(B(n + 1, p) ≤ k) = P(B(n, p) ≤ k) − p · P(B(n, p) = k)
"""

from __future__ import annotations

from functools import lru_cache


@lru_cache(maxsize=64)
def low_ranks(p: float, most: int, alpha: float) -> tuple[int | None, ...]:
    """Return for n = 1 … `most` the rank l of the lower end, counted from 1; None if n is too small. 0 < p < 1."""
    lower_ranks: list[int | None] = []
    k, below, at = -1, 0.0, 0.0  # the largest k with P(B ≤ k) ≤ α / 2, that probability, and P(B = k)
    for n in range(1, most + 1):
        if k >= 0:
            below, at = below - p * at, at * n * (1 - p) / (n - k)
        while k < n:
            following = (1 - p) ** n if k < 0 else at * (n - k) / (k + 1) * p / (1 - p)
            if below + following > alpha / 2:
                break
            k, below, at = k + 1, below + following, following
        lower_ranks.append(k + 1 if k >= 0 else None)
    return tuple(lower_ranks)


def ranks(p: float, most: int, alpha: float) -> tuple[list[int | None], list[int | None]]:
    """Return for n = 1 … `most` the ranks of both ends; None for both if n is too small for one of them."""
    low, mirrored = low_ranks(p, most, alpha), low_ranks(1 - p, most, alpha)
    both = [None if a is None or b is None else (a, n + 1 - b) for n, (a, b) in enumerate(zip(low, mirrored, strict=True), 1)]
    return [pair and pair[0] for pair in both], [pair and pair[1] for pair in both]


def smallest(p: float, alpha: float) -> int:
    """Return the smallest n for which the quantile p has an interval."""
    edge, n = max(p, 1 - p), 1
    while edge**n > alpha / 2:
        n += 1
    return n
