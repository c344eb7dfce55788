"""Every JSON file of a dataset, broken but still JSON, through every command that reads it: told, and nothing half written.
The slow variant prints what came of how many: ``pytest -m slow -s tests/test_corpus_dataset.py``.
"""

import collections

import pytest
from corpus import mutated, mutated_json
from corpus_dataset import files_of, run, without_export, write_everything

FEW = pytest.param(4, id="few")
MANY = pytest.param(400, id="many", marks=pytest.mark.slow)
READ_BY = {
    "planes": ["refine", "report", "eval", "calibrate", "ablate"],
    "statics": ["refine", "report"],
    "targets": ["refine", "report", "eval"],
    "pairs": ["refine --table auto"],
    "calibration": ["refine", "ablate"],
    "camera": ["eval --vsd-depth rendered"],
    "scene_camera": ["refine --table auto", "eval", "eval --vsd-depth rendered"],
    "scene_gt": ["eval", "eval --vsd-depth rendered", "ablate"],
    "scene_gt_info": ["eval --vsd-depth rendered"],
    "models_info": ["eval", "ablate"],
    "scene": ["table"],
}


@pytest.fixture(scope="module")
def everything(tmp_path_factory):
    root = tmp_path_factory.mktemp("data")
    write_everything(root)
    return root, files_of(root)


@pytest.fixture(autouse=True)
def no_export(monkeypatch):
    without_export(monkeypatch)


@pytest.mark.parametrize("name", sorted({name for names in READ_BY.values() for name in names}))
def test_the_files_are_good_before_they_are_broken(everything, name, capsys):
    root, _ = everything
    assert run(root, name) == 0


@pytest.mark.parametrize("count", [FEW, MANY])
@pytest.mark.parametrize(("broken", "name"), [(broken, name) for broken, names in READ_BY.items() for name in names])
def test_broken_json_is_refused_listed_or_read(everything, broken, name, count, capsys, caplog):
    root, files = everything
    whole, outcomes = files[broken].read_bytes(), collections.Counter()
    count = max(count // 8, 2) if "table" in name else count  # a second each
    try:
        for seed in range(count):
            files[broken].write_bytes(mutated(whole, seed) if seed % 4 == 3 else mutated_json(whole, seed))
            caplog.clear()
            capsys.readouterr()
            code = run(root, name)
            told = capsys.readouterr()
            assert code == 0 or caplog.records or "error" in told.out + told.err, f"seed {seed}: not a word"
            outcomes[code] += 1
    finally:
        files[broken].write_bytes(whole)
    with capsys.disabled():
        if count > 10:
            names = {0: "read", 1: "listed", 2: "refused"}
            print(f"\n{broken}, {name}: {count} broken files:", *(f"{names[c]} {n}," for c, n in sorted(outcomes.items())))
