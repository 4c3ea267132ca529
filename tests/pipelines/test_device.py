"""The clock of a made device against a made motion, and its signals at the frames."""

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from tests.verdicts import agreed_verdict

from marey.cli.main import WRONG_INPUT, run
from marey.errors import FileProblem, SettingProblem
from marey.geometry import rotations
from marey.io.markers.recordings import read_recording
from marey.io.opensim.mot_sto import Orientations, write_orientations
from marey.io.opensim.trc import PointPaths, write_trc
from marey.pipelines.device import align_device, parse_match

OFFSET, DRIFT, MASS = 0.8130, 4e-4, 70.0
"""Planted clock of the device, and the mass of the person [kg]."""
FRAMES, SAMPLES = np.arange(360) / 30, np.arange(9000) / 1000
"""Times of the motion's frames, and of the device's samples [s]."""
HERTZ, PHASE = np.array([0.31, 0.53, 0.87, 1.41, 2.17]), np.array([0.3, 2.0, 4.1, 1.2, 5.0])


def path(instants, derivative=0):
    """Squats and bounces that do not repeat themselves, whose parts have accelerations of 1 m/s2."""
    turn = 2 * np.pi * HERTZ
    return (turn ** (derivative - 2.0) * np.sin(turn * instants[:, None] + PHASE + derivative * np.pi / 2)).sum(1)


def made_motion(folder, rng, *, of=path):
    """Hips whose height is a known function of time, with errors of 1 mm, in a TRC."""
    points = np.zeros((len(FRAMES), 2, 3))
    points[:, 1, 0] = 0.2
    points[..., 2] = 0.9 + of(FRAMES)[:, None] + 0.001 * rng.normal(size=(len(FRAMES), 2))
    paths = PointPaths(names=("left_hip", "right_hip"), time=FRAMES, rate=30.0, points=points)
    write_trc(folder / "hips.trc", paths)
    return folder / "hips.trc"


def written(path, columns, times=SAMPLES):
    """A table of signals."""
    with path.open("w", newline="") as file:
        rows = csv.writer(file)
        rows.writerow(["time", *columns])
        rows.writerows(np.column_stack([times, *columns.values()]).round(9).tolist())
    return path


def made_plates(folder, rng, *, of=path, name="forces.csv"):
    """Two plates that share the weight of the person, with noise of 5 N each."""
    force = MASS * (9.81 + of(SAMPLES * (1 + DRIFT) + OFFSET, 2))
    share = 0.5 + 0.3 * np.sin(SAMPLES)
    noise = 5 * rng.normal(size=(2, len(SAMPLES)))
    return written(folder / name, {"left": share * force + noise[0], "right": (1 - share) * force + noise[1]})


def test_the_force_under_both_feet_gives_the_clock(tmp_path, rng):
    motion, plates = made_motion(tmp_path, rng), made_plates(tmp_path, rng)
    found = align_device(motion, plates, match=["left+right=force"])
    at = np.array([0.0, 4.5, 9.0])
    late = found.clock.instants(at) - (at * (1 + DRIFT) + OFFSET)
    assert (np.abs(late) < 4 * found.clock.instants_sd(at)).all()
    # Below a tenth of a frame in the middle.
    assert abs(late[1]) < 0.0033
    # The pelvis is not the centre of mass: 5 ms are added to the standard deviation.
    assert 0.005 < found.clock.instants_sd(at)[1] < 0.006
    total = found.values.sum(axis=1)
    known = np.isfinite(total)
    assert (known == ((FRAMES >= OFFSET) & (FRAMES <= OFFSET + 9.0))).mean() > 0.98
    off = total - MASS * (9.81 + path(FRAMES, 2))
    sd = np.sqrt(found.variance.sum(axis=1))
    assert np.mean(np.abs(off[known]) < 1.96 * sd[known]) > 0.9
    # 5 ms at the usual slope of 10 kN/s.
    assert np.median(sd[known]) < 60


def test_a_gyroscope_gives_the_clock(tmp_path, rng):
    axis = np.array([0.0, 0.6, 0.8])
    turned = np.array([rotations.about(axis, np.array(5 * path(t[None])[0])) for t in FRAMES])[:, None]
    write_orientations(
        tmp_path / "shank.sto", Orientations(time=FRAMES, rate=30.0, names=("left_shank",), world_from_body=turned)
    )
    times = SAMPLES[::5]
    speed = 5 * path(times * (1 + DRIFT) + OFFSET, 1)
    parts = {f"gyro_{x}": 57.3 * speed * a + rng.normal(size=len(times)) for x, a in zip("xyz", axis, strict=True)}
    imu = written(tmp_path / "imu.csv", parts, times)
    clock = align_device(tmp_path / "shank.sto", imu, match=["gyro_x,gyro_y,gyro_z=turning:left_shank"]).clock
    assert abs(clock.instants(np.array(4.5)) - 4.5 * (1 + DRIFT) - OFFSET) < 4 * clock.instants_sd(np.array(4.5)) < 0.02


def test_the_axes_of_a_gyroscope_need_not_be_those_of_the_segment(tmp_path, rng):
    vector = np.stack([2 * path(FRAMES), path(1.3 * FRAMES + 2), path(0.8 * FRAMES + 5)], axis=1)
    turned = rotations.exp(vector)[:, None]
    write_orientations(
        tmp_path / "head.sto", Orientations(time=FRAMES, rate=30.0, names=("head",), world_from_body=turned)
    )
    times, step = SAMPLES[::5], 1e-4
    at = times * (1 + DRIFT) + OFFSET
    before, after = (
        rotations.exp(np.stack([2 * path(t), path(1.3 * t + 2), path(0.8 * t + 5)], axis=1))
        for t in (at - step / 2, at + step / 2)
    )
    speed = rotations.log(np.swapaxes(before, 1, 2) @ after) / step @ rotations.exp(np.array([1.0, -2.0, 0.5]))
    imu = written(tmp_path / "imu.csv", dict(zip(("a", "b", "c"), speed.T, strict=True)), times)
    clock = align_device(tmp_path / "head.sto", imu, match=["a,b,c=turning:head"]).clock
    assert abs(clock.instants(np.array(4.5)) - 4.5 * (1 + DRIFT) - OFFSET) < 4 * clock.instants_sd(np.array(4.5)) < 0.01


def periodic(instants, derivative=0):
    turn = 2 * np.pi * 1.8
    return 0.02 * turn**derivative * np.sin(turn * instants + derivative * np.pi / 2)


def test_without_a_clear_answer_there_is_none(tmp_path, rng):
    motion = made_motion(tmp_path, rng)
    other = made_plates(tmp_path, rng, of=lambda t, d=0: path(3.7 - 0.8 * t, d))
    short = written(tmp_path / "short.csv", {"left": 700 + path(SAMPLES[:900], 2)}, SAMPLES[:900])
    for device, match in ((other, "left+right=force"), (short, "left=force")):
        with pytest.raises(FileProblem, match="does not determine a clock"):
            align_device(motion, device, match=[match])


def test_a_periodic_motion_has_no_answer(tmp_path, rng):
    motion, plates = made_motion(tmp_path, rng, of=periodic), made_plates(tmp_path, rng, of=periodic)
    with pytest.raises(FileProblem, match="periodic"):
        align_device(motion, plates, match=["left+right=force"])


def test_events_give_the_clock_of_emg(tmp_path, rng):
    motion = made_motion(tmp_path, rng)
    emg = written(tmp_path / "emg.csv", {"emg": rng.normal(size=len(SAMPLES))})
    taps = np.array([0.41, 1.33, 2.9, 5.2, 8.8])
    rows = [f"{t * (1 + DRIFT) + OFFSET + 0.005 * rng.normal()},{t}" for t in taps]
    (tmp_path / "taps.csv").write_text("\n".join(["motion_s,device_s", *rows, "7.7,"]) + "\n")
    aligned = align_device(motion, emg, events=tmp_path / "taps.csv")
    clock = aligned.clock
    assert clock.used == 5
    # The device stops 3 s before the motion.
    assert aligned.verdict.level == "usable with limits"
    assert "frames have no signal" in str(aligned.verdict)
    assert abs(clock.offset_s - OFFSET) < 4 * clock.offset_sd_s < 0.08


@pytest.mark.parametrize("text", ["left", "=force", "left=weight", "left=turning", "left=force:hip", "a,,b=force"])
def test_a_wrong_match_is_named(text):
    with pytest.raises(SettingProblem, match="--match"):
        parse_match(text)


def test_the_command_writes_what_it_prints(tmp_path, rng, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    made_motion(tmp_path, rng), made_plates(tmp_path, rng)
    assert run(["device", "hips.trc", "forces.csv", "--match", "left+right=force"]) == 0
    printed = capsys.readouterr()
    assert printed.out.endswith("\nSignals: forces_at_frames/signals.csv\n")
    agreed_verdict(Path("forces_at_frames/run.json"), printed=printed.out)
    assert "forces.csv: offset +81" in printed.err
    clock = json.loads((tmp_path / "forces_at_frames" / "clock.json").read_text())
    assert abs(clock["offset_s"] - OFFSET) < 0.02
    assert len((tmp_path / "forces_at_frames" / "signals.csv").read_text().splitlines()) == len(FRAMES) + 1
    assert json.loads((tmp_path / "forces_at_frames" / "run.json").read_text())["command"] == "device"


@pytest.mark.parametrize(
    ("more", "wrong"),
    [
        ([], "forces.csv: has no force plates; its signals are left, right."),
        (["--match", "middle=force"], "forces.csv: has no signal 'middle'"),
        (["--match", "left=turning:tail"], "The motion has no segment 'tail'. It has: none."),
        (["--events", "nothing.csv"], "nothing.csv: does not exist"),
        (["--match", "left=force", "--within", "0"], "--within"),
    ],
)
def test_wrong_input_is_one_line(tmp_path, rng, monkeypatch, capsys, more, wrong):
    monkeypatch.chdir(tmp_path)
    made_motion(tmp_path, rng), made_plates(tmp_path, rng)
    assert run(["device", "hips.trc", "forces.csv", *more]) == WRONG_INPUT
    error = capsys.readouterr().err
    assert wrong in error
    assert [line for line in error.splitlines() if line.startswith("marey:")] == [error.splitlines()[-1]]
    assert not (tmp_path / "forces_at_frames").exists()


def test_a_real_walk_over_plates_is_ambiguous_by_a_step_and_right_otherwise(tmp_path, shared):
    file = shared / "data" / "markers" / "functional" / "walk.c3d"
    markers = read_recording(file)
    numbers = [markers.point_names.index(f"{side}HipCenterScore") for side in ("Left", "Right")]
    hips = PointPaths(
        names=("left_hip", "right_hip"), time=markers.time[::4], rate=30.0, points=markers.points[::4][:, numbers]
    )
    write_trc(tmp_path / "hips.trc", hips)
    with pytest.raises(FileProblem, match="periodic"):
        align_device(tmp_path / "hips.trc", file)
    clock = align_device(tmp_path / "hips.trc", file, within=0.4).clock
    # Both are of one clock; the plates carry the person from 5.1 to 6.7 s.
    assert abs(clock.instants(np.array(5.9)) - 5.9) < 3 * clock.instants_sd(np.array(5.9)) < 0.03
