# SPDX-License-Identifier: Apache-2.0
"""Docstrings as Markdown: Sphinx's roles become code."""

from __future__ import annotations

import re

import griffe

_ROLE = re.compile(r":(?:class|func|meth|attr|data|mod|exc):`~?([^`]+)`")


def plain(text: str) -> str:
    """The text with ``:class:`~warpmpc.Plan``` and the like as the last part of their names, those of MuJoCo whole."""
    return _ROLE.sub(lambda found: f"`{re.sub(r'^(?!mujoco).*[.]', '', found[1])}`", text)


class Roles(griffe.Extension):
    """Takes the roles out of every docstring."""

    def on_object(self, *, obj: griffe.Object, **_: object) -> None:
        """Mend one docstring."""
        if obj.docstring is not None:
            obj.docstring.value = plain(obj.docstring.value)
