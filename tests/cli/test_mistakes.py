"""A user's mistake ends with code 2 and one line that names it, and no file is written; other errors are not hidden."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from sonar_graph.cli import main
from sonar_graph.logs import sonar_image_messages, write_log
from sonar_graph.logs.mcap import write_recording

DESIGN = '[[landmark]]\nid = {id}\nname = "plate"\nsize_m = {size_m}\nshapes = [{{ level_db = 12.0, {shape} }}]\n'
SUITE = 'name = "x"\nreference = "b"\n[[logs]]\nname = "a"\nlog = "a.mcap"\n[[estimators]]\nname = "b"\n'
CIRCLE = "circle_m = [0.0, 0.0, 0.15]"
BAR = "polygon_m = [[-0.3, -0.02], [0.3, -0.02], [0.3, 0.02], [-0.3, 0.02]]"


@pytest.fixture(scope="module")
def files(lane, lane_log, basin_content, tmp_path_factory) -> Path:
    """Folder with logs, and with everything that a user may give in place of another file."""
    folder = tmp_path_factory.mktemp("files")
    (folder / "basin.mcap").write_bytes(basin_content)
    (folder / "lane.mcap").write_bytes(lane_log.read_bytes())
    write_log(folder / "bare.mcap", lane.sequence)
    blind = replace(lane, sequence=replace(lane.sequence, truth=None))
    blind.write(folder / "blind.mcap", [lane.one(k) for k in range(3)])
    images = [
        sonar_image_messages(
            "/sonar", lane.one(0), frequency_hz=1.8e6, sound_speed_m_s=1480
        )
    ]
    write_recording(folder / "images.mcap", images, {})
    (folder / "killed").mkdir()
    large = CIRCLE.replace("0.15", "1.0")
    label = {"range_m": 1.9, "azimuth_rad": 0.0, "id": 12}
    label["stamp_ns"] = int(lane.frames.stamps_ns[40])
    high = "[floor]\nz_m = -1700.0\nsigma_m = 0.1\n[start]\nposition_m = [0.0, 0.0, -700.0]\nrpy_rad = [0.0, 0.5, 0.0]\n"
    texts = {
        "notes.txt": "these are = = words",
        "words.json": "{ no",
        "list.json": "[1]",
        "strange.toml": DESIGN.format(id=9, size_m=0.6, shape=BAR),
        "broken.toml": DESIGN.format(id=1, size_m=-1, shape=CIRCLE),
        "large.toml": DESIGN.format(id=4, size_m=2.0, shape=large),
        "millimetres.toml": high,
        "labels.json": '{"log": "lane.mcap", "labels": []}',
        "twelve.json": json.dumps({"log": "lane.mcap", "labels": [label]}),
        "gyro.toml": "[imu]\ngyro_sigma = 1\n",
        "clock.toml": '[imu]\nstamp = "log"\n',
        "above.toml": "imu.gyro_noise_density = 1e-3\n[imu]\n",
        "twice.toml": '[dvl]\nrotation = "flu"\nrotation = "frd"\n',
        "bare.toml": 'rotation = "frd"\n',
        "capital.toml": '[DVL]\nrotation = "frd"\n',
        "lower.toml": '[imu]\ndvl.rotation = "frd"\n',
        "below.toml": "[dvl]\nimu.gyro_noise_density = 1e-3\n",
        "logs.toml": 'name = "x"\nreference = "isam2"\nlogs = 3\n',
        "late.toml": SUITE,
        "killed/.sonar_graph.json": '{"format": "sonar_graph folder 1", "kind": "batch", "files": {}}',
        "killed/.lock": "",
    }
    for name, text in texts.items():
        (folder / name).write_text(text)
    (folder / "empty").mkdir()
    return folder


MISTAKES = {
    "dance": "dance",
    "compare basin.mcap -o out --speed 9": "--speed",
    "compare missing.mcap -o out": r"missing\.mcap",
    "inspect empty": r"empty: is a folder without metadata\.yaml and \.mcap files; give a log",
    "inspect notes.txt": r"notes\.txt",
    "compare notes.txt -o out": r"notes\.txt",
    "compare basin.mcap -o notes.txt": "is a file; give a folder",
    "compare basin.mcap -o notes.txt/deeper": "cannot be written",
    "simulate basin -o empty": "expected the name of a file that ends in .mcap",
    "simulate basin -o basin.bag": r"ends in \.mcap",
    "compare basin.mcap -o out --estimators isam3": "no estimator is called 'isam3'; did you mean isam2[?] installed",
    "compare basin.mcap -o out --estimators ,": "no estimator is called ''",
    "compare basin.mcap -o out --estimators isam2,,mine": "no estimator is called ''",
    "recognise images.mcap -o out.mcap --calibration millimetres.toml": (
        r"1000 m above the floor and sees nothing of it up to its range of .* \(metres\)"
    ),
    "recognise lane.mcap -o out.mcap --calibration strange.toml": "is not a calibration; .*--designs",
    "recognise lane.mcap -o out.mcap --calibration labels.json": "is not a calibration; .*--labels",
    "compare basin.mcap -o out --rate-hz 0": "--rate-hz",
    "compare basin.mcap -o out --rate-hz inf": "--rate-hz",
    "compare basin.mcap -o out --rate-hz nan": "--rate-hz",
    "compare basin.mcap -o out --rate-hz 2000": "--rate-hz",
    "run basin.mcap -o out --estimator dead-reckoning --rate-hz 0.001": "too short",
    "run basin.mcap -o out --set isam2.lag_s": "expected name=value",
    "run basin.mcap -o out --set ekf-slam.x=1": "ekf-slam is not among the estimators that run: isam2",
    "run basin.mcap -o out --set isam3.x=1": "isam3 is not among the estimators that run: isam2; did you mean isam2",
    "run basin.mcap -o out --set identity.policy=gate": r"name comes first, such as isam2\.identity\.policy$",
    "run basin.mcap -o out --set isam2.=1": r"expected ESTIMATOR\.setting=value",
    "run basin.mcap -o out --set isam2.nonsense=1": "nonsense",
    "run basin.mcap -o out --set isam2.smoother.lag_s=5 --set isam2.smoother.lag_s=6": "also set to 5; give it once",
    "run basin.mcap -o out --set isam2.smoother.lag_s=5 --set isam2.smoother={}": "and one is inside the other",
    "--": "sonar-graph --help",
    "simulate basin -o new.mcap --set tracks=true --set tracks=false": "tracks is also set to True; give it once",
    "simulate basin -o new.mcap --set wrong_id_share=0.3": "wrong_id_share = 0.3 is a share of a track; set tracks",
    "run notes.txt -o out --set isam2.identity.policy=max-mixture --set isam2.history.policy=bounded": (
        'history.policy = "bounded" cannot be with identity.policy = "max-mixture"'
    ),
    "run notes.txt -o out --set isam2.history.remembered_s=10": (
        'there is no such field with policy = "whole"; history.policy = "bounded" has it'
    ),
    "run basin.mcap -o out --start 1e6": r"nothing was recorded from 1000000\.000 s to the end",
    "run basin.mcap -o out --topic /imu/data": "expected ROLE=TOPIC",
    "run basin.mcap -o out --topic smell=/imu/data": "smell",
    "run basin.mcap -o out --topic imu=/imu/raw": "/imu/raw",
    "run basin.mcap -o out --calibration notes.txt": "not TOML",
    "run basin.mcap -o out --calibration gyro.toml": r"gyro\.toml: imu\.gyro_sigma",
    "run basin.mcap -o out --calibration clock.toml": r"imu\.stamp is a key of a log configuration.*--log-config",
    "run basin.mcap -o out --calibration above.toml": r"\[imu\] begins in line 1: put its keys together there",
    "run basin.mcap -o out --log-config twice.toml": "`rotation` in line 3 is set above already: keep one",
    "run basin.mcap -o out --log-config bare.toml": r"`rotation = …` belongs below a table, such as \[dvl\]",
    "run basin.mcap -o out --log-config capital.toml": r"did you mean \[dvl\]",
    "run basin.mcap -o out --log-config lower.toml": r"belongs above the first table, or into \[dvl\]",
    "run basin.mcap -o out --map empty": "empty: expected a map as a file, not a folder",
    "run basin.mcap -o out --calibration below.toml": "goes above the first table of the file",
    "run basin.mcap -o out --calibration list.json": "expected a JSON object, found list; give sections, such as",
    "simulate basin -o new.mcap --set wind=3": "wind",
    "simulate basin -o new.mcap --images --set image.nois=1": r"image\.nois: there is no such field.*noise_db",
    "simulate basin -o new.mcap --set image.designs=mine.toml": "give --images too",
    "simulate basin -o new.mcap --set imu=sundial": "sundial",
    "simulate basin -o new.mcap --duration-s 1": "laps",
    "simulate basin -o new.mcap --laps many": "--laps",
    "simulate landmarks --on basin.mcap -o new.mcap --set spacing=4": "did you mean spacing_m",
    "convert dataset mrclam empty --number 1 -o new.mcap": "empty",
    "convert dataset dlr empty --number 1 -o new.mcap": "data set dlr: expected FOLDER",
    "report empty": "empty",
    "label basin.mcap -o new.json --map empty": "No such option: --map",
    "recognise basin.mcap -o new.mcap --map empty": "No such option: --map",
    "calibrate basin.mcap -o new.json --map empty": "No such option: --map",
    "join basin.mcap basin.mcap -o new.mcap --map empty": "No such option: --map",
    "calibration basin.mcap --map empty": "No such option: --map",
    "simulate landmarks --on basin.mcap -o new.mcap --map empty": "No such option: --map",
    "calibration": "give --template",
    "report killed": "before any of its runs was done; give the bench command that began it again",
    "bench logs.toml -o out": r"logs\.toml, line 3: logs",
    "bench late.toml -o out": r"late\.toml, line 7: est",
    "bench late.toml -o out --workers 2 --scheduler tcp://127.0.0.1:1": "give one of them",
    "recognise bare.mcap -o new.mcap": r"bare\.mcap: has no sonar images; .*inspect .*` lists .*compare` .* need none",
    "recognise lane.mcap -o new.mcap --rule bayes": "rule.*virtual-evidence.*jeffrey",
    "recognise lane.mcap -o new.mcap --model words.json": r"words\.json is not JSON",
    "recognise lane.mcap -o new.mcap --model list.json": r"list\.json: .*calibrate",
    "recognise lane.mcap -o new.mcap --designs broken.toml": r"broken\.toml.*size_m",
    "recognise lane.mcap -o new.mcap --designs large.toml": r"plate \(id 4\) would never be found",
    "recognise lane.mcap -o new.mcap --designs empty": "empty: no landmark designs",
    "recognise lane.mcap -o new.mcap --topic sonar=/none": "/none was chosen but is not in the log",
    "recognise lane.mcap -o new.mcap --rule jeffrey --set identity.rule=jeffrey": "--rule jeffrey and --set .*one of",
    "recognise lane.mcap -o new.mcap --set least_frames=many": "least_frames",
    "recognise lane.mcap -o new.mcap --recogniser design": "no recogniser is called 'design'; did you mean designs",
    "compare images.mcap -o out": r"images\.mcap: nothing for imu.*`sonar-graph recognise images\.mcap` needs",
    "compare lane.mcap -o out --topic sonar=/none": "/none was chosen but is not in the log",
    "compare bare.mcap -o out --rule jeffrey": r"bare\.mcap: has no sonar images.*--rule",
    "compare lane.mcap -o out --rule bayes": r"settings of the recogniser: identity\.rule: .*virtual-evidence.*jeffrey",
    "compare lane.mcap -o out --designs broken.toml": r"broken\.toml.*size_m",
    "calibrate bare.mcap -o new.mcap": r"ends in \.json",
    "calibrate blind.mcap -o new.json": r"blind\.mcap: has no true poses and true.*label .*--labels",
    "calibrate bare.mcap -o new.json": r"bare\.mcap: has no sonar images",
    "calibrate lane.mcap lane.mcap -o new.json": r"lane\.mcap: is named twice.*name each log once",
    "calibrate lane.mcap -o new.json --designs strange.toml": "true landmarks are 1, 2, 3, 4, the designs are 9: ",
    "calibrate lane.mcap -o new.json --labels labels.json": r"labels\.json: 0 of 0 labels met .*; too few labelled fr",
    "calibrate lane.mcap -o new.json --labels labels.json --labels labels.json": "1 logs and 2 files for --labels; give",
    "calibrate lane.mcap -o new.json --labels twelve.json": "its labels name landmark 12, the designs are 1, 2, 3, 4",
    "calibrate lane.mcap -o new.json --motion images": "--motion is for --labels",
    "join notes.txt lane.mcap -o new.mcap": r"lane\.mcap: has /sonar/image already; recognise it as it is",
    "label lane.mcap -o new.toml": r"expected the name of a file that ends in \.json",
    "recognise lane.mcap -o new.mcap --report page.pdf": r"expected the name of a file that ends in \.html",
    "calibrate lane.mcap -o new.json --set identity.unknown_pror=1": r"identity\.unknown_pror: .*unknown_prior",
}


@pytest.mark.parametrize(("command", "expected"), MISTAKES.items())
def test_a_mistake_is_named_in_one_line_and_no_file_is_written(
    command, expected, files, refuse
):
    refuse(files, command, expected)


@pytest.mark.parametrize(
    ("stop", "code"),
    [
        (KeyboardInterrupt, 130),
        (PermissionError(13, "Permission denied", "x.mcap"), 2),
    ],
)
def test_interruption_and_refused_access_end_in_one_line(
    stop, code, basin, monkeypatch, reply
):
    monkeypatch.setattr("sonar_graph.logs.inspect_log", raising(stop))
    said = reply(code, "inspect", basin).err
    assert re.fullmatch(r"sonar-graph: .+\n", said)


def test_unforeseen_error_is_not_hidden(basin, monkeypatch):
    monkeypatch.setattr("sonar_graph.logs.inspect_log", raising(ZeroDivisionError()))
    with pytest.raises(ZeroDivisionError):
        main(["inspect", str(basin)])


def raising(error: Any) -> Callable[..., None]:
    def stopped(*_):
        raise error

    return stopped
