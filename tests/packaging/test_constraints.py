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
        one = Requirement(line)
        if one.marker is None or one.marker.evaluate(environment):
            (pin,) = one.specifier
            assert pin.operator == "==" and known.setdefault(same(one.name), pin.version) == pin.version, line
    return known


@pytest.mark.parametrize("python", PYTHONS)
def test_what_make_installs_is_pinned_within_its_bounds(python):
    known = pins(python)
    assert not known.keys() & {"torch", "triton"}
    asked = [*PROJECT["dependencies"], *(one for extra in EXTRAS for one in PROJECT["optional-dependencies"][extra])]
    for text in asked:
        one = Requirement(text)
        if one.name != "torch":
            assert one.specifier.contains(known.get(same(one.name), "0")), f"{text}: run `make lock`"
