"""Instruments as MuJoCo bodies: probe, grasper, jaws, supports and robot arms."""

from surgsim_env.instruments.arm.arm import Arm, load_arm
from surgsim_env.instruments.arm.arm_instrument import ArmInstrument, check_port_outside, parked_place
from surgsim_env.instruments.arm.inverse_kinematics import PoseSolution, solve_pose
from surgsim_env.instruments.arm.model import compile_arm, position_actuator, read_model, read_xml
from surgsim_env.instruments.arm.pair import SIDES, Pair
from surgsim_env.instruments.arm.steering import SteeredArm
from surgsim_env.instruments.arm.urdf import MESH_FORMATS, find_mesh, mesh_names
from surgsim_env.instruments.instrument import Instrument
from surgsim_env.instruments.joint_couplings import coupled_values, leaders_of, narrowed_limits
from surgsim_env.instruments.tool_bodies import CONTACT_GROUP, ToolBodies

__all__ = [
    "CONTACT_GROUP",
    "MESH_FORMATS",
    "SIDES",
    "Arm",
    "ArmInstrument",
    "Instrument",
    "Pair",
    "PoseSolution",
    "SteeredArm",
    "ToolBodies",
    "check_port_outside",
    "compile_arm",
    "coupled_values",
    "find_mesh",
    "leaders_of",
    "load_arm",
    "mesh_names",
    "narrowed_limits",
    "parked_place",
    "position_actuator",
    "read_model",
    "read_xml",
    "solve_pose",
]
