"""Instruments as MuJoCo bodies: probe, grasper, jaws, supports and robot arms."""

from surgsim_env.instruments.arm.arm import Arm, load_arm
from surgsim_env.instruments.arm.arm_instrument import ArmInstrument, check_port_outside, parked_place
from surgsim_env.instruments.arm.inverse_kinematics import PoseSolution, solve_pose
from surgsim_env.instruments.arm.model import compile_arm, hold_joints, position_actuator, read_model, read_xml, warned
from surgsim_env.instruments.arm.pair import SIDES, Pair
from surgsim_env.instruments.arm.steering import SteeredArm
from surgsim_env.instruments.arm.urdf import MOMENTS, shape_faults
from surgsim_env.instruments.instrument import Instrument
from surgsim_env.instruments.joint_couplings import (
    Followers,
    followers_of,
    joint_law,
    linear_law,
    narrowed_limits,
)
from surgsim_env.instruments.tool_bodies import CONTACT_GROUP, ToolBodies

__all__ = [
    "CONTACT_GROUP",
    "MOMENTS",
    "SIDES",
    "Arm",
    "ArmInstrument",
    "Followers",
    "Instrument",
    "Pair",
    "PoseSolution",
    "SteeredArm",
    "ToolBodies",
    "check_port_outside",
    "compile_arm",
    "followers_of",
    "hold_joints",
    "joint_law",
    "linear_law",
    "load_arm",
    "narrowed_limits",
    "parked_place",
    "position_actuator",
    "read_model",
    "read_xml",
    "shape_faults",
    "solve_pose",
    "warned",
]
