# SPDX-License-Identifier: Apache-2.0
"""The table of bad measurements: a row for each kind, and the exit code of one whose error does not come back."""

import json
import logging

import pytest
from shared import bad_samples as shared
from studies.plants import bad_samples


@pytest.fixture(autouse=True)
def log_level():
    """The table silences warpmpc's log: other tests read it."""
    yield
    logging.getLogger("warpmpc").setLevel(logging.NOTSET)  # empties the cache of levels, too


def test_a_filter_without_a_gate_does_not_come_back_from_what_it_believes(tmp_path, capsys, monkeypatch):
    file, kinds = tmp_path / "figures.json", ["not finite", "5 jumps, large"]
    arguments = ["--seeds", "0:1", "--filters", "constant_velocity", "--kinds", *kinds]
    assert bad_samples.main([*arguments, "--json", str(file)]) == 0
    figures = json.loads(file.read_text())
    assert figures["columns"] == ["bad measurements", "constant_velocity"]
    assert figures["groups"][0]["rows"] == [[kind, "1/1"] for kind in kinds]
    assert "5 jumps, large; constant_velocity: 0.0" in capsys.readouterr().out
    monkeypatch.setattr(shared, "BACK", 0.02)
    estimate = shared.schema.Estimate
    monkeypatch.setattr(shared.schema, "Estimate", lambda **keys: estimate(gate=None, **keys))
    assert bad_samples.main(arguments) == 1


@pytest.mark.parametrize("kind", shared.KINDS)
def test_measurements_are_good_until_the_first_bad_one(kind):
    motion = shared.waved("constant_velocity", 0)
    rows, last = shared.spoilt(motion.measured, shared.KINDS[kind], shared.SENSORS["pose"])
    good = [measured for measured in motion.measured if measured.time < shared.BAD]
    assert [id(measured) for _, measured in rows[: len(good)]] == [id(measured) for measured in good]
    assert [id(measured) for _, measured in rows] != [id(measured) for measured in motion.measured]
    assert shared.BAD <= last < shared.END - shared.BACK
