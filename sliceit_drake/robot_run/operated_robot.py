"""A robot whose motions an operator confirms: connect, check, show, ask for the word, move."""

import contextlib
import dataclasses as dc
import shutil
import sys
import termios
import threading
import time as clock
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Self, TextIO

from sliceit_drake.configuration import ConfigurationError
from sliceit_drake.diagrams.live_view import make_meshcat
from sliceit_drake.diagrams.run import Run
from sliceit_drake.diagrams.scenario import Scenario
from sliceit_drake.hardware.checks import Check
from sliceit_drake.hardware.client import RobotClient, RobotUnavailableError, is_loopback
from sliceit_drake.hardware.guarded_touch import Touch, TouchError
from sliceit_drake.hardware.hardware_config import HardwareConfig, differing
from sliceit_drake.hardware.real_time import RealTime
from sliceit_drake.hardware.rtde_link import RobotLink
from sliceit_drake.hardware.safety import Stop
from sliceit_drake.hardware.supervisor import Supervisor
from sliceit_drake.interruption import (
    ENDING,
    catch_signals,
    handle_signals,
    interrupt_main_thread,
    interrupted_once,
    uninterrupted,
)
from sliceit_drake.robot_run.board_touch import BoardTouch, check_height
from sliceit_drake.robot_run.hardware_run import (
    INTERRUPTED,
    HardwareRun,
    prepare_hardware_run,
    write_hardware_outputs,
)
from sliceit_drake.robot_run.move_to_start import MoveToStart
from sliceit_drake.robot_run.retreat import SPEED, Retreat

__all__ = ["OperatedRobot", "ask", "plan_text"]

WORD = "slice"
MOVE_WORD = "move"
TOUCH_WORD = "touch"
RETREAT_WORD = "retreat"
ROOM = 1e8
"""Least free room on the disk, bytes."""
LOOK = 2e-3
"""Pause between two looks at the connection while the operator is asked, s."""
SILENCE = 0.5
"""How long the robot may send no data then, controller s."""
WATCHED = 1.0
"""Longest time that a dry run follows the robot's data, s."""


@dc.dataclass
class OperatedRobot:
    """A robot at an address, and an operator at the terminal who types a word before each motion.

    Attributes:
        host: Address of the robot.
        config: The robot's file; a touch writes the board's height into it.
        pace: Controller seconds in a second; 1 for all robots.
        dry_run: Whether to do all but move.
        found: What the last touch of the board has found.
    """

    host: str
    config: HardwareConfig
    pace: float = 1.0
    dry_run: bool = False
    found: Touch | None = None
    _connection: tuple[RobotClient, Supervisor] | None = None

    def run(
        self,
        scenario: Scenario,
        directory: Path,
        *,
        move_to_start: bool = False,
        touch: bool = False,
        duration: float | None = None,
        draws: bool = False,
        keep: Callable[[Run], object] | None = None,
    ) -> Run | None:
        """Connects, checks, asks for the word, runs, and writes the outputs.

        Args:
            scenario: What to run.
            directory: Where the outputs go.
            move_to_start: Whether to move the joints to the start first.
            touch: Whether to find the board's height then.
            duration: Duration, s; None for the motion's.
            draws: Whether to write a replay.
            keep: Writes what else the caller keeps of a run, with the outputs, before anything else
                is asked, such as for a retreat: whatever ends that, the record is complete.

        Returns:
            The run; None if the robot was not ready or the operator did not confirm.
        """
        if move_to_start and not self.dry_run:
            if not self.move_to_start(scenario):
                return None
        if touch and not self.dry_run:
            if not self.find_board(scenario):
                return None
        made: Run | None = None
        try:
            with self.connected() as client:
                meshcat = make_meshcat() if draws and not self.dry_run else None
                hardware = prepare_hardware_run(scenario, self.config, client, self.pace, meshcat)
                made = self.checked_run(hardware, directory, duration, keep)
        except RobotUnavailableError:
            # Who confirms no stop has ended the run as stopped, and the operator was told.
            if made is None or not made.stopped:
                raise
        if Retreat.is_offered_after(hardware):
            self.retreat(hardware, directory)
        return made

    def retreat(self, hardware: HardwareRun, directory: Path) -> bool:
        """Connects anew and goes back on the last way after the operator's word.

        Its log is retreat.csv in the directory, with the columns of robot.csv.

        Returns:
            False if the robot was not ready or stopped, or the operator did not confirm.
        """
        with self.connected() as client:
            hardware.client = client
            retreat = Retreat(hardware)
            if not _report("Retreat", [*hardware.check_facts(), *retreat.checks()]):
                return False
            print(
                f"\nRETREAT: the knife goes back on its last way, {1e3 * retreat.distance:.1f} mm "
                f"at {1e3 * SPEED:g} mm/s. It stops at {retreat.limits.force:.0f} N; it feels "
                f"{retreat.force:.0f} N now. Look first what it pressed on.\n"
            )
            if not self.asks(RETREAT_WORD):
                return False
            problem: str | None = "the retreat ended by an error"
            try:
                problem = retreat.execute()
            finally:
                _tell(
                    f"STOPPED: {problem}" if problem else "The knife is back.",
                    _stopped_text(retreat.link),
                )
                retreat.link.write_log(directory / "retreat.csv")
            return problem is None

    def move_to_start(self, scenario: Scenario) -> bool:
        """Connects, checks the robot, and moves it to the start after the operator's word.

        Returns:
            False if the robot was not ready or did not move, or the operator did not confirm.
        """
        with self.connected() as client:
            hardware = prepare_hardware_run(scenario, self.config, client, self.pace)
            if not _report("Robot", hardware.check_facts()):
                return False
            move = MoveToStart(hardware)
            if not _report("Move to the start", move.checks()):
                return False
            print(
                "\nMOVE: the joints turn straight to "
                f"{hardware.twin.start_joints.round(4).tolist()}; the knife moves at up to "
                f"{1e3 * move.knife_speed:.0f} mm/s, and nothing looks for obstacles but board, "
                "table and holder. Stand back.\n"
            )
            if not self.asks(MOVE_WORD):
                return False
            problem = move.execute()
            if problem is not None:
                print(f"STOPPED on the way to the start: {problem}")
            return problem is None

    def find_board(self, scenario: Scenario) -> bool:
        """Connects and finds the board, see `touch_board`; the program on the robot is stopped."""
        with self.connected() as client:
            return self.touch_board(scenario, client)

    def touch_board(self, scenario: Scenario, client: RobotClient) -> bool:
        """Finds the board after checks and the word; `config` then has the height found.

        Returns:
            False if the robot was not ready, the operator did not confirm, or there was no board.

        Raises:
            ConfigurationError: The board is not where it is expected.
        """
        # Its own copy: an expected height is not a measured one until the knife has met the board.
        config, self.found = dc.replace(self.config), None
        field = "scenario.board.height" if config.board_height is None else "board_height"
        if config.board_height is None:
            config.board_height = scenario.board.height
        hardware = prepare_hardware_run(scenario, config, client, self.pace)
        touch = BoardTouch(hardware)
        if not _report("Robot and touch", [*hardware.check_facts(), *touch.checks()]):
            return False
        if not _report("Start", hardware.check_at_start()):
            return False
        print(
            f"\nTOUCH: the knife goes straight down by up to {1e3 * touch.depth:.1f} mm at "
            f"{1e3 * config.touch.speed:g} mm/s, until it meets {config.touch.force:g} N, and back "
            f"up. It looks for the board between the start and "
            f"{touch.expected - config.touch.below:.4f} m. Take the food away: the knife would "
            "take it for the board.\n"
        )
        if not self.asks(TOUCH_WORD):
            return False
        try:
            found = self.found = touch.execute()
        except TouchError as error:
            print(f"STOPPED: {error}")
            print(_stopped_text(touch.link))
            return False
        print(
            f"The board is at {found.height:.4f} m (+- {1e3 * found.uncertainty:.2f} mm), expected "
            f"at {touch.expected:.4f}. It is as stiff as {1e-3 * found.stiffness:.0f} N/mm, with "
            f"the arm; the force rose to {found.peak_force:.1f} N."
        )
        check_height(found, touch.expected, config.touch.tolerance, field)
        self.config.board_height = found.height
        print("This run takes the height that was found.\n")
        return True

    def checked_run(
        self,
        hardware: HardwareRun,
        directory: Path,
        duration: float | None = None,
        keep: Callable[[Run], object] | None = None,
    ) -> Run | None:
        """The same as `run` with a robot that is connected already, and at the start."""
        if not _report("Robot and plan", hardware.check_before()):
            return None
        duration = _run_duration(hardware, duration)
        if not _report("Start", [*hardware.check_at_start(), _room(directory)]):
            return None
        print(plan_text(hardware, duration))
        if self.dry_run:
            made = hardware.execute(min(WATCHED, duration), moves=False)
            assert hardware.link is not None
            timing = ", ".join(f"{k} {v:.4g}" for k, v in hardware.link.timing().items())
            print(f"Dry run: nothing was sent to the joints. {timing}")
            if made.stopped:
                print(f"NOT READY: {made.stopped}")
                print(_stopped_text(hardware.link))
            return made
        return _slice(hardware, duration, directory, keep) if self.asks(WORD) else None

    @staticmethod
    def report(title: str, checks: Sequence[Check]) -> bool:
        """Prints checks; whether all passed."""
        return _report(title, checks)

    def asks(self, word: str) -> bool:
        """Whether the operator types the word, see `ask`, and the robot was there all the time."""
        if self._connection is None:
            return ask(word, is_loopback(self.host))
        watch = _Watch(*self._connection, self.pace)
        is_confirmed = False
        try:
            with watch:
                is_confirmed = ask(word, is_loopback(self.host))
        except KeyboardInterrupt:
            if watch.problem is None:
                raise
        if watch.problem is None:
            return is_confirmed
        print(f"\nSTOPPED: {watch.problem} Nothing was moved.", flush=True)
        return False

    @contextmanager
    def connected(self) -> Iterator[RobotClient]:
        """A client in control of the robot; at its end, however it ends, the program is stopped.

        SIGTERM and SIGHUP, which a terminal that is closed sends, end it as Ctrl-C does.

        Raises:
            RobotUnavailableError: It does not answer, or refuses.
        """
        from sliceit_drake.hardware.ur_client import UrClient

        # The supervisor begins before, and keeps the usual priority.
        with (
            catch_signals(),
            Supervisor(self.host) as supervisor,
            RealTime(asks=not is_loopback(self.host)) as real_time,
        ):
            print(f"Connecting to {self.host}", flush=True)
            _report("This computer", real_time.checks)
            config = self.config
            client = UrClient(
                self.host, config.lookahead_time, config.gain, config.limits, pace=self.pace,
                supervisor=supervisor,
            )  # fmt: skip
            try:
                self._connection = client, supervisor
                yield client
            finally:
                # A second signal would leave the program playing, and ur_rtde's threads alive.
                with uninterrupted():
                    self._connection = None
                    client.close()


class _Watch(threading.Thread):
    """Ends a question with an interrupt when the robot's data stop or a connection is lost.

    Attributes:
        problem: What was lost, and whether the program on the robot is stopped; or None.
    """

    def __init__(self, client: RobotClient, supervisor: Supervisor, pace: float) -> None:
        super().__init__(daemon=True)
        self._client, self._supervisor = client, supervisor
        self._silence = SILENCE / pace
        self._is_over = threading.Event()
        self.problem: str | None = None

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_over.set()
        self.join()

    def run(self) -> None:
        newest, arrival = self._client.timestamp(), clock.monotonic()
        while not self._is_over.wait(LOOK):
            time, now = self._client.timestamp(), clock.monotonic()
            if time != newest:
                newest, arrival = time, now
            if self._client.is_connected() and now - arrival < self._silence:
                continue
            problem = "the connection to the robot was lost."
            with self._supervisor.limit():
                try:
                    self._client.stop()
                except RuntimeError as error:
                    problem += f" {_not_stopped_text(str(error))}"
            self.problem = problem
            interrupt_main_thread()
            return


def _run_duration(hardware: HardwareRun, duration: float | None) -> float:
    """How long to run, s.

    Raises:
        ConfigurationError: It is no part of the motion: the knife would stay where it is.
    """
    longest = hardware.motion.duration
    if duration is None:
        return longest
    if not 0.0 < duration <= longest + 1e-9:
        raise ConfigurationError(
            f"{duration:g} s is not within the motion",
            field="--duration",
            fix=f"Give up to {longest:g}, or leave it out.",
        )
    return duration


def _room(directory: Path) -> Check:
    """Whether the disk has room for the record; what is above the directory need not exist yet."""
    free = shutil.disk_usage(next(p for p in [directory, *directory.parents] if p.exists())).free
    return Check(
        "room for the record",
        free >= ROOM,
        f"{1e-6 * free:.0f} MB free at {directory}, wanted {1e-6 * ROOM:.0f}",
        "Make room, or write elsewhere with --output.",
    )


def _slice(
    hardware: HardwareRun,
    duration: float,
    directory: Path,
    keep: Callable[[Run], object] | None,
) -> Run:
    """Runs, tells the operator how it ended, and writes what was measured, whatever ended it."""
    hardware.abandoned = _end_a_diagram_that_stands
    with interrupted_once():
        try:
            made = _executed(hardware, duration)
        except KeyboardInterrupt:
            if hardware.run is not None:
                again = ", more than once" if hardware.run.stopped == INTERRUPTED else ""
                hardware.run.stopped = (hardware.run.stopped or INTERRUPTED) + again
            raise
        finally:
            # What was not prepared has sent nothing, and has no record.
            if hardware.run is not None and hardware.link is not None:
                with handle_signals(ENDING, _say_still_writing):
                    _tell_and_write(hardware, hardware.run, directory, keep)
    return made


def _end_a_diagram_that_stands(stop: Stop) -> None:
    """Tells the operator of a stop that the diagram does not come back to see; interrupts it."""
    _tell(
        f"STOPPED: {stop}. The program waits for it still, and is interrupted; the robot's program "
        "is being stopped. If nothing follows, use the emergency stop before you go near it.",
        file=sys.stderr,
    )
    interrupt_main_thread()


def _executed(hardware: HardwareRun, duration: float) -> Run:
    """Runs, and shows how far it is."""
    from tqdm import tqdm

    with tqdm(
        total=duration,
        desc=hardware.scenario.name,
        bar_format="{desc}: {percentage:3.0f}%|{bar}| {n:.2f}/{total:.2f} s",
    ) as bar:

        def show(time: float, wall: float) -> None:
            bar.update(time - bar.n)

        return hardware.execute(duration, show)


def _tell_and_write(
    hardware: HardwareRun, made: Run, directory: Path, keep: Callable[[Run], object] | None
) -> None:
    """Says first how a run has ended: a full disk, or a record that takes long, must not keep that
    from the operator."""
    if made.stopped:
        _tell(f"STOPPED: {made.stopped}", _stopped_text(hardware.link))
    if hardware.error is not None:
        _tell("".join(traceback.format_exception(hardware.error)), file=sys.stderr)
    try:
        summary = write_hardware_outputs(hardware, directory)
        if keep is not None:
            keep(made)
    except OSError as error:
        _tell(f"NOT ALL IS WRITTEN: {directory}: {error.strerror}. Make room before the next run.")
        raise
    robot = summary["robot"]
    _tell(
        f"Peak force {summary['peak_force_N']:.1f} N; {robot['cycles']:.0f} cycles, "
        f"{robot['missed_cycles']:.0f} missed, lateness {1e3 * robot['lateness_99_s']:.2f} ms "
        f"(99 %), {1e3 * robot['lateness_max_s']:.2f} ms at most"
    )


def _say_still_writing(*_: object) -> None:
    # Python refuses to print where the signal came in the middle of a print.
    with contextlib.suppress(RuntimeError):
        _tell("Still writing the record.")


def _tell(*lines: str, file: TextIO | None = None) -> None:
    """Prints to an operator who may have left: what was measured is kept all the same.

    A reader who leaves ends the motion, by the error of the progress bar; a closed terminal does by
    its signal.
    """
    with contextlib.suppress(OSError):
        print("\n".join(lines), file=file, flush=True)


def ask(word: str, is_emulated: bool) -> bool:
    """Whether the operator types the word; Enter alone, an end of input or Ctrl-C do not.

    What was typed before the question does not count, and a robot is not moved by a pipe.

    Args:
        word: The word that goes on.
        is_emulated: Whether the robot is emulated on this machine, so that a pipe may answer.
    """
    if sys.stdin.isatty():
        termios.tcflush(sys.stdin, termios.TCIFLUSH)
    elif not is_emulated:
        print(f'The word "{word}" must be typed at a terminal. Nothing was moved.')
        return False
    try:
        answer = input(f'Type "{word}" to go on, anything else to leave: ')
    except EOFError:
        answer = ""
    if answer.strip() == word:
        return True
    print("Not confirmed. Nothing was moved.")
    return False


def _report(title: str, checks: Sequence[Check]) -> bool:
    """Prints checks; whether all passed."""
    print(f"{title}:")
    for check in checks:
        print(f"  {check}")
    failed = [check.name for check in checks if not check.passed]
    if failed:
        print(f"Not ready: {', '.join(failed)}. Nothing was moved.")
    return not failed


def plan_text(hardware: HardwareRun, duration: float) -> str:
    """What is about to happen, for the operator to read."""
    scenario, plan, limits = hardware.scenario, hardware.plan, hardware.config.limits
    board = scenario.board.height
    changed = differing(hardware.config)
    phases = ", ".join(
        f"{label} {end - begin:.2f} s" for label, begin, end in hardware.motion.phases
    )
    policy = scenario.policy
    if policy is not None:
        phases = f"{policy.describe()}; up to there"
    low, high = plan.edge_low[2] - board, plan.edge_high[2] - board
    lines = [
        "",
        f"PLAN: {scenario.name}, {duration:.2f} s: {phases}",
        f"  knife up to {1e3 * plan.fastest:.0f} mm/s; edge between "
        f"{1e3 * low:+.2f} and {1e3 * high:+.1f} mm over the board at {board:.4f} m",
        f"  stops at {limits.force:g} N, {limits.torque:g} Nm, {limits.knife_speed:g} m/s of the "
        f"knife, {1e3 * limits.board_depth:g} mm below the board, {limits.tracking_error:g} rad "
        "off the target",
        f"  settings that differ from the defaults: {'; '.join(changed) if changed else 'none'}",
        "",
    ]
    return "\n".join(lines)


def _stopped_text(link: RobotLink | None) -> str:
    """What an operator must know about the robot after a stop."""
    if link is None or link.stop_error is None:
        return "The robot's program is stopped. Find the cause before you start again."
    return _not_stopped_text(link.stop_error)


def _not_stopped_text(error: str) -> str:
    return (
        f"THE ROBOT DID NOT CONFIRM THAT ITS PROGRAM IS STOPPED ({error}). Use the "
        "emergency stop before you go near it."
    )
