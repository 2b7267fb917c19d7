"""Runs the kernels of forward dynamics compliance control on arrays that NumPy shares."""

import dataclasses as dc
from typing import Any

import numpy as np
import warp as wp
from pydrake.math import RigidTransform

from sliceit_drake.cutting.warp_start import start_warp
from sliceit_drake.cutting.workspace import LAUNCH_LOCK
from sliceit_drake.systems.compliance_kernel import MODES, mat34d, place_arm, update_arm
from sliceit_drake.systems.ur5e_kinematics import KinematicChain

__all__ = ["ComplianceLaw", "ComplianceUpdate", "load_kernels"]

_CPU = "cpu"


def load_kernels() -> None:
    """Compiles the kernels, once a machine, and loads them, once a process."""
    with LAUNCH_LOCK:
        start_warp()
        wp.load_module(update_arm.module, device=_CPU)


@dc.dataclass(frozen=True)
class ComplianceLaw:
    """Constants that all updates of a controller share.

    Attributes:
        chain: The arm of n joints, n > 0.
        mass: Virtual masses at the origins of the links and, last, of the end effector [n + 1], kg.
        moment: Moments of inertia about every axis there [n + 1], kg m2.
        R_EC: Rotation of the compliance reference C in the end effector E [3, 3].
        mode: One of `MODES`.
        iterations: Virtual steps of an update.
        time_step: Duration of a virtual step, s.
        damping_factor: Factor on the virtual velocity at each step.
        threshold: A displacement shorter than this [m] counts as zero, and so does a rotation whose
            matrix differs from its transpose by less.
        hand_frame_control: Whether the target wrench is in the axes of E, not of B.
    """

    chain: KinematicChain
    mass: np.ndarray
    moment: np.ndarray
    R_EC: np.ndarray
    mode: str
    iterations: int
    time_step: float
    damping_factor: float
    threshold: float
    hand_frame_control: bool


class ComplianceUpdate:
    """Room for one update at a time: fill in inputs and state, `run`, read the state.

    A call takes nothing from the calls before it. A deep copy is a new room for the same law.
    Pairs of vectors have the translational one first and are in the axes of the arm's base B if
    nothing else is said.

    Attributes:
        measured: Input: measured joint positions [n], rad.
        target: Input: target pose X_BE [3, 4]; not used in force mode.
        sensor_wrench: Input: about Co in C [2, 3]; not used in motion mode.
        settings: Input: stiffness in C, selection, P gains times the error scale, D gains times the
            error scale over the time step, target wrench [5, 2, 3].
        q: State: joint positions of the virtual model [n], rad.
        v: State: their velocities [n], rad per virtual second.
        error: State: net force, or pose error in motion mode [2, 3].
        u: The scaled error of the last step [2, 3].
    """

    def __init__(self, law: ComplianceLaw) -> None:
        self._law = law
        n = len(law.chain.joints)
        self.measured, self.q, self.v = np.zeros((3, n))
        self.target, self.settings = np.zeros((3, 4)), np.zeros((5, 2, 3))
        self.sensor_wrench, self.error, self.u = np.zeros((3, 2, 3))
        self._R_BL, self._p_BL = np.zeros((n + 1, 3, 3)), np.zeros((n + 1, 3))
        self._failed = np.zeros(1, np.int32)
        load_kernels()
        # What is launched during a capture in another thread would be taken for part of it.
        with LAUNCH_LOCK:
            self._capture()

    def __deepcopy__(self, memo: dict[int, Any]) -> "ComplianceUpdate":
        return ComplianceUpdate(self._law)

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

    def _capture(self) -> None:
        law, n = self._law, len(self.q)
        joints = law.chain.joints
        poses = [joint.X_PL for joint in joints] + [law.chain.X_LE or RigidTransform()]
        arm = [
            _shared(self.q),
            _shared(np.array([X.rotation().matrix() for X in poses]), wp.mat33d),
            _shared(np.array([X.translation() for X in poses]), wp.vec3d),
            _shared(self._R_BL, wp.mat33d),
            _shared(self._p_BL, wp.vec3d),
        ]
        inputs = [
            *arm,
            _shared(law.mass),
            _shared(law.moment),
            _shared(np.array([joint.lower for joint in joints])),
            _shared(np.array([joint.upper for joint in joints])),
            MODES.index(law.mode),
            law.iterations,
            law.time_step,
            law.damping_factor,
            law.threshold,
            law.hand_frame_control,
            wp.mat33d(*law.R_EC.ravel()),
            _shared(self.measured),
            _shared(self.target[None], mat34d),
            _shared(self.sensor_wrench, wp.vec3d),
            *(_shared(setting, wp.vec3d) for setting in self.settings),
            _shared(self.v),
            _shared(self.error, wp.vec3d),
            _shared(self.u, wp.vec3d),
            wp.zeros((n, n), dtype=wp.float64, device=_CPU),
            wp.zeros(n, dtype=wp.float64, device=_CPU),
            _shared(self._failed, wp.int32),
        ]
        # The graphs hold addresses alone.
        self._arrays = inputs
        with wp.ScopedCapture(device=_CPU) as place:
            wp.launch(place_arm, dim=1, inputs=arm, device=_CPU)
        with wp.ScopedCapture(device=_CPU) as update:
            wp.launch(update_arm, dim=1, inputs=inputs, device=_CPU)
        self._place, self._update = place.graph, update.graph


def _shared(values: np.ndarray, dtype: Any = wp.float64) -> wp.array:
    """A Warp array in the memory of a NumPy array."""
    return wp.array(values, dtype=dtype, device=_CPU, copy=False)
