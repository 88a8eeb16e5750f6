"""One served page for all tests of a module."""

import pytest

from surgsim_env.live.exchange_records import Change, Phase
from surgsim_env.live.organ_choice import NONE, OrganChoice
from tests.live.served import Served, wait_until


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    made = Served(tmp_path_factory.mktemp("live") / "out")
    yield made
    made.close()


@pytest.fixture
def fresh(served):
    """The same session with another organ, at rest, tips parked."""
    before = int(served.session.frame()["organ"])
    served.session.park()
    served.session.ask(Change(OrganChoice(lesions=NONE)))

    def renewed() -> bool:
        frame = served.session.frame()
        return int(frame["organ"]) > before and frame["phase"] == Phase.RUNNING

    wait_until(renewed)
