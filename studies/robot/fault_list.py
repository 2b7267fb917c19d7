"""The faults of the table in docs/results/robot_faults.md: what is injected, and when."""

import dataclasses as dc
from collections.abc import Iterator

__all__ = ["AIR", "CONTACT", "Case", "cases"]

AIR, CONTACT = 0.1, 0.55
"""Controller time since the first target, s: the knife goes down in the air, and in the food."""


@dc.dataclass(frozen=True)
class Case:
    """A fault at a time.

    Attributes:
        name: In words, as the table shows it.
        faults: As `sliceit emulate --inject` takes them, all at once; none for a run without.
        at: Controller time since the first target, s.
        signal: Of the client's process then, as "SIGKILL"; empty for none.
        unseen: Why nothing can see it, where nothing can.
    """

    name: str
    faults: tuple[str, ...] = ()
    at: float = CONTACT
    signal: str = ""
    unseen: str = ""

    @property
    def key(self) -> str:
        """What a result is stored under."""
        return f"{self.name}, {'air' if self.at == AIR else 'food'}"


FORCE, RAW = "shows:actual_TCP_force", "shows:ft_raw_wrench"
SLOW_ENOUGH = "it is held against a limit from above, and the edge's speed follows from the joints"
IN_TOLERANCE = "smaller than what the limits allow an honest robot"
_CASES = (
    ("force frozen", f"{FORCE}:frozen"),
    ("force all zero", f"{FORCE}:0"),
    ("force flipped", f"{FORCE}:flipped"),
    ("force 20 N less", f"{FORCE}:+-20"),
    ("force 6 N more", f"{FORCE}:+6"),
    ("force 40 % of itself", f"{FORCE}:*0.4"),
    ("force 2.5 times itself", f"{FORCE}:*2.5"),
    ("force not a number", f"{FORCE}:nan"),
    ("force infinite", f"{FORCE}:inf"),
    ("sensor bias 4 N", "sensor_bias:4", IN_TOLERANCE),
    ("sensor bias 30 N", "sensor_bias:30"),
    ("sensor bias 60 N", "sensor_bias:60"),
    ("raw force frozen", f"{RAW}:frozen"),
    ("raw force zero", f"{RAW}:0"),
    ("raw force flipped", f"{RAW}:flipped"),
    ("raw force 10 N more", f"{RAW}:+10"),
    ("raw force not a number", f"{RAW}:nan"),
    ("joints frozen", "shows:actual_q:frozen"),
    ("joints all zero", "shows:actual_q:0"),
    ("joints 1 mrad more", "shows:actual_q:+0.001"),
    ("joints 10 mrad more", "shows:actual_q:+0.01"),
    ("joints 0.1 rad more", "shows:actual_q:+0.1"),
    ("joints not a number", "shows:actual_q:nan"),
    ("joint speeds zero", "shows:actual_qd:0", SLOW_ENOUGH),
    ("joint speeds flipped", "shows:actual_qd:flipped", SLOW_ENOUGH),
    ("joint speeds 3 rad/s", "shows:actual_qd:3"),
    ("joint speeds not a number", "shows:actual_qd:nan"),
    ("targets frozen", "shows:target_q:frozen"),
    ("targets 10 mrad more", "shows:target_q:+0.01"),
    ("targets not a number", "shows:target_q:nan"),
    ("tool pose frozen", "shows:actual_TCP_pose:frozen"),
    ("tool pose 10 mm more", "shows:actual_TCP_pose:+0.01"),
    ("tool pose not a number", "shows:actual_TCP_pose:nan"),
    ("speed scaling 30 %", "shows:speed_scaling:0.3"),
    ("speed slider 30 %", "shows:target_speed_fraction:0.3"),
    ("speed scaling not a number", "shows:speed_scaling:nan"),
    ("robot mode idle", "shows:robot_mode:5"),
    ("safety bits: recovery", "shows:safety_status_bits:8"),
    ("safety bits: none", "shows:safety_status_bits:0"),
    ("program shown as paused", "shows:runtime_state:4"),
    ("program shown as in an unknown state", "shows:runtime_state:9"),
    ("clock stands", "shows:timestamp:frozen"),
    ("clock back to zero", "shows:timestamp:0"),
    ("clock 1 s ahead", "shows:timestamp:+1"),
    ("clock not a number", "shows:timestamp:nan"),
    ("payload 0.5 kg more", "shows:payload:+0.5"),
    ("payload's centre 50 mm off", "shows:payload_cog:+0.05"),
    ("payload changed on the pendant", "wrong_payload:2"),
    ("silence 0.1 s", "silence:0.1"),
    ("silence 0.5 s", "silence:0.5"),
    ("10 % of packages lost", "drop_packets:0.1", "the next one comes in time"),
    ("50 % of packages lost", "drop_packets:0.5"),
    ("all packages lost", "drop_packets:1"),
    ("packages 4 ms late", "late_packets:0.004", IN_TOLERANCE),
    ("packages 50 ms late", "late_packets:0.05"),
    ("125 Hz", "frequency_125", "four cycles are within the limits of age"),
    ("RTDE closed", "close:rtde"),
    ("RTDE reset", "close:rtde:reset"),
    ("dashboard closed", "close:dashboard", "needed only for a second way to stop"),
    ("script port closed", "close:script", "needed only to begin"),
    ("frame of 0 bytes", "frame_size:0"),
    ("frame of 2 bytes", "frame_size:2"),
    ("frame of 65535 bytes", "frame_size:65535"),
    ("targets 4 ms late", "late_inputs:0.004", IN_TOLERANCE),
    ("targets 60 ms late", "late_inputs:0.06"),
    ("targets 0.2 s late", "late_inputs:0.2"),
    ("a target jumps by 0.1 rad", "jump_inputs:0.1"),
    ("a target jumps by 10 mrad", "jump_inputs:0.01"),
    ("a target jumps by 2 mrad", "jump_inputs:0.002"),
    ("targets shifted by 1 mrad", "shift_inputs:0.001"),
    ("targets shifted by 0.1 rad", "shift_inputs:0.1"),
    ("two targets swapped", "swap_inputs", "the servo averages over more"),
    ("10 % of targets lost", "lose_inputs:0.1", "the next one comes in time"),
    ("half of the targets lost", "lose_inputs:0.5", "the next one comes in time"),
    ("all targets lost", "lose_inputs:1"),
    ("protective stop, program paused", "protective_stop:pause"),
    ("protective stop, program stopped", "protective_stop:stop"),
    ("safeguard stop", "safeguard_stop"),
    ("emergency stop", "emergency_stop"),
    ("program stopped on the pendant", "program_stopped"),
    ("program paused on the pendant", "program_paused"),
    ("local control", "remote_control_off"),
    ("a second client takes free registers", "second_client", "it gets none that are in use"),
    ("arm stuck", "arm_stuck", "targets begin where the arm is measured, and wait there with it"),
)
_IN_AIR = {"force frozen", "force all zero", "force flipped", "raw force frozen", "joints frozen"}
_IN_AIR |= {"silence 0.5 s", "a target jumps by 0.1 rad", "RTDE closed", "arm stuck"}
_SIGNALS = ("SIGINT", "SIGTERM", "SIGHUP", "SIGKILL", "SIGSTOP", "SIGSEGV")


def cases() -> Iterator[Case]:
    """All faults of the table, in its order."""
    for name, fault, *unseen in _CASES:
        case = Case(name, (fault,), unseen=unseen[0] if unseen else "")
        yield case
        if name in _IN_AIR:
            yield dc.replace(case, at=AIR)
    for signal in _SIGNALS:
        yield Case(f"{signal} to the program", signal=signal)
    yield Case("no new connections for 0.5 s", ("refuse:0.5",), unseen="it has its connections")
    yield Case("RTDE closed, no new connections", ("refuse:1", "close:rtde"))
