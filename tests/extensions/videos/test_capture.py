"""Captures: recorded runs are executed once more with rendering; nothing counts them, and the rest is compared."""

from __future__ import annotations

import json
import os
import shutil
import signal
from pathlib import Path
from typing import Any

import pytest

import sierra
from sierra.api import Project
from sierra.errors import Missing, NotFound
from sierra.extensions.videos import capture
from sierra.extensions.videos import videos as make_videos
from tests import projects
from tests.extensions.videos import video_files
from tests.waiting import until

SIMULATOR = """\
import os, sys
from pathlib import Path
arena = open(sys.argv[1]).read()
count = int(arena.split('count="')[1].split('"')[0])
frames = Path(sys.argv[2]) if len(sys.argv) > 2 else None
drift = float(os.environ.get("DRIFT", 0))
if frames:
    frames.mkdir()
if "WAITS" in os.environ and count == 2:
    import time
    Path(os.environ["WAITS"] + ".seen").touch()
    while os.path.exists(os.environ["WAITS"]):
        time.sleep(0.05)
with open("swarm.csv", "w") as file:
    print("tick,x", file=file)
    for tick in range(3):
        print(tick, tick * count + drift, sep=",", file=file)
        if frames:
            (frames / f"{tick * 10}.ppm").write_bytes(b"P6 2 2 255\\n" + bytes([tick, count * 50, 0] * 4))
"""
CONFIG = """\
template = "arena.xml"
command = "{python} sim.py {input}"
seed = "//random/@seed"
runs = 2
observe = "none"
variables.population_size = "//swarm/@count"
limits = { wall = 30 }
"""
CAPTURE = """\
[capture]
files = "frames/{tick}.ppm"
ticks_per_second = 10
arguments = "{output}/frames"
"""


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a project with a batch of two experiments."""
    root = projects.make(tmp_path_factory.mktemp("capture") / "project", CONFIG, simulator=SIMULATOR)
    projects.run(root, "population_size=1,2")
    return root


@pytest.fixture
def root(measured: Path, tmp_path: Path) -> Path:
    """Return a copy of the project, in which runs render."""
    root = shutil.copytree(measured, tmp_path / "project", symlinks=True)
    return configured(root, CAPTURE)


def configured(root: Path, capture: str) -> Path:
    (root / "sierra.toml").write_text(CONFIG + capture)
    return root


def captured(root: Path, *words: str) -> tuple[int, dict[str, Any]]:
    done = projects.quick(root, "capture", "--json", *words)
    return done.returncode, json.loads(done.stdout)


def table(project: Project, query: str) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = project.sql(query).to_pylist()
    return rows


COUNTED = """SELECT run, status, executions, r.execution, count(s.x) AS rows, sum(s.x) AS x
FROM runs r LEFT JOIN swarm s USING (run) GROUP BY ALL ORDER BY run"""


@pytest.mark.integration
def test_frames_are_recorded_and_nothing_counts_their_executions(root: Path) -> None:
    project = sierra.open(root)
    before = table(project, COUNTED)
    status, answer = captured(root)
    assert (status, answer["known"], [row["verdict"] for row in answer["made"]]) == (0, 0, ["identical"] * 2)
    made = [(row["frames"], row["ticks_per_second"], row["files"]) for row in answer["made"]]
    assert made == [(3, 10.0, "frames/{tick}.ppm")] * 2
    assert table(project, COUNTED) == before
    assert table(project, "SELECT * FROM nondeterminism") == []
    assert table(project, "SELECT purpose, count(*) AS n FROM executions GROUP BY ALL ORDER BY n, purpose") == [
        {"purpose": "capture", "n": 2},
        {"purpose": "run", "n": 4},
    ]
    shown = json.loads(projects.quick(root, "show", "--json", answer["batch"]).stdout)["captures"]
    assert [(row["ordinal"], row["number"], row["frames"], row["verdict"]) for row in shown] == [
        (0, 0, 3, "identical"),
        (1, 0, 3, "identical"),
    ]
    assert "captures:" in projects.quick(root, "show", answer["batch"]).stdout
    frame = projects.quick(root, "files", answer["made"][1]["execution"], "output/frames/20.ppm")
    assert frame.stdout.encode("latin-1", "replace").startswith(b"P6 2 2 255\n\x02")
    again, _ = projects.run(root, "population_size=1,2")
    assert (again["executed"], again["reused"]) == (0, 4)
    assert projects.quick(root, "fsck").returncode == 0
    said = projects.quick(root, "why", answer["batch"][:10]).stdout
    assert ("a capture of frames" in said, "did not finish" in said) == (True, False)


@pytest.mark.integration
def test_runs_with_frames_are_not_captured_again_unless_the_rendering_changes(root: Path) -> None:
    assert len(captured(root)[1]["made"]) == 2
    assert captured(root) == (0, {"batch": sierra.open(root).batches[0].batch, "made": [], "known": 2} | NOTHING)
    status, answer = captured(root, "--runs", "2")
    assert (status, len(answer["made"]), answer["known"]) == (0, 2, 2)
    assert len(captured(root, "--again")[1]["made"]) == 2
    configured(root, CAPTURE + 'environment = { COLOURS = "grey" }\n')
    assert len(captured(root)[1]["made"]) == 2


NOTHING: dict[str, Any] = {"notes": [], "interrupted": False}


@pytest.mark.integration
def test_a_rendering_that_changes_results_is_reported(root: Path) -> None:
    configured(root, CAPTURE + 'environment = { DRIFT = "0.5" }\n')
    done = projects.quick(root, "capture")
    assert (done.returncode, done.stdout.count("different"), done.stdout.count("swarm.csv: ")) == (1, 2, 2)
    assert table(sierra.open(root), "SELECT DISTINCT verdict, frames FROM captures") == [{"verdict": "different", "frames": 3}]


@pytest.mark.integration
@pytest.mark.parametrize(
    ("capture", "reason"),
    [
        (CAPTURE.replace("ppm", "png"), "the execution left no file 'frames/{tick}.png'; see [capture]"),
        (CAPTURE.replace("{output}/frames", "{output}/no/frames"), "exit status 1: FileNotFoundError: [Errno 2] No such file"),
    ],
)
def test_captures_without_frames_have_failed(root: Path, capture: str, reason: str) -> None:
    status, answer = captured(configured(root, capture))
    assert (status, [(row["verdict"], row["frames"]) for row in answer["made"]]) == (1, [("failed", 0)] * 2)
    assert all(row["reason"].startswith(reason) for row in answer["made"])
    assert len(captured(root)[1]["made"]) == 2


@pytest.mark.integration
def test_frames_without_another_output_are_not_taken_for_what_was_measured(root: Path) -> None:
    status, answer = captured(configured(root, CAPTURE.replace("frames/{tick}.ppm", "*")))
    assert (status, {(row["verdict"], row["reason"]) for row in answer["made"]}) == (
        1,
        {("different", "no other output could be compared")},
    )


@pytest.mark.nightly
def test_rendering_may_be_turned_on_in_the_input(root: Path) -> None:
    """The simulator finds its argument in the input; the recorded input stays as it is."""
    code = SIMULATOR.replace("sys.argv[2]) if len(sys.argv) > 2 else None", '"frames") if "<render/>" in arena else None')
    (root / "sim.py").write_text(code)
    projects.run(root, "population_size=3")
    changes = """changes = [{ add = "/arena", xml = "<render/>" }]\n"""
    status, answer = captured(configured(root, CAPTURE.partition("arguments")[0] + changes))
    assert (status, [row["frames"] for row in answer["made"]]) == (0, [3])
    recorded = projects.quick(root, "files", answer["made"][0]["execution"], "input/input.xml").stdout
    assert "<render/>" not in recorded


@pytest.mark.integration
@pytest.mark.parametrize(
    ("capture", "message"),
    [
        ("", "nothing says how runs of platform 'command' render; in [capture], set files to the names"),
        ('[capture]\nfiles = "a/*.png"\ncamera = "top"\n', "[capture] camera: platform 'command' has no rendering of its own"),
        (CAPTURE + 'environment = { HOME = "/" }\n', "[capture] environment HOME: SIERRA sets this variable for each run"),
        ('[capture]\nfiles = "*.png"\narguments = "--to {there}"\n', "[capture] arguments: unknown placeholder {there}"),
        (
            '[capture]\nfiles = "*.png"\nchanges = [{ set = "//none/@on", value = "1" }]\n',
            "[capture] changes: //none/@on matches nothing in the recorded input",
        ),
        ('[capture]\nfiles = "../*.png"\n', "files"),
    ],
)
def test_nothing_is_executed_with_a_wrong_table(root: Path, capture: str, message: str) -> None:
    done = projects.quick(configured(root, capture), "capture")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert message in done.stderr
    assert table(sierra.open(root), "SELECT DISTINCT purpose FROM executions") == [{"purpose": "run"}]


def test_a_display_needs_xvfb(root: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    configured(root, CAPTURE + "display = true\n")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(Missing, match="rendering needs Xvfb, which is not installed here"):
        capture(sierra.open(root))


@pytest.mark.nightly
def test_captures_are_removed_with_the_measured_executions(root: Path) -> None:
    _, answer = captured(root)
    project = sierra.open(root)
    [first, second] = answer["made"]
    assert projects.quick(root, "rm", "--yes", first["recorded"]).returncode == 0
    assert table(project, "SELECT run FROM captures") == [{"run": second["run"]}]
    assert projects.quick(root, "rm", "--yes", answer["batch"]).returncode == 0
    assert table(project, "SELECT count(*) AS n FROM captures") == [{"n": 0}]
    assert projects.quick(root, "fsck").returncode == 0


@pytest.mark.integration
def test_runs_of_one_experiment_or_one_id_are_captured_with_the_recorded_code(root: Path) -> None:
    """The code is that of then; the limits are those of now, and those in [capture] come before those in [limits]."""
    (root / "sim.py").write_text("raise SystemExit('the code has changed')\n")
    config = (root / "sierra.toml").read_text()
    (root / "sierra.toml").write_text(config.replace("wall = 30", "wall = 0.001"))
    _, answer = captured(root)
    assert [row["reason"].partition(": ")[2] for row in answer["made"]] == ["[capture] wall sets another limit"] * 2
    config = config.replace("wall = 30", 'wall = 0.001, output = "1 B"')
    (root / "sierra.toml").write_text(config + "wall = 30\n")
    assert captured(root)[1]["made"][0]["reason"].endswith(": [capture] output sets another limit")
    (root / "sierra.toml").write_text(config + 'wall = 30\noutput = "1 MB"\n')
    project = sierra.open(root)
    [run] = table(project, "SELECT run FROM batch_runs WHERE ordinal = 1 AND number = 1")
    answer = capture(project, run["run"])
    assert [(row.run, row.verdict) for row in answer.made] == [(run["run"], "identical")]
    [experiment] = table(project, "SELECT experiment FROM experiments WHERE ordinal = 0")
    assert len(capture(project, experiment["experiment"], runs=2).made) == 2


@pytest.mark.integration
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGINT])
def test_a_capture_that_was_cut_off_continues_with_what_is_missing(root: Path, tmp_path: Path, number: signal.Signals) -> None:
    """The first run has finished, the second one has not, when the capture ends."""
    configured(root, f"{CAPTURE}environment = {{ WAITS = '{tmp_path}/waits' }}\n")
    (tmp_path / "waits").touch()
    project = sierra.open(root)
    with projects.start(root, "capture", "-j1") as process:
        until((tmp_path / "waits.seen").exists)
        os.kill(process.pid, number)
        assert process.wait(30) == (130 if number is signal.SIGINT else -9)
    assert table(project, "SELECT * FROM captures") == []
    (tmp_path / "waits").unlink()
    status, answer = captured(root)
    assert (status, [row["verdict"] for row in answer["made"]]) == (0, ["identical"] * 2)
    assert len({row["session"] for row in answer["made"]}) == 2
    good = "SELECT count(*) AS n FROM executions WHERE purpose = 'capture' AND status = 'ok'"
    assert table(project, good) == [{"n": 2}]
    assert captured(root)[1]["known"] == 2
    assert projects.quick(root, "fsck").returncode == 0
    assert [path for path in (root / ".sierra/work").iterdir() if path.is_dir()] == []


@pytest.mark.integration
def test_each_run_gets_a_display_that_ends_with_it(root: Path, require: Any) -> None:
    """The simulator connects to its display, and writes the number of it as a frame."""
    require("Xvfb")
    connect = "import os, socket\nif 'DISPLAY' in os.environ:\n    found = os.environ['DISPLAY'][1:]\n" + (
        "    socket.socket(socket.AF_UNIX).connect('/tmp/.X11-unix/X' + found)\n    open('display.txt', 'w').write(found)\n"
    )
    (root / "sim.py").write_text(connect + SIMULATOR)
    projects.run(root, "population_size=1,2")
    status, answer = captured(configured(root, '[capture]\nfiles = "display.txt"\ndisplay = true\n'))
    assert (status, [row["frames"] for row in answer["made"]]) == (0, [1, 1]), answer
    numbers = [projects.quick(root, "files", row["execution"], "output/display.txt").stdout for row in answer["made"]]
    assert len(set(numbers)) == 2
    assert [number for number in numbers if Path(f"/tmp/.X11-unix/X{number}").exists()] == []


VIDEO = '[videos.seen]\nkind = "capture"\nsize = [320, 240]\n'


@pytest.mark.integration
def test_a_video_shows_captured_frames_and_says_if_they_are_not_what_was_measured(root: Path) -> None:
    """The frames of the second experiment have one colour, which has more green than the others."""
    project = sierra.open(configured(root, CAPTURE + VIDEO))
    with pytest.raises(NotFound, match="no captured frames of run 0 of experiment 0; sierra video --capture"):
        make_videos(project, names=["seen"])
    assert captured(root)[0] == 0
    made = make_videos(project)
    paths, notes = made.files, made.notes
    assert [path.name for path in paths] == ["seen-population_size=1.mp4", "seen-population_size=2.mp4"]
    assert [note for note in notes if "NOT what was measured" in note] == []
    assert "rendered apart from the measured runs, with the same results" in str(table(project, "FROM deliverables"))
    frames = video_files.decoded(paths[1])
    assert len(frames) == 3
    assert frames[2][120, 160].astype(int) == pytest.approx((2, 100, 0), abs=12)
    assert [one.problem for one in project.deliverables.check()] == [None]

    changed = sierra.open(configured(root, CAPTURE + 'environment = { DRIFT = "0.5" }\n' + VIDEO))
    assert captured(root)[0] == 1
    notes = make_videos(changed).notes
    assert any("NOT what was measured: run 0 differs when it is rendered (swarm.csv: " in note for note in notes), notes
