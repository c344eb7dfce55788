"""The benchmarks on tiny sizes: what they report is there and is right; how long anything takes is nobody's business here."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from physpose_torch.bench import images as bench_images
from physpose_torch.bench import oracle as bench_oracle
from physpose_torch.bench import pairs as bench_pairs_module
from physpose_torch.bench.__main__ import All, Scenes, main, parse
from physpose_torch.bench.growth import (
    GrowthCase,
    bench_growth,
    cake_body,
    cake_image,
    growth_table,
    measure_growth,
    sweep,
)
from physpose_torch.bench.images import ImageSet, load_images
from physpose_torch.bench.machine import describe_machine, find_device
from physpose_torch.bench.oracle import find_oracle
from physpose_torch.bench.pairs import batches_table, bench_batches, bench_pairs, errors_of, pairs_table
from physpose_torch.bench.part_pairs import make_part_pairs
from physpose_torch.bench.plot import plot_costs
from physpose_torch.bench.scenes import bench_scenes, make_config, scenes_table
from physpose_torch.config import RefinerConfig
from physpose_torch.distance.autograd import backends, signed_distance
from physpose_torch.errors import DataError, InvalidInputError
from physpose_torch.geometry.body import Body

CPU = torch.device("cpu")
BACKEND = backends()[-1]


@pytest.fixture(autouse=True)
def few_repeats(monkeypatch):
    monkeypatch.setattr(bench_pairs_module, "LEAST", 0.0)
    monkeypatch.setattr(bench_pairs_module, "REPEATS", 1)


@pytest.fixture(scope="module")
def images():
    return [cake_image(8, 4, seed=seed, overlap=0.0) for seed in range(10)]


@pytest.fixture(scope="module")
def part_pairs(images):
    return make_part_pairs(images, 18, oracle=find_oracle())[0]


def quick_config(**options):
    return replace(make_config("default", BACKEND), steps=4, **options)


# ---- part pairs and their errors


def test_there_are_pairs_of_every_kind(part_pairs):
    apart, touching, deep = part_pairs
    assert [p.kind for p in part_pairs] == ["apart", "touching", "deep"]
    assert [len(p) for p in part_pairs] == [6, 6, 6]
    assert (apart.distance > 0).all()
    assert np.abs(touching.distance).max() < 1e-13
    assert (deep.distance < -1e-5).all()
    assert (deep.distance >= -0.0101).all()
    for pairs in part_pairs:
        assert np.allclose(np.linalg.norm(pairs.normal, axis=1), 1)


def test_the_same_seed_gives_the_same_pairs(images, part_pairs):
    again, _ = make_part_pairs(images, 18, oracle=find_oracle())
    other, _ = make_part_pairs(images, 18, oracle=find_oracle(), seed=1)
    assert torch.equal(again[2].T_b, part_pairs[2].T_b)
    assert not torch.equal(other[2].T_b, part_pairs[2].T_b)


def test_fewer_pairs_than_asked_for_are_said(images):
    sets, notes = make_part_pairs(images[:4], 10**6, oracle=None)
    assert len(notes) == 1
    assert f"{len(sets[0])} apart" in notes[0]


def test_images_without_neighbours_are_an_error():
    with pytest.raises(DataError, match="near each other"):
        make_part_pairs([cake_image(1, 1)], 9, oracle=None)


def test_every_backend_has_a_row_for_every_kind_and_no_error(part_pairs):
    seen = []
    rows = bench_pairs(part_pairs, CPU, judged=True, names=(BACKEND,), on_row=seen.append)
    assert seen == rows
    keys = {(r["dtype"], r["kind"]) for r in rows}
    kinds = ("apart", "touching", "deep", "gradient", "drop")
    assert keys == {(d, k) for d in ("float64", "float32") for k in kinds}
    for row in rows:
        assert row["us_per_pair"] * row["pairs_per_second"] == pytest.approx(1e6)
        if row["kind"] not in ("gradient", "drop"):
            assert row["error_max_m"] < {"float64": 1e-9, "float32": 1e-5}[row["dtype"]]
            assert row["error_p999_m"] <= row["error_max_m"]
            assert (row["wrong_signs"], row["nan"]) == (0, 0)
    assert len(pairs_table(rows).splitlines()) == 2 + len(rows)


def test_a_backend_with_wrong_signs_is_caught(part_pairs, monkeypatch):
    def wrong(*args, **kwargs):
        right = signed_distance(*args, **kwargs)
        return right._replace(distance=-right.distance)

    monkeypatch.setattr(bench_pairs_module, "signed_distance", wrong)
    rows = bench_pairs(part_pairs, CPU, judged=True, names=(BACKEND,))
    signs = {r["kind"]: r["wrong_signs"] for r in rows if r["dtype"] == "float64" and "wrong_signs" in r}
    assert signs == {"apart": 6, "touching": 0, "deep": 6}
    (deep,) = (r for r in rows if (r["dtype"], r["kind"]) == ("float64", "deep"))
    assert deep["error_max_m"] == pytest.approx(2 * np.abs(part_pairs[2].distance).max())


def test_errors_are_counted_each_for_what_it_is():
    truth = np.array([1e-3, 1e-12, -2e-3, 5e-3, 0.0])
    found = np.array([-1e-3, -1e-12, -2.5e-3, np.nan, 1e-9])
    errors = errors_of(found, truth, 1e-9)
    assert (errors["wrong_signs"], errors["nan"]) == (1, 1)  # within the tolerance either sign will do
    assert errors["error_max_m"] == pytest.approx(2e-3)
    only_nan = errors_of(np.array([np.nan]), np.array([1.0]), 1e-9)
    assert (only_nan["error_max_m"], only_nan["nan"]) == (None, 1)


def test_without_an_oracle_there_are_times_only(images):
    sets, _ = make_part_pairs(images, 9, oracle=None)
    rows = bench_pairs(sets, CPU, judged=False, names=(BACKEND,))
    assert not any("error_max_m" in r or "wrong_signs" in r for r in rows)
    assert "  -" in pairs_table(rows)


def test_the_oracle_says_the_same_in_other_processes(part_pairs, monkeypatch):
    pairs = part_pairs[0]
    R, t = pairs.relative()
    monkeypatch.setattr(bench_oracle, "FEW", 1)
    monkeypatch.setattr(bench_oracle, "CHUNK", 4)
    distance, normal = bench_oracle.oracle_distances(find_oracle(), pairs.hulls(), pairs.pairs.numpy(), R, t)
    np.testing.assert_array_equal(distance, pairs.distance)
    np.testing.assert_array_equal(normal, pairs.normal)


def test_python_fcl_is_only_asked_about_pairs_that_are_well_apart(part_pairs):
    pytest.importorskip("fcl")
    rows = bench_pairs(part_pairs, CPU, judged=True, names=("python-fcl",))
    assert [r["kind"] for r in rows] == ["apart > 1 mm"]
    assert rows[0]["pairs"] == (part_pairs[0].distance > 1e-3).sum()
    assert rows[0]["error_max_m"] < 1e-4


def test_coal_is_asked_about_all_pairs(part_pairs):
    pytest.importorskip("coal")
    rows = bench_pairs(part_pairs, CPU, judged=True, names=("coal",))
    assert [r["kind"] for r in rows] == ["apart", "touching", "deep"]
    assert max(r["error_max_m"] for r in rows) < 1e-4


def test_pairs_in_a_call_are_counted(part_pairs):
    rows = bench_batches(part_pairs[0], CPU, names=(BACKEND,))
    assert [r["pairs"] for r in rows] == [1, 10]
    assert len(batches_table(rows).splitlines()) == 4


# ---- images


def test_without_data_there_are_generated_scenes(monkeypatch):
    boxes = {
        n: Body.box((0.06, 0.05, 0.04), label=n) for n in ("mug", "bowl", "box", "can", "bottle", "plate", "banana")
    }
    monkeypatch.delenv("PHYSPOSE_DATA", raising=False)
    monkeypatch.setattr("physpose_torch.demo.household_bodies", lambda: boxes)
    monkeypatch.setattr(bench_images, "ARRANGEMENTS", 2)
    found = load_images(3)
    assert "generated" in found.source
    assert [len(i.scene) for i in found.images] == [len(i.poses) for i in found.images]
    assert not torch.equal(found.images[0].poses, found.images[2].poses)  # one arrangement, other errors


def test_a_data_folder_without_ycbv_is_an_error(tmp_path):
    with pytest.raises(DataError, match="ycbv"):
        load_images(3, data=tmp_path)


# ---- refinements


def test_a_row_for_every_number_of_images(images):
    rows, notes = bench_scenes(images[:3], (1, 4), [("default", quick_config())], CPU, repeats=1, keep_slow=True)
    assert notes == []
    assert [r["images"] for r in rows] == [1, 4]
    assert [r["objects"] for r in rows] == [4, 16]  # three images, cycled
    for row in rows:
        assert (row["backend"], row["preset"], row["repeats"]) == (BACKEND, "default", 1)
        assert row["ms_per_image"] > 0
        assert row["steps_mean"] == 4
    assert len(scenes_table(rows).splitlines()) == 4


def test_a_slow_call_is_not_repeated(images):
    rows, _ = bench_scenes(images, (1,), [("default", quick_config())], CPU, repeats=5, patience=0.0)
    assert rows[0]["repeats"] == 1
    assert np.isnan(rows[0]["ms_per_iteration"])
    assert "  -" in scenes_table(rows)


def test_slow_backends_are_left_out_of_large_batches_and_said_so(images):
    slow = replace(quick_config(), physics=replace(quick_config().physics, backend="fcl"))
    rows, notes = bench_scenes(images, (64,), [("default", slow)], CPU)
    assert rows == []
    assert "fcl with 64 images" in notes[0]


def test_configurations_by_name():
    config = make_config("paper", BACKEND)
    assert config.optimizer == RefinerConfig.paper().optimizer
    assert config.physics.backend == BACKEND
    assert make_config("lm", BACKEND).solver == "lm"
    with pytest.raises(InvalidInputError, match="expected one of default, lm, paper"):
        make_config("best", BACKEND)


# ---- growth


def test_a_sweep_varies_one_size_at_a_time():
    cases = sweep(GrowthCase(parts=8, objects=6, images=4), (1, 2), (3,), (5,))
    assert [(c.varied, c.parts, c.objects, c.images) for c in cases] == [
        ("parts", 1, 6, 4),
        ("parts", 2, 6, 4),
        ("objects", 8, 3, 4),
        ("images", 8, 6, 5),
    ]


@pytest.mark.parametrize("parts", [1, 2, 3, 7])
def test_cut_cans_have_the_parts_asked_for_and_one_outline(parts):
    body = cake_body(parts)
    assert body.parts.n_parts == parts
    whole = body.parts.vertices.amax(0) - body.parts.vertices.amin(0)
    assert whole.tolist() == pytest.approx([0.08, 0.08, 0.04], abs=4e-3)
    volume = sum(m.volume for m in body.parts.to_trimesh())
    assert volume == pytest.approx(np.pi * 0.04**2 * 0.04, rel=0.06)


def test_growth_rows_tell_size_time_memory_and_exponent(monkeypatch):
    monkeypatch.setattr("physpose_torch.bench.growth.STEPS", 4)
    monkeypatch.setattr("physpose_torch.bench.scenes.PATIENCE", 0.0)
    base = GrowthCase(parts=2, objects=2, images=1, backend=BACKEND)
    rows = bench_growth(sweep(base, (1, 2), (), (1,)), isolated=False)
    assert [(r["varied"], r["size"]) for r in rows] == [("parts", 1), ("parts", 2), ("images", 1)]
    assert rows[0]["exponent"] is None
    assert rows[2]["exponent"] is None  # another sweep
    assert all(r["part_pairs"] > 0 and r["peak_mib"] >= 0 and r["resident_before_mib"] > 10 for r in rows)
    assert len(growth_table(rows).splitlines()) == 5


def test_what_does_not_grow_stays_as_it_is_fixed(monkeypatch):
    seen = []
    monkeypatch.setattr("physpose_torch.bench.__main__.bench_growth", lambda cases, **_: seen.extend(cases) or [])
    assert main(["growth", "--parts", "--images", "--objects", "1", "1000", "--fixed", "1", "2", "3"]) == 0
    assert [(c.parts, c.objects, c.images, c.varied) for c in seen] == [(1, 1, 3, "objects"), (1, 1000, 3, "objects")]
    assert main(["growth", "--fixed", "1", "0", "3"]) == 2


@pytest.mark.slow
def test_a_process_of_its_own_measures_the_same_scene():
    case = GrowthCase(parts=1, objects=2, images=1, backend=BACKEND)
    (row,) = bench_growth([case])
    assert row["part_pairs"] == measure_growth(case)["part_pairs"]


# ---- the command


@pytest.fixture
def small(images, monkeypatch):
    found = ImageSet("tiny scenes", images, 0.0, 0.0)
    monkeypatch.setattr("physpose_torch.bench.__main__.load_images", lambda *args, **kwargs: found)


def test_the_command_writes_table_numbers_and_plot(small, tmp_path, capsys):
    out, plot = tmp_path / "bench.json", tmp_path / "bench.png"
    assert main(["pairs", "--pairs", "9", "--backend", BACKEND, "--json", str(out), "--plot", str(plot)]) == 0
    printed = capsys.readouterr().out
    assert "µs/pair" in printed
    assert "tiny scenes" in printed
    written = json.loads(out.read_text())
    assert set(written) >= {"machine", "pairs", "batches", "notes"}
    assert written["machine"]["torch_threads"] == 1
    assert written["machine"]["versions"]["torch"] == torch.__version__
    assert plot.stat().st_size > 10_000


def test_without_a_subcommand_all_is_run():
    assert parse([]) == All()
    assert parse(["--pairs", "9"]) == All(pairs=9)
    assert parse(["scenes", "--images", "1", "16"]) == Scenes(images=(1, 16))


def test_what_was_measured_before_an_error_is_kept(small, tmp_path, monkeypatch):
    monkeypatch.setattr("physpose_torch.bench.__main__.bench_scenes", lambda *_, **__: 1 / 0)
    out = tmp_path / "bench.json"
    with pytest.raises(ZeroDivisionError):
        main(["all", "--pairs", "9", "--backend", BACKEND, "--json", str(out)])
    assert json.loads(out.read_text())["pairs"]


def test_without_the_oracle_the_command_says_so(small, monkeypatch, capsys):
    monkeypatch.setattr("physpose_torch.bench.__main__.find_oracle", lambda: None)
    assert main(["pairs", "--pairs", "9", "--backend", BACKEND]) == 0
    assert "errors need the oracle" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--backend", "bullet"], "--backend bullet"),
        (["pairs", "--pairs", "2"], "--pairs 2"),
        (["scenes", "--images", "0"], "--images"),
        (["growth", "--parts", "0"], "--parts"),
        (["pairs", "--device", "nowhere"], "--device nowhere"),
        (["pairs", "--threads", "0"], "--threads 0"),
    ],
)
def test_wrong_arguments_are_named(small, capsys, arguments, message):
    assert main(arguments) == 2
    assert message in capsys.readouterr().err


def test_a_plot_holds_whatever_was_measured(tmp_path):
    scene = {"backend": "x", "preset": "default", "ms_per_image": 3.0, "ms_per_iteration": 0.5}
    growth = {"varied": "parts", "parts": 1, "objects": 2, "images": 3, "backend": "x", "ms_per_iteration": 1.0}
    results = {
        "machine": {"device": "cpu", "cpu": "abacus", "torch_threads": 1},
        "scenes": [{**scene, "images": n} for n in (1, 16)]
        + [{**scene, "images": 64, "ms_per_iteration": float("nan")}],
        "growth": [{**growth, "size": n} for n in (1, 4)],
    }
    path = tmp_path / "cost.png"
    plot_costs(path, results)
    assert path.stat().st_size > 10_000
    with pytest.raises(InvalidInputError, match="nothing to plot"):
        plot_costs(path, {"machine": {}})
    with pytest.raises(InvalidInputError, match=r"cost\.unknown"):
        plot_costs(tmp_path / "cost.unknown", results)
    plot_costs(tmp_path / "cost", results)
    assert (tmp_path / "cost").read_bytes()[:4] == b"\x89PNG"


def test_a_plot_of_no_known_kind_is_refused_before_the_run(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("physpose_torch.bench.__main__.Pairs.run", None)
    assert main(["pairs", "--backend", BACKEND, "--plot", str(tmp_path / "cost.unknown")]) == 2
    assert "cost.unknown: a picture's name ends in one of" in capsys.readouterr().err


def test_the_machine_is_described():
    machine = describe_machine(find_device("cpu"))
    assert machine["torch_threads"] == torch.get_num_threads()
    assert machine["cpu"]
    json.dumps(machine)
