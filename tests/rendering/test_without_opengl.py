"""OpenGL is loaded when a picture is asked for and not before; where there is none, the error names the packages."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from surgsim_env.rendering import gl

REPOSITORY = Path(__file__).resolve().parents[2]
PACKAGES = "libegl1 libegl-mesa0 libgl1-mesa-dri"
DRAW = """
import gymnasium as gym, surgsim_env
env = gym.make("SurgSim/Palpate-v0", render_mode="rgb_array", width=64, height=48)
env.reset(seed=0)
try:
    print(env.render().shape)
except Exception as error:
    print(type(error).__name__, error)
"""
LOADED = """
import sys
with open("/proc/self/maps") as maps:
    mapped = {line.split("/")[-1].strip() for line in maps if "/lib" in line}
print(sorted(name for name in mapped if name.startswith(("libEGL", "libGL", "libOpenGL", "libOSMesa"))))
print(sorted(name for name in sys.modules if name.split(".")[0] == "OpenGL" or name in ("mujoco.egl", "PIL")))
"""


def run(code: str, **environment: str) -> str:
    """Output of a fresh interpreter, without a display."""
    inherited = {key: value for key, value in os.environ.items() if key not in (*gl.DISPLAYS, gl.VARIABLE)}
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=REPOSITORY,
        env={**inherited, **environment},
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")
def test_nothing_loads_opengl_before_a_picture_is_asked_for(opengl):
    """Import, make, reset and step, also with render_mode; then a picture, which shows that the test would see it."""
    code = """
import gymnasium as gym, numpy as np, surgsim_env
for mode in (None, "rgb_array"):
    env = gym.make("SurgSim/Palpate-v0", render_mode=mode, camera="endoscope")
    env.reset(seed=0)
    env.step(np.zeros(4, dtype=np.float32))
envs = gym.make_vec("SurgSim/Palpate-v0", num_envs=2, vectorization_mode="vector_entry_point", render_mode="rgb_array")
envs.reset(seed=0)
"""
    before, modules, after, _ = run(f"{code}{LOADED}env.render(){LOADED}").splitlines()
    assert before == modules == "[]"
    assert "libEGL" in after


def test_missing_library_names_the_packages(tmp_path):
    """A file that is no library stands before the real one, as good as none."""
    for name in ("libEGL.so.1", "libEGL.so"):
        (tmp_path / name).write_text("not a library")
    output = run(DRAW, LD_LIBRARY_PATH=str(tmp_path))
    assert output.startswith("NoGLError no OpenGL through EGL") and PACKAGES in output and "MUJOCO_GL=egl" in output
