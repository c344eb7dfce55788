"""The stress bench: every failure on generated scenes, and how far the covariance is to be believed."""

import json

import pytest

from physpose_torch.bench.__main__ import main
from physpose_torch.bench.stress import coverage
from physpose_torch.config import RefinerConfig
from physpose_torch.demo import household_bodies
from physpose_torch.planted import FAILURES


def test_every_failure_has_a_row_and_accurate_estimates_stay(tmp_path, capsys):
    out = tmp_path / "stress.json"
    assert main(["stress", "--seeds", "2", "--presets", "lm", "--json", str(out)]) == 0
    content = json.loads(out.read_text())
    rows = {row["failure"]: row for row in content["stress"]}
    assert set(rows) <= {"nothing", *(f.label for f in FAILURES)}
    assert len(rows) >= len(FAILURES) - 2  # a scene that has one of everything has no false detection
    assert rows["accurate"]["recall_before"] > 0.99
    assert rows["accurate"]["worse"]["value"] == 0
    assert rows["plane too high"]["change"]["value"] == 0
    assert rows["nothing"]["change"]["value"] > 0.05
    assert rows["nothing"]["better"]["value"] > 0.7
    assert {c["config"] for c in content["coverage"]} == {"usual σ", "calibrated"}
    text = capsys.readouterr().out
    assert all(f"{label}, lm" in text for label in rows)


def test_the_covariance_is_believed_more_where_the_estimators_errors_are_known():
    bodies = household_bodies()
    from physpose_torch.bench.stress import ERRORS

    usual = coverage(range(4), RefinerConfig(), bodies)
    known = coverage(range(4), RefinerConfig().calibrated(ERRORS), bodies)
    assert usual["objects"] > 20
    assert known["pose"] > usual["pose"]
    assert known["pose"] > 0.85
    assert 0.3 < known["mean"] < 1.3


@pytest.mark.parametrize("args", [["--seeds", "0"], ["--data", "."], ["--presets", "none"]])
def test_what_makes_no_sense_is_refused(args, capsys):
    assert main(["stress", *args]) == 2
    assert "error" in capsys.readouterr().err
