# SPDX-License-Identifier: Apache-2.0
"""Blocks of seeds: a report draws one that nobody has looked at, and none overlaps another."""

import pytest
from shared import seeds


def test_shipped_blocks_of_seeds_do_not_overlap():
    used = seeds.blocks()
    for block, before in zip(used, [seeds.TUNING, *(block.seeds for block in used[:-1])], strict=True):
        assert block.first > before[-1]
        assert len(block.seeds) >= (seeds.COUNT if block.settings else 1)  # one drawn by hand may have fewer


def test_a_report_draws_the_next_block_once(tmp_path):
    file = tmp_path / "seeds.toml"
    file.write_text('[[block]]\nreport = "first"\nfirst = 1000\nlast = 1009\n')
    assert seeds.draw("second", "a", file) == range(1010, 1020)
    assert seeds.draw("second", "a", file) == range(1010, 1020)  # it goes on
    with pytest.raises(ValueError, match="made with other settings"):
        seeds.draw("second", "b", file)
