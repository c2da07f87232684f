"""The condition of a robot before a run: battery, disk, firmware, calibration, and the checks that its fleet declares.

A value that cannot be measured is reported with the reason.
"""

from __future__ import annotations

import os
import shutil
import subprocess
from typing import Callable, Mapping, Sequence

from sierra.extensions.robots.agent.processes import TAIL_BYTES
from sierra.extensions.robots.agent.records import Record
from sierra.extensions.robots.agent.topic_rates import shortfall
from sierra.worker.errors import explain
from sierra.worker.outputs import describe

CHECK_S = 10.0


class Condition:
    """The declared condition of one robot, and measurements of it."""

    def __init__(self, declared: Record, environment: Mapping[str, str]) -> None:
        """`declared` has the keys of a `hello` (see `robot_agent`). `environment`: the variables of all commands."""
        self.battery: Sequence[str] | str | None = declared.get("battery")
        self.firmware: Sequence[str] | None = declared.get("firmware")
        self.calibration: str | None = declared.get("calibration")
        self.checks: Sequence[Sequence[str]] = declared.get("checks", ())
        self.topic_rates: Mapping[str, float] = declared.get("topic_rates", {})
        self.environment = environment

    def measured(self, folder: str) -> Record:
        """Return the charge of the battery in percent, and the free bytes of the disk of a folder."""
        return {**self.read(battery=self.battery_level), "disk": shutil.disk_usage(folder).free}

    def described(self) -> Record:
        """Return the firmware, the SHA-256 of the calibration file, and a line for each check that has failed."""
        read = self.read(firmware=self.firmware_version, calibration=self.calibration_hash)
        return {**read, "failed": self.failed_checks()}

    def read(self, **sources: Callable[[], object]) -> Record:
        """Return values by name, and `unread`: why some of them are missing, by name."""
        values: Record = {"unread": {}}
        for name, source in sources.items():
            try:
                values[name] = source()
            except OSError as error:
                values[name], values["unread"][name] = None, explain(error)
            except ValueError as error:
                values[name], values["unread"][name] = None, str(error)
        return values

    def failed_checks(self) -> list[str]:
        """Execute all checks at once, because each may wait for something; return a line for each one that has failed."""
        from concurrent.futures import ThreadPoolExecutor

        with ThreadPoolExecutor(max(1, len(self.checks) + len(self.topic_rates))) as pool:
            rates = pool.map(self.slow_topic, self.topic_rates)
            ended = list(pool.map(self.output_of, self.checks))
        return [
            *(
                "%s: %s" % (" ".join(argv), words or "status %s" % status)
                for argv, (status, words) in zip(self.checks, ended)
                if status != 0
            ),
            *filter(None, rates),
        ]

    def slow_topic(self, topic: str) -> str | None:
        """Return why a topic has too few messages a second; None if it has enough."""
        return shortfall(topic, self.topic_rates[topic], self.environment)

    def firmware_version(self) -> str | None:
        """Return what the command prints that knows the version; None without a command. Raises ValueError."""
        if not self.firmware:
            return None
        status, words = self.output_of(self.firmware)
        if status != 0 or not words:
            raise ValueError("%s: %s" % (" ".join(self.firmware), words or "status %s" % status))
        return words

    def calibration_hash(self) -> str | None:
        """Return the SHA-256 of the calibration file; None without one. Raises OSError."""
        if not self.calibration:
            return None
        path = os.path.expanduser(self.calibration)
        return describe(path, path)["sha256"]

    def battery_level(self) -> float | None:
        """Return the first number that the battery's file or command gives; None without one. Raises OSError, ValueError."""
        if not self.battery:
            return None
        if isinstance(self.battery, str):
            with open(os.path.expanduser(self.battery), encoding="utf-8", errors="replace") as file:
                words = file.read(4096)
        else:
            status, words = self.output_of(self.battery)
            if status != 0:
                raise ValueError(words or "status %s" % status)
        try:
            level = float(words.split()[0].rstrip("%"))
        except (IndexError, ValueError):
            raise ValueError("%r is not a number" % words[:40]) from None
        if not 0 <= level <= 100:  # also nan, which no limit would refuse, and volts or milliampere hours
            raise ValueError("%r is not a charge from 0 to 100 %%" % words[:40])
        return level

    def output_of(self, argv: Sequence[str]) -> tuple[int | None, str]:
        """Execute a command; return its status, None if it does not end in time, and its output or the error."""
        try:
            ended = subprocess.run(
                argv,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                env=self.environment,
                timeout=CHECK_S,
                start_new_session=True,
            )
        except subprocess.TimeoutExpired:
            return None, "did not end within %g s" % CHECK_S
        except (OSError, ValueError) as error:
            return None, explain(error)
        return ended.returncode, " ".join(ended.stdout.decode("utf-8", "replace").split())[-TAIL_BYTES:]
