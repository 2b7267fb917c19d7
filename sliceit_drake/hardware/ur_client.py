"""A UR robot through ur_rtde.

ur_rtde 1.6.5 keeps silent about much (docs/how_to/hardware.md): its getters return the last values
for ever when the link is gone, servoJ returns True on a dead link, and a lost control link is taken
up again. So freshness comes from the controller's timestamp alone. The program on the robot is
ours (`control_script`), which ur_rtde does not upload anew.
"""

import contextlib
import re
import threading
import time
from collections.abc import Callable
from typing import TypeVar

from sliceit_drake.hardware.client import (
    PLAYING,
    STOPPED,
    RobotFacts,
    RobotState,
    RobotUnavailableError,
)
from sliceit_drake.hardware.control_script import NOTHING, control_script, upload
from sliceit_drake.hardware.hardware_config import SafetyLimits
from sliceit_drake.hardware.supervisor import Supervisor

__all__ = ["LOST", "UrClient"]

RATE = 500.0
DECELERATION = 2.0
"""Deceleration of the fastest joint when a planned motion is stopped, rad/s2."""
START_TIME = 2.0
"""Time in which a program begins to play, s."""
STOP_TIME = 2.0
"""Time in which a program ends that is asked to, s; longer means that the link is dead."""
ATTEMPT = 1.4
"""Time for each of two ways to stop a robot, s: together less than `RobotLink` waits before it
tells the operator that the robot does not answer, and lets go of the connections."""
SLOWEST = 0.2
"""Pace below which no more wall time is given for that."""

LOST: list[object] = []
"""What ur_rtde made for lost links. Its threads connect again and again, even once they are told to
disconnect, and crash the process if it is freed, also at the process's usual end."""

_T = TypeVar("_T")


class UrClient:
    """A connection to a UR e-Series robot; implements `RobotClient`.

    Args:
        host: Name or address.
        lookahead_time: Argument of servoj, s, 0.03 to 0.2.
        gain: Argument of servoj, 100 to 2000.
        limits: Of which the program on the robot keeps step and speed; None for the defaults.
        pace: Controller seconds in a second; 1 for all robots.
        supervisor: Is told when this takes control and when the program is stopped, and limits
            calls that can wait for ever with Python's lock held; None for nobody.

    Raises:
        RobotUnavailableError: Nothing answers there, or it refuses, or ur_rtde is not installed.
    """

    def __init__(
        self,
        host: str,
        lookahead_time: float,
        gain: float,
        limits: SafetyLimits | None = None,
        *,
        pace: float = 1.0,
        supervisor: Supervisor | None = None,
    ) -> None:
        self._supervisor = supervisor
        self._limit = contextlib.nullcontext if supervisor is None else supervisor.limit
        try:
            import dashboard_client
            import rtde_control
            import rtde_receive
        except ImportError as error:
            raise RobotUnavailableError(
                f"ur_rtde is not installed ({error}). Install sliceit_drake[hardware]."
            ) from None
        self._host, self._lookahead, self._gain = host, lookahead_time, gain
        self._is_moving = self._is_stopped = self._was_lost = False
        self._stop_time, self._attempt = (t / max(pace, SLOWEST) for t in (STOP_TIME, ATTEMPT))
        step = "the dashboard server (port 29999), which PolyScope X does not have,"
        try:
            self._dashboard = dashboard_client.DashboardClient(host)
            self._dashboard.connect(2000)
            step = "RTDE (port 30004)"
            self._receive = rtde_receive.RTDEReceiveInterface(host, RATE)
            if not self._receive.isConnected():
                raise RuntimeError("it refuses to stream at 500 Hz; is it an e-Series robot?")
            self._refuse_stopped_robot()
            self._refuse_running_program()
            self._has_raw_wrench = self._shows_raw_wrench()
            step = "taking control (ports 30003 and 30004)"
            kind = rtde_control.RTDEControlInterface
            flags = kind.FLAG_CUSTOM_SCRIPT | kind.FLAG_NO_WAIT
            self._control = kind(host, RATE, flags)
            # ur_rtde keeps the name alone, and reads the file when it has reconnected.
            self._control.setCustomScriptFile(str(NOTHING))
            limits = limits or SafetyLimits()
            script = control_script(limits.joint_step, max(limits.joint_speed))
            if supervisor is not None:
                supervisor.begin()
            try:
                self._script = upload(host, script)
                self._await_program(START_TIME / max(pace, SLOWEST))
            except BaseException:
                # It may play already, or begin yet; so may it where somebody presses Ctrl-C. The
                # supervisor is not told of a stop, and asks once more at the end.
                with contextlib.suppress(RuntimeError):
                    self._dashboard.stop()
                raise
        except (RuntimeError, OSError) as error:
            if isinstance(error, RobotUnavailableError):
                raise
            raise RobotUnavailableError(
                f"{host}: {step} failed: {str(error).strip().rstrip('.')}. Check the address, that "
                "the robot is on, in remote control, and that no other program controls it."
            ) from None

    def _refuse_stopped_robot(self) -> None:
        # Taking control of it would fail after 5 s, with no word about the reason.
        for question, good in (
            ("robotmode", ("RUNNING",)),
            ("safetymode", ("NORMAL", "REDUCED")),
        ):
            answer = getattr(self._dashboard, question)()
            if answer.partition(":")[2].strip() not in good:
                raise RobotUnavailableError(
                    f"{self._host}: the robot reports {answer.strip()}, wanted {good[0]}. Find the "
                    "cause, clear it on the pendant, and see that the arm is on and its brakes are "
                    "released."
                )

    def _refuse_running_program(self) -> None:
        # Taking control would replace it, and stop a robot that works for somebody else. One that
        # is paused would be lost as well.
        deadline = time.monotonic() + self._stop_time
        while not self._has_ended():
            if time.monotonic() > deadline:
                raise RobotUnavailableError(
                    f"{self._host}: a program runs on the robot, or is paused. Whosever it is: "
                    "stop it on the pendant, and start again."
                )
            time.sleep(0.05)

    def _await_program(self, patience: float) -> None:
        deadline = time.monotonic() + patience
        while not self._control.isProgramRunning():
            if time.monotonic() > deadline:
                raise RuntimeError(
                    f"its program does not start in {patience:g} s; the pendant's log may say why"
                )
            time.sleep(0.01)

    def _shows_raw_wrench(self) -> bool:
        # Before PolyScope 5.9 a robot does not have it, and the getter of ur_rtde raises.
        try:
            self._receive.getFtRawWrench()
        except RuntimeError:
            return False
        return True

    def timestamp(self) -> float:
        return self._receive.getTimestamp()

    def read(self) -> RobotState:
        receive = self._receive
        # Each getter takes the newest package; a package may come in between. If one always does,
        # parts of the state are newer than its time stamp, by which alone freshness is judged.
        for _ in range(5):
            before = receive.getTimestamp()
            state = RobotState(
                before,
                receive.getActualQ(),
                receive.getActualQd(),
                receive.getActualTCPForce(),
                receive.getRuntimeState(),
                receive.getSafetyStatusBits(),
                (receive.getPayload(), *receive.getPayloadCog()),
                receive.getTargetQ(),
                receive.getFtRawWrench() if self._has_raw_wrench else None,
                receive.getActualTCPPose(),
                receive.getSpeedScalingCombined(),
                receive.getRobotMode(),
            )
            if receive.getTimestamp() == before:
                break
        return state

    def is_connected(self) -> bool:
        is_there = self._receive.isConnected() and self._control.isConnected()
        self._was_lost |= not is_there
        return is_there

    def _ask(self, call: Callable[..., _T], *arguments: object) -> _T:
        """What a call of ur_rtde's control returns; not one after a lost link: most never return.

        Raises:
            RobotUnavailableError: A connection was lost.
        """
        with self._limit():
            if not self.is_connected() or self._was_lost:
                raise RobotUnavailableError(f"{self._host}: a connection to the robot was lost")
            return call(*arguments)

    def servo(self, q: list[float]) -> bool:
        return self._control.servoJ(q, 0.0, 0.0, 1.0 / RATE, self._lookahead, self._gain)

    def kick(self) -> None:
        self._control.kickWatchdog()

    def set_watchdog(self, frequency: float) -> bool:
        return self._ask(self._control.setWatchdog, frequency)

    def stop(self) -> None:
        self._is_stopped = True
        self._stop()
        if self._supervisor is not None:
            self._supervisor.confirm()

    def _stop(self) -> None:
        """Stops the program in one of two ways; raises RuntimeError where neither is confirmed."""
        before, errors = self._receive.getTimestamp(), []

        def end_program() -> None:
            try:
                if self._is_moving:
                    self._control.stopJ(DECELERATION)
                else:
                    self._control.servoStop()
            except RuntimeError as error:
                errors.append(error)
            self._control.stopScript()

        # While ur_rtde reconnects, a call can end the process. A paused program does not listen.
        listens = self._receive.getRuntimeState() == PLAYING
        if listens and self.is_connected() and not self._was_lost:
            if self._ends(end_program, before) and not errors:
                return
        # The dashboard has a connection of its own, and needs no program that listens.
        if not self._ends(self._stop_by_dashboard, before):
            reason = f" ({errors[0]})" if errors else ""
            raise RuntimeError(f"the robot's program plays or is paused, or no data come{reason}")

    def _stop_by_dashboard(self) -> bool:
        self._dashboard.stop()
        return self._has_ended()

    def _has_ended(self) -> bool:
        """Whether the dashboard knows of no program that plays, nor of one that could go on."""
        dashboard = self._dashboard
        return not dashboard.running() and dashboard.programState().startswith("STOPPED")

    def _ends(self, ask: Callable[[], object], before: float) -> bool:
        """Whether the program ends in time that is asked to, by data newer than `before`, s.

        A paused one has not ended: it goes on when somebody resumes it. What asks may block for
        ever; where it returns True it knows that the program has ended.
        """
        known: list[bool] = []

        def quietly() -> None:
            with contextlib.suppress(RuntimeError):
                known.append(ask() is True)

        asking = threading.Thread(target=quietly, daemon=True)
        asking.start()
        deadline = time.monotonic() + self._attempt
        receive = self._receive
        while receive.getRuntimeState() != STOPPED or receive.getTimestamp() == before:
            if known == [True]:
                return True
            if time.monotonic() > deadline:
                return False
            time.sleep(0.01)
        asking.join(max(0.0, deadline - time.monotonic()))
        return True

    def facts(self) -> RobotFacts:
        dashboard, receive = self._dashboard, self._receive
        version = re.search(r"\d+\.\d+(\.\d+)*", dashboard.polyscopeVersion())
        remote: bool | None = None
        # CB3 and old software do not know the question.
        with contextlib.suppress(RuntimeError):
            remote = dashboard.isInRemoteControl()
        return RobotFacts(
            model=dashboard.getRobotModel().strip(),
            serial=dashboard.getSerialNumber().strip(),
            software=version.group() if version else "",
            robot_mode=dashboard.robotmode().partition(":")[2].strip(),
            safety_mode=dashboard.safetymode().partition(":")[2].strip(),
            remote_control=remote,
            payload=receive.getPayload(),
            payload_cog=receive.getPayloadCog(),
            tcp=self._ask(self._control.getTCPOffset),
            speed_scaling=receive.getSpeedScaling(),
        )

    def zero_sensor(self) -> None:
        if not self._ask(self._control.zeroFtSensor):
            raise RobotUnavailableError(f"{self._host}: the force sensor cannot be zeroed")
        time.sleep(0.1)  # The next readings are of after it.

    def allows_joints(self, q: list[float]) -> bool:
        return self._ask(self._control.isJointsWithinSafetyLimits, q)

    def start_move(self, q: list[float], speed: float, acceleration: float) -> bool:
        self._is_moving = True
        return self._ask(self._control.moveJ, q, speed, acceleration, True)

    def close(self) -> None:
        try:
            if not self._is_stopped:
                self.stop()  # Left alone it would go on with what it does.
        except RuntimeError:
            # The supervisor was told of no stop: at its end it stops the robot, and says so.
            if self._supervisor is None:
                raise
        finally:
            self._disconnect()

    def _disconnect(self) -> None:
        parts = self._control, self._receive, self._dashboard
        if self._was_lost or not self.is_connected():
            LOST.extend(parts)
        for part in parts:
            # A link that is gone already cannot be closed better.
            with contextlib.suppress(RuntimeError), self._limit():
                part.disconnect()
        self._script.close()
