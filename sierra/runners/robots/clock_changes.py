"""Changes of a robot's clock during a run: steps that its agent saw, and the change of its offset to the clock of this host.

Stamps of a robot are converted by a line through two measurements of the offset, before and after the run. That is wrong if the
clock was set in between. A clock that nobody sets drifts by less than `DRIFT`, and evenly.
"""

from __future__ import annotations

from sierra.runners.robots.trial import Part

DRIFT = 1e-4
"""The seconds per second by which a clock of quartz drifts at most; crystals of small computers are good to 2e-5 to 5e-5."""


def remark(part: Part, clock_error: float) -> str | None:
    """Return why stamps of a robot cannot be converted; None if they can, or if its clock was not measured twice.

    `clock_error` is the error of a measurement that is allowed, in seconds.
    """
    if steps := _steps(part):
        moved = ", ".join(f"{step:+g}" for step in steps)
        return f"its wall clock has moved by {moved} s while the run was executed"
    change = _change(part)
    if part.clock is None or part.clock_after is None or change is None:
        return None
    seconds = (part.clock_after.at_ns - part.clock.at_ns) / 1e9
    if abs(change) <= clock_error + DRIFT * abs(seconds):
        return None
    return f"its wall clock has drifted by {change:+.3g} s in {seconds:.3g} s"


def failure(part: Part, limit: float | None) -> str | None:
    """Return that a clock has moved by more than `limit` seconds; None if it has not, or without a limit."""
    moves = [*_steps(part), _change(part) or 0.0]
    largest = max(moves, key=abs)
    if limit is None or abs(largest) <= limit:
        return None
    return f"has a clock that moved by {largest:+.3g} s during the run, more than clock_drift = {limit:g} in [runners.robots]"


def _steps(part: Part) -> list[float]:
    return list((part.ended or {}).get("steps", ()))


def _change(part: Part) -> float | None:
    """Return by how many seconds a robot's offset has changed; None if it was not measured twice."""
    if part.clock is None or part.clock_after is None:
        return None
    return (part.clock_after.offset_ns - part.clock.offset_ns) / 1e9
