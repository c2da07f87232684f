"""Examples of simulators that a command drives, with the real simulators: from the stock files to figures and replays."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from tests import projects
from tests.projects import values
from tests.simulators import Started, configure

LOCKS = Path(__file__).parents[1] / "data" / "simulators"


def test_the_example_of_mesa_goes_from_a_query_to_figures(started: Started) -> None:
    root, mesa = started(LOCKS / "mesa.txt")
    configure(root, "{python}", f"{mesa.bin}/python")
    done = projects.quick(root, "run", "people=50,200", "--runs", "2")
    assert done.returncode == 0, done.stderr
    assert len(list((root / "figures").glob("*/*.png"))) == 1
    informed = "SELECT avg(informed) AS i FROM rumour WHERE step = 50 GROUP BY people ORDER BY people"
    few, many = (float(str(row["i"])) for row in projects.sql(root, informed))
    assert 0 < few < many
    assert len(values(root, "SELECT sum(informed) AS s FROM rumour GROUP BY run")) == 4
    batch = str(projects.sql(root, "SELECT batch FROM batches")[0]["batch"])
    replayed = projects.quick(root, "replay", batch[:10])
    assert (replayed.returncode, "identical (4 runs: 4 identical)" in replayed.stdout) == (0, True), replayed.stderr


def test_the_example_of_ngspice_goes_from_a_query_to_figures(require: Callable[..., str], tmp_path: Path) -> None:
    require("ngspice")
    assert projects.quick(tmp_path, "init", "--example", "ngspice", "demo").returncode == 0
    root = tmp_path / "demo"
    done = projects.quick(root, "run", "tolerance=0.05,0.2", "--runs", "4")
    assert done.returncode == 0, done.stderr
    assert len(list((root / "figures").glob("*/*.png"))) == 1
    spread = "SELECT stddev(gain) AS s FROM gain WHERE frequency BETWEEN 1000 AND 1001 GROUP BY tolerance ORDER BY tolerance"
    narrow, wide = (float(str(row["s"])) for row in projects.sql(root, spread))
    assert 0 < narrow < wide
    batch = str(projects.sql(root, "SELECT batch FROM batches")[0]["batch"])
    replayed = projects.quick(root, "replay", batch[:10])
    assert (replayed.returncode, "identical (8 runs: 8 identical)" in replayed.stdout) == (0, True), replayed.stderr


def test_the_example_of_ns3_is_compiled_and_goes_from_a_query_to_figures(require: Callable[..., str], tmp_path: Path) -> None:
    require("ns3++")
    assert projects.quick(tmp_path, "init", "--example", "ns3", "demo").returncode == 0
    root = tmp_path / "demo"
    done = projects.quick(root, "run", "nodes=4,16", "--runs", "2")
    assert done.returncode == 0, done.stderr
    assert len(list((root / "figures").glob("*/*.png"))) == 2
    arrived = "SELECT avg(received / sent) AS share FROM throughput GROUP BY nodes ORDER BY nodes"
    few, many = (float(str(row["share"])) for row in projects.sql(root, arrived))
    assert many < 0.8 < few <= 1.01
    assert len(values(root, "SELECT sum(received) AS s FROM throughput WHERE nodes = 16 GROUP BY run")) == 2
    assert any("ns3" in str(name) for name in values(root, "SELECT name FROM programs"))
    batch = str(projects.sql(root, "SELECT batch FROM batches")[0]["batch"])
    replayed = projects.quick(root, "replay", batch[:10], "--runs", "1")
    assert (replayed.returncode, "2 identical; built from source" in replayed.stdout) == (0, True), replayed.stdout
    again = root / "adhoc.cc"
    again.write_text(again.read_text().replace("OfdmRate6Mbps", "OfdmRate54Mbps"))
    summary, _ = projects.run(root, "nodes=16", "--runs", "2")
    assert (summary["executed"], values(root, "SELECT count(*) AS n FROM builds WHERE exit_code = 0")) == (2, {3})
    runs_of_batch = f"SELECT run FROM batch_runs WHERE batch = '{summary['batch']}'"
    faster = f"SELECT avg(received / sent) AS share FROM throughput WHERE run IN ({runs_of_batch})"
    assert float(str(projects.sql(root, faster)[0]["share"])) > 0.9
