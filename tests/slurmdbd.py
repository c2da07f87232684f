"""A SLURM with accounting: a slurmdbd and its own MariaDB in the cluster's folder. Debian: see `make system`.

All users have the account `physics`, and the QOS `normal` (without limits) or `small`, which is the default.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from tests import clusters
from tests.clusters import Slurm
from tests.waiting import until

PROGRAMS = ("slurmdbd", "sacctmgr", "mariadbd", "mariadb-install-db")
SMALL = ("MaxSubmitJobsPerUser=5", "MaxWall=00:20:00")
"""The limits of the QOS `small`."""


class Accounted(Slurm):
    """One cluster with enforced accounting."""

    def __init__(self, root: Path) -> None:
        self._database, self._daemon = clusters.free_ports(2)
        settings = {
            "AccountingStorageType": "accounting_storage/slurmdbd",
            "AccountingStorageHost": "127.0.0.1",
            "AccountingStoragePort": str(self._daemon),
            "AccountingStoragePass": f"{root}/munge.sock",
            "AccountingStorageEnforce": "associations,limits,qos",
        }
        super().__init__(root, settings=settings)
        lines = {
            "AuthType": "auth/munge",
            "AuthInfo": f"socket={root}/munge.sock",
            "DbdHost": "localhost",
            "DbdPort": str(self._daemon),
            "SlurmUser": "root",
            "LogFile": f"{root}/log/slurmdbd.log",
            "PidFile": f"{root}/slurmdbd.pid",
            "StorageType": "accounting_storage/mysql",
            "StorageHost": "127.0.0.1",
            "StoragePort": str(self._database),
            "StorageUser": "root",
            "StorageLoc": "accounting",
        }
        configuration = root / "slurmdbd.conf"
        configuration.write_text("".join(f"{name}={value}\n" for name, value in lines.items()))
        configuration.chmod(0o600)  # slurmdbd refuses other modes

    def start(self) -> None:
        super().start()
        self._account("add", "account", "physics", "Description=physics", "Organization=physics")
        self._account("add", "qos", "small")
        self._account("modify", "qos", "small", "set", *SMALL)
        self._account("add", "user", "root", "Account=physics")
        self._account("modify", "user", "root", "set", "DefaultAccount=physics")
        where = ("where", "name=root", "account=physics")
        self._account("modify", "user", *where, "set", "QOS=normal,small")
        self._account("modify", "user", *where, "set", "DefaultQOS=small")

    def stop(self) -> None:
        for name in ("slurmctld", "slurmdbd", "mariadbd"):  # each waits for the next one
            if name in self._processes:
                self._kill(name)
        super().stop()

    def _start(self, name: str, *argv: str) -> None:
        if "slurmdbd" not in self._processes:
            self._start_accounting()
        super()._start(name, *argv)

    def _start_accounting(self) -> None:
        data = self.root / "database"
        make = ("mariadb-install-db", "--no-defaults", f"--datadir={data}", "--user=root", "--skip-test-db", "--force")
        self.command(*make, "--auth-root-authentication-method=normal")
        files = (f"--datadir={data}", f"--socket={self.root}/db.sock", f"--pid-file={self.root}/db.pid", "--user=root")
        listening = ("--bind-address=127.0.0.1", f"--port={self._database}", "--innodb-flush-log-at-trx-commit=0")
        self._spawn("mariadbd", "mariadbd", "--no-defaults", *files, *listening)
        self._until_it_listens("mariadbd", self._database)
        self._spawn("slurmdbd", "slurmdbd", "-D")
        self._until_it_listens("slurmdbd", self._daemon)
        self._account("add", "cluster", clusters.SETTINGS["ClusterName"])

    def _until_it_listens(self, name: str, port: int) -> None:
        until(lambda: clusters.listens(port) or self._gone(name), f"{name} listens")
        assert not self._gone(name), f"{name} has ended; see {self.root}/log"

    def _account(self, *words: str) -> None:
        self.command("sacctmgr", "--immediate", *words)


def needed(require: Callable[..., str]) -> None:
    """Skip the test, or fail, if accounting is not available."""
    clusters.needed(require)
    clusters.programs(require, PROGRAMS)
