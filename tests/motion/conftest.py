"""A person and a motion for the tests of this room."""

import pytest
from tests import performer

from marey.body.articulation.surface import Body
from marey.motion.motion import BodyMotion


@pytest.fixture(scope="session")
def person() -> Body:
    return performer.body()


@pytest.fixture(scope="session")
def motion(person: Body) -> BodyMotion:
    return performer.motion(person)
