"""Forward dynamics compliance control (FDCC) as a Drake system.

Scherzinger, Roennau and Dillmann, "Forward Dynamics Compliance Control (FDCC): A new approach to
cartesian compliance for robotic manipulators", IROS 2017. A virtual model of the arm, nearly all
of whose mass sits at its end effector, is pushed by the net force of a spring to the target pose,
the measured wrench and the target wrench; the joint positions that it reaches are the command. The
steps are those of the authors' cartesian_controllers (commit f53f798), reproduced to rounding.

Inside this module wrenches and pose errors are arrays [2, 3] whose first row is the translational
part and whose second is the rotational one, so that a change of axes is one product from the right:
v_B = v_C @ R_BC.T.
"""

import copy
import dataclasses as dc
from typing import Any

import numpy as np
import warp as wp
from pydrake.common.value import Value
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce
from pydrake.systems.framework import Context, DiscreteValues

from sliceit_drake.configuration import choice, quantity, validate
from sliceit_drake.cutting.kernels.types import mat34d
from sliceit_drake.cutting.warp_start import LAUNCH_LOCK, load_modules, shared, start_warp
from sliceit_drake.systems.compliance_kernel import MODES, place_arm, update_arm
from sliceit_drake.systems.declare import PlainSystem, declare_cached, declare_output
from sliceit_drake.systems.ur5e_kinematics import KinematicChain, virtual_bodies
from sliceit_drake.systems.wrench_sensor import wrench_shift

__all__ = ["ComplianceController", "ComplianceControllerConfig", "ComplianceUpdate"]

_CPU = "cpu"

# Threshold of KDL (orocos_kinematics_dynamics, frames.cpp): shorter vectors count as zero, and
# rotation matrices whose opposite elements differ by less count as symmetric.
_KDL_THRESHOLD = 1e-6
# Without the dead zones the same tests only keep divisions by zero away.
_ROUNDING_THRESHOLD = 1e-12


@dc.dataclass
class ComplianceControllerConfig:
    """How a `ComplianceController` works, and its values for input ports that are not connected.

    Vectors of six have the translational x, y, z first. The defaults of the gains are those of the
    README of cartesian_controllers, without its D gains.
    """

    mode: str = choice("compliance", MODES)
    """compliance: spring plus wrenches. motion: pose error alone, without stiffness. force:
    wrenches alone. parallel: spring and wrenches weighted by the selection."""
    period: float = quantity(0.002, "s", low=1e-4, high=0.1)
    """Time between updates, which is the coupling period."""
    iterations: int = quantity(1, "", low=1, high=100)
    """Virtual steps per update; force mode always takes one."""
    virtual_time_step: float = quantity(0.02, "s", low=1e-4, high=0.1)
    """Virtual time that one step advances the model."""
    damping_factor: float = quantity(0.9, "", low=0.0, high=1.0)
    """Factor on the virtual joint velocity at each step."""
    link_mass: float = quantity(0.1, "kg", low=1e-9, high=10.0)
    """Virtual mass at the origin of each moving link."""
    dead_zones: bool = True
    """Whether pose errors below about 1e-6 m and 5e-7 rad count as zero, as KDL has it."""
    hand_frame_control: bool = False
    """Whether the target wrench is given in the axes of the end effector E, not of the world."""
    error_scale: float = quantity(0.5, "", low=0.0)
    """Factor on the controlled error."""
    stiffness: list[float] = quantity(
        [500.0, 500.0, 500.0, 20.0, 20.0, 20.0], "N/m and Nm/rad", low=0.0, size=6
    )
    """Stiffness along and about the axes of the compliance reference frame C."""
    p_gains: list[float] = quantity([0.05, 0.05, 0.05, 1.5, 1.5, 1.5], "", low=0.0, size=6)
    """Proportional gains along and about the axes of the base B (in motion mode N/m and Nm/rad)."""
    d_gains: list[float] = quantity([0.0] * 6, "s", low=0.0, size=6)
    """Derivative gains, per virtual second, along and about the axes of the base B."""
    selection: list[float] = quantity([1.0, 1.0, 0.5, 1.0, 0.5, 1.0], "", low=0.0, high=1.0, size=6)
    """Weight of the spring in parallel mode (1: position only, 0: force only), along and about the
    axes of the base B. The default is that of the SliceIt! agent."""


def _load_kernels() -> None:
    """Compiles the kernels, once a machine, and loads them, once a process."""
    with LAUNCH_LOCK:
        start_warp()
        load_modules([update_arm.module.name], _CPU)


class ComplianceUpdate:
    """Room for one update at a time: fill in inputs and state, `run`, read the state.

    A call takes nothing from the calls before it. A deep copy is a new room for the same law, with
    the same settings.
    Pairs of vectors have the translational one first and are in the axes of the arm's base B if
    nothing else is said.

    Args:
        config: Mode and steps of the law; the values for input ports are not read.
        chain: The arm of n joints.
        R_EC: Rotation of the compliance reference C in the end effector E [3, 3].
        X_BA: Pose of the frame A in which the target is given [3, 4]; None for B itself.
        to_C: Matrix [6, 6] from the sensor's wrench, as it is given, to force and moment about Co
            in C; None for such.

    Attributes:
        measured: Input: measured joint positions [n], rad.
        target: Input: target pose X_AE [3, 4]; not used in force mode.
        sensor_wrench: Input [6]; not used in motion mode.
        settings: Input: stiffness in C, selection, P gains times the error scale, D gains times the
            error scale over the time step, target wrench [5, 2, 3].
        q: State: joint positions of the virtual model [n], rad.
        v: State: their velocities [n], rad per virtual second.
        error: State: net force, or pose error in motion mode [2, 3].
        moving: State: `v` and `error` in one array [n + 6].
        u: The scaled error of the last step [2, 3].
    """

    def __init__(
        self,
        config: ComplianceControllerConfig,
        chain: KinematicChain,
        R_EC: np.ndarray,
        X_BA: np.ndarray | None = None,
        to_C: np.ndarray | None = None,
    ) -> None:
        self._law = config, chain, R_EC, X_BA, to_C
        n = len(chain.joints)
        self.measured, self.q = np.zeros((2, n))
        # Velocities and error side by side, so that they are copied at once.
        self.moving = np.zeros(n + 6)
        self.v, self.error = self.moving[:n], self.moving[n:].reshape(2, 3)
        self.target, self.settings = np.zeros((3, 4)), np.zeros((5, 2, 3))
        self.sensor_wrench, self.u = np.zeros(6), np.zeros((2, 3))
        self._R_BL, self._p_BL = np.zeros((n + 1, 3, 3)), np.zeros((n + 1, 3))
        self._failed = np.zeros(1, np.int32)
        _load_kernels()
        # What is launched during a capture in another thread would be taken for part of it.
        with LAUNCH_LOCK:
            self._capture(
                config,
                chain,
                R_EC,
                np.eye(3, 4) if X_BA is None else X_BA,
                np.eye(6) if to_C is None else to_C,
            )

    def __deepcopy__(self, memo: dict[int, Any]) -> "ComplianceUpdate":
        room = ComplianceUpdate(*self._law)
        room.settings[:] = self.settings
        return room

    def run(self) -> bool:
        """Advances the state by one update.

        Returns:
            Whether all accelerations were finite; if not, q and u are those of the step that gave
            one that was not.
        """
        wp.capture_launch(self._update)
        return not self._failed[0]

    def place(self) -> np.ndarray:
        """Pose X_BE at q [3, 4]."""
        wp.capture_launch(self._place)
        return np.column_stack([self._R_BL[-1], self._p_BL[-1]])

    def _capture(
        self,
        config: ComplianceControllerConfig,
        chain: KinematicChain,
        R_EC: np.ndarray,
        X_BA: np.ndarray,
        to_C: np.ndarray,
    ) -> None:
        n, joints = len(self.q), chain.joints
        poses = [joint.X_PL for joint in joints] + [chain.X_LE or RigidTransform()]
        arm = [
            shared(self.q),
            shared(np.array([X.rotation().matrix() for X in poses]), wp.mat33d),
            shared(np.array([X.translation() for X in poses]), wp.vec3d),
            shared(self._R_BL, wp.mat33d),
            shared(self._p_BL, wp.vec3d),
        ]
        inputs = [
            *arm,
            *(shared(values) for values in virtual_bodies(chain, config.link_mass)),
            shared(np.array([joint.lower for joint in joints])),
            shared(np.array([joint.upper for joint in joints])),
            MODES.index(config.mode),
            1 if config.mode == "force" else config.iterations,
            config.virtual_time_step,
            config.damping_factor,
            _KDL_THRESHOLD if config.dead_zones else _ROUNDING_THRESHOLD,
            config.hand_frame_control,
            wp.mat33d(*R_EC.ravel()),
            mat34d(*X_BA.ravel()),
            shared(to_C),
            shared(self.measured),
            shared(self.target[None], mat34d),
            shared(self.sensor_wrench),
            *(shared(setting, wp.vec3d) for setting in self.settings),
            shared(self.v),
            shared(self.error, wp.vec3d),
            shared(self.u, wp.vec3d),
            wp.zeros((n, n), dtype=wp.float64, device=_CPU),
            wp.zeros(n, dtype=wp.float64, device=_CPU),
            shared(self._failed, wp.int32),
        ]
        # The graphs hold addresses alone.
        self._arrays = inputs
        with wp.ScopedCapture(device=_CPU) as place:
            wp.launch(place_arm, dim=1, inputs=arm, device=_CPU)
        with wp.ScopedCapture(device=_CPU) as update:
            wp.launch(update_arm, dim=1, inputs=inputs, device=_CPU)
        self._place, self._update = place.graph, update.graph


class ComplianceController(PlainSystem):
    """Turns a target pose, a target wrench and a measured wrench into joint positions.

    Frames: W world, B base of the arm, E end effector (the knife frame K in a station),
    C compliance reference and S sensor, both fixed to E. Vectors of six have translations first.

    Each period the virtual model starts at the measured joint positions and takes `iterations`
    steps of `virtual_time_step`: with the net force e of the mode, in the axes of B,

    - compliance: ``e = K (pose error) + f``,
    - motion: ``e = pose error``,
    - force: ``e = f``, one step,
    - parallel: ``e = S K (pose error) + (1 - S) f``,

    where f is the sum of the sensor wrench and the target wrench, a step is
    ``u = error_scale (p e + d de/dt)``, ``q += v dt``, ``v = damping_factor (v + H^-1 J^T u dt)``,
    and then q is clamped to the position limits. At rest K (target - pose) + f = 0.

    Three properties come from the reference implementation and are kept:

    - The pose in the first error of an update is that of the model after its last step, not that of
      the measured joints (`commanded_pose`).
    - K is taken in the axes of C, p, d and S in those of B.
    - The sensor wrench is moved to the origin of C once, by the fixed transform from S. The moment
      about C then acts as if it were about E.

    The initialization event puts the model at the measured joints, at rest. Run it
    (`Simulator.Initialize`) before the first update. Outputs are functions of the state alone.

    Inputs:
        joint_positions: Measured positions [n] of the n joints [rad].
        sensor_wrench: SpatialForce of the environment on the robot, about So, in S. Zero if not
            connected.
        target_pose: RigidTransform X_WE. Not used in force mode.
        target_wrench: SpatialForce that pulls on the robot, about Eo, in W (in E with
            `hand_frame_control`). Zero if not connected.
        stiffness: [6] N/m and Nm/rad, in C.
        p_gains: [6] in B.
        d_gains: [6] in B [s of virtual time].
        selection: [6] in B; used in parallel mode.
        error_scale: [1].

    Outputs:
        joint_positions_command: [n] [rad].
        joint_velocities_command: [n], rad per *virtual* second. A real second has
            ``iterations * virtual_time_step / period`` virtual ones.
        commanded_pose: RigidTransform X_WE at `joint_positions_command`.

    Args:
        config: Mode, steps and values for unconnected ports. Later changes have no effect.
        chain: The arm from B to E.
        X_WB: Pose of the arm's base in the world; None for the identity.
        X_EC: Pose of the compliance reference in E; None for the identity.
        X_ES: Pose of the sensor in E; None for a sensor at the last moving link's frame (the tool
            flange of a UR5e).

    Raises:
        ConfigurationError: If the configuration or the chain is invalid.
    """

    def __init__(
        self,
        config: ComplianceControllerConfig,
        chain: KinematicChain,
        *,
        X_WB: RigidTransform | None = None,
        X_EC: RigidTransform | None = None,
        X_ES: RigidTransform | None = None,
    ) -> None:
        super().__init__()
        validate(config, "compliance_controller")
        config = self._config = copy.deepcopy(config)
        X_EC = X_EC or RigidTransform()
        R_EC = X_EC.rotation().matrix()

        # Here, so that no robot waits for it.
        _load_kernels()

        self._X_WB = X_WB or RigidTransform()
        self._X_BW = self._X_WB.inverse().GetAsMatrix34()
        if X_ES is None:
            X_ES = RigidTransform() if chain.X_LE is None else chain.X_LE.inverse()
        # A wrench of Drake's has the moment first, here the force is.
        to_C = np.roll(wrench_shift(X_EC.InvertAndCompose(X_ES)), 3, axis=0)

        size = len(chain.joints)
        wrench = Value(SpatialForce.Zero())
        self._joint_positions = self.DeclareVectorInputPort("joint_positions", size)
        self._sensor_wrench = self.DeclareAbstractInputPort("sensor_wrench", wrench)
        self._target_pose = self.DeclareAbstractInputPort("target_pose", Value(RigidTransform()))
        self._target_wrench = self.DeclareAbstractInputPort("target_wrench", wrench)
        # Each with what it is while the port is not connected.
        self._parameters = {
            name: (self.DeclareVectorInputPort(name, len(default)), np.array(default, float))
            for name, default in (
                ("stiffness", config.stiffness),
                ("p_gains", config.p_gains),
                ("d_gains", config.d_gains),
                ("selection", config.selection),
                ("error_scale", [config.error_scale]),
            )
        }

        # Every use fills this room before it reads anything. It lies in the cache of this system's
        # own context, so that contexts do not disturb each other, in other threads either.
        self._room = declare_cached(
            self,
            "room for an update",
            lambda context: ComplianceUpdate(config, chain, R_EC, self._X_BW, to_C),
            {self.nothing_ticket()},
        )
        # The room with the settings in it. A policy changes them far less often than the controller
        # runs, so they are read only when they change (at every update if what feeds them depends
        # on the time).
        setting_ports = [self._target_wrench, *(port for port, _ in self._parameters.values())]
        self._settings = declare_cached(
            self, "settings", self._calc_settings, {port.ticket() for port in setting_ports}
        )

        positions = self.DeclareDiscreteState(size)
        # Velocities, then the error.
        moving = self.DeclareDiscreteState(size + 6)
        # Plain numbers: Drake's indices would be made such in each call.
        self._positions_state, self._moving_state, self._size = int(positions), int(moving), size
        self.DeclareStateOutputPort("joint_positions_command", positions)
        declare_output(
            self,
            "joint_velocities_command",
            size,
            lambda context: context.get_discrete_state().value(self._moving_state)[:size],
            {self.discrete_state_ticket(moving)},
        )
        declare_output(
            self,
            "commanded_pose",
            Value(RigidTransform()),
            self._commanded_pose,
            {self.discrete_state_ticket(positions)},
        )
        self.DeclareInitializationDiscreteUpdateEvent(self._activate)
        self.DeclarePeriodicDiscreteUpdateEvent(config.period, 0.0, self._update)

    def _activate(self, context: Context, discrete_state: DiscreteValues) -> None:
        # The previous error is left alone, as in the reference implementation.
        positions = self._joint_positions.Eval(context)
        discrete_state.set_value(self._positions_state, positions)
        discrete_state.get_mutable_value(self._moving_state)[: self._size] = 0.0

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        room: ComplianceUpdate = self._settings.Eval(context)
        if self._config.mode != "force":
            room.target[:] = self._target_pose.Eval(context).GetAsMatrix34()
        if self._config.mode != "motion":
            has_sensor = self._sensor_wrench.HasValue(context)
            room.sensor_wrench[:] = (
                self._sensor_wrench.Eval(context).get_coeffs() if has_sensor else 0.0
            )
        room.measured[:] = self._joint_positions.Eval(context)
        # They hold the state.
        positions = discrete_state.get_mutable_value(self._positions_state)
        moving = discrete_state.get_mutable_value(self._moving_state)
        room.q[:], room.moving[:] = positions, moving
        if not room.run():
            raise RuntimeError(
                f"{self.GetSystemPathname()}: the virtual model has no finite acceleration at "
                f"t = {context.get_time():.6g} s (joint positions {room.q} rad, scaled net force "
                f"{room.u.reshape(6)}). An input is not finite, or the loop has diverged: lower "
                "error_scale or the stiffness."
            )
        positions[:], moving[:] = room.q, room.moving

    def _calc_settings(self, context: Context) -> ComplianceUpdate:
        """Returns the room, its settings as the ports say."""
        value = {
            name: port.Eval(context) if port.HasValue(context) else default
            for name, (port, default) in self._parameters.items()
        }
        error_scale = value["error_scale"]
        room: ComplianceUpdate = self._room.Eval(context)
        settings = room.settings
        settings[0] = value["stiffness"].reshape(2, 3)
        settings[1] = value["selection"].reshape(2, 3)
        settings[2] = error_scale * value["p_gains"].reshape(2, 3)
        settings[3] = error_scale * value["d_gains"].reshape(2, 3) / self._config.virtual_time_step
        settings[4] = 0.0
        if self._target_wrench.HasValue(context):
            # Drake's spatial forces have the moment first.
            settings[4] = self._target_wrench.Eval(context).get_coeffs().reshape(2, 3)[::-1]
            if not self._config.hand_frame_control:
                settings[4] = settings[4].dot(self._X_BW[:, :3].T)
        return room

    def _commanded_pose(self, context: Context) -> RigidTransform:
        room: ComplianceUpdate = self._room.Eval(context)
        room.q[:] = context.get_discrete_state(self._positions_state).value()
        return self._X_WB @ RigidTransform(room.place())
