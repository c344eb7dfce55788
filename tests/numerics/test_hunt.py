"""The properties in this folder hold for many more examples, other ones each time."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = 60


@pytest.mark.slow
@pytest.mark.parametrize("file", ["test_distances.py", "test_costs.py", "test_functions.py"])
def test_many_more_examples_hold(file):
    """As ``PHYSPOSE_EXAMPLES=60 pytest tests/numerics`` does."""
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", str(Path(__file__).parent / file)]
    done = subprocess.run(
        [*command, "-m", "not slow"],
        env={**os.environ, "PHYSPOSE_EXAMPLES": str(EXAMPLES)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout[-3000:]
