# SPDX-License-Identifier: Apache-2.0
"""What ``import warpmpc`` offers, whatever else has been imported before."""

import importlib
import pkgutil

import pytest
import warp as wp

import warpmpc


def rooms() -> list[str]:
    """All rooms of the package."""
    return [module.name for module in pkgutil.iter_modules(warpmpc.__path__) if module.ispkg]


@pytest.mark.parametrize("name", warpmpc.__all__)
def test_a_public_name_is_what_it_is_after_every_room_was_entered(name):
    """A room of the same name as a function would take its place, and users' terms could not call it."""
    for room in rooms():
        importlib.import_module(f"warpmpc.{room}")
    value = getattr(warpmpc, name)
    assert type(value).__name__ != "module"
    if name.islower() and name not in warpmpc._HOME:
        assert isinstance(value, wp.Function)
    assert name in dir(warpmpc)


def test_a_name_that_is_not_there_is_an_attribute_error():
    with pytest.raises(AttributeError, match="no attribute 'controler'"):
        _ = warpmpc.controler
