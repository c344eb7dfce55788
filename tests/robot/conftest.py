"""Small robots, written for the tests."""

import pytest
from robot_files import TWO_JOINTS


@pytest.fixture
def write(tmp_path):
    """Writes a URDF and returns its path."""

    def to_file(text=TWO_JOINTS, name="robot.urdf"):
        path = tmp_path / name
        path.write_text(text)
        return path

    return to_file


@pytest.fixture
def one_link(write):
    """A robot of one link with the collision geometry that is given."""

    def of(geometry, origin=""):
        return write(
            f'<robot name="r"><link name="a"><collision>{origin}<geometry>{geometry}</geometry></collision></link></robot>'
        )

    return of
