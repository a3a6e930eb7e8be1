"""The tutorials run as they stand, and what they print is true."""

import ast
import json
import os
import re
import shutil
import subprocess
import sys
import textwrap
import tomllib
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore
from typer.testing import CliRunner

from sonar_graph.cli.main import app
from sonar_graph.logs import PartialCalibration, read_log
from sonar_graph.logs.adapters import read_log_config
from sonar_graph.logs.convert.csv_log import parse_csv_config
from sonar_graph.recognition import read_labels
from sonar_graph.recognition.confusion_fit import LEAST_FRAMES
from sonar_graph.sequence import Sequence
from sonar_graph.simulation import BasinOptions, simulate_basin

TUTORIALS = Path(__file__).parents[1] / "docs" / "tutorials"
TRUE_LANDMARKS = {1: (5.0, 0.0), 2: (7.0, -5.0), 3: (2.0, -7.0), 4: (0.0, -2.0)}


def output(folder: Path, *command: object, **environment: str) -> str:
    """Output of a command that ends well, or with a doubt about the log; the first word is an installed script."""
    script, *words = map(str, command)
    asked = [Path(sys.executable).parent / script, *words]
    told = os.environ | environment
    done = subprocess.run(
        asked, cwd=folder, capture_output=True, text=True, timeout=600, env=told
    )
    is_doubt = (
        "inspect" in command
        and done.returncode in (1, 3)
        and not done.stderr.startswith("sonar-graph:")
    )
    # sensors that contradict each other: results are written, and marked
    is_doubt |= done.returncode == 3 and "the results are doubtful" in done.stderr
    assert done.returncode == 0 or is_doubt, f"{command}\n{done.stdout}{done.stderr}"
    return done.stdout


def python(folder: Path, *words: object) -> str:
    """Output of a program, by its file or after ``-c``."""
    return output(folder, "python", "-W", "error", *words)


def page_of(name: str) -> str:
    return (TUTORIALS / name).read_text(encoding="utf-8")


def blocks(page: str, language: str) -> list[str]:
    """Blocks of a language on a page."""
    return re.findall(rf"```{language}\n(.*?)```", page, re.DOTALL)


def commands(page: str) -> list[str]:
    """What follows ``sonar-graph`` in the indented lines of a page."""
    return re.findall(r"^    sonar-graph (.*)$", page, re.MULTILINE)


def number_after(text: str, pattern: str) -> float:
    found = re.search(pattern + r"\s*(-?[\d.]+(?:e-?\d+)?)", text)
    assert found, f"{pattern!r} is not in:\n{text}"
    return float(found[1])


@pytest.mark.slow
def test_first_comparison_finds_the_landmarks_and_writes_a_page(
    tmp_path,
):
    printed = python(tmp_path, TUTORIALS / "01_first_comparison.py")
    number = r" +(-?[\d.]+)"
    rows = re.findall(rf"^ +(\d){number * 2} +[\d.]+$", printed, re.MULTILINE)
    assert_are_true(rows, 0.3)
    assert len(rows) == 4
    page = (tmp_path / "comparison" / "report.html").read_text(encoding="utf-8")
    for name in ("isam2", "ekf-slam", "dead-reckoning"):
        assert number_after(printed, rf"\n{name}") < 0.5
        assert name in page
        assert (tmp_path / "comparison" / "runs" / name / "trajectory.tum").is_file()


@pytest.mark.slow
def test_pages_on_the_library_and_preintegration_print_what_they_say(tmp_path):
    printed = python(tmp_path, TUTORIALS / "02_library.py")
    assert number_after(printed, r"in 10\.00 s:") == pytest.approx(0.39 * 10, abs=1.5)
    assert abs(number_after(printed, "turns it by")) == pytest.approx(
        1e-4 * 10, rel=0.01
    )
    assert "landmarks [1, 2, 3, 4]" in printed
    assert "120 poses" in printed or "119 poses" in printed
    assert 0 < abs(number_after(printed, r"landmarks \[1, 2\]:")) < 1
    printed = python(tmp_path, TUTORIALS / "05_preintegration.py")
    bias = number_after(printed, "about z:")
    sigma = number_after(printed, "±")
    assert abs(bias - 0.01) < 3.5 * sigma < 1e-3
    assert number_after(printed, "after 20 s:") < 0.05
    off_m = number_after(printed, "gap of 5 s:")
    sigma_m = number_after(printed, "1 sigma ")
    assert off_m < 3.5 * sigma_m < 0.2


@pytest.mark.slow
def test_recogniser_page_finds_the_landmark_where_it_is(tmp_path):
    printed = python(tmp_path, TUTORIALS / "06_recogniser.py")
    last = printed[printed.rindex(": landmark 3 (") :]
    identity, certainty, range_m = re.search(
        r"landmark (\d) \(([\d.]+)\) at ([\d.]+)", last
    ).groups()
    assert identity == "3"
    assert float(certainty) > 0.9
    assert float(range_m) == pytest.approx(
        number_after(last, "true, of the last: landmark 3 at"), abs=0.01
    )
    azimuth_deg = number_after(last, "mm,")
    assert azimuth_deg == pytest.approx(
        number_after(last, r"true, of the last: landmark 3 at [\d.]+ m,"), abs=0.3
    )


@pytest.mark.slow
def test_page_on_viewers_has_commands_and_a_program_that_work(tmp_path):
    page = page_of("03_viewers.md")
    for words in (
        "simulate basin -o basin.mcap --duration-s 120 --laps 1",
        "compare basin.mcap -o comparison --estimators isam2",
    ):
        output(tmp_path, "sonar-graph", *words.split())
    lines = re.findall(r"^    (evo_\w+ .*)$|`(evo_\w+ [^`]*)`", page, re.MULTILINE)
    assert len(lines) == 4
    for indented, inline in lines:
        printed = output(
            tmp_path,
            *(indented or inline).split(),
            HOME=str(tmp_path),
            MPLBACKEND="Agg",
        )
        assert "rmse" in printed or "poses" in printed
    (program,) = blocks(page, "python")
    assert_landmarks_are_true(python(tmp_path, "-c", program), 0.3)


def assert_landmarks_are_true(printed: str, off_m: float) -> int:
    """The number of landmarks that are printed, each near the true one."""
    seen = re.findall(r"landmark (\d) at (-?[\d.]+), (-?[\d.]+)", printed)
    assert_are_true(seen, off_m)
    return len(seen)


def assert_are_true(seen: list[tuple[str, str, str]], off_m: float) -> None:
    """Identities and places of landmarks."""
    assert seen
    for landmark, *place in seen:
        true = TRUE_LANDMARKS[int(landmark)]
        assert [float(x) for x in place] == pytest.approx(true, abs=off_m)


def assert_is_simulated(found: Sequence, depth_scale: float | None = None) -> None:
    """Whatever axes and units lie between; a depth from pressure has the gravity of the reader's calibration."""
    truth = simulate_basin(BasinOptions(seed=1, duration_s=120.0, laps=1))
    scale = depth_scale or truth.calibration.gravity_m_s2 / 9.80665
    for one, other in (
        (found.imu.angular_velocity, truth.imu.angular_velocity),
        (found.imu.specific_force, truth.imu.specific_force),
        (found.dvl.velocity, truth.dvl.velocity),
        (found.depth.z_m, truth.depth.z_m * scale),
    ):
        np.testing.assert_allclose(one, other, atol=1e-9)


@pytest.mark.slow
def test_page_on_own_logs_has_programs_and_commands_that_work(tmp_path):
    page = page_of("04_your_own_log.md")
    making, *others = blocks(page, "python")
    (configuration,) = blocks(page, "toml")
    store = get_typestore(Stores.ROS1_NOETIC)
    with Writer(tmp_path / "old.bag") as writer:
        connection = writer.add_connection(
            "/chatter", "std_msgs/msg/String", typestore=store
        )
        text = store.types["std_msgs/msg/String"]("hello")
        writer.write(connection, 1, store.serialize_ros1(text, "std_msgs/msg/String"))
    python(tmp_path, "-c", making)
    (tmp_path / "my_bag").mkdir()
    shutil.copy(tmp_path / "dive.mcap", tmp_path / "my_bag")
    printed = {}
    for line in commands(page):
        words, _, target = line.partition(" > ")
        printed[words] = output(tmp_path, "sonar-graph", *words.split())
        if target:  # what is printed is a starting point; the page's own text is where the reader ends
            assert (
                '# topic = "/nav/dvl"\n# type = "my_msgs/msg/Speed"' in printed[words]
            )
            (tmp_path / target).write_text(configuration, encoding="utf-8")
    first = printed["inspect dive.mcap"]
    second = printed["inspect dive.mcap --log-config dive.toml"]
    assert "not usable for compare: no DVL" in first
    assert "gravity is felt along -z" in first
    assert "less than the atmosphere's" in first
    # the page's log has no frames, of which each sensor and all mountings warn, and its Doppler log is turned
    expected = r"warning:? (DVL mounting yaw|mountings those of imu, dvl, depth|.{0,40}no transform from)"
    rest = re.sub(expected, "", " ".join(second.split()))
    assert not re.findall("warning|not usable|left out", rest), rest
    for program in others:
        python(tmp_path, "-c", program)
    config = read_log_config(tmp_path / "dive.toml")
    assert_is_simulated(read_log(tmp_path / "dive.mcap", config=config))


@pytest.mark.slow
def test_page_on_batches_has_a_suite_a_command_and_a_program_that_work(tmp_path):
    page = page_of("07_batches.md")
    (suite,) = blocks(page, "toml")
    (program,) = blocks(page, "python")
    commands = re.findall(r"^    (sonar-graph|python) (.*)$", page, re.MULTILINE)
    assert [words.split()[:2] for _, words in commands] == [
        ["bench", "lap.toml"],
        ["benchmarks/regression/regression_gate.py", "bless"],
        ["bench", "lap.toml"],
        ["benchmarks/regression/regression_gate.py", "judge"],
    ]
    (tmp_path / "lap.toml").write_text(suite, encoding="utf-8")
    (tmp_path / "benchmarks").symlink_to(TUTORIALS.parents[1] / "benchmarks")
    for script, words in commands:
        module = ["-m", "sonar_graph"] if script == "sonar-graph" else []
        said = output(tmp_path, "python", *module, *words.split())
    assert "Gate: passed, without any test of errors, 8 runs" in said
    printed = python(tmp_path, "-c", program)
    assert len(printed.splitlines()) == 2 * 2 * 2
    assert printed.count("no kernel ok") == 4
    for cluster in blocks(page, "python cluster"):
        compile(cluster, "cluster.py", "exec")


def test_page_on_recordings_has_a_calibration_and_labels_that_are_read(tmp_path):
    page = page_of("09_from_a_recording.md")
    (tmp_path / "over.toml").write_text(
        textwrap.dedent(re.search(r"```toml\n(.*?)```", page, re.DOTALL)[1])
    )
    assert "floor.z_m" in PartialCalibration.read(tmp_path / "over.toml").before("log")
    assert (
        f'Of one landmark and of "none of them" {LEAST_FRAMES} labelled frames are needed'
        in page
    )
    (labels,) = blocks(page, "csv")
    (tmp_path / "labels.csv").write_text(labels)
    assert [
        label.id
        for label in read_labels(tmp_path / "labels.csv", Path("joined.mcap")).labels
    ] == [1, None]
    for words in commands(page):
        command, *more = words.split()
        options = {option for option in more if option.startswith("--")}
        help_of_it = CliRunner().invoke(
            app, [command, "--help"], env={"COLUMNS": "300"}
        )
        said = help_of_it.stdout
        assert all(option in said for option in options), words


EXECUTE = """
import sys, nbclient, nbformat
notebook = nbformat.read(sys.argv[1], as_version=4)
nbclient.NotebookClient(notebook, timeout=500, kernel_name="python3").execute()
nbformat.write(notebook, "executed.ipynb")
"""


@pytest.mark.slow
def test_the_notebook_is_stored_without_output_and_runs(
    tmp_path,
):
    pytest.importorskip(
        "nbclient", reason="nbclient is not installed: pip install nbclient ipykernel"
    )
    stored = json.loads((TUTORIALS / "12_notebook.ipynb").read_text("utf-8"))
    codes = [cell for cell in stored["cells"] if cell["cell_type"] == "code"]
    assert all(
        cell["outputs"] == [] and cell["execution_count"] is None for cell in codes
    )
    output(tmp_path, "python", "-c", EXECUTE, TUTORIALS / "12_notebook.ipynb")
    cells = json.loads((tmp_path / "executed.ipynb").read_text("utf-8"))["cells"]
    shown = [one.get("data", {}) for cell in cells for one in cell.get("outputs", [])]
    tables = ["".join(one["text/html"]) for one in shown if "text/html" in one]
    captions = [re.findall(r"<caption>(?:<span>)?(\w+)", table)[0] for table in tables]
    assert captions == ["Sequence", "Scores", "Trajectory", "Map"]
    assert sum("image/svg+xml" in one for one in shown) == 2
    assert "at the same 240 instants" in "".join(cells[-1]["outputs"][0]["text"])


@pytest.mark.slow
def test_page_on_tables_gives_the_simulated_run(
    tmp_path,
):
    page = page_of("11_tables.md")
    (making,) = blocks(page, "python")
    configuration, more, vehicle = blocks(page, "toml")
    parse_csv_config(tomllib.loads(configuration) | tomllib.loads(more), "the page")
    PartialCalibration.parse(tomllib.loads(vehicle), "the page")
    python(tmp_path, "-c", making)
    for line in commands(page):
        words, _, target = line.partition(" > ")
        printed = output(tmp_path, "sonar-graph", *words.split())
        if target:  # the guess is that of the page, but for the axes of the IMU
            said = [
                row.partition("  #")[0]
                for row in printed.splitlines()
                if not row.startswith("#") and row
            ]
            assert said == [
                row
                for row in configuration.splitlines()
                if row and row != 'rotation = "frd"'
            ]
            (tmp_path / target).write_text(configuration, encoding="utf-8")
    assert_is_simulated(read_log(tmp_path / "dive.mcap"), depth_scale=1.0)


@pytest.mark.slow
def test_programs_on_the_page_of_own_scripts_find_the_landmarks(
    tmp_path,
):
    page = page_of("../howto/own_estimator.md")
    programs = blocks(page, "python")
    for program, most in zip(programs, (20, 30, 40), strict=True):
        assert len([line for line in program.splitlines() if line.strip()]) <= most
    output(tmp_path, "sonar-graph", *commands(page)[0].split())
    scored, graph, compared = (python(tmp_path, "-c", program) for program in programs)
    assert number_after(scored, "isam2: position error") < 0.1
    assert (tmp_path / "comparison" / "report.html").is_file()
    for landmark, true in TRUE_LANDMARKS.items():
        found = ast.literal_eval(graph.splitlines()[-1])[landmark]
        np.testing.assert_allclose(found[:2], true, atol=0.1)
    for name in ("MyEkf", "ekf-slam", "isam2"):
        assert number_after(compared, rf"'{name}': '") < 0.3


def test_first_page_makes_a_sequence_a_report_and_a_log_from_arrays(tmp_path):
    (program,) = blocks(page_of("README.md"), "python")
    head, tail = program.split("20 * 10**9")
    shorter = f"{head}6 * 10**9{tail}"
    python(tmp_path, "-c", shorter)
    assert (tmp_path / "comparison" / "report.html").is_file()
    assert read_log(tmp_path / "dive.mcap").depth.z_m[0] == -2.0


def test_every_tutorial_is_listed_and_run():
    listed = page_of("README.md")
    run_here = Path(__file__).read_text(encoding="utf-8")
    for script in (
        *TUTORIALS.glob("0*"),
        *TUTORIALS.glob("11*"),
    ):  # 10 is run in tests/live
        assert script.name in listed
        assert script.name in run_here


@pytest.mark.slow
def test_page_on_doubtful_identities_has_commands_that_work(
    tmp_path,
):
    pytest.importorskip("dask", reason="needs sonar-graph[bench]")
    page = page_of("08_doubtful_identities.md")
    (suite,) = blocks(page, "toml")
    (tmp_path / "policies.toml").write_text(suite, encoding="utf-8")
    printed = {
        words: output(tmp_path, "sonar-graph", *words.split(), COLUMNS="300")
        for words in commands(page)
    }
    for words, said in {
        "run basin.mcap -o gated --set isam2.identity.policy=gate": (
            "Warning: isam2 puts landmark 4 far outside its covariance (NEES up to "
        ),
        "run blind.mcap -o ignored": "none of 220 detections has an identity that isam2 can use",
        "run blind.mcap -o found --set isam2.identity.unknown.policy=associate": (
            "isam2 found 4 landmarks without a name (identity.unknown.policy); scored by place, as 1, 2, 3 and 4."
        ),
    }.items():
        assert said in printed[words]
    compared, asked = (
        python(tmp_path, "-c", program) for program in blocks(page, "python")
    )
    off_m = [
        number_after(compared, rf"{name} [\d.]+")
        for name in ("default", "gate", "max-mixture")
    ]
    assert off_m[1] > 2
    assert max(off_m[0], off_m[2]) < 0.1
    assert assert_landmarks_are_true(asked, 0.2) == 4
    assert "withheld: []" in asked
