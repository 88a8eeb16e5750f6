"""The two packets of the UDP protocol between a device's client and a simulation; `docs/haptics.md` has the table."""

import math
import struct
from typing import NamedTuple

import numpy as np

from msdm_core.mesh.tet_mesh import FloatArray

# UDP port of the simulation, in no list of IANA.
PORT = 47801
MAGIC = b"SSHP"
VERSION = 1
KIND_POSE, KIND_FORCE = 1, 2
# Little-endian, without gaps. Magic, version, kind, buttons, sequence, time; position, rotation.
POSE = struct.Struct("<4sBBHId3d4d")
# Magic, version, kind, zero, sequence and time of the answered pose; force.
FORCE = struct.Struct("<4sBBHId3d")
assert FORCE.size <= POSE.size

# Positions farther from the device's origin are refused [m].
POSITION_LARGEST = 10.0
# Tolerance on the length of a rotation's quaternion.
ROTATION_SLACK = 1e-3


class PosePacket(NamedTuple):
    """A pose.

    Fields:
        sequence: increases with each packet, modulo 2^32
        time: on the sender's clock [s]; the answer repeats it
        position: [m], (3,)
        buttons: one bit each, 16 of them
        rotation: unit quaternion (w, x, y, z), or None; checked, and not used in this version
    """

    sequence: int
    time: float
    position: FloatArray
    buttons: int = 0
    rotation: FloatArray | None = None


class ForcePacket(NamedTuple):
    """A force as it travels: sequence and time of the pose that it answers, and the force [N], (3,)."""

    sequence: int
    time: float
    force: FloatArray


def pack_pose(pose: PosePacket) -> bytes:
    """The 76 bytes of a pose."""
    rotation = np.zeros(4) if pose.rotation is None else pose.rotation
    header = (MAGIC, VERSION, KIND_POSE, pose.buttons, pose.sequence, pose.time)
    return POSE.pack(*header, *pose.position.tolist(), *rotation.tolist())


def unpack_pose(data: bytes) -> PosePacket | None:
    """A pose of exactly 76 well-formed bytes; None for anything else."""
    if len(data) != POSE.size:
        return None
    magic, version, kind, buttons, sequence, time, x, y, z, *turn = POSE.unpack(data)
    if magic != MAGIC or version != VERSION or kind != KIND_POSE or not math.isfinite(time):
        return None
    # No comparison with a NaN holds.
    if not all(abs(value) <= POSITION_LARGEST for value in (x, y, z)):
        return None
    rotation = None
    if any(turn):
        if not abs(math.hypot(*turn) - 1.0) <= ROTATION_SLACK:
            return None
        rotation = np.array(turn)
    return PosePacket(sequence, time, np.array((x, y, z)), buttons, rotation)


def pack_force(force: ForcePacket) -> bytes:
    """The 44 bytes of a force."""
    return FORCE.pack(MAGIC, VERSION, KIND_FORCE, 0, force.sequence, force.time, *force.force.tolist())


def unpack_force(data: bytes) -> ForcePacket | None:
    """A force of exactly 44 well-formed bytes; None for anything else."""
    if len(data) != FORCE.size:
        return None
    magic, version, kind, _, sequence, time, *force = FORCE.unpack(data)
    if magic != MAGIC or version != VERSION or kind != KIND_FORCE or not all(map(math.isfinite, (time, *force))):
        return None
    return ForcePacket(sequence, time, np.array(force))


def newer(sequence: int, last: int) -> bool:
    """Whether a sequence number comes after another, modulo 2^32 (RFC 1982)."""
    return 0 < (sequence - last) % 2**32 < 2**31
