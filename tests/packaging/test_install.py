"""A wheel carries the scenes; an editable install uses those of the checkout, not the copy hatchling leaves."""

import sys
import tarfile
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.packaging.conftest import REPOSITORY, Environment, copy_of_project, run

WHERE = "from surgsim_env.scene.load import scenes_folder; print(scenes_folder())"
LIST = "import surgsim_env.scene.load; print(*surgsim_env.scene.load.list_scenes())"


# What a wheel carries of agents/.
AGENTS = ("policies", "results")


def shipped_files(folder: Path) -> set[str]:
    return {
        path.relative_to(folder).as_posix()
        for path in folder.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }


def test_wheel_holds_the_packages_their_data_and_nothing_else(wheel):
    names = [name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name]
    assert {Path(name).parts[0] for name in names} == {"msdm_core", "surgsim_apps", "surgsim_env"}
    assets = "surgsim_env/assets/"
    shipped = {name.removeprefix(assets) for name in names if name.startswith(assets)}
    agents = {f"agents/{part}/{name}" for part in AGENTS for name in shipped_files(REPOSITORY / "agents" / part)}
    assert shipped == shipped_files(REPOSITORY / "scenes") | agents
    assert not [name for name in names if name.endswith(".pyc")]


def test_archives_of_a_checkout_hold_its_tracked_files_alone(tmp_path):
    project = copy_of_project(tmp_path / "project")
    (project / ".gitignore").write_text("*.log\n")
    git = ["git", "-c", "user.name=x", "-c", "user.email=x@x"]
    for arguments in (["init", "-q"], ["add", "-A"], ["commit", "-q", "-m", "all"]):
        run([*git, *arguments], cwd=project)
    tracked = set(run([*git, "ls-files"], cwd=project).splitlines())
    (project / ".git" / "info" / "exclude").write_text("mine.toml\n")
    for place in ("", "scenes", "scenes/organs", "agents/policies", "agents/results", "surgsim_env/x", "surgsim_apps"):
        (project / place).mkdir(exist_ok=True)
        for name in ("secret.key", ".env", "mine.toml", "new.json", "new.py", "run.log"):
            (project / place / name).write_text("must not ship")
    run([sys.executable, "-m", "build", "--no-isolation", "--outdir", tmp_path / "dist", project])
    run([sys.executable, "-m", "build", "--no-isolation", "--wheel", "--outdir", tmp_path / "wheel", project])
    (archive,), (wheel,), (direct,) = (tmp_path.glob(f"{end}") for end in ("dist/*.gz", "dist/*.whl", "wheel/*.whl"))
    with tarfile.open(archive) as tar:
        assert {name.partition("/")[2] for name in tar.getnames()} == tracked | {"PKG-INFO"}
    names = zipfile.ZipFile(wheel).namelist()
    assert names == zipfile.ZipFile(direct).namelist()
    shipped = ("msdm_core/", "surgsim_env/", "surgsim_apps/", "scenes/", "agents/policies/", "agents/results/")
    assert len([name for name in names if ".dist-info/" not in name]) == sum(
        name.startswith(shipped) for name in tracked
    )


def test_wheel_says_that_its_packages_are_typed(wheel):
    assert {"msdm_core/py.typed", "surgsim_env/py.typed"} <= set(zipfile.ZipFile(wheel).namelist())


def test_installed_wheel_finds_its_scenes(wheel, make_environment, tmp_path, clean_environ):
    environment: Environment = make_environment(tmp_path / "venv")
    environment.install(wheel)
    scenes = Path(run([environment.python, "-c", WHERE], cwd=tmp_path, env=clean_environ).strip())
    assert scenes == environment.site_packages / "surgsim_env" / "assets"
    shipped = sorted(path.name for path in scenes.glob("organs/*.toml"))
    assert shipped == sorted(path.name for path in (REPOSITORY / "scenes").glob("organs/*.toml")) != []
    assert (environment.folder / "bin" / "surgsim").is_file()
    known = run([environment.python, "-c", LIST], cwd=tmp_path, env=clean_environ).split()
    assert [f"{name}.toml" for name in known] == shipped


@pytest.mark.slow
@pytest.mark.agents
def test_installed_wheel_evaluates(wheel, make_environment, tmp_path, clean_environ):
    """Policies by name, from a folder that is no checkout; results stay out of the installation."""
    pytest.importorskip("torch", reason="needs the `agents` extra")
    environment: Environment = make_environment(tmp_path / "venv")
    environment.install(wheel)
    surgsim, here = environment.folder / "bin" / "surgsim", {"cwd": tmp_path, "env": clean_environ}
    common = ["--seeds", "3", "--results", "scores"]
    run([surgsim, "evaluate", "--policy", "palpate_organs", "--scene", "phantom_small", *common], **here)
    run(
        [surgsim, "evaluate", "--policy", "sites_evolved", "--scene", "phantom_small", "--budget", "2", *common], **here
    )
    assert len(list((tmp_path / "scores").glob("*.json"))) == 2
    family = ["--scene", "liver_family", "--level", "standard"]
    compared = run([surgsim, "evaluate", "--compare", "raster_5", "raster_6", *family], **here)
    assert "PalpateSites_liver_family_standard" in compared
    before = set((environment.site_packages / "surgsim_env" / "assets" / "agents" / "results").iterdir())
    assert {path.name for path in before} == {path.name for path in (REPOSITORY / "agents" / "results").iterdir()}


@pytest.mark.slow
def test_editable_install_sees_an_edit_at_once(
    make_environment: Callable[[Path], Environment], tmp_path: Path, clean_environ: dict[str, str]
):
    project = copy_of_project(tmp_path / "project")
    environment = make_environment(tmp_path / "venv")
    environment.install("--editable", project)
    (project / "scenes" / "organs" / "planted.toml").write_text("# new since the installation\n")

    scenes = Path(run([environment.python, "-c", WHERE], cwd=tmp_path, env=clean_environ).strip())

    assert scenes == project / "scenes"
    assert (scenes / "organs" / "planted.toml").is_file()
    stale = environment.site_packages / "surgsim_env" / "assets"
    assert not (stale / "organs" / "planted.toml").exists()
