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
    """Output of a fresh interpreter, without a display, and without what this one chose for its own pictures."""
    own = (*gl.DISPLAYS, gl.VARIABLE, gl.DEVICE, gl.PLATFORM)
    inherited = {key: value for key, value in os.environ.items() if key not in own}
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


COMMAND = """
from surgsim_apps.cli.main import main
assert main(["materials"]) == 0
"""


def test_what_draws_nothing_runs_whatever_mujoco_gl_says(tmp_path):
    """MuJoCo loads OpenGL when it is imported; a library that is none stands for one that is missing."""
    for name in ("libOSMesa.so.8", "libOSMesa.so", "libEGL.so.1", "libEGL.so"):
        (tmp_path / name).write_text("not a library")
    for kind in ("osmesa", "egl", "nonsense"):
        given = {gl.VARIABLE: kind, "LD_LIBRARY_PATH": str(tmp_path)}
        assert "ecoflex_00_10" in run(COMMAND, **given), kind
        output = run(DRAW, **given)
        assert output.startswith("NoGLError") and gl.VARIABLE in output and kind in output.lower(), kind


@pytest.mark.parametrize("name", [gl.DEVICE, gl.PLATFORM])
def test_a_variable_that_is_wrong_is_named_and_no_package(opengl, name):
    output = run(DRAW, **{name: "77"})
    assert output.startswith("NoGLError") and f"{name} is '77'" in output and PACKAGES not in output


def test_missing_library_names_the_packages(tmp_path):
    """A file that is no library stands before the real one, as good as none."""
    for name in ("libEGL.so.1", "libEGL.so"):
        (tmp_path / name).write_text("not a library")
    output = run(DRAW, LD_LIBRARY_PATH=str(tmp_path))
    assert output.startswith("NoGLError no OpenGL through EGL") and PACKAGES in output and "MUJOCO_GL=egl" in output
