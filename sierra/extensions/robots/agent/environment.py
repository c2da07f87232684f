"""The environment of runs on a robot: the variables that its setup line sets, its address, and its time zone."""

from __future__ import annotations

import os
import subprocess
import time
from typing import Mapping

from sierra.extensions.robots.agent.processes import TAIL_BYTES, ending
from sierra.extensions.robots.agent.records import Refused

SETUP_S = 60.0
LEFT_OUT = ("_", "SHLVL", "PWD", "OLDPWD")  # variables that a shell sets


def with_setup(line: str | None, environment: Mapping[str, str]) -> dict[str, str]:
    """Return the variables that are set after bash has executed a line. Raises Refused if it fails."""
    own = {name: value for name, value in environment.items() if not name.startswith("SSH_")}
    if not line:
        return own
    script = "exec 3>&1 >&2\n%s\nstatus=$?; [ $status = 0 ] || exit $status\nexec env -0 >&3" % line
    try:
        ended = subprocess.run(
            ["bash", "-c", script],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            env=own,
            timeout=SETUP_S,
            start_new_session=True,
        )
    except subprocess.TimeoutExpired:
        raise Refused("its setup line did not end within %g s" % SETUP_S, "setup") from None
    if ended.returncode:
        words = " ".join(ended.stderr.decode("utf-8", "replace").split())[-TAIL_BYTES:]
        raise Refused("its setup line ended with %s: %s" % (ending(ended.returncode), words), "setup")
    if not ended.stdout:
        unknown = "its setup line ended the shell (by exit or exec), so that the variables that it sets are unknown"
        raise Refused(unknown, "setup")
    pairs = (pair.partition("=") for pair in ended.stdout.decode("utf-8", "surrogateescape").split("\0") if "=" in pair)
    return {name: value for name, _, value in pairs if name not in LEFT_OUT and not name.startswith("BASH_FUNC_")}


def own_address() -> str | None:
    """Return the address of this robot at which its driver has reached it, in the robot's own network; None without SSH."""
    words = os.environ.get("SSH_CONNECTION", "").split()  # address and port of the client, then of the server
    return words[2] if len(words) == 4 else None


def utc_offset(zone: str | None) -> int:
    """Return the seconds by which local time is ahead of UTC now, with this value of TZ; None: in the system's time zone."""
    before = os.environ.get("TZ")
    try:
        set_zone(zone)
        return time.localtime().tm_gmtoff
    finally:
        set_zone(before)


def set_zone(zone: str | None) -> None:
    os.environ.pop("TZ", None)
    if zone is not None:
        os.environ["TZ"] = zone
    time.tzset()
