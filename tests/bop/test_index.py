"""An indexed result file gives what reading it as a whole gives, whatever it holds, and never takes it into memory."""

import os
import threading
import tracemalloc

import numpy as np
import pytest
import torch
from bop_files import HEADER
from hypothesis import given, settings
from hypothesis import strategies as st

from physpose_torch.bop import index as module
from physpose_torch.bop.formats import read_estimates
from physpose_torch.bop.index import EstimatesIndex
from physpose_torch.errors import DataError

I9 = "1 0 0 0 1 0 0 0 1"


def row(scene, image, obj=1, R=I9, t="10 20 800", score="0.5"):
    return f"{scene},{image},{obj},{score},{R},{t},0.5"


def both(path):
    """(estimates, index) or the messages of their errors."""
    made = []
    for make in (read_estimates, EstimatesIndex):
        try:
            made.append(make(path))
        except DataError as error:
            made.append(str(error))
    return made


def assert_same(path):
    whole, index = both(path)
    if isinstance(whole, str):
        assert index == whole
        return None
    with index:
        assert b"".join(index) == path.read_bytes()
        assert index.lines == len(whole.text)
        part = index.read(np.arange(len(index.keys)))
        for name in ("scene_id", "im_id", "obj_id", "score", "time", "line"):
            np.testing.assert_array_equal(getattr(part, name), getattr(whole, name))
        assert torch.equal(part.T_camera_object, whole.T_camera_object)
        assert [part.text[i] for i in part.place] == [whole.text[i] for i in whole.place]
        assert part.problems == tuple(p for p in whole.problems if None not in (p.scene_id, p.im_id))
        assert index.unplaced == [p.message for p in whole.problems if None in (p.scene_id, p.im_id)]
        keys = list(map(tuple, index.keys.tolist()))
        readable = dict.fromkeys(zip(whole.scene_id.tolist(), whole.im_id.tolist(), strict=True))
        assert keys[: index.usable] == list(readable)
        lost = dict.fromkeys((p.scene_id, p.im_id) for p in part.problems)
        assert keys[index.usable :] == [key for key in lost if key not in readable]
    return whole


@pytest.mark.parametrize("block", [1, 7, 100, 1 << 20])
@pytest.mark.parametrize(
    "content",
    [
        f"{HEADER}\n{row(1, 1)}\n{row(2, 1)}\n{row(1, 1)}\n",
        f"\ufeff{HEADER}\r\n{row(1, 1)}\r\n\r\n{row(1, 2)}\r\n",
        f"{row(1, 1)}\n{row(1, 2)}",
        f"{HEADER}\r{row(1, 1)}\r{row(1, 1)}",
        f"\n\n {HEADER.replace(',', ' , ')}\n{row('07', ' 3 ')}\n\r\n\r",
        f"{HEADER}\n{HEADER}\n{row(1, 1)}\n{row(1, 2, R='2 0 0 0 1 0 0 0 1')}\nüü,1\n{row(1, 3, score='nan')}\n{row(1, 1)}",
        f"{HEADER}\n",
        "",
        "\ufeff \r\n",
        "gibberish\nmore\n",
        f"gibberish\n{HEADER}\n",
        f"scene_id,im_id\n{row(1, 1)}\n",
        f"{HEADER}\n{row(1, 1, t='0.1 0.1 0.8')}\n{row(1, 2, t='0.1 0.1 0.8')}\n{row(1, 3)}\n",
        f"{HEADER}\n{row(1, 1, t='0.1 0.1 0.8')}\n{row(1, 2)}\n{row(1, 3)}\n",
    ],
)
def test_an_index_gives_the_rows_problems_and_errors_of_the_whole_file(tmp_path, monkeypatch, content, block):
    monkeypatch.setattr(module, "_BLOCK", block)
    path = tmp_path / "est.csv"
    path.write_bytes(content.encode())
    assert_same(path)


@settings(max_examples=150, deadline=None)
@given(data=st.data())
def test_whatever_the_file_holds_an_index_agrees_with_reading_it_as_a_whole(tmp_path_factory, data):
    field = st.sampled_from(["48", "1", "", " ", "nan", "0.5", I9, "10 20 800", "1 1 1", "-1", "\ufeff", "\x0c", "٣", "x"])
    line = st.lists(field, min_size=1, max_size=9).map(",".join) | st.builds(
        row, st.integers(1, 2), st.integers(1, 3), t=st.sampled_from(["10 20 800", "0 0 2", "0 0 -700"])
    )
    rows = data.draw(st.lists(line, max_size=8))
    ends = data.draw(st.lists(st.sampled_from(["\n", "\r\n", "\r", ""]), min_size=len(rows), max_size=len(rows)))
    content = data.draw(st.sampled_from(["", HEADER + "\n"])) + "".join(a + b for a, b in zip(rows, ends, strict=True))
    path = tmp_path_factory.getbasetemp() / "index.csv"
    path.write_bytes(content.encode())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "_BLOCK", data.draw(st.integers(1, 60)))
        assert_same(path)


def test_a_file_that_is_not_utf8_is_refused_with_the_place(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_BLOCK", 10)
    path = tmp_path / "est.csv"
    path.write_bytes(f"{HEADER}\n{row(1, 1)}\n".encode() + b"\xff\n")
    whole, index = both(path)
    assert index == whole
    assert "not UTF-8" in index


def test_images_are_read_alone_and_chosen_by_scene_and_order(tmp_path):
    path = tmp_path / "est.csv"
    keys = [(2, 1), (1, 5), (2, 1), (2, 2), (1, 5), (3, 1), (1, 4)]
    path.write_text("\n".join([HEADER, *(row(*key) for key in keys)]))
    with EstimatesIndex(path) as index:
        assert index.keys.tolist() == [[2, 1], [1, 5], [2, 2], [3, 1], [1, 4]]
        assert index.keys[index.choose([1, 2], 2)].tolist() == [[2, 1], [2, 2]]
        assert index.choose([7]).tolist() == []
        some = index.read(index.numbers([(1, 5), (9, 9), (2, 2)]))
        assert (some.line.tolist(), some.im_id.tolist()) == ([3, 5, 6], [5, 2, 5])
        assert len(index.read(np.zeros(0, dtype=np.int64))) == 0


def test_a_file_that_changes_underneath_is_noticed(tmp_path):
    path = tmp_path / "est.csv"
    path.write_text(f"{HEADER}\n{row(1, 1)}\n")
    with EstimatesIndex(path) as index:
        with path.open("a") as file:
            file.write(row(1, 2))
        with pytest.raises(DataError, match=r"est\.csv: the file was changed"):
            index.read(np.array([0]))
        with pytest.raises(DataError, match="changed"):
            list(index)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes")
def test_a_pipe_is_read_like_a_file(tmp_path):
    content = f"{HEADER}\n{row(1, 1)}\n{row(1, 2)}\n"
    os.mkfifo(tmp_path / "pipe")
    writer = threading.Thread(target=(tmp_path / "pipe").write_text, args=(content,))
    writer.start()
    with EstimatesIndex(tmp_path / "pipe") as index:
        assert index.read(np.array([1])).line.tolist() == [3]
        assert b"".join(index).decode() == content
    writer.join()


def test_memory_is_a_few_bytes_a_row(tmp_path):
    """300 bytes a row of text, more than a kilobyte as numbers, if they were kept."""

    def peak(rows):
        path = tmp_path / "est.csv"
        with path.open("w") as file:
            file.writelines(row(k % 7, (k * 7919) % (rows // 10), t=f"{k}e-4 {k}e-5 800.1234567") + "\n" for k in range(rows))
        tracemalloc.start()
        try:
            EstimatesIndex(path).__exit__()
            return tracemalloc.get_traced_memory()[1]
        finally:
            tracemalloc.stop()

    few, many = peak(10_000), peak(60_000)
    assert many - few < 50_000 * 100
