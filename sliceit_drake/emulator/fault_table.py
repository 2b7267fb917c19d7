"""The faults that can be injected, as data; what they do is in `faults`."""

import dataclasses as dc

__all__ = ["FAULTS", "Fault", "faults_as_text"]


@dc.dataclass(frozen=True)
class Fault:
    """How a fault is written and what it does.

    Attributes:
        usage: Name, with a colon and what may follow it.
        meaning: Meaning, for people.
        method: Name of the method of `faults.FaultInjector` that does it.
    """

    usage: str
    meaning: str
    method: str


FAULTS = {
    fault.usage.partition(":")[0].rstrip("["): fault
    for fault in (
        Fault(
            "protective_stop[:pause|stop]",
            "the safety system stops the arm; the program is paused or stopped",
            "_protective_stop",
        ),
        Fault("safeguard_stop", "a safeguard opens: the program is paused", "_safeguard_stop"),
        Fault("emergency_stop", "the robot's emergency stop is pushed", "_emergency_stop"),
        Fault("normal", "safety mode normal, arm powered; the program stays as it is", "_normal"),
        Fault("program_stopped", "somebody stops the program on the pendant", "_program_stopped"),
        Fault("program_paused", "somebody pauses it", "_program_paused"),
        Fault("program_resumed", "somebody resumes it", "_program_resumed"),
        Fault(
            "remote_control_off[:keep]",
            "the pendant goes to local control; the program stops (keep: goes on)",
            "_remote_control_off",
        ),
        Fault("remote_control_on", "the pendant goes back to remote control", "_remote_control_on"),
        Fault(
            "silence:SECONDS",
            "the network is cut; afterwards what was sent meanwhile arrives at once",
            "_silence",
        ),
        Fault("drop_packets:SHARE", "a fraction of the data packages gets lost", "_drop_packets"),
        Fault("late_packets:SECONDS", "data packages come late, both ways", "_late_packets"),
        Fault(
            "close:rtde|dashboard|script[:reset]",
            "the connections of a service are closed; clients may connect again",
            "_close",
        ),
        Fault("refuse:SECONDS", "new connections are turned away for a time", "_refuse"),
        Fault(
            "frequency_125", "data packages come with 125 Hz at most, as from a CB3", "_frequency"
        ),
        Fault(
            "wrong_payload:KILOGRAMS",
            "the payload is set to a mass and stays so, whatever clients set",
            "_wrong_payload",
        ),
        Fault(
            "sensor_bias:NEWTONS", "is added to the force along the flange's axis", "_sensor_bias"
        ),
        Fault("model:NAME", "another robot model, as UR10", "_model"),
        Fault(
            "second_client",
            "something else takes the input registers that are still free",
            "_second_client",
        ),
    )
}
"""Faults that can be injected, by name."""


def faults_as_text() -> str:
    """A line for each fault, for help texts."""
    return "\n".join(f"  {fault.usage:<36} {fault.meaning}" for fault in FAULTS.values())
