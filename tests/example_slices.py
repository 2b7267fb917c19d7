"""Synthetic slices for tests of records: a known force on a known motion, and a sensor."""

import numpy as np
from scipy.spatial.transform import Rotation

from sliceit_drake.records.metadata import (
    FoodFacts,
    KnifeFacts,
    NominalMotion,
    Phase,
    SensorFacts,
    SliceMetadata,
    ToolFacts,
    WrenchFacts,
)
from sliceit_drake.records.slice_record import SliceRecord, velocities

HEIGHT = 0.027


def example_metadata() -> SliceMetadata:
    """Metadata of a press-and-draw slice of a cylinder, nothing left out."""
    phases = [
        Phase("air", 0.0, 0.5),
        Phase("slice", 0.5, 1.85),
        Phase("hold", 1.85, 2.1),
        Phase("retract", 2.1, 3.0),
    ]
    return SliceMetadata(
        name="cucumber_00",
        date="2026-03-01",
        provenance="synthetic",
        food=FoodFacts(
            name="cucumber",
            shape="cylinder",
            size=[HEIGHT, 0.12, HEIGHT],
            support="end_slice",
            slice_thickness=0.005,
            peeled=False,
            position=[0.4, 0.1, 0.02],
            yaw=0.0,
        ),
        board_height=0.02,
        knife=KnifeFacts("gazebo", 0.15, 0.059, 3.5e-3, 8e-5, 4e-5, 0.0),
        tool=ToolFacts(mass=0.3, center_of_mass=[0.02, 0.0, -0.06]),
        motion=NominalMotion(speed=0.02, draw_ratio=0.5, phases=phases),
        wrench=WrenchFacts(tared="yes"),
        sensor=SensorFacts(force_range=50.0, torque_range=10.0, rate=500.0),
        condition="press 20 mm/s",
    )


def example_slice(noise: float = 0.1, seed: int = 0) -> SliceRecord:
    """A press with draw at 20 mm/s through 27 mm, a hold and a withdrawal, at 500 Hz.

    The knife presses along -z and draws along its edge; the food pushes back as a semicircle of
    depth, 20 N at most, and not during the withdrawal.
    """
    time = np.arange(0.0, 3.0, 0.002)
    depth = 0.02 * np.interp(time, [0.0, 0.5, 1.85, 2.1, 3.0], [-0.5, 0.0, 1.35, 1.35, -0.9])
    position = np.array([0.4, 0.1, 0.02 + HEIGHT]) + np.outer(depth, [0.5, 0.0, -1.0])
    # The edge points down, Kx along Wx.
    rotation = np.broadcast_to(np.diag([1.0, -1.0, -1.0]), (len(time), 3, 3)).copy()
    v, w = velocities(time, position, rotation)
    size = np.sqrt(np.clip(depth * (HEIGHT - depth), 0.0, None)) / (0.5 * HEIGHT)
    force = 20.0 * np.outer(np.where(time < 2.1, size, 0.0), [-0.4, 0.0, 1.0])
    rng = np.random.default_rng(seed)
    return SliceRecord(
        metadata=example_metadata(),
        time=time,
        position=position,
        rotation=rotation,
        velocity=v,
        angular_velocity=w,
        force=force + noise * rng.normal(size=force.shape),
        torque=np.zeros_like(force) + 0.1 * noise * rng.normal(size=force.shape),
        file="cucumber_00.csv",
    )


def short_press() -> SliceRecord:
    """From 1 mm above the food to 4 mm in it at 50 mm/s."""
    metadata = example_metadata()
    metadata.motion.phases, metadata.motion.speed, metadata.motion.draw_ratio = [], 0.05, 0.0
    time = np.arange(0.0, 0.1, 2e-3)
    position = np.column_stack([0.4 + 0 * time, 0.1 + 0 * time, 0.02 + HEIGHT + 1e-3 - 0.05 * time])
    rotation = np.broadcast_to(np.diag([1.0, -1.0, -1.0]), (len(time), 3, 3)).copy()
    v, w = velocities(time, position, rotation)
    return SliceRecord(metadata, time, position, rotation, v, w, np.zeros((len(time), 3)))


def wrist_motion(time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A smooth motion about all axes with its exact velocities: p_WK, R_WK, v_WK, w_WK."""
    axis = np.array([1.0, 2.0, -0.5]) / np.linalg.norm([1.0, 2.0, -0.5])
    angle, rate = 0.6 * np.sin(3.0 * time), 1.8 * np.cos(3.0 * time)
    rotation = Rotation.from_rotvec(np.outer(angle, axis)).as_matrix() @ np.diag([1.0, -1.0, -1.0])
    position = np.column_stack([0.1 * np.sin(2.0 * time), 0.05 * time, 0.08 * np.cos(4.0 * time)])
    velocity = np.column_stack(
        [0.2 * np.cos(2.0 * time), np.full_like(time, 0.05), -0.32 * np.sin(4.0 * time)]
    )
    return position, rotation, velocity, np.outer(rate, axis)
