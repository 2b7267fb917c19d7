"""Where the arm of the cucumber's scenario stands, and its knife by the controller's own chain."""

import numpy as np
from pydrake.math import RigidTransform, RotationMatrix

from sliceit_drake.systems.ur5e_kinematics import ur5e_chain

# Near the start of scenarios/cucumber_measured.yaml: the edge level, along Wy, 50 mm above the
# board.
START = [1.35559, -1.48188, 1.94802, -2.03694, -1.57079, 1.35559]
BOARD = 0.05
LENGTH = 0.15
X_TK = np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0.21]])
X_WB = np.eye(4)[:3]


def chain_pose(q):
    """X_WK by the chain of the compliance controller."""
    chain = ur5e_chain(RigidTransform(X_TK))
    X = RigidTransform(X_WB)
    for joint, angle in zip(chain.joints, q, strict=True):
        X = X @ joint.X_PL @ RigidTransform(RotationMatrix.MakeZRotation(angle), [0, 0, 0])
    return X @ chain.X_LE
