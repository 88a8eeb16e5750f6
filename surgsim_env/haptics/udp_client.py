"""A minimal client of `surgsim haptics`: sends poses 1000 times a second and prints the forces.

`python -m surgsim_env.haptics.udp_client` presses 25 mm down and up every four seconds. A real client reads its
device's position instead, and applies the force to the device instead of printing it.
"""

import math
import socket
import sys
import time

import numpy as np

from surgsim_env.haptics.udp import FORCE, PORT, PosePacket, pack_pose, unpack_force

# Time without an answer after which the force is zero [s].
SILENCE = 0.05


def run(port: int, seconds: float, direction: tuple[float, float, float] = (0.0, 0.0, -1.0)) -> float:
    """Press along a direction for a time [s]; returns the largest force received [N]."""
    link = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    link.setblocking(False)
    link.connect(("127.0.0.1", port))
    begin, largest, answered = time.monotonic(), 0.0, -math.inf
    force = np.zeros(3)
    step = 0
    while (now := time.monotonic() - begin) < seconds:
        depth = 0.0125 * (1.0 - math.cos(0.5 * math.pi * now))
        try:
            link.send(pack_pose(PosePacket(step, now, depth * np.array(direction))))
            while (answer := unpack_force(link.recv(FORCE.size + 1))) is not None:
                force, answered = answer.force, now
        except (BlockingIOError, ConnectionRefusedError):
            pass  # no answer yet, or no server yet
        if now - answered > SILENCE:
            force = np.zeros(3)
        largest = max(largest, float(np.linalg.norm(force)))
        if step % 500 == 0:
            print(f"{now:5.1f} s  moved {depth * 1e3:5.1f} mm  force {np.round(force, 3)} N")
        step += 1
        time.sleep(max(0.0, begin + step * 1e-3 - time.monotonic()))
    link.close()
    return largest


if __name__ == "__main__":
    run(int(sys.argv[1]) if len(sys.argv) > 1 else PORT, float(sys.argv[2]) if len(sys.argv) > 2 else 20.0)
