"""The faults that can be injected, in words; what they do is in `faults`."""

__all__ = ["FAULTS", "faults_as_text"]

_MEANINGS = {
    "protective_stop[:pause|stop]": (
        "the safety system stops the arm; the program is paused or stopped"
    ),
    "safeguard_stop": "a safeguard opens: the program is paused",
    "emergency_stop": "the robot's emergency stop is pushed",
    "normal": "safety mode normal, arm powered; the program stays as it is",
    "program_stopped": "somebody stops the program on the pendant",
    "program_paused": "somebody pauses it",
    "program_resumed": "somebody resumes it",
    "remote_control_off[:keep]": (
        "the pendant goes to local control; the program stops (keep: goes on)"
    ),
    "remote_control_on": "the pendant goes back to remote control",
    "silence:SECONDS": "the network is cut; afterwards what was sent meanwhile arrives at once",
    "drop_packets:SHARE": "a fraction of the data packages gets lost",
    "late_packets:SECONDS": "data packages come late, both ways",
    "close:rtde|dashboard|script[:reset]": (
        "the connections of a service are closed; clients may connect again"
    ),
    "late_inputs:SECONDS": "what clients send comes late",
    "jump_inputs:RADIANS": "is added to joint 1 of the next target of servoJ, and to no other",
    "shift_inputs:RADIANS": "is added to joint 1 of all that follow",
    "swap_inputs": "the next two targets come the other way round",
    "lose_inputs:SHARE": "a fraction of the targets gets lost",
    "arm_stuck": "the arm stays where it is, whatever the program does",
    "frame_size:BYTES": "the header of the next data package claims a size that is not its own",
    "shows:VARIABLE:frozen|flipped|true|NUMBER|+NUMBER|*NUMBER": (
        "an output variable of RTDE is shown otherwise than it is, each of its elements"
    ),
    "refuse:SECONDS": "new connections are turned away for a time",
    "frequency_125": "data packages come with 125 Hz at most, as from a CB3",
    "wrong_payload:KILOGRAMS": "the payload is set to a mass and stays so, whatever clients set",
    "sensor_bias:NEWTONS": "is added to the force along the flange's axis",
    "model:NAME": "another robot model, as UR10",
    "second_client": "something else takes the input registers that are still free",
}

FAULTS = {usage.partition(":")[0].rstrip("["): usage for usage in _MEANINGS}
"""How each fault is written, by its name: with a colon and what may follow it."""


def faults_as_text() -> str:
    """A line for each fault, for help texts."""
    return "\n".join(f"  {usage:<36} {meaning}" for usage, meaning in _MEANINGS.items())
