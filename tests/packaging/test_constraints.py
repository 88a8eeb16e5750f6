"""constraints.txt names one version of everything that pyproject.toml asks for, within its bounds, for each Python."""

import re
import tomllib

import pytest
from packaging.requirements import Requirement

from tests.packaging.conftest import REPOSITORY

LINES = (REPOSITORY / "constraints.txt").read_text(encoding="utf-8").splitlines()
PROJECT = tomllib.loads((REPOSITORY / "pyproject.toml").read_text(encoding="utf-8"))["project"]
MAKEFILE = (REPOSITORY / "Makefile").read_text(encoding="utf-8")
EXTRAS = re.findall(r"^LOCKED := (.*)$", MAKEFILE, flags=re.MULTILINE)[0].split()
PYTHONS = ["3.11", "3.12", "3.13"]


def same(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def pins(python: str) -> dict[str, str]:
    """The version of each package under a Python on Linux; two for one package would be refused by pip."""
    known: dict[str, str] = {}
    environment = {"python_version": python, "python_full_version": f"{python}.9", "sys_platform": "linux"}
    for line in LINES:
        if line.startswith("#"):
            continue
        requirement = Requirement(line)
        if requirement.marker is None or requirement.marker.evaluate(environment):
            (pin,) = requirement.specifier
            assert pin.operator == "==" and known.setdefault(same(requirement.name), pin.version) == pin.version, line
    return known


@pytest.mark.parametrize("python", PYTHONS)
def test_what_make_installs_is_pinned_within_its_bounds(python):
    known = pins(python)
    assert not known.keys() & {"torch", "triton"}
    asked = [*PROJECT["dependencies"], *(line for extra in EXTRAS for line in PROJECT["optional-dependencies"][extra])]
    for text in asked:
        requirement = Requirement(text)
        if requirement.name != "torch":
            assert requirement.specifier.contains(known.get(same(requirement.name), "0")), f"{text}: run `make lock`"
