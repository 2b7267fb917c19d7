"""Motions of the knife: analytic positions and velocities, continuity, records, and the system."""

import numpy as np
import pytest
from pydrake.math import RigidTransform, RollPitchYaw
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from scipy.spatial.transform import Rotation

from sliceit_drake.configuration import ConfigurationError, dump_yaml, load_yaml
from sliceit_drake.cutting.motion import (
    ConstantSpeed,
    Hold,
    Motion,
    MotionPlan,
    Pose,
    PressAndDraw,
    Recorded,
    Retract,
    Waypoints,
)
from sliceit_drake.systems.motion_sources import MotionSource

# A knife that points down (z of K along -z of W), turned about the vertical, off the origin.
START = Pose(Rotation.from_euler("xyz", [np.pi, 0.0, 0.3]).as_matrix(), np.array([0.4, -0.1, 0.2]))
COLUMNS = ("time", "p_WK_x", "p_WK_y", "p_WK_z", *(f"quat_WK_{axis}" for axis in "wxyz"))


def motion_of(*segments, start=START):
    return Motion(MotionPlan(list(segments)), start)


def in_start_axes(motion, t):
    return START.R.T @ (motion.pose(t).p - START.p), START.R.T @ motion.velocity(t).v


def write_record(file, times, positions, rotations, columns=COLUMNS):
    rows = np.column_stack([times, positions, rotations.as_quat(scalar_first=True)])
    lines = [",".join(columns), *(",".join(f"{x:.17g}" for x in row) for row in rows)]
    file.write_text("\n".join(lines), encoding="utf-8")


@pytest.fixture
def record(tmp_path):
    file = tmp_path / "record.csv"
    times = 3.0 + np.linspace(0.0, 1.0, 51)
    positions = np.column_stack(
        [0.01 * np.sin(5 * times), 0.4 + 0.02 * np.cos(3 * times), 0.2 - 0.03 * times]
    )
    rotations = Rotation.from_euler("xyz", np.outer(times, [0.05, -0.1, 0.2]) + [np.pi, 0, 0])
    write_record(file, times, positions, rotations)
    return file, times, positions, rotations


def test_constant_speed_without_ramps_is_a_straight_line():
    motion = motion_of(ConstantSpeed(speed=0.02, distance=0.03))
    assert motion.duration == pytest.approx(1.5, rel=1e-12)
    for t in (0.0, 0.4, 1.49):
        p, v = in_start_axes(motion, t)
        np.testing.assert_allclose(p, [0, 0, 0.02 * t], atol=1e-15)
        np.testing.assert_allclose(v, [0, 0, 0.02], atol=1e-15)
        np.testing.assert_array_equal(motion.pose(t).R, START.R)


def test_pressing_moves_a_knife_that_points_down_towards_the_board():
    motion = motion_of(ConstantSpeed(speed=0.02, distance=0.03), Retract(distance=0.01))
    np.testing.assert_allclose(motion.pose(1.5).p, START.p - [0, 0, 0.03], atol=1e-12)
    np.testing.assert_allclose(motion.pose(9.0).p, START.p - [0, 0, 0.02], atol=1e-12)


def test_direction_counts_and_its_length_does_not():
    motion = motion_of(ConstantSpeed(speed=0.05, direction=[30.0, 0.0, 40.0], duration=1.0))
    p, v = in_start_axes(motion, 0.5)
    np.testing.assert_allclose(v, [0.03, 0, 0.04], atol=1e-15)
    np.testing.assert_allclose(p, [0.015, 0, 0.02], atol=1e-15)


def test_ramps_have_the_given_acceleration_and_keep_the_distance():
    speed, distance, acceleration = 0.1, 0.03, 0.5
    motion = motion_of(ConstantSpeed(speed=speed, distance=distance, acceleration=acceleration))
    ramp = speed / acceleration
    assert motion.duration == pytest.approx(distance / speed + ramp, rel=1e-12)
    for t, z, v in (
        (0.1, 0.5 * acceleration * 0.01, 0.05),
        (ramp, 0.5 * speed * ramp, speed),
        (0.25, 0.5 * speed * ramp + speed * 0.05, speed),
        (motion.duration - 0.1, distance - 0.5 * acceleration * 0.01, 0.05),
        (motion.duration, distance, 0.0),
    ):
        p_K, v_K = in_start_axes(motion, t)
        np.testing.assert_allclose(p_K, [0, 0, z], atol=1e-14)
        np.testing.assert_allclose(v_K, [0, 0, v], atol=1e-14)


def test_a_path_too_short_for_its_speed_turns_back_at_half_way():
    motion = motion_of(ConstantSpeed(speed=1.0, distance=0.02, acceleration=0.5))
    assert motion.duration == pytest.approx(2 * np.sqrt(0.02 / 0.5), rel=1e-12)
    p, v = in_start_axes(motion, motion.duration / 2)
    np.testing.assert_allclose(p, [0, 0, 0.01], atol=1e-14)
    np.testing.assert_allclose(v, [0, 0, 0.5 * motion.duration / 2], atol=1e-14)


def test_a_given_duration_includes_the_ramps():
    motion = motion_of(ConstantSpeed(speed=0.1, duration=1.0, acceleration=0.5))
    assert motion.duration == pytest.approx(1.0, rel=1e-12)
    assert in_start_axes(motion, 1.0)[0][2] == pytest.approx(0.1 * (1.0 - 0.2), rel=1e-12)


def test_steady_draw_keeps_its_ratio_to_the_press():
    motion = motion_of(
        PressAndDraw(press_speed=0.01, distance=0.02, draw_ratio=3.0, acceleration=0.2)
    )
    for t in np.linspace(0.01, motion.duration - 0.01, 7):
        p, v = in_start_axes(motion, t)
        assert p[0] == pytest.approx(3 * p[2], rel=1e-12)
        assert v[0] == pytest.approx(3 * v[2], rel=1e-12)
    np.testing.assert_allclose(
        in_start_axes(motion, motion.duration)[0], [0.06, 0, 0.02], atol=1e-12
    )


def test_sinusoidal_draw_follows_its_formula():
    motion = motion_of(
        PressAndDraw(press_speed=0.01, distance=0.02, amplitude=0.015, frequency=2.0)
    )
    omega = 4 * np.pi
    for t in (0.0, 0.13, 1.0, 1.9):
        p, v = in_start_axes(motion, t)
        np.testing.assert_allclose(p, [0.015 * np.sin(omega * t), 0, 0.01 * t], atol=1e-15)
        np.testing.assert_allclose(v, [0.015 * omega * np.cos(omega * t), 0, 0.01], atol=1e-14)


def test_ramps_of_a_draw_do_not_exceed_its_acceleration_along_the_path():
    acceleration = 0.5
    motion = motion_of(
        PressAndDraw(amplitude=0.01, frequency=1.0, draw_ratio=1.0, acceleration=acceleration)
    )
    times = np.linspace(0.0, 0.02, 21)
    speeds = [np.linalg.norm(motion.velocity(t).v) for t in times]
    rates = np.diff(speeds) / np.diff(times)
    assert speeds[0] == 0.0
    assert rates.max() <= acceleration * (1 + 1e-9)
    assert rates.min() >= 0.9 * acceleration


def test_hold_rests_where_the_segment_before_it_ended():
    motion = motion_of(ConstantSpeed(distance=0.01), Hold(duration=0.5), Retract())
    _, begin, end = motion.phases[1]
    for t in np.linspace(begin, end - 1e-9, 5):
        np.testing.assert_allclose(in_start_axes(motion, t)[0], [0, 0, 0.01], atol=1e-12)
        np.testing.assert_array_equal(motion.velocity(t).v, np.zeros(3))


def test_waypoints_are_reached_at_their_times_with_their_rotations():
    plan = Waypoints(
        times=[0.5, 2.0],
        positions=[[0.0, 0.0, 0.02], [0.03, 0.01, 0.02]],
        rotations=[[0.1, 0.0, 0.0], [0.1, -0.4, 0.2]],
    )
    for interpolation in ("linear", "smooth"):
        plan.interpolation = interpolation
        motion = motion_of(plan)
        for t, p, angles in zip(plan.times, plan.positions, plan.rotations, strict=True):
            np.testing.assert_allclose(in_start_axes(motion, t)[0], p, atol=1e-12)
            R = START.R @ RollPitchYaw(angles).ToRotationMatrix().matrix()
            np.testing.assert_allclose(motion.pose(t).R, R, atol=1e-12)


def test_linear_waypoints_turn_at_constant_rate_and_smooth_ones_rest_at_each():
    plan = Waypoints(times=[2.0], positions=[[0.0, 0.0, 0.02]], rotations=[[0.0, 0.6, 0.0]])
    plan.interpolation = "linear"
    motion = motion_of(plan)
    np.testing.assert_allclose(START.R.T @ motion.velocity(0.7).w, [0, 0.3, 0], atol=1e-12)
    np.testing.assert_allclose(in_start_axes(motion, 0.7)[1], [0, 0, 0.01], atol=1e-12)
    plan.interpolation = "smooth"
    motion = motion_of(plan)
    # Minimum jerk: half way at half time, at 15/8 of the mean rate.
    np.testing.assert_allclose(in_start_axes(motion, 1.0)[0], [0, 0, 0.01], atol=1e-12)
    np.testing.assert_allclose(in_start_axes(motion, 1.0)[1], [0, 0, 15 / 800], atol=1e-12)
    assert np.linalg.norm(motion.velocity(1e-4).w) < 1e-7
    assert np.linalg.norm(motion.velocity(2 - 1e-4).v) < 1e-7


def every_kind(record):
    return [
        Recorded(file=str(record)),
        ConstantSpeed(distance=0.02, acceleration=0.5, label="approach"),
        PressAndDraw(amplitude=0.01, frequency=2.0, draw_ratio=0.5, acceleration=2.0),
        Hold(),
        Waypoints(
            times=[0.4, 0.9], positions=[[0.01, 0, 0], [0, 0, 0.02]], rotations=[[0, 0.3, 0]] * 2
        ),
        Retract(),
    ]


def test_a_sequence_is_continuous_and_its_velocity_is_the_derivative_of_its_pose(record):
    motion = motion_of(*every_kind(record[0]))
    begins = [begin for _, begin, _ in motion.phases]
    for begin in [*begins, motion.duration]:
        before, after = motion.pose(begin - 1e-9), motion.pose(begin + 1e-9)
        np.testing.assert_allclose(before.p, after.p, atol=1e-9)
        np.testing.assert_allclose(before.R, after.R, atol=1e-8)
    h = 1e-5
    for t in np.arange(0.0111, motion.duration, 0.0173):
        low, high, V = motion.pose(t - h), motion.pose(t + h), motion.velocity(t)
        np.testing.assert_allclose((high.p - low.p) / (2 * h), V.v, atol=2e-5)
        turn = Rotation.from_matrix(high.R @ low.R.T).as_rotvec() / (2 * h)
        np.testing.assert_allclose(turn, V.w, atol=1e-6)


def test_the_knife_rests_before_the_start_and_after_the_end():
    motion = motion_of(ConstantSpeed(distance=0.02))
    np.testing.assert_array_equal(motion.pose(-1.0).p, START.p)
    np.testing.assert_allclose(in_start_axes(motion, 99.0)[0], [0, 0, 0.02], atol=1e-12)
    for t in (-1e-9, motion.duration, 99.0):
        np.testing.assert_array_equal(motion.velocity(t).v, np.zeros(3))


def test_phases_are_named_by_their_labels():
    motion = motion_of(
        ConstantSpeed(distance=0.02, label="approach"),
        ConstantSpeed(distance=0.02),
        Hold(duration=0.5),
        Retract(),
    )
    names = [motion.phase_at(t) for t in (-1.0, 0.0, 0.999, 1.001, 1.999, 2.3, 2.6, 99.0)]
    assert names == [
        *["approach"] * 3,
        *["slice"] * 2,
        "hold",
        *["retract"] * 2,
    ]
    assert [label for label, _, _ in motion.phases] == ["approach", "slice", "hold", "retract"]
    assert motion.phases[2][1:] == pytest.approx((2.0, 2.5), abs=1e-12)


def test_a_record_in_the_world_reproduces_its_source_between_and_at_its_rows(record):
    file, times, positions, rotations = record
    motion = motion_of(Recorded(file=str(file), placement="world"))
    assert motion.duration == pytest.approx(1.0, abs=1e-12)
    R, p, w, v = motion.sample(times - times[0])
    np.testing.assert_allclose(p, positions, atol=1e-12)
    np.testing.assert_allclose(R, rotations.as_matrix(), atol=1e-12)
    np.testing.assert_allclose(v[:-1], np.diff(positions, axis=0) / 0.02, atol=1e-10)
    turns = (rotations[1:] * rotations[:-1].inv()).as_rotvec() / 0.02
    np.testing.assert_allclose(w[:-1], turns, atol=1e-10)
    middle = motion.pose(0.01)
    np.testing.assert_allclose(middle.p, positions[:2].mean(axis=0), atol=1e-12)


def test_a_record_at_the_start_keeps_its_shape_and_begins_at_the_start(record):
    file, times, positions, rotations = record
    motion = motion_of(Recorded(file=str(file)))
    np.testing.assert_allclose(motion.pose(0.0).p, START.p, atol=1e-12)
    relative = rotations[0].inv().apply(positions[30] - positions[0])
    np.testing.assert_allclose(
        motion.pose(times[30] - times[0]).p, START.p + START.R @ relative, atol=1e-12
    )


def test_a_sampled_motion_written_as_a_record_plays_back_the_same(tmp_path):
    motion = motion_of(
        ConstantSpeed(distance=0.02, acceleration=1.0),
        Hold(),
        Retract(distance=0.03, acceleration=1.0),
    )
    times = np.arange(0.0, motion.duration, 0.002)
    R, p, _, _ = motion.sample(times)
    file = tmp_path / "played.csv"
    write_record(file, times, p, Rotation.from_matrix(R))
    again = motion_of(Recorded(file=str(file), placement="world"))
    for t in np.linspace(0.0, times[-1], 97):
        # Half the acceleration times a quarter of the squared period bounds a chord's error.
        np.testing.assert_allclose(again.pose(t).p, motion.pose(t).p, atol=1.0 * 0.002**2 / 4)


def test_a_record_in_the_world_that_is_not_first_is_refused(record):
    segments = [Hold(), Recorded(file=str(record[0]), placement="world")]
    with pytest.raises(ConfigurationError, match=r"motion.segments\[1\].placement: would jump"):
        motion_of(*segments)


def edited(text, line, column, value):
    rows = [row.split(",") for row in text.split("\n")]
    rows[line - 1][column] = value
    return "\n".join(",".join(row) for row in rows)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda s: edited(s, 5, 2, "nan"), "line 5: p_WK_y: is 'nan', which is not a finite"),
        (lambda s: edited(s, 7, 0, "x"), "line 7: time: is 'x'"),
        (lambda s: edited(s, 3, 0, "2.5"), "time: row 2 has 2.5 after 3. Sort the rows"),
        (lambda s: edited(s, 3, 0, "3.0"), "time: row 2 has 3 after 3. Sort the rows"),
        (lambda s: s.replace("p_WK_z", "p_z"), 'no column "p_WK_z".*p_z, quat'),
        (lambda s: edited(s, 4, 4, "2"), "row 3 has a quaternion of length .* w first"),
        (lambda s: edited(s, 4, 3, "110"), "p_WK_z: row 3 has 110 m.*in mm. Write 0.11"),
        (lambda s: s.split("\n")[0], "the table has no rows"),
        (lambda s: "\n".join(s.split("\n")[:2]), "the record has one row"),
        (lambda s: s.rpartition(",")[0], "line 52: quat_WK_z: is ''"),
        (lambda s: "", "the first row has: nothing"),
    ],
)
def test_a_bad_record_is_refused_with_file_column_row_and_fix(record, edit, message):
    file = record[0]
    file.write_text(edit(file.read_text(encoding="utf-8")), encoding="utf-8")
    with pytest.raises(ConfigurationError, match=message) as caught:
        motion_of(Recorded(file=str(file)))
    assert str(caught.value).startswith(str(file))
    assert caught.value.fix


def test_a_missing_record_is_refused(tmp_path):
    with pytest.raises(ConfigurationError, match="nowhere.csv: the table cannot be read"):
        motion_of(Recorded(file=str(tmp_path / "nowhere.csv")))


@pytest.mark.parametrize(
    ("segment", "message"),
    [
        ("!ConstantSpeed {}", r"segments\[1\]: needs one of distance and duration; neither"),
        ("!ConstantSpeed {distance: 0.1, duration: 2}", "both are given"),
        ("!ConstantSpeed {distance: 27}", r"\[1\].distance: 27 m is not .*mm. Write 0.027"),
        ("!ConstantSpeed {distance: 0.1, direction: [0, 0, 0]}", "direction: .* no direction"),
        (
            "!ConstantSpeed {duration: 0.01, acceleration: 1}",
            "0.01 s is shorter than the ramps .* 0.04",
        ),
        ("!ConstantSpeed {speed: 20, distance: 0.1}", "speed: 20 m/s .*Is it in mm/s"),
        ("!Waypoints {times: [], positions: []}", r"times: is empty"),
        ("!Waypoints {times: [1, 0.5], positions: [[0, 0, 0], [0, 0, 0]]}", r"times\[1\]: 0.5 s"),
        ("!Waypoints {times: [1, 2], positions: [[0, 0, 0]]}", "positions: has 1 entries for 2"),
        ("!Waypoints {times: [1], positions: [[0, 0]]}", r"positions\[0\]: has 2 values"),
        ("!Waypoints {times: [1], positions: [[0, 0, .nan]]}", r"positions\[0\]\[2\]: is nan"),
        ("!Waypoints {positions: [[0, 0], [0]]}", "positions: has 2 entries for 1 times"),
        ("!Waypoints {rotations: [[0, 90, 0]]}", r"rotations\[0\]\[1\]: 90 rad .*in degrees"),
        ("!Recorded {}", "file: is empty"),
        ("!Retreat {}", 'unknown tag !Retreat. Did you mean "!Retract"'),
    ],
)
def test_a_bad_segment_is_refused_with_its_place_and_fix(tmp_path, segment, message):
    file = tmp_path / "plan.yaml"
    file.write_text(f"segments:\n- !Hold {{}}\n- {segment}\n", encoding="utf-8")
    with pytest.raises(ConfigurationError, match=message) as caught:
        load_yaml(MotionPlan, file)
    assert "motionplan.segments[1]" in str(caught.value)
    assert caught.value.fix


def test_a_plan_survives_yaml(record, tmp_path):
    plan = MotionPlan(every_kind(record[0]))
    file = tmp_path / "plan.yaml"
    dump_yaml(plan, file)
    assert load_yaml(MotionPlan, file) == plan


def test_a_plan_without_segments_and_a_start_that_is_no_pose_are_refused():
    with pytest.raises(ConfigurationError, match="motion.segments: is empty"):
        motion_of()
    with pytest.raises(ValueError, match="not a rotation matrix"):
        motion_of(Hold(), start=Pose(np.diag([1.0, 1.0, -1.0]), np.zeros(3)))
    with pytest.raises(ValueError, match="not a pose"):
        motion_of(Hold(), start=Pose(np.eye(3), np.array([0, 0, np.nan])))


def test_the_system_gives_the_motion_at_the_time_of_its_context(record):
    plan = MotionPlan(every_kind(record[0]))
    X_WK = RigidTransform(RollPitchYaw(np.pi, 0, 0.3), START.p)
    builder = DiagramBuilder()
    source = builder.AddNamedSystem("motion", MotionSource(plan, X_WK))
    diagram = builder.Build()
    simulator = Simulator(diagram)
    motion = Motion(plan, START)
    for t in (0.0, 0.25, 1.5, 3.7):
        simulator.AdvanceTo(t)
        context = source.GetMyContextFromRoot(simulator.get_context())
        pose = source.GetOutputPort("target_pose").Eval(context)
        velocity = source.GetOutputPort("target_velocity").Eval(context)
        np.testing.assert_allclose(pose.translation(), motion.pose(t).p, atol=1e-12)
        np.testing.assert_allclose(pose.rotation().matrix(), motion.pose(t).R, atol=1e-12)
        np.testing.assert_allclose(velocity.translational(), motion.velocity(t).v, atol=1e-12)
        np.testing.assert_allclose(velocity.rotational(), motion.velocity(t).w, atol=1e-12)


def test_two_contexts_of_the_system_do_not_disturb_each_other():
    source = MotionSource(MotionPlan([ConstantSpeed(distance=0.03)]), RigidTransform())
    port = source.GetOutputPort("target_pose")
    early, late = source.CreateDefaultContext(), source.CreateDefaultContext()
    early.SetTime(0.2)
    late.SetTime(1.0)
    first = port.Eval(early).translation()
    port.Eval(late)
    clone = early.Clone()
    np.testing.assert_array_equal(port.Eval(early).translation(), first)
    np.testing.assert_array_equal(port.Eval(clone).translation(), first)
    assert port.Eval(late).translation()[2] > first[2]
