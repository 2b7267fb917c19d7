"""Slice records: one slice as a table (NAME.csv) and what is known about it (NAME.yaml), SI units.
docs/reference/records.md describes the format; calibration/records holds three to look at.
"""

import argparse
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from sliceit_drake.cli.arguments import add_output_folder, check_name
from sliceit_drake.cli.extras import needs_extra
from sliceit_drake.cli.record_questions import add_question_options, asked, complete_facts
from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.resources import here_or_shipped

if TYPE_CHECKING:
    from sliceit_drake.records.metadata import SliceMetadata
    from sliceit_drake.records.slice_record import SliceRecord

__all__ = ["add_arguments", "run"]

CHECK = """\
Say what is wrong with slice records: by file, column and line, and what to do about it.

Finds missing columns, gaps, time that runs backwards, kN for N, mm for m, ms for s, degrees, a
flipped sign or wrong frame, a sensor that was not tared, clipped or stuck, jumps of the pose,
velocities that disagree with it, and facts that are missing.

A record with an error cannot be used; with a warning it can, with care. Ends with status 1 if there
is an error.
"""

IMPORT = """\
Make a slice record from another format.

  ur_rtde   a recording of ur_rtde's RTDEReceiveInterface.startFileRecording, with at least the
            variables timestamp, actual_TCP_pose, actual_TCP_speed, actual_TCP_force (and actual_q):
              sliceit records import ur_rtde run_07.csv --metadata session.yaml \\
                --tcp-to-knife 0 0 0.12 0 0 0 --output records
  force     time and force of any lab, with a comma, semicolon, tab or spaces between; the motion
            is nominal, straight down at motion.speed. At a terminal the command asks for what the
            table does not say; in a script options or a YAML file say it:
              sliceit records import force slice.csv --output records
              sliceit records import force slice.csv --component vertical --food radish \\
                --shape cylinder --size 0.027 0.12 0.027 --speed 0.02 --output records
              sliceit records import force scale.csv --metadata facts.yaml --contact 0.4 \\
                --output records
  profile   a force profile digitised from a figure, as those in calibration/measured
  rosbag    a ROS 1 .bag, a ROS 2 folder, .db3 or .mcap: --topics names one of WrenchStamped, and
            one of PoseStamped, TransformStamped or (a UR5e's) JointState; no ROS is needed:
              sliceit records import rosbag run_07.mcap --topics /wrench /tcp_pose \\
                --tcp-to-knife 0 0 0.12 0 0 0 --between 4.0 9.5 --metadata session.yaml \\
                --output records

--metadata is a YAML file with what FILE does not say: food, board, knife, nominal motion, sensor,
provenance, and what is unknown (docs/reference/records.md). Writes DIR/NAME.csv and DIR/NAME.yaml,
and prints what `sliceit records check` finds in them. A record that is there already is replaced
only with --replace, and FILE never.
"""


AGAIN = {
    "flipped sign": "--sign by_knife",
    "kilonewtons": "--units s kN",
    "force unit": "--units s mN",
    "great work": "--units s g",
    "negative norm": "--component vertical (and --sign by_knife if a press is negative)",
    "level end": "--between START END",
}
"""What mends an import of a force in which something was found."""


MOST = 0.7
"""Part of the food's height below which a slice that ends there is asked about."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Adds the command's arguments."""
    actions = parser.add_subparsers(title="actions", metavar="ACTION", required=True)
    check = actions.add_parser(
        "check",
        help="what is wrong with records",
        description=CHECK,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    check.add_argument(
        "paths",
        metavar="PATH",
        nargs="+",
        type=here_or_shipped,
        help="a record (NAME.csv), or a folder",
    )
    check.set_defaults(action=_check)
    make = actions.add_parser(
        "import",
        help="make a record from another format",
        description=IMPORT,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    make.add_argument(
        "format", choices=("ur_rtde", "force", "profile", "rosbag"), help="what FILE is"
    )
    make.add_argument("file", metavar="FILE", type=here_or_shipped, help="what to read")
    add_output_folder(make, "folder of records", required=True)
    make.add_argument("--metadata", metavar="YAML", type=Path, help="what FILE does not say")
    make.add_argument("--name", help="name of the record; default: that in YAML, or FILE's")
    make.add_argument(
        "--replace", action="store_true", help="replace a record of that name, as after a mistake"
    )
    pose = ("X", "Y", "Z", "ROLL", "PITCH", "YAW")
    make.add_argument(
        "--tcp-to-knife",
        metavar=pose,
        nargs=6,
        type=float,
        help="ur_rtde, rosbag: knife in the tool frame set in the controller, or in the frame that "
        "the topic is of (of joints: tool0), m and rad; the knife frame has its origin at the "
        "middle of the edge, x along it, z from spine to edge",
    )
    make.add_argument(
        "--world-to-base",
        metavar=pose,
        nargs=6,
        type=float,
        help="ur_rtde, rosbag: robot's base (of joints: UR's base, not base_link), or the frame "
        "that poses are in, in the world; default: they are the same",
    )
    make.add_argument(
        "--component",
        choices=("norm", "vertical", "components"),
        help="force: what of the force FILE has (without a terminal: norm)",
    )
    make.add_argument(
        "--columns",
        metavar="COLUMN",
        nargs="+",
        default=(),
        help="force: names, or numbers from 1, of time and force, or of time and x, y, z",
    )
    make.add_argument(
        "--units",
        metavar=("TIME", "FORCE"),
        nargs=2,
        default=(),
        help="force: units in FILE, as ms kN, where its header does not say them (default: s N)",
    )
    make.add_argument(
        "--sign",
        choices=("on_knife", "by_knife"),
        help="force: whether a vertical force upwards is positive in a press (on_knife)",
    )
    make.add_argument(
        "--contact",
        metavar="S",
        type=float,
        help="force, profile: time at which the force rises, which ends the air phase (force: "
        "found by default)",
    )
    make.add_argument(
        "--topics", metavar=("WRENCH", "MOTION"), nargs=2, help="rosbag: of force and of motion"
    )
    make.add_argument(
        "--tool-frame", metavar="NAME", help="rosbag: frame that MOTION is of, if it does not say"
    )
    make.add_argument(
        "--between",
        metavar=("S", "S"),
        nargs=2,
        type=float,
        help="force, rosbag: begin and end of the slice, s, in the time of FILE, or after the "
        "first wrench or, of a clock's time, the first row; default: all",
    )
    make.add_argument(
        "--clock",
        choices=("header", "received"),
        default="header",
        help="rosbag: stamps of the messages (the default), or when they were recorded",
    )
    add_question_options(make)
    make.set_defaults(action=_import)


def run(options: argparse.Namespace) -> int:
    """Runs the command."""
    return options.action(options)


def _check(options: argparse.Namespace) -> int:
    """Runs `sliceit records check`."""
    from sliceit_drake.records.slice_record import read_table
    from sliceit_drake.records.validation import check_table, record_files

    files = [file for path in options.paths for file in record_files(path)]
    bad = 0
    for file in files:
        try:
            findings = check_table(read_table(file))
            lines = [str(finding) for finding in findings]
            is_bad = any(finding.severity == "error" for finding in findings)
        except ConfigurationError as error:
            lines, is_bad = [f"error: {error}"], True
        print("\n".join(lines or [f"{file}: nothing found"]))
        bad += is_bad
    print(f"{len(files)} records, {bad} with errors")
    return 1 if bad else 0


def _import(options: argparse.Namespace) -> int:
    """Runs `sliceit records import`."""
    from sliceit_drake.configuration import load_yaml
    from sliceit_drake.records.metadata import SliceMetadata
    from sliceit_drake.records.slice_record import read_table, write_record
    from sliceit_drake.records.validation import check_table

    metadata = load_yaml(SliceMetadata, options.metadata)
    metadata.name = options.name or metadata.name or options.file.stem
    check_name(metadata.name, "a record", "Give --name NAME, one")
    target = options.output / metadata.name
    _check_target(target, options)
    if options.format == "force":
        metadata.wrench.sign = options.sign or metadata.wrench.sign
        options.component = options.component or _component(options)
        metadata = complete_facts(metadata, options)
    record = _imported(options, metadata)
    file = write_record(record, target)
    print(f"{file} and .yaml: {len(record)} rows, {record.time[-1] - record.time[0]:.4g} s")
    if options.format == "force":
        _say_what_was_taken(record)
    # As they were written, for that is what all else will read.
    findings = check_table(read_table(file))
    for finding in findings:
        print(finding)
        if options.format == "force" and finding.kind in AGAIN:
            print(f"If so, import it again with {AGAIN[finding.kind]}.")
            print("With --replace it is written over this record.")
    return 1 if any(finding.severity == "error" for finding in findings) else 0


def _check_target(target: Path, options: argparse.Namespace) -> None:
    """Refuses to write a record over the file that it is made of, or over another record."""
    from sliceit_drake.records.slice_record import record_pair

    for file in record_pair(target):
        if file.resolve() == options.file.resolve():
            raise ConfigurationError(
                "the record would be written over FILE, the measurement itself",
                source=str(file),
                fix="Give another --output, or --name NAME.",
            )
        if file.exists() and not options.replace:
            raise ConfigurationError(
                "is there already",
                source=str(file),
                fix="Give --name NAME to keep both, or --replace to write over it.",
            )


def _say_what_was_taken(record: "SliceRecord") -> None:
    """What the command found by itself, so that a user sees where it erred."""
    from sliceit_drake.records.spikes import without_spikes

    facts = record.metadata
    begins = [phase.start for phase in facts.motion.phases if phase.label == "slice"]
    if record.phase("air").any():
        print(f"The force begins at {begins[0]:.4g} s: give --contact if it does not.")
    else:
        print("The record begins in the food: a calibration lets the knife come from above it.")
    if "motion.speed" in facts.unknown:
        print(
            f"The speed is not known: {facts.motion.speed:.3g} m/s would bring the knife to the "
            "board with the last row. A calibration fits it."
        )
    if facts.motion.speed is not None and facts.food.size is not None:
        way = facts.motion.speed * (record.time[-1] - begins[0])
        print(
            f"By the last row the knife is {1e3 * way:.0f} mm deep in a food that is "
            f"{1e3 * facts.food.size[2]:.0f} mm high."
        )
        if way < MOST * facts.food.size[2]:
            print(
                "If it went on to the board, correct --speed, or the height, the last number of "
                "--size."
            )
    if "no unit" in facts.processing[0].note:
        print("The table names no unit: s and N are taken. Give --units if they are others.")
    if spikes := int((without_spikes(record.measured_force)[1] > 0.0).any(1).sum()):
        print(
            f"{spikes} row{'s' * (spikes > 1)} far from those before and after, as of a faulty "
            "cable: the fit hardly counts such."
        )
    if "start" in facts.processing[0].numbers:
        print("The table has the time of a clock: times count from its first row.")
    if any(step.name == "tare" for step in facts.processing):
        print("The mean force before that is taken off.")
    if facts.unknown:
        print(f"Listed as unknown: {', '.join(facts.unknown)}.")


def _component(options: argparse.Namespace) -> str:
    """What of the force the file has, asked at a terminal."""
    if len(options.columns) == 4:
        return "components"
    if not sys.stdin.isatty() or options.metadata is not None:
        return "norm"
    while True:
        words = "norm, vertical or components"
        text = f"What of the force the file has, {words} (Enter: norm): "
        answer = asked(text, "component")
        if not answer or answer in words.replace(" or", ",").split(", "):
            return answer or "norm"


def _imported(options: argparse.Namespace, metadata: "SliceMetadata") -> "SliceRecord":
    from sliceit_drake.records import importers

    if options.format == "profile":
        return importers.import_profile(options.file, metadata, contact=options.contact)
    if options.format == "force":
        return importers.import_force(
            options.file,
            metadata,
            component=options.component,
            contact=options.contact,
            columns=options.columns,
            units=options.units,
            between=options.between,
        )
    if options.format == "rosbag" and options.topics is None:
        raise ConfigurationError(
            "is not given",
            field="--topics",
            fix="Give two: of WrenchStamped, and of PoseStamped, TransformStamped or JointState.",
        )
    if options.tcp_to_knife is None:
        raise ConfigurationError(
            "is not given",
            field="--tcp-to-knife",
            fix="Give the pose of the knife in the controller's tool frame: X Y Z ROLL PITCH YAW.",
        )

    tcp, base = options.tcp_to_knife, options.world_to_base or [0.0] * 6
    for option, pose in (("--tcp-to-knife", tcp), ("--world-to-base", base)):
        if any(abs(angle) > 2.0 * math.pi for angle in pose[3:]):
            raise ConfigurationError(
                f"{' '.join(f'{angle:g}' for angle in pose[3:])} is more than a turn",
                field=option,
                fix="Give ROLL PITCH YAW in rad: 180 degrees are 3.1416.",
            )
    X_TK = importers.pose_matrix(tcp[:3], tcp[3:])
    X_WB = importers.pose_matrix(base[:3], base[3:])
    if options.format == "ur_rtde":
        return importers.import_ur_rtde(options.file, metadata, X_TK, X_WB)
    from sliceit_drake.hardware.edge_kinematics import flange_pose
    from sliceit_drake.records.rosbag import import_rosbag

    wrench, motion = options.topics
    with needs_extra("ros"):
        return import_rosbag(
            options.file,
            metadata,
            wrench,
            motion,
            X_TK,
            X_WB,
            forward=flange_pose,
            tool_frame=options.tool_frame,
            between=options.between,
            clock=options.clock,
        )
