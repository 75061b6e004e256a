# SPDX-License-Identifier: Apache-2.0
"""The history of benchmarks: appended to, plotted, and what became slower is named."""

import json

import pytest
from benches import history

MACHINE = {"cpu": "a processor", "cores": 2, "gpus": []}


def report(date, plan, ratio, **machine):
    rows = [
        {"title": "push", "where": "2 cores", "plan_ms": {"p50": plan}, "floor_ms": {"p50": 20.0}},
        {"title": "quadruped", "where": "1 core", "ratio": ratio},
        {"title": "lost", "where": "1 core", "error": "left out: no time"},
    ]
    return {"date": date, "machine": {**MACHINE, "load": [0.0], **machine}, "rows": rows}


def add(tmp_path, *measured):
    (tmp_path / "plans.json").write_text(json.dumps(report(*measured)))
    return history.main([str(tmp_path / "history.jsonl"), "--of", str(tmp_path / "plans.json")])


def test_lines_are_appended_and_a_slower_row_is_named(tmp_path, capsys):
    assert add(tmp_path, "2026-01-01", 2.0, 20.0) == 0
    assert add(tmp_path, "2026-01-02", 2.2, 19.0) == 0
    assert add(tmp_path, "2026-01-03", 2.0, 12.0) == 1
    assert "slower: quadruped on 1 core: 12 times its floor, usually 19.5" in capsys.readouterr().out
    lines = history.read(tmp_path / "history.jsonl")
    assert [line["date"] for line in lines] == ["2026-01-01", "2026-01-02", "2026-01-03"]
    assert lines[0]["times_as_fast"] == {"push on 2 cores": 10.0, "quadruped on 1 core": 20.0}


def test_lines_of_another_machine_are_kept_and_not_compared(tmp_path, capsys):
    add(tmp_path, "2026-01-01", 2.0, 20.0)
    (tmp_path / "plans.json").write_text(json.dumps(report("2026-01-02", 4.0, 10.0, cpu="another")))
    file = tmp_path / "history.jsonl"
    assert history.main([str(file), "--of", str(tmp_path / "plans.json")]) == 0
    assert "1 lines of this machine" in capsys.readouterr().out
    assert len(history.read(file)) == 2


def test_all_lines_are_plotted(tmp_path):
    pytest.importorskip("matplotlib")
    add(tmp_path, "2026-01-01", 2.0, 20.0)
    add(tmp_path, "2026-01-02", 2.2, 21.0)
    picture = tmp_path / "history.png"
    assert history.main([str(tmp_path / "history.jsonl"), "--measure", "none", "--plot", str(picture)]) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")


def test_a_line_that_is_none_is_named_and_nothing_is_lost(tmp_path):
    file = tmp_path / "history.jsonl"
    add(tmp_path, "2026-01-01", 2.0, 20.0)
    file.write_text(file.read_text() + "{}\n")
    before = file.read_bytes()
    with pytest.raises(ValueError, match=r"history\.jsonl: line 2 is no line of a history"):
        add(tmp_path, "2026-01-02", 2.2, 21.0)
    assert file.read_bytes() == before


def test_a_report_without_floors_is_refused(tmp_path):
    found = report("2026-01-01", 2.0, 20.0)
    found["rows"] = found["rows"][2:]
    with pytest.raises(ValueError, match="beside its floor"):
        history.entry(found)
