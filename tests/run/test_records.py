# SPDX-License-Identifier: Apache-2.0
"""Finished jobs on disk: kept at once, read again, and nothing else is taken for them."""

import json

import pytest

from warpmpc.run.records import Records


def test_kept_jobs_survive_a_write_that_was_cut_off(tmp_path):
    records = Records(tmp_path / "new" / "t.jsonl")
    records.add("first", {"seed": 0})
    with open(records.path, "ab") as file:
        file.write(b'{"key": "half')
    records = Records(records.path)
    assert set(records.by_key) == {"first"}
    records.add("second", {"seed": 1})
    assert [json.loads(line)["seed"] for line in records.path.read_text().splitlines()] == [0, 1]
    assert set(Records(records.path).by_key) == {"first", "second"}


@pytest.mark.parametrize("text", ["no JSON\n", "[1, 2]\n", '{"seed": 3}\n', "7\n"])
def test_a_file_of_something_else_is_refused_by_its_line(tmp_path, text):
    file = tmp_path / "t.jsonl"
    file.write_text('{"key": "a"}\n' + text)
    with pytest.raises(ValueError, match=r"t\.jsonl:2: is no record"):
        Records(file)
