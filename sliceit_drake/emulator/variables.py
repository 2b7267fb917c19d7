"""The variables of UR's Real-Time Data Exchange (RTDE): names, types, and what clients write.

From Universal Robots' "Real-Time Data Exchange (RTDE) guide". The lists hold what the public
clients ask for, not all that ever existed.
"""

from collections.abc import Hashable, Mapping, Sequence

__all__ = [
    "INPUTS",
    "IN_USE",
    "NOT_FOUND",
    "OUTPUTS",
    "TYPES",
    "WHOLE_NUMBERS",
    "InputRegisters",
    "output_type",
    "zero",
]

TYPES = {
    "BOOL": "?",
    "UINT8": "B",
    "UINT32": "I",
    "UINT64": "Q",
    "INT32": "i",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
    "VECTOR6UINT32": "6I",
}
"""Type names of the protocol, and how `struct` writes them."""

WHOLE_NUMBERS = {
    "B": (0, 2**8 - 1),
    "I": (0, 2**32 - 1),
    "Q": (0, 2**64 - 1),
    "i": (-(2**31), 2**31 - 1),
}
"""Least and greatest whole number of a type, by its letter in `struct`."""

NOT_FOUND = "NOT_FOUND"
"""Word in place of the type of a variable that the controller does not have."""

IN_USE = "IN_USE"
"""Word in place of the type of an input that another client holds."""

_OUTPUT_LISTS = {
    "DOUBLE": """timestamp actual_execution_time target_execution_time speed_scaling
        target_speed_fraction actual_momentum actual_main_voltage actual_robot_voltage
        actual_robot_current standard_analog_input0 standard_analog_input1
        standard_analog_output0 standard_analog_output1 io_current tcp_force_scalar
        tool_analog_input0 tool_analog_input1 tool_output_current tool_temperature
        euromap67_24V_voltage euromap67_24V_current joint_position_deviation_ratio
        collision_detection_ratio payload""",
    "VECTOR6D": """target_q target_qd target_qdd target_current target_moment actual_q actual_qd
        actual_current actual_current_window actual_current_as_torque joint_control_output
        actual_TCP_pose actual_TCP_speed actual_TCP_force target_TCP_pose target_TCP_speed
        joint_temperatures actual_joint_voltage tcp_offset ft_raw_wrench
        wrench_calc_from_currents payload_inertia""",
    "VECTOR3D": "actual_tool_accelerometer elbow_position elbow_velocity payload_cog",
    "UINT64": """actual_digital_input_bits actual_digital_output_bits
        actual_configurable_digital_input_bits actual_configurable_digital_output_bits""",
    "INT32": """robot_mode safety_mode safety_status tool_output_voltage encoder0_raw
        encoder1_raw time_scale_source""",
    "VECTOR6INT32": "joint_mode",
    "UINT32": """runtime_state robot_status_bits safety_status_bits analog_io_types
        tool_analog_input_types tool_mode euromap67_input_bits euromap67_output_bits
        script_control_line output_bit_registers0_to_31 output_bit_registers32_to_63
        input_bit_registers0_to_31 input_bit_registers32_to_63""",
    "UINT8": "tool_output_mode tool_digital_output0_mode tool_digital_output1_mode",
}
_INPUT_LISTS = {
    "UINT32": "speed_slider_mask input_bit_registers0_to_31 input_bit_registers32_to_63",
    "DOUBLE": "speed_slider_fraction standard_analog_output_0 standard_analog_output_1",
    "UINT8": """standard_digital_output_mask standard_digital_output
        configurable_digital_output_mask configurable_digital_output tool_digital_output_mask
        tool_digital_output standard_analog_output_mask standard_analog_output_type""",
    "VECTOR6D": "external_force_torque",
}

INPUTS = {name: kind for kind, names in _INPUT_LISTS.items() for name in names.split()}
"""Variables that a client may write, with their types."""
INPUTS |= {f"input_int_register_{i}": "INT32" for i in range(48)}
INPUTS |= {f"input_double_register_{i}": "DOUBLE" for i in range(48)}
INPUTS |= {f"input_bit_register_{i}": "BOOL" for i in range(64, 128)}

OUTPUTS = {name: kind for kind, names in _OUTPUT_LISTS.items() for name in names.split()}
"""Variables that a client may read, with their types; the input registers among them."""
OUTPUTS |= {f"output_int_register_{i}": "INT32" for i in range(48)}
OUTPUTS |= {f"output_double_register_{i}": "DOUBLE" for i in range(48)}
OUTPUTS |= {f"output_bit_register_{i}": "BOOL" for i in range(64, 128)}
OUTPUTS |= {name: kind for name, kind in INPUTS.items() if name.startswith("input_")}

# First software version (major, minor) with a variable; the others are older than all we emulate.
_SINCE = {
    "ft_raw_wrench": (5, 9),
    "payload": (5, 6),
    "payload_cog": (5, 6),
    "payload_inertia": (5, 11),
    "actual_current_as_torque": (5, 23),
}


def output_type(name: str, version: tuple[int, ...]) -> str:
    """Type of an output in a software version (major, minor, ...), or `NOT_FOUND`."""
    if version[:2] < _SINCE.get(name, (0, 0)):
        return NOT_FOUND
    return OUTPUTS.get(name, NOT_FOUND)


def zero(kind: str) -> int | float | bool | tuple:
    """The value 0 of a type; a tuple for vectors."""
    element = {"d": 0.0, "?": False}.get(TYPES[kind][-1], 0)
    return (element,) * int(TYPES[kind][:-1]) if len(TYPES[kind]) > 1 else element


class InputRegisters:
    """Inputs of the controller. Each belongs to the client that first asked for it.

    They keep their values after a package, after their writer has gone, and across programs.

    Attributes:
        values: Value by name.
        written_at: Controller time of the last package with a name, s; only names once written.
    """

    def __init__(self) -> None:
        self.values = {name: zero(kind) for name, kind in INPUTS.items()}
        self.written_at: dict[str, float] = {}
        self._owners: dict[str, Hashable] = {}

    def claim(self, owner: Hashable, names: Sequence[str]) -> list[str]:
        """Asks for inputs by name; they are given only if all can be.

        Returns:
            Their types; `NOT_FOUND` or `IN_USE` for those that cannot be had.
        """
        types = []
        for name in names:
            held = self._owners.get(name, owner) != owner
            types.append(IN_USE if held else INPUTS.get(name, NOT_FOUND))
        if not {IN_USE, NOT_FOUND} & set(types):
            self._owners.update(dict.fromkeys(names, owner))
        return types

    def claim_free(self, owner: Hashable, names: Sequence[str]) -> list[str]:
        """Takes those of `names` that nobody holds, and returns them."""
        free = [name for name in names if name not in self._owners]
        self._owners.update(dict.fromkeys(free, owner))
        return free

    def release(self, owner: Hashable) -> None:
        """Frees all inputs of an owner."""
        self._owners = {name: o for name, o in self._owners.items() if o != owner}

    def write(self, values: Mapping[str, int | float | bool | tuple], time: float) -> None:
        """Sets inputs at a controller time, s."""
        self.values.update(values)
        self.written_at.update(dict.fromkeys(values, time))

    def integer(self, index: int) -> int:
        """input_int_register_<index>."""
        return int(self.values[f"input_int_register_{index}"])  # type: ignore[arg-type]

    def doubles(self, index: int, count: int) -> list[float]:
        """`count` input_double_registers from `index` on."""
        names = (f"input_double_register_{i}" for i in range(index, index + count))
        return [float(self.values[name]) for name in names]  # type: ignore[arg-type]
