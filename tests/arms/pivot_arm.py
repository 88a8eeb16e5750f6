"""An arm whose reach is known exactly: two hinges cross at the trocar, a slide runs through it, nothing else."""

import math

from surgsim_env.scene.arm_description import read_description

YAW, PITCH, NEAR, FAR = math.radians(40.0), math.radians(30.0), 0.04, 0.20
OUTER, RADIUS = 0.25, 0.004
EFFORT = (3.0, 2.0, 20.0)

MODEL = f"""<mujoco model="pivot">
  <compiler angle="radian" autolimits="true"/>
  <worldbody>
    <body name="yaw"><inertial pos="0 0 0.1" mass="0.2" diaginertia="0.001 0.001 0.001"/>
      <joint name="yaw" axis="0 1 0" range="{-YAW} {YAW}"/>
      <body name="pitch"><inertial pos="0 0 0.1" mass="0.2" diaginertia="0.001 0.001 0.001"/>
        <joint name="pitch" axis="1 0 0" range="{-PITCH} {PITCH}"/>
        <body name="slide"><inertial pos="0 0 0.1" mass="0.2" diaginertia="0.001 0.001 0.001"/>
          <joint name="slide" type="slide" axis="0 0 -1" range="{NEAR} {FAR}"/>
          <geom name="shaft" type="capsule" fromto="0 0 0 0 0 {OUTER + 0.1}" size="{RADIUS}"/>
          SITES
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
SITE = '<site name="tip" pos="0 0 0"/>'
TABLE = f"""
model = "pivot.xml"
kind = "palpator"
joints = ["yaw", "pitch", "slide"]
contact = ["shaft"]
[tip]
site = "tip"
direction = [0.0, 0.0, -1.0]
[trocar]
shaft_body = "slide"
shaft_axis = [0.0, 0.0, -1.0]
fixed = true
tolerance = 1e-9
[control]
mode = "servo"
speed_limit = [1.0, 1.0, 0.2]
stiffness = [200.0, 200.0, 2000.0]
damping = [10.0, 10.0, 60.0]
effort = [{EFFORT[0]}, {EFFORT[1]}, {EFFORT[2]}]
[home]
yaw = 0.0
pitch = 0.0
slide = 0.1
"""


def write_pivot(folder, *, model=MODEL, table=TABLE, sites=SITE):
    """The path of the arm's TOML file in a folder."""
    (folder / "pivot.xml").write_text(model.replace("SITES", sites))
    (folder / "pivot.toml").write_text(table)
    return folder / "pivot.toml"


def pivot(folder):
    return read_description(write_pivot(folder))


def pivot_coordinates(point):
    """Yaw, pitch and depth that put the tip at a point, the trocar at the origin and the port's frame the world's.

    R_y(a) R_x(b) (0, 0, -d) = d (-sin a cos b, sin b, -cos a cos b).
    """
    x, y, z = point
    depth = math.sqrt(x * x + y * y + z * z)
    return math.atan2(-x, -z), math.asin(y / depth), depth


def pivot_excess(point):
    """Excess of a point over the limits of yaw, pitch [rad] and depth [m]; negative within."""
    yaw, pitch, depth = pivot_coordinates(point)
    return abs(yaw) - YAW, abs(pitch) - PITCH, max(NEAR - depth, depth - FAR)
