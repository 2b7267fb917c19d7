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

import dataclasses as dc
from collections.abc import Callable, Sequence

import numpy as np
from pydrake.common.value import AbstractValue, Value
from pydrake.math import RigidTransform
from pydrake.multibody.math import SpatialForce
from pydrake.multibody.plant import MultibodyPlant
from pydrake.multibody.tree import (
    FixedOffsetFrame,
    RevoluteJoint,
    SpatialInertia,
    UnitInertia,
)
from pydrake.systems.framework import (
    CacheEntry,
    Context,
    DependencyTicket,
    DiscreteValues,
    LeafSystem,
    ValueProducer,
)

from sliceit_drake.configuration import ConfigurationError, choice, quantity, validate
from sliceit_drake.systems.compliance_kernel import MODES
from sliceit_drake.systems.compliance_update import (
    ComplianceLaw,
    ComplianceUpdate,
    load_kernels,
)
from sliceit_drake.systems.ur5e_kinematics import KinematicChain

__all__ = ["ComplianceController", "ComplianceControllerConfig", "make_virtual_model"]

_END_EFFECTOR = "end_effector"

# Virtual mass [kg] and moment of inertia [kg m2] of the end effector, moment of inertia of a link.
_END_EFFECTOR_MASS = 1.0
_END_EFFECTOR_INERTIA = 1.0
_LINK_INERTIA = 1e-6

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


def make_virtual_model(chain: KinematicChain, link_mass: float) -> MultibodyPlant:
    """Makes the arm that FDCC moves instead of the real one.

    A point-like mass sits at the origin of every link that a joint moves, and 1 kg with 1 kg m2
    about every axis at the end effector. There is no gravity. If the last link is itself the end
    effector, it has the end effector's inertia alone.

    Args:
        chain: The arm; its base B is the plant's world frame.
        link_mass: Mass [kg] of each moving link.

    Returns:
        The finalized plant, one position [rad] per joint, with a body named ``end_effector``.

    Raises:
        ConfigurationError: If the chain has no joints, or a joint's limits are the wrong way round.
    """
    _check(chain)
    plant = MultibodyPlant(0.0)
    plant.mutable_gravity_field().set_gravity_vector([0.0, 0.0, 0.0])
    parent = plant.world_body()
    end_effector_inertia = _inertia(_END_EFFECTOR_MASS, _END_EFFECTOR_INERTIA)
    for index, joint in enumerate(chain.joints):
        is_end_effector = chain.X_LE is None and index == len(chain.joints) - 1
        link = plant.AddRigidBody(
            _END_EFFECTOR if is_end_effector else joint.name,
            end_effector_inertia if is_end_effector else _inertia(link_mass, _LINK_INERTIA),
        )
        mount = FixedOffsetFrame(f"{joint.name}_mount", parent.body_frame(), joint.X_PL)
        plant.AddJoint(
            RevoluteJoint(
                f"{joint.name}_joint", plant.AddFrame(mount), link.body_frame(), [0.0, 0.0, 1.0]
            )
        )
        parent = link
    if chain.X_LE is not None:
        end_effector = plant.AddRigidBody(_END_EFFECTOR, end_effector_inertia)
        plant.WeldFrames(parent.body_frame(), end_effector.body_frame(), chain.X_LE)
    plant.Finalize()
    return plant


def _inertia(mass: float, moment: float) -> SpatialInertia:
    """Returns the inertia of a body with equal moments [kg m2] about its origin."""
    return SpatialInertia(mass, np.zeros(3), UnitInertia.TriaxiallySymmetric(moment / mass))


def _check(chain: KinematicChain) -> None:
    if not chain.joints:
        raise ConfigurationError("the chain has no joints", field="chain.joints", fix="Give one.")
    for index, joint in enumerate(chain.joints):
        if not joint.lower <= joint.upper:
            raise ConfigurationError(
                f"the limits of {joint.name} are [{joint.lower:.6g}, {joint.upper:.6g}] rad",
                field=f"chain.joints[{index}]",
                fix="Give lower <= upper.",
            )


def _bodies(chain: KinematicChain, link_mass: float) -> tuple[np.ndarray, np.ndarray]:
    """Returns masses [kg] and moments of inertia [kg m2] of the links and the end effector."""
    n = len(chain.joints)
    mass = np.array([link_mass] * n + [_END_EFFECTOR_MASS])
    moment = np.array([_LINK_INERTIA] * n + [_END_EFFECTOR_INERTIA])
    if chain.X_LE is None:
        # The end effector stands for the last link.
        mass[-2] = moment[-2] = 0.0
    return mass, moment


class ComplianceController(LeafSystem):
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
        """Makes the controller of an arm.

        Args:
            config: Mode, steps and values for unconnected ports. Later changes have no effect.
            chain: The arm from B to E.
            X_WB: Pose of the arm's base in the world; None for the identity.
            X_EC: Pose of the compliance reference in E; None for the identity.
            X_ES: Pose of the sensor in E; None for a sensor at the last moving link's frame (the
                tool flange of a UR5e).

        Raises:
            ConfigurationError: If the configuration or the chain is invalid.
        """
        super().__init__()
        validate(config, "compliance_controller")
        _check(chain)
        mass, moment = _bodies(chain, config.link_mass)
        self._law = ComplianceLaw(
            chain=chain,
            mass=mass,
            moment=moment,
            R_EC=(X_EC or RigidTransform()).rotation().matrix(),
            mode=config.mode,
            iterations=1 if config.mode == "force" else config.iterations,
            time_step=config.virtual_time_step,
            damping_factor=config.damping_factor,
            threshold=_KDL_THRESHOLD if config.dead_zones else _ROUNDING_THRESHOLD,
            hand_frame_control=config.hand_frame_control,
        )

        # Here, so that no robot waits for it.
        load_kernels()

        self._X_WB = X_WB or RigidTransform()
        self._X_BW = self._X_WB.inverse().GetAsMatrix34()
        if X_ES is None:
            X_ES = RigidTransform() if chain.X_LE is None else chain.X_LE.inverse()
        self._wrench_C_from_S = _wrench_transform((X_EC or RigidTransform()).InvertAndCompose(X_ES))

        size = len(chain.joints)
        wrench = Value(SpatialForce.Zero())
        self._joint_positions = self.DeclareVectorInputPort("joint_positions", size)
        self._sensor_wrench = self.DeclareAbstractInputPort("sensor_wrench", wrench).get_index()
        self._target_pose = self.DeclareAbstractInputPort("target_pose", Value(RigidTransform()))
        self._target_wrench = self.DeclareAbstractInputPort("target_wrench", wrench).get_index()
        self._stiffness = self._parameter_input("stiffness", config.stiffness)
        self._p_gains = self._parameter_input("p_gains", config.p_gains)
        self._d_gains = self._parameter_input("d_gains", config.d_gains)
        self._selection = self._parameter_input("selection", config.selection)
        self._error_scale = self._parameter_input("error_scale", [config.error_scale])

        # Every use fills this room before it reads anything. It lies in the cache of this system's
        # own context, so that contexts do not disturb each other, in other threads either.
        self._room = self._cache_entry(
            "room for an update",
            lambda context: ComplianceUpdate(self._law),
            {self.nothing_ticket()},
        )
        # A policy changes these far less often than the controller runs, so they are read only when
        # they change (at every update if what feeds them depends on the time).
        self._settings = self._cache_entry(
            "settings",
            self._calc_settings,
            {
                self.input_port_ticket(index)
                for index in (
                    self._target_wrench,
                    self._stiffness[0],
                    self._p_gains[0],
                    self._d_gains[0],
                    self._selection[0],
                    self._error_scale[0],
                )
            },
        )

        self._positions_state = self.DeclareDiscreteState(size)
        self._velocities_state = self.DeclareDiscreteState(size)
        self._error_state = self.DeclareDiscreteState(6)
        self.DeclareStateOutputPort("joint_positions_command", self._positions_state)
        self.DeclareStateOutputPort("joint_velocities_command", self._velocities_state)
        self.DeclareAbstractOutputPort(
            "commanded_pose",
            lambda: Value(RigidTransform()),
            self._calc_commanded_pose,
            {self.discrete_state_ticket(self._positions_state)},
        )
        self.DeclareInitializationDiscreteUpdateEvent(self._activate)
        self.DeclarePeriodicDiscreteUpdateEvent(config.period, 0.0, self._update)

    def _parameter_input(self, name: str, default: Sequence[float]) -> tuple[int, np.ndarray]:
        """Declares an input port; returns its index, and its value while it is not connected."""
        index = self.DeclareVectorInputPort(name, len(default)).get_index()
        return index, np.array(default, dtype=float)

    def _cache_entry(
        self, name: str, calc: Callable[[Context], object], prerequisites: set[DependencyTicket]
    ) -> CacheEntry:
        return self.DeclareCacheEntry(
            name,
            ValueProducer(
                allocate=lambda: Value(object()),
                calc=lambda context, value: value.set_value(calc(context)),
            ),
            prerequisites,
        )

    def _activate(self, context: Context, discrete_state: DiscreteValues) -> None:
        # The previous error is left alone, as in the reference implementation.
        positions = self._joint_positions.Eval(context)
        discrete_state.set_value(self._positions_state, positions)
        discrete_state.set_value(self._velocities_state, np.zeros_like(positions))

    def _update(self, context: Context, discrete_state: DiscreteValues) -> None:
        room: ComplianceUpdate = self._room.Eval(context)
        room.settings[:] = self._settings.Eval(context)
        if self._law.mode != "force":
            target = self._target_pose.Eval(context).GetAsMatrix4()
            self._X_BW.dot(target, out=room.target)
        if self._law.mode != "motion":
            room.sensor_wrench[:] = self._eval_sensor_wrench(context)
        room.measured[:] = self._joint_positions.Eval(context)
        state = context.get_discrete_state()
        room.q[:] = state.value(self._positions_state)
        room.v[:] = state.value(self._velocities_state)
        room.error.reshape(6)[:] = state.value(self._error_state)
        if not room.run():
            raise RuntimeError(
                f"{self.GetSystemPathname()}: the virtual model has no finite acceleration at "
                f"t = {context.get_time():.6g} s (joint positions {room.q} rad, scaled net force "
                f"{room.u.reshape(6)}). An input is not finite, or the loop has diverged: lower "
                "error_scale or the stiffness."
            )
        discrete_state.set_value(self._positions_state, room.q)
        discrete_state.set_value(self._velocities_state, room.v)
        discrete_state.set_value(self._error_state, room.error.reshape(6))

    def _calc_settings(self, context: Context) -> np.ndarray:
        """Returns what `ComplianceUpdate.settings` takes [5, 2, 3]."""

        def axes(port: tuple[int, np.ndarray]) -> np.ndarray:
            return self._parameter(context, port).reshape(2, 3)

        error_scale = self._parameter(context, self._error_scale)
        settings = np.zeros((5, 2, 3))
        settings[0] = axes(self._stiffness)
        settings[1] = axes(self._selection)
        settings[2] = error_scale * axes(self._p_gains)
        settings[3] = error_scale * axes(self._d_gains) / self._law.time_step
        value = self.EvalAbstractInput(context, self._target_wrench)
        if value is not None:
            # Drake's spatial forces have the moment first.
            settings[4] = value.get_value().get_coeffs().reshape(2, 3)[::-1]
            if not self._law.hand_frame_control:
                settings[4] = settings[4].dot(self._X_BW[:, :3].T)
        return settings

    def _parameter(self, context: Context, port: tuple[int, np.ndarray]) -> np.ndarray:
        index, default = port
        vector = self.EvalVectorInput(context, index)
        # The copy outlives the input's value, as a view of it would not.
        return default if vector is None else vector.CopyToVector()

    def _eval_sensor_wrench(self, context: Context) -> np.ndarray:
        """Returns the sensor wrench [2, 3] about Co in C."""
        value = self.EvalAbstractInput(context, self._sensor_wrench)
        if value is None:
            return np.zeros((2, 3))
        return self._wrench_C_from_S.dot(value.get_value().get_coeffs()).reshape(2, 3)

    def _calc_commanded_pose(self, context: Context, output: AbstractValue) -> None:
        room: ComplianceUpdate = self._room.Eval(context)
        room.q[:] = context.get_discrete_state(self._positions_state).value()
        output.set_value(self._X_WB @ RigidTransform(room.place()))


def _wrench_transform(X_CS: RigidTransform) -> np.ndarray:
    """Returns the matrix [6, 6] from a wrench about So in S, moment first, to one about Co in C.

    The result has the force first: f_C = R f_S and tau_C = R tau_S + p x (R f_S).
    """
    R = X_CS.rotation().matrix()
    x, y, z = X_CS.translation()
    p_cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.block([[np.zeros((3, 3)), R], [R, p_cross @ R]])
