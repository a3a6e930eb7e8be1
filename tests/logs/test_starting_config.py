from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import pytest

from sonar_graph.cli.main import main
from sonar_graph.logs.adapters.log_config import LogConfig
from sonar_graph.logs.cdr.definitions import definition
from sonar_graph.logs.inspection import inspect_log
from sonar_graph.logs.reading import read_log
from sonar_graph.logs.roles import ROLES, Choice, choose_topic
from sonar_graph.logs.writing import write_log


def choices(path: Path, config: LogConfig) -> dict[str, Choice]:
    from sonar_graph.logs.mcap.reader import scan
    from sonar_graph.logs.mcap.topic import Keep

    recording = scan(path, lambda _: Keep.STAMP)
    return {name: choose_topic(role, recording, config) for name, role in ROLES.items()}


def test_read_back_unchanged_it_makes_the_same_choices(bench: Any, make_sequence: Any, tmp_path: Path) -> None:
    imu, dvl = bench.basics()
    poses = [bench.odometry(bench.t0_ns, 0.0)]
    pressure = ("/bar30", "pressure", [bench.pressure(bench.t0_ns, 2e5)])
    logs = [
        bench.write(imu, dvl, pressure, ("/odom", "odometry", poses), name="plain.mcap"),
        bench.write(imu, dvl, ("/second", "imu", imu[2]), name="two.mcap"),
        bench.write(imu, name="half.mcap"),
        tmp_path / "own.mcap",
    ]
    write_log(logs[-1], make_sequence())
    said = [
        LogConfig(),
        LogConfig.parse({"dvl": {"rotation": [1, 2, 3], "covariance": False}, "depth": {"use": False}}, "x"),
        LogConfig.parse({"truth": {"topic": "/odom"}, "imu": {"frame_id": 'a "frame"', "stamp_offset_s": -0.04}}, "x"),
    ]
    for path in logs:
        for config in said:
            text = inspect_log(path, config).toml
            again = LogConfig.parse(tomllib.loads(text), "again")
            first, second = choices(path, config), choices(path, again)
            for role in ROLES:
                assert first[role].topic == second[role].topic
                assert first[role].candidates == second[role].candidates
                assert plain(first[role]) == plain(second[role])


def plain(choice: Choice) -> object:
    """The adapter but for its topic, which the text names and a search by type does not."""
    return choice.adapter and choice.adapter.model_copy(update={"topic": None})


def test_what_is_changed_in_it_counts(bench: Any) -> None:
    path = bench.write(*bench.basics())
    text = inspect_log(path).toml
    assert 'rotation = "flu"' in text
    turned = LogConfig.parse(tomllib.loads(text.replace('rotation = "flu"', 'rotation = "frd"')), "x")
    plain, frd = read_log(path), read_log(path, config=turned)
    assert (frd.imu.specific_force == plain.imu.specific_force * [1, -1, -1]).all()


def test_several_topics_are_offered_and_those_whose_names_say_nothing(bench: Any) -> None:
    imu, dvl = bench.basics()
    poses = [bench.odometry(bench.t0_ns, 0.0)]
    text = inspect_log(bench.write(imu, dvl, ("/second", "imu", imu[2]), ("/odom", "odometry", poses))).toml
    assert '# [imu]  # one of\n# topic = "/imu"\n# topic = "/second"' in text
    assert '# [truth]  # one of\n# topic = "/odom"' in text


def test_an_unknown_type_is_proposed_with_its_fields(bench: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    own = "float64 time\nfloat64[3] speed\nfloat32[] beams\n"
    globals_ = bench.write.__globals__
    monkeypatch.setitem(globals_["TYPES"], "own", "my_msgs/msg/Velocity")
    monkeypatch.setitem(globals_, "definition", lambda name: own if name.startswith("my_msgs") else definition(name))
    rows = [{"time": 0.0, "speed": [1.0, 2.0, 3.0], "beams": []}] * 3
    path = bench.write(bench.basics()[0], ("/my_dvl", "own", rows))
    text = inspect_log(path).toml
    assert '# topic = "/my_dvl"\n# type = "my_msgs/msg/Velocity"\n# stamp = "log"' in text
    assert "#   time\n#   speed[3]\n#   beams[]" in text
    filled = "\n".join(line.removeprefix("# ") for line in text.splitlines() if "my_dvl is" not in line)
    table = filled[filled.index("[dvl]") : filled.index("[depth]")].replace('"..."', '"speed[{}]"').format(0, 1, 2)
    sequence = read_log(path, config=LogConfig.parse(tomllib.loads(table), "x"))
    assert sequence.dvl.velocity.tolist() == [[1, 2, 3]] * 3


def test_the_command_prints_what_the_option_takes(
    bench: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = bench.write(*bench.basics())
    with pytest.raises(SystemExit) as done:
        main(["inspect", str(path), "--toml"])
    assert done.value.code == 0
    config = tmp_path / "log.toml"
    config.write_text(capsys.readouterr().out)
    with pytest.raises(SystemExit) as done:
        main(["inspect", str(path), "--log-config", str(config)])
    assert done.value.code == 0
    assert f"chosen in {config}" in capsys.readouterr().out
